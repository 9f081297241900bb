"""Laws of heat beside the thermal network of an arm: cooling strategies, surfaces that people touch, and more."""
