"""The PettingZoo environment on the simulation engine."""
