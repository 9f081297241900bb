"""Reports, figures and tables of a shift."""
