"""Fleets in real time: every participant a process of its own, which meets the others on the bus."""
