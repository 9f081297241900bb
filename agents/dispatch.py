"""Dispatching by worth and time: Smith's rule, with and without an eye on heat."""

from collections.abc import Mapping

import numpy as np

from agents.policy import WAIT
from fleet.env.observation import Observation


class Wspt:
    """The pair of free arm and job with the highest value per time first: weighted shortest processing time.

    Optimal for the weighted sum of completion times on one machine (W. E. Smith, Naval Research Logistics Quarterly 3,
    1956); a strong rule on several unlike ones. It looks at no temperature.
    """

    only_choices = True
    most_p = 1.0
    """No claim above this probability to pass the warning limit."""

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Pair after pair; ties go to the older job, then to the first arm."""
        arms = list(observations)
        worth = np.stack([self._worth(seen) for seen in observations.values()])  # [arm, slot]
        actions = dict.fromkeys(arms, WAIT)
        while np.isfinite(worth).any():
            slot, arm = np.unravel_index(int(np.argmax(worth.T)), worth.T.shape)
            actions[arms[arm]] = int(slot) + 1
            worth[arm, :] = -np.inf
            worth[:, slot] = -np.inf
        return actions

    def _worth(self, seen: Observation) -> np.ndarray:
        """Value per second of every slot, −inf where it is not to be claimed, [slot]."""
        may = seen.action_mask[1:].astype(bool) & (seen.p_saturation <= self.most_p)
        return np.where(may, seen.value / np.maximum(seen.duration_s, 1.0), -np.inf).astype(float)


class WsptCool(Wspt):
    """The same, but an arm leaves what would more likely than not take a motor past the warning limit from now.

    It rests rather than run hot; work that nobody could do coolly waits until somebody can, or for ever.
    """

    only_choices = True
    most_p = 0.5
