"""From a scenario to a fleet: plans, trained twins, calibration."""
