"""Run one shift: the loop, its record, schedule and metrics."""
