"""Measurements: speed, faults, whole fleets in one process, and the studies of the paper (`benchmarks.paper`)."""
