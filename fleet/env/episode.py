"""One shift, ready to run."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fleet.seeds import child
from fleet.sim.kernel import Plant
from fleet.sim.state import World


@dataclass(frozen=True, eq=False)
class Episode:
    """One shift, ready to run."""

    world: World
    plant: Plant
    twins: tuple[str, ...]
    """Version of each arm's difficulty model."""
    sensors: np.random.SeedSequence
    """Of the sensors' noise; its first child is the chance of what becomes of words on their way."""

    @property
    def chance(self) -> np.random.SeedSequence:
        """Of what becomes of words on their way."""
        return child(self.sensors, 0)


EpisodeFactory = Callable[[np.random.SeedSequence], Episode]
"""Makes the episode of a seed; the fleet must be the same for every seed."""
