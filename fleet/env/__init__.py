"""The PettingZoo environment over the kernel."""
