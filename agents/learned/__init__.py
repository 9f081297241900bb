"""Policies that are trained: one shared network over sets of jobs and peers, and how it learns."""
