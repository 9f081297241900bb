"""How far from the best: upper bounds, hindsight search, exact optima of tiny shifts, normalised scores."""
