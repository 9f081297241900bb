"""From a job to joint motion: inverse kinematics, trajectories, limits, collision checks, plan cache."""
