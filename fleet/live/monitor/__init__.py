"""Participants that only listen: fleet snapshot, health checks, event feed."""
