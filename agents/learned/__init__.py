"""Trained policies: one shared network over sets of jobs and peers, and its training."""
