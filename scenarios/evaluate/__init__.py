"""Policies judged: studies over fleets, trainings and seeds, their statistics, bounds, and the leaderboard."""
