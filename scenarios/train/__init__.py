"""Training of policies: networks on a scenario or a split, and scores of arm-job pairs by evolution."""
