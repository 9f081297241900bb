"""Calibrated probability that a motor passes its warning limit."""
