"""A thermal network identified from an arm's own logs, and its observer."""
