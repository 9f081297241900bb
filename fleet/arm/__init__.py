"""One arm and its cell in MuJoCo: models, kinematics, motion plans, exclusion of motions, plant."""
