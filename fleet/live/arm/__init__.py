"""A live arm: state, quotes, awards, execution."""
