"""Decisions: policies that see an observation and nothing else."""
