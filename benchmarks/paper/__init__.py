"""Studies of the paper: `python -m benchmarks.paper STUDY` from the root of a checkout."""
