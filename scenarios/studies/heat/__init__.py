"""Studies of heat: ways of cooling."""
