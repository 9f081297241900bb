"""Spaces of one arm, for the single environment and the batch."""

from copy import copy

import numpy as np
from gymnasium import spaces

from fleet.observation import Layout


def arm_spaces(layout: Layout) -> tuple[spaces.Dict, spaces.Discrete]:
    """What one arm observes, and what it may answer."""
    low, high = layout.bounds
    observation = spaces.Dict(
        {
            "observation": spaces.Box(low, high, dtype=np.float32),
            "action_mask": spaces.Box(0, 1, (layout.actions,), dtype=np.int8),
        }
    )
    return observation, spaces.Discrete(layout.actions)


def spaces_like(first: tuple[spaces.Dict, spaces.Discrete]) -> tuple[spaces.Dict, spaces.Discrete]:
    """Spaces with a random generator of their own that share the bounds of others, which are large with many arms."""
    observation, action = first
    return spaces.Dict({name: copy(space) for name, space in observation.items()}), copy(action)
