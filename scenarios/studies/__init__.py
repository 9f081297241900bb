"""Research studies of the twin; nothing else depends on them."""
