"""The environment as each trainer wants it: one file per trainer, loaded by nobody but its user."""
