"""The environment for each trainer: one file per trainer, imported by its users only."""
