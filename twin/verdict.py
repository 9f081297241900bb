"""Uncritical or anomalous: a threshold on a twin's cumulative error with a bounded rate of false alarms."""

import math
from dataclasses import dataclass

import numpy as np

from fleet.errors import FleetError, nearest
from fleet.motion import CHANNELS
from twin.log_windows import log_windows
from twin.logs.recording import Recording
from twin.vae.measures import PARTS, READINGS, Calibration, Features, fewest
from twin.vae.twin import Twin

Array = np.ndarray

UNCRITICAL, ANOMALOUS = "uncritical", "anomalous"


class NoGuarantee(FleetError):
    """The twin's calibration allows no verdict at this rate."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Rule:
    """Motion is anomalous if its p-value is at most alpha.

    A cool job, exchangeable with the cool jobs of one kind that calibrated the twin, is called anomalous with
    probability <= alpha, over the draw of the calibration and the job. With the reading `latent` this is approximate:
    the cluster from which it measures distances is that of the calibrating jobs themselves.

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
                "with exploration (twin.exploration of the scenario), or with a larger --hold-out or more cool logs."
            )
        count, wanted = self.twin.calibration.smallest_group, fewest(self.alpha)
        if count < wanted:
            least = math.ceil(1e4 / (count + 1)) / 1e4  # not rounded to a rate that is refused, too
            raise NoGuarantee(
                f"A false-alarm rate of {self.alpha:g} needs {wanted} held-out cool jobs of each kind or more (the "
                f"twin of '{self.twin.arm}' has {count}). Choose --alpha >= {least:g}, or train with more: "
                "a larger --hold-out or more cool logs, or twin.exploration of a scenario."
            )

    @property
    def calibration(self) -> Calibration:
        """That of the twin."""
        assert self.twin.calibration is not None
        return self.twin.calibration

    def p_value(self, features: Features, reading: str | None = None) -> Array:
        """p-values of features [..., joint] by a reading, [...]; default: that of the rule."""
        return self.calibration.p_value(features, self.twin.joint_weight, reading or self.reading)

    def anomalous(self, features: Features) -> Array:
        """Whether motion is anomalous, bool [...]."""
        return self.p_value(features) <= self.alpha

    @property
    def guarantee(self) -> str:
        """Guarantee of the verdict, as a sentence."""
        kinds = len(np.unique(self.calibration.group))
        most = "About" if self.reading == "latent" else "At most"
        return (
            f"{most} {self.alpha:.3g} of new cool jobs are called anomalous, if they are like the held-out ones "
            f"({len(self.calibration.group)} jobs of {kinds} kind{'s' * (kinds > 1)})."
        )


def word(anomalous: bool) -> str:
    """The verdict as a word."""
    return ANOMALOUS if anomalous else UNCRITICAL


STRETCH_S = 120.0
"""Length of the stretches of a log that are judged, to whole windows: shorter work hardly warms a motor."""


@dataclass(frozen=True, eq=False)
class LogStretches:
    """The windows of a recording, and all its stretches of `length` consecutive windows; gaps are left out.

    A recording that is shorter than a stretch is one stretch.
    """

    windows: Features
    """[window, joint]."""
    stretches: Features
    """Means of their windows, [stretch, joint]; one begins with each window."""
    length: int

    @classmethod
    def of(cls, twin: Twin, recording: Recording) -> "LogStretches":
        """Those of a recording; raises as `log_windows`."""
        packed = np.concatenate([features.packed for *_, features in log_windows(twin, recording)])
        config = twin.config
        length = min(max(1, round(STRETCH_S * config.rate_hz / config.window)), len(packed))
        means = np.lib.stride_tricks.sliding_window_view(packed, length, axis=0).mean(axis=-1)
        return cls(Features(packed), Features(means), length)

    def worst(self, weight: Array) -> Features:
        """Errors of the stretch with the largest d, torque of that with the largest load, latents of all, [joint].

        Args:
            weight: w_k of the joints, [joint].
        """
        packed = self.windows.packed.mean(axis=0)
        newest, heaviest = (
            self.stretches.packed[np.argmax(score @ weight)]
            for score in (self.stretches.difficulty, self.stretches.one_sided)
        )
        packed[:, : len(CHANNELS)] = newest[:, : len(CHANNELS)]
        packed[:, len(CHANNELS) : PARTS] = heaviest[:, len(CHANNELS) : PARTS]
        return Features(packed)

    def share(self, anomalous: Array) -> float:
        """Share of the windows that belong to stretches which are anomalous, bool [stretch]."""
        inside = np.convolve(anomalous, np.ones(self.length))
        return float(np.mean(inside > 0.5))


def log_features(twin: Twin, recording: Recording) -> Features:
    """Features by which a recording is judged, [joint]: those of its worst stretches; raises as `log_windows`."""
    return LogStretches.of(twin, recording).worst(twin.joint_weight)
