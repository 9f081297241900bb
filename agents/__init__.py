"""Policies: they decide from observations alone."""
