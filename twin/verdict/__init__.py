"""Uncritical or anomalous: verdicts on jobs and recordings."""
