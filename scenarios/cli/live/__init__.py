"""Commands of a live fleet."""
