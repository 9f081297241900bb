"""Uncritical or anomalous: a threshold on a twin's cumulative error with a bounded rate of false alarms."""

from dataclasses import dataclass

import numpy as np

from fleet.errors import FleetError, nearest
from twin.logs.recording import Recording, Stretch, stretches
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


def log_windows(twin: Twin, recording: Recording) -> list[tuple[Stretch, Array, Features]]:
    """Each stretch without gaps with the first samples of its windows, which do not overlap, and their features.

    Raises:
        FleetError: the recording has another number of joints than the twin, or no stretch of one window.
    """
    if recording.joints != twin.joints:
        raise FleetError(f"'{recording.name}' has {recording.joints} joints, the twin of '{twin.arm}' {twin.joints}.")
    config, parts = twin.config, list[tuple[Stretch, Array, Features]]()
    for stretch in stretches(recording, config.rate_hz):
        first = np.arange(0, len(stretch.profile) - config.window + 1, config.window)
        if len(first):
            inside = first[:, None] + np.arange(config.window)
            windows = stretch.profile[inside].transpose(0, 1, 3, 2)
            parts.append((stretch, first, twin.window_features(windows)))
    if not parts:
        raise FleetError(
            f"'{recording.name}' has no stretch of {config.window / config.rate_hz:g} s without a gap, which one "
            "window needs."
        )
    return parts


def log_features(twin: Twin, recording: Recording) -> Features:
    """Mean features of a recording over its windows, [joint]; raises as `log_windows`."""
    parts = [features.packed for _, _, features in log_windows(twin, recording)]
    return Features(np.concatenate(parts).mean(axis=0))
