"""An alarm with a bounded rate of false alarms: split conformal prediction over whole jobs.

The bound holds on average over calibrations, for jobs exchangeable with the calibration jobs, not for motion of another
kind. It rates whole jobs, because windows of one job are not exchangeable.
Source: Vovk, Gammerman & Shafer, Algorithmic Learning in a Random World, 2005, ch. 4; Laxhammar & Falkman 2010.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.errors import FleetError
from twin.conformal import allowed, fewest, rate_interval

Array = np.ndarray


class TooFewJobs(FleetError):
    """Too few jobs for the false-alarm rate."""


@dataclass(frozen=True, kw_only=True)
class ConformalAlarm:
    """Warns of jobs with a score above almost all jobs without the event."""

    alpha: float
    """Bound on the rate of false alarms, (0, 1)."""
    scores: tuple[float, ...]
    """Scores of the calibration jobs, none of which had the event, ascending."""

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 1:
            raise ValueError(f"ConformalAlarm.alpha must be between 0 and 1 (got {self.alpha}).")
        if not np.isfinite(self.scores).all():
            raise ValueError("ConformalAlarm.scores must be finite.")
        if list(self.scores) != sorted(self.scores):
            raise ValueError("ConformalAlarm.scores must be sorted.")
        if self._allowed() < 1:
            raise TooFewJobs(
                f"A false-alarm rate of {self.alpha:g} needs {fewest(self.alpha)} or more jobs without the event "
                f"(got {len(self.scores)}). Collect more jobs, or choose a larger alpha."
            )

    @classmethod
    def fit(cls, scores: Sequence[float] | Array, alpha: float = 0.05) -> "ConformalAlarm":
        """The alarm from scores [job] of jobs without the event that the score was not fitted on.

        Raises:
            TooFewJobs: fewer than 1/alpha − 1.
            ValueError: alpha outside (0, 1), or scores that are not finite.
        """
        return cls(alpha=alpha, scores=tuple(np.sort(np.asarray(scores, dtype=float)).tolist()))

    @property
    def threshold(self) -> float:
        """The alarm is raised above this score."""
        return self.scores[-self._allowed()]

    def __call__(self, score: Array) -> Array:
        """Whether to warn, bool of the same shape as the scores; true for NaN."""
        return ~(np.asarray(score, dtype=float) <= self.threshold)

    def spread(self, confidence: float = 0.9) -> tuple[float, float]:
        """Interval of the rate of false alarms of this one calibration; see `twin.conformal.rate_interval`."""
        return rate_interval(len(self.scores), self.alpha, confidence)

    def _allowed(self) -> int:
        """How far from the top the threshold lies."""
        return allowed(len(self.scores), self.alpha)
