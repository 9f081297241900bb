"""Intervals and tests of every comparison and study: means, counts, several tests at once, and suites of instances."""
