"""Rival detectors and nominal loads that the twin is compared with."""
