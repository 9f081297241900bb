"""The twin report: the tables and figures of the paper, and the rivals."""
