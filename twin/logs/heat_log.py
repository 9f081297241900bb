"""Heat of an arm's motors in steps of some seconds, from its recordings: the input of identification and estimation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fleet.motor import Motors, friction_heat, reference_current
from twin.logs.recording import Recording, interval_current_sq, interval_speed

Array = np.ndarray

CurrentSource = Literal["current", "torque"]
"""Current from the recording itself, or from torque and speed by the motor law."""

STEP_S = 10.0
"""Length of a step; a winding needs minutes to warm."""
GAP_S = 10.0
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


def heat_logs(recording: Recording, motors: Motors, source: CurrentSource, *, step_s: float = STEP_S) -> list[HeatLog]:
    """The stretches of a recording between gaps, each at least two steps long.

    Args:
        motors: Its torque constant, efficiency and friction speed; its friction coefficients are not used.
        step_s: 0 keeps every sample.

    Raises:
        ValueError: a recording without temperatures, or without currents where they are the source.
    """
    if recording.temp_c is None:
        raise ValueError(f"Recording '{recording.name}' has no motor temperatures.")
    terms, friction = _current_terms(recording, motors, source), _friction_terms(recording, motors)
    logs = []
    breaks = np.flatnonzero(np.diff(recording.time_s) > GAP_S) + 1
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
    ends = []
    for end in (slice(None, -1), slice(1, None)):
        tau, qd = recording.tau[end], _signed_speed(recording, recording.qd[end])
        still = np.zeros_like(tau)
        i_0 = reference_current(tau, qd, none)
        i_c, i_b = reference_current(still, qd, coulomb), reference_current(still, qd, viscous)
        ends.append(np.stack([i_0**2, 2 * i_0 * i_c, 2 * i_0 * i_b, i_c**2, 2 * i_c * i_b, i_b**2], axis=-1))
    return (ends[0] + ends[1]) / 2.0


def _signed_speed(recording: Recording, qd: Array) -> Array:
    """Speed at one end of each interval, rad/s, or that of the positions where the samples missed a move."""
    moved = (np.diff(recording.q, axis=0) + np.pi) % (2 * np.pi) - np.pi
    by_position = moved / np.diff(recording.time_s)[:, None]
    read = (np.abs(recording.qd[1:]) + np.abs(recording.qd[:-1])) / 2.0
    return np.where(np.abs(by_position) > read, by_position, qd)


def _friction_terms(recording: Recording, motors: Motors) -> Array:
    """Over each interval between samples, [interval, joint, 2]."""
    speed = interval_speed(recording)
    return np.stack([friction_heat(speed, _with_friction(motors, *unit)) for unit in ((1, 0), (0, 1))], axis=-1)
