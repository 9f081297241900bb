"""Trials: policies on scenarios, fleets, trainings and seeds, over many processes, with results that stay."""
