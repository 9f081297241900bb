"""Studies of verdicts: which reading of a twin's errors to use, and how often it is wrong."""
