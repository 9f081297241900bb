"""Studies of a twin over its life: a start from another arm, added synthetic motion, drift and retraining."""
