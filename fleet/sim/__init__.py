"""One engine: kernel, plants and planner. MuJoCo lives here and nowhere else."""
