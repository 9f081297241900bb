"""Sensor readings of one arm over time, at any rate or at a regular one, and the heat of its motors in steps."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fleet import readings
from fleet.errors import FleetError, IdentificationError, distinguish
from fleet.heat.motor import Motors, friction_heat, reference_current
from fleet.robot import half_turn

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
    """Name of the file; if a file holds several arms, folder/file/arm."""
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
        readings = {channel: getattr(self, channel) for channel in READINGS}
        kept = {channel: None if values is None else values[rows] for channel, values in readings.items()}
        return replace(self, time_s=self.time_s[rows], **kept)


def check_recordings(given: object) -> None:
    """Check that a value is a list of recordings, and not for example the path of a log.

    Raises:
        TypeError: it is not; names how a log is read.
    """
    if isinstance(given, Recording):
        raise TypeError(f"A list of recordings is needed (got one, '{given.name}'); put it in brackets.")
    several = given if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
    if wrong := [each for each in several if not isinstance(each, Recording)]:
        raise TypeError(
            f"A recording is needed (got {type(wrong[0]).__name__} {str(wrong[0])[:60]!r}). "
            "twin.logs.reader.read(path) returns the recordings of a log."
        )


def check_log(recordings: Sequence[Recording]) -> None:
    """Check that these are one or more recordings, each with a name of its own.

    Raises:
        TypeError: see `check_recordings`.
        FleetError: there is none, or two have one name.
    """
    check_recordings(recordings)
    if not recordings:
        raise FleetError("At least one recording is needed (got none).")
    if twice := sorted(name for name, count in Counter(each.name for each in recordings).items() if count > 1):
        raise FleetError(
            f"Names of recordings must differ; given more than once: {', '.join(twice)}. Give each recording once, and "
            "another name with dataclasses.replace(recording, name=…)."
        )


def interval_speed(recording: Recording) -> Array:
    """Mean speed over each interval between samples, rad/s, >= 0, [time − 1, joint].

    The larger of measured speed, which slow sampling may miss, and change of position, which misses moves there and
    back. Angles may wrap.
    """
    measured, by_position = _speeds(recording)
    return np.maximum(measured, np.abs(by_position))


def _speeds(recording: Recording) -> tuple[Array, Array]:
    """Mean of the measured speeds, >= 0, and signed change of position over each interval, rad/s, [time − 1, joint]."""
    moved = half_turn(np.diff(recording.q, axis=0))
    measured = (np.abs(recording.qd[1:]) + np.abs(recording.qd[:-1])) / 2.0
    return measured, moved / np.diff(recording.time_s)[:, None]


def interval_current_sq(recording: Recording) -> Array:
    """Mean squared current over each interval between samples, A², [time − 1, joint].

    Raises:
        ValueError: a recording without currents.
    """
    if recording.current_a is None:
        raise ValueError(f"Recording '{recording.name}' has no motor currents.")
    return (recording.current_a[1:] ** 2 + recording.current_a[:-1] ** 2) / 2.0


GAP_S = 2.0
"""A longer step between samples is a gap: at the top speed of 1.33 rad/s the motion across it is unknown."""
_SAME_RATE = 1e-6
"""Relative difference of rates that counts as rounding."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Motion at a regular rate without a gap."""

    recording: str
    """Name of its recording."""
    time_s: Array
    """Middle of each sample in the recording's own time, [time]."""
    profile: Array
    """q rad (continuous joints unwrapped), qd rad/s, tau N·m, float64 [time, 3, joint]."""
    temp_c: Array | None
    """Motor temperature, [time, joint]."""


def stretches(recording: Recording, rate_hz: float, *, gap_s: float = GAP_S) -> list[Stretch]:
    """A recording at a regular rate, split where a step between samples exceeds `gap_s`.

    Readings are interpolated linearly. At a lower rate a new sample is the mean of the line over its time, which keeps
    the mean load; at the same or a higher rate it is the value of the line. Stretches shorter than one new sample are
    dropped.

    Raises:
        ValueError: a rate or gap that is not positive, or a gap below the usual step of the recording.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz must be > 0 (got {rate_hz}).")
    steps = np.diff(recording.time_s)
    if not gap_s > 0:
        raise ValueError(f"gap_s must be > 0 (got {gap_s}).")
    if len(steps) and np.median(steps) > gap_s:
        step, gap = distinguish(float(np.median(steps)), gap_s, 3)
        raise ValueError(
            f"Recording '{recording.name}' has a sample every {step} s, so gap_s={gap} would drop all of it; give a "
            "larger gap_s."
        )
    pieces = np.split(np.arange(len(recording.time_s)), np.flatnonzero(steps > gap_s) + 1)
    resampled = list[Stretch]()
    for part in (recording.part(piece) for piece in pieces if len(piece) > 1):
        channels = [unwrap(part.q, part.qd, part.time_s), part.qd, part.tau]
        if part.temp_c is not None:
            channels.append(part.temp_c)
        time_s, values = at_rate(part.time_s, np.stack(channels, axis=1), rate_hz)
        if len(time_s):
            resampled.append(Stretch(part.name, time_s, values[:, :3], None if part.temp_c is None else values[:, 3]))
    return resampled


def unwrap(q: Array, qd: Array, time_s: Array) -> Array:
    """Angles [time, joint] with the whole-turn jumps of continuous joints removed.

    Turns between two samples follow from the velocities, so a joint may move more than half a turn in one step.
    """
    step = np.diff(q, axis=0)
    expected = (qd[1:] + qd[:-1]) / 2.0 * np.diff(time_s)[:, None]
    turns = np.round((expected - step) / (2 * np.pi))
    turns[:, ~np.isin(np.arange(q.shape[1]), CONTINUOUS)] = 0.0
    return q + 2 * np.pi * np.concatenate([np.zeros((1, q.shape[1])), np.cumsum(turns, axis=0)])


def at_rate(time_s: Array, values: Array, rate_hz: float) -> tuple[Array, Array]:
    """Readings at a regular rate that starts at the first of them.

    Args:
        time_s: Strictly increasing, [time], two or more.
        values: [time, ...].

    Returns:
        Times of the new samples, s, [sample], and their values, [sample, ...]; see `stretches`.
    """
    from scipy.interpolate import make_interp_spline  # slow to import, and a live arm needs none of these

    since_s = time_s - time_s[0]
    line = make_interp_spline(since_s, values, k=1)
    samples = int(since_s[-1] * rate_hz + _SAME_RATE * len(time_s))
    at_s = np.minimum(np.arange(samples + 1) / rate_hz, since_s[-1])
    if rate_hz * np.median(np.diff(time_s)) >= 1 - _SAME_RATE:
        return time_s[0] + at_s, line(at_s)
    width_s = np.diff(at_s).reshape(-1, *(1,) * (values.ndim - 1))
    return time_s[0] + (at_s[1:] + at_s[:-1]) / 2.0, np.diff(line.antiderivative()(at_s), axis=0) / width_s


class NothingCool(FleetError):
    """No part of the recordings stayed cool for long enough, so there is no training data."""


def cool_stretches(
    recordings: Sequence[Recording], rate_hz: float, *, cool_c: float, joints: Sequence[int], least_s: float = 0.0
) -> list[Stretch]:
    """The stretches after every moment of which no motor reaches `cool_c` in the rest of its recording.

    They are chosen by the later temperatures, not by those at the time: a heavy job begins cool too.

    Args:
        cool_c: °C.
        joints: Index 0..6 of the motors that count: idle wrists of a Gen3 are at 40 to 43 °C.
        least_s: Least length of a stretch, such as a twin's window.

    Raises:
        NothingCool: there is no such stretch, which names the warm motors, or all are shorter than `least_s`.
        ValueError: no recordings, one without temperatures, or unknown joints.
    """
    if not recordings:
        raise ValueError("Training data needs at least one recording (got none).")
    unknown = [j for j in joints if not 0 <= j < recordings[0].joints]
    if unknown or not joints:
        raise ValueError(f"joints must be some of 0 … {recordings[0].joints - 1} (got {tuple(joints)}).")
    cool_parts, whole, coolest = list[Stretch](), True, np.full(recordings[0].joints, np.inf)
    for recording in recordings:
        if recording.temp_c is None:
            raise ValueError(f"Recording '{recording.name}' has no motor temperatures, so its cool parts are unknown.")
        hot = np.flatnonzero((recording.temp_c[:, list(joints)] >= cool_c).any(axis=1))
        begin = int(hot[-1]) + 1 if len(hot) else 0
        whole &= begin == 0
        coolest = np.minimum(coolest, recording.temp_c.min(axis=0, initial=np.inf))
        cool_parts += stretches(recording.part(slice(begin, None)), rate_hz)
    if not cool_parts:
        always = ", ".join(f"{j + 1} ({coolest[j]:.1f} °C)" for j in joints if coolest[j] >= cool_c)
        raise NothingCool(
            f"At no moment of {len(recordings)} recording(s) do the motors {', '.join(str(j + 1) for j in joints)} "
            f"stay below {cool_c:g} °C for the rest of its recording."
            + (f" Always above: {always}, the coolest sample." if always else "")
            + " Raise the limit (--cool), or record light work."
        )
    long = [s for s in cool_parts if len(s.time_s) >= least_s * rate_hz]
    if not long:
        longest_s = max(len(s.time_s) for s in cool_parts) / rate_hz
        what = "The recording" if whole else "The part that stays cool"
        least, longest = distinguish(least_s, longest_s)
        raise NothingCool(
            f"{what} is shorter than one window: {least} s are needed, the longest stretch has {longest} s. Record "
            "for longer, or choose a smaller window (--window)."
        )
    return long


CurrentSource = Literal["current", "torque"]
"""Current from the recording itself, or from torque and speed by the motor law."""

STEP_S = 10.0
"""Length of a step; a winding needs minutes to warm."""
HEAT_GAP_S = 10.0
"""A longer pause between two samples splits the log: its heat is unknown."""


@dataclass(frozen=True, eq=False)
class HeatLog:
    """A stretch of one recording without gaps, in steps of a few seconds.

    The squared current is quadratic in the friction coefficients, so its six terms are averaged once for all friction
    coefficients that a fit may try.
    """

    name: str
    """Of the recording."""
    time_s: Array
    """At the edges of the steps, [step + 1]."""
    temp_c: Array
    """Motor temperatures at the edges, [step + 1, joint]."""
    current_terms: Array
    """Mean i² at the magnets' reference temperature is terms · (1, c, b, c², cb, b²), A², [step, joint, 6]."""
    friction_terms: Array
    """Mean friction heat is terms · (c, b), W, [step, joint, 2]; c Coulomb N·m, b viscous N·m·s/rad."""
    source: CurrentSource

    @property
    def dt_s(self) -> Array:
        """Length of each step, [step]."""
        return np.diff(self.time_s)

    @property
    def middle_c(self) -> Array:
        """Mean of the motor temperatures at a step's two edges, [step, joint]."""
        return (self.temp_c[1:] + self.temp_c[:-1]) / 2.0

    def current_sq(self, coulomb_nm: Array, viscous: Array) -> Array:
        """Mean squared current, A², [..., step, joint], for friction coefficients [..., joint]."""
        c, b = coulomb_nm, viscous
        basis = np.stack([np.ones_like(c), c, b, c**2, c * b, b**2], axis=-1)
        return np.einsum("sjk,...jk->...sj", self.current_terms, basis)

    def friction_w(self, coulomb_nm: Array, viscous: Array) -> Array:
        """Mean friction heat, W, [..., step, joint], for friction coefficients [..., joint]."""
        return np.einsum("sjk,...jk->...sj", self.friction_terms, np.stack([coulomb_nm, viscous], axis=-1))


def source_of(recordings: Sequence[Recording]) -> CurrentSource:
    """The recorded current where every recording has one, else torque and speed."""
    return "current" if all(r.current_a is not None for r in recordings) else "torque"


def without_repeats(recording: Recording) -> Recording:
    """The recording without rows that repeat the one before in every reading, temperatures included.

    A logger that is late repeats its last reading. Held on, a single reading in motion would count for seconds; without
    the repeated rows the heat in between is that of the readings on either side. Runs longer than `HEAT_GAP_S` and the
    last row stay, and so do all rows of a recording without temperatures, in which an arm at rest repeats.
    """
    if recording.temp_c is None:
        return recording
    rows = np.concatenate([values for name in READINGS if (values := getattr(recording, name)) is not None], axis=1)
    time_s, kept = recording.time_s, np.ones(len(rows), dtype=bool)
    for first, end in readings.runs(np.concatenate([[False], (np.diff(rows, axis=0) == 0).all(axis=1)])):
        last = min(end, len(rows) - 1)
        kept[first:last] = time_s[last] - time_s[first - 1] > HEAT_GAP_S
    return recording.part(kept)


def heat_logs(recording: Recording, motors: Motors, source: CurrentSource, *, step_s: float = STEP_S) -> list[HeatLog]:
    """The stretches of a recording between gaps, each at least two steps long, without repeated rows.

    Args:
        motors: Its torque constant, efficiency and friction speed; its friction coefficients are not used.
        step_s: 0 keeps every sample.

    Raises:
        ValueError: a recording without temperatures, or without currents where they are the source.
        IdentificationError: it has other joints than the thermal network.
    """
    if recording.joints != (joints := motors.torque_per_amp.shape[-1]):
        raise IdentificationError(f"'{recording.name}' has {recording.joints} joints, the thermal network {joints}.")
    recording = without_repeats(recording)
    if recording.temp_c is None:
        raise ValueError(f"Recording '{recording.name}' has no motor temperatures.")
    terms, friction = _current_terms(recording, motors, source), _friction_terms(recording, motors)
    logs = []
    breaks = np.flatnonzero(np.diff(recording.time_s) > HEAT_GAP_S) + 1
    for samples in np.split(np.arange(len(recording.time_s)), breaks):
        time_s = recording.time_s[samples]
        edges = _edges(time_s, step_s)
        if len(edges) < 3:
            continue
        dt_s = np.diff(time_s)
        inside = slice(samples[0], samples[-1])
        logs.append(
            HeatLog(
                name=recording.name,
                time_s=time_s[edges],
                temp_c=recording.temp_c[samples[edges]],
                current_terms=_means(terms[inside], dt_s, edges),
                friction_terms=_means(friction[inside], dt_s, edges),
                source=source,
            )
        )
    return logs


def _edges(time_s: Array, step_s: float) -> Array:
    """Index of the samples at which steps begin and end: the first in each `step_s` after the start."""
    if step_s == 0.0 or len(time_s) == 0:
        return np.arange(len(time_s))
    # Half a millisecond of tolerance, so that a rounding clock does not make steps of uneven length.
    bins = np.floor((time_s - time_s[0] + 5e-4) / step_s)
    return np.flatnonzero(np.diff(bins, prepend=-1.0) > 0)


def _means(values: Array, dt_s: Array, edges: Array) -> Array:
    """Time mean over each step of values per interval between samples, [step, ...]."""
    used = dt_s[: edges[-1]]
    shape = (-1, *[1] * (values.ndim - 1))
    total = np.add.reduceat(values[: edges[-1]] * used.reshape(shape), edges[:-1], axis=0)
    return total / np.add.reduceat(used, edges[:-1]).reshape(shape)


def _with_friction(motors: Motors, coulomb: float, viscous: float) -> Motors:
    ones = np.ones_like(motors.coulomb_nm)
    return replace(motors, coulomb_nm=coulomb * ones, viscous_nms_per_rad=viscous * ones)


def _current_terms(recording: Recording, motors: Motors, source: CurrentSource) -> Array:
    """Over each interval between samples, A², [interval, joint, 6]."""
    if source == "current":
        measured = interval_current_sq(recording)
        return np.concatenate([measured[..., None], np.zeros((*measured.shape, 5))], axis=-1)
    # The law is affine in the friction coefficients: i = i_0 + c·i_c + b·i_b.
    none, coulomb, viscous = (_with_friction(motors, *friction) for friction in ((0, 0), (1, 0), (0, 1)))
    measured, by_position = _speeds(recording)
    ends = []
    for end in (slice(None, -1), slice(1, None)):
        tau, qd = recording.tau[end], np.where(np.abs(by_position) > measured, by_position, recording.qd[end])
        still = np.zeros_like(tau)
        i_0 = reference_current(tau, qd, none)
        i_c, i_b = reference_current(still, qd, coulomb), reference_current(still, qd, viscous)
        ends.append(np.stack([i_0**2, 2 * i_0 * i_c, 2 * i_0 * i_b, i_c**2, 2 * i_c * i_b, i_b**2], axis=-1))
    return (ends[0] + ends[1]) / 2.0


def _friction_terms(recording: Recording, motors: Motors) -> Array:
    """Over each interval between samples, [interval, joint, 2]."""
    speed = interval_speed(recording)
    return np.stack([friction_heat(speed, _with_friction(motors, *unit)) for unit in ((1, 0), (0, 1))], axis=-1)
