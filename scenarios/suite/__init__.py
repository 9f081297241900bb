"""The suite: a generator of scenarios with named axes, and frozen splits of instances."""
