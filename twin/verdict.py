"""Uncritical or anomalous: a threshold on a twin's cumulative error with a bounded rate of false alarms."""

from dataclasses import dataclass

import numpy as np

from fleet.errors import FleetError, nearest
from twin.log_windows import log_windows
from twin.logs.recording import Recording
from twin.vae.measures import READINGS, Calibration, Features, fewest
from twin.vae.twin import Twin

Array = np.ndarray

UNCRITICAL, ANOMALOUS = "uncritical", "anomalous"


class NoGuarantee(FleetError):
    """The twin's calibration allows no verdict at this rate."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Rule:
    """Motion is anomalous if its p-value is at most alpha.

    A cool job, exchangeable with the cool jobs of one kind that calibrated the twin, is called anomalous with
    probability <= alpha, over the draw of the calibration and the job.

    Raises:
        NoGuarantee: the twin has no calibration, or too few jobs for alpha.
        FleetError: alpha outside (0, 1), or no such reading.
    """

    twin: Twin
    alpha: float = 0.05
    reading: str = "load"
    """One of `READINGS`."""

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 1:
            raise FleetError(f"alpha must be between 0 and 1 (got {self.alpha:g}).")
        if self.reading not in READINGS:
            raise FleetError(f"No reading '{self.reading}'{nearest(self.reading, READINGS)}")
        if self.twin.calibration is None:
            raise NoGuarantee(
                f"The twin of '{self.twin.arm}' has no held-out cool jobs, so a verdict has no guarantee. Train it "
                "with exploration (twin.exploration of the scenario), or on more cool recordings."
            )
        count, wanted = self.twin.calibration.smallest_group, fewest(self.alpha)
        if count < wanted:
            raise NoGuarantee(
                f"A false-alarm rate of {self.alpha:g} needs {wanted} held-out cool jobs of each kind or more (the "
                f"twin of '{self.twin.arm}' has {count}). Choose alpha >= {1 / (count + 1):.3g}, or train on more."
            )

    @property
    def calibration(self) -> Calibration:
        """That of the twin."""
        assert self.twin.calibration is not None
        return self.twin.calibration

    def p_value(self, features: Features) -> Array:
        """p-values of features [..., joint], [...]."""
        return self.calibration.p_value(features, self.twin.joint_weight, self.reading)

    def anomalous(self, features: Features) -> Array:
        """Whether motion is anomalous, bool [...]."""
        return self.p_value(features) <= self.alpha

    @property
    def guarantee(self) -> str:
        """Guarantee of the verdict, as a sentence."""
        kinds = len(np.unique(self.calibration.group))
        return (
            f"At most {self.alpha:.3g} of new cool jobs are called anomalous, if they are like the held-out ones "
            f"({len(self.calibration.group)} jobs of {kinds} kind{'s' * (kinds > 1)})."
        )


def word(anomalous: bool) -> str:
    """The verdict as a word."""
    return ANOMALOUS if anomalous else UNCRITICAL


def log_features(twin: Twin, recording: Recording) -> Features:
    """Mean features of a recording over its windows, [joint]; raises as `log_windows`."""
    parts = [features.packed for _, _, features in log_windows(twin, recording)]
    return Features(np.concatenate(parts).mean(axis=0))
