"""Thermal laws besides the network of an arm: cooling, limits, insulation, tool drift and surfaces."""
