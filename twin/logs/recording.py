"""Sensor readings of one arm over time."""

from dataclasses import dataclass, replace

import numpy as np

Array = np.ndarray

READINGS = ("q", "qd", "tau", "current_a", "temp_c")
"""The arrays of a recording besides the time, in the order in which they are checked."""
CONTINUOUS = (0, 2, 4, 6)
"""Joints without end stops (Kinova Gen3 user guide, actuator position limits), index 0..6."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """Sensor readings of one arm, equally long arrays with the time axis first, at any rate, with any gaps.

    Raises:
        ValueError: arrays of different shapes, numbers that are not finite, or times that do not increase.
    """

    name: str
    """Name of the file, and of the arm if a file holds several."""
    time_s: Array
    """Strictly increasing, [time]."""
    q: Array
    """rad, [time, joint]; wrapped to half a turn or continued over turns."""
    qd: Array
    """rad/s, [time, joint]."""
    tau: Array
    """Torque with which the motor drives the joint, N·m, [time, joint]; gravity's own torque has the other sign."""
    current_a: Array | None = None
    """Motor current, A, [time, joint], of the same sign as `tau`."""
    temp_c: Array | None = None
    """Motor temperature, °C, [time, joint]."""
    dropped: tuple[str, ...] = ()
    """Dropped parts of a damaged file, one sentence each."""

    def __post_init__(self) -> None:
        if self.time_s.ndim != 1 or self.q.ndim != 2:
            raise ValueError(
                f"Recording '{self.name}': time_s must be [time] and q [time, joint] "
                f"(got {self.time_s.shape} and {self.q.shape})."
            )
        if not np.isfinite(self.time_s).all():
            raise ValueError(f"Recording '{self.name}': time_s is not finite.")
        wanted = (len(self.time_s), self.q.shape[1])
        for channel in READINGS:
            values = getattr(self, channel)
            if values is None:
                continue
            if values.shape != wanted:
                raise ValueError(f"Recording '{self.name}': {channel} must be {wanted} (got {values.shape}).")
            if not np.isfinite(values).all():
                time, joint = np.argwhere(~np.isfinite(values))[0]
                raise ValueError(f"Recording '{self.name}': {channel} of joint {joint + 1} is not finite ({time=}).")
        back = np.flatnonzero(np.diff(self.time_s) <= 0)
        if len(back):
            before, after = self.time_s[back[0]], self.time_s[back[0] + 1]
            raise ValueError(f"Recording '{self.name}': time goes from {before} s to {after} s; it must increase.")

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def duration_s(self) -> float:
        """From the first to the last sample, s; zero without samples."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self.time_s) else 0.0

    def part(self, rows: slice | Array) -> "Recording":
        """The recording of some of its samples, by slice, mask or indices."""
        own = {channel: getattr(self, channel) for channel in READINGS}
        kept = {channel: None if values is None else values[rows] for channel, values in own.items()}
        return replace(self, time_s=self.time_s[rows], **kept)


def interval_speed(recording: Recording) -> Array:
    """Mean speed over each interval between samples, rad/s, >= 0, [time − 1, joint].

    The larger of measured speed, which slow sampling may miss, and change of position, which misses moves there and
    back. Angles may wrap.
    """
    moved = np.diff(recording.q, axis=0)
    moved = np.abs((moved + np.pi) % (2 * np.pi) - np.pi)
    read = (np.abs(recording.qd[1:]) + np.abs(recording.qd[:-1])) / 2.0
    return np.maximum(read, moved / np.diff(recording.time_s)[:, None])


def interval_current_sq(recording: Recording) -> Array:
    """Mean squared current over each interval between samples, A², [time − 1, joint].

    Raises:
        ValueError: a recording without currents.
    """
    if recording.current_a is None:
        raise ValueError(f"Recording '{recording.name}' has no motor currents.")
    return (recording.current_a[1:] ** 2 + recording.current_a[:-1] ** 2) / 2.0
