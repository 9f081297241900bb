"""Motion of one arm: hold times, generation, posture recovery."""
