"""The suite: a generator of scenarios with named axes, and fixed splits of instances."""
