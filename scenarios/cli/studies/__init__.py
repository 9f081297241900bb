"""Commands of studies of the twin."""
