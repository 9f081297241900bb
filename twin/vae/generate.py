"""Generate motion near known motion: perturb its latents, decode positions, smooth, join, keep the joint limits.

Only positions are decoded. Decoded q, qd and tau are not consistent (their rates differ by more than 100 %), so speed
follows from the smoothed path, and the caller computes torque by inverse dynamics.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import BSpline

from fleet.errors import ArgumentError
from fleet.motion import RATE_HZ, Phase, Plan
from fleet.robot import GEN3
from twin.logs.recording import CONTINUOUS
from twin.vae.twin import Twin
from twin.vae.window import Q, cut, resample, starts

Array = np.ndarray

DEGREE = 5
"""Spline degree: speed, acceleration and jerk are continuous; three equal control points at an end mean rest."""
KNOT_S = 0.8
"""Time between knots: details below about a second are smoothed away. Denser knots follow decoder artefacts where
windows meet, and the jerk limit then stretches a cycle by 20 % instead of 7 %."""
OVERLAP = 5
"""Decoded windows that overlap at any time."""
DENSE_HZ = 200.0
"""Sample rate at which a path is checked for its limits."""


@dataclass(frozen=True, eq=False)
class PhaseMotion:
    """Generated motion of one phase, RATE_HZ samples per second as in `fleet.motion.Phase`."""

    q: Array
    """rad, [time, joint]."""
    qd: Array
    qdd: Array
    payload_kg: Array
    """[time]."""


@dataclass(frozen=True, eq=False)
class Variation:
    """One motion generated from a known one: from rest at its start through its phases back to rest there."""

    phases: tuple[PhaseMotion, ...]
    """Approach, cycle (ends where it begins) and retreat."""
    distance_rad: float
    """RMS distance of the joint positions from the source, at equal shares of its time."""
    distance_z: float
    """The same in training standard deviations of each joint."""


def vary(twin: Twin, source: Plan, s: float, rng: np.random.Generator) -> Variation:
    """A motion `s` posterior standard deviations from a known one: z = mu + s·eps·sigma, decoded, joined, timed.

    The noise of overlapping windows is correlated by their overlap, so that they can be joined. The motion rests where
    the source's payload changes, and wherever a phase begins or ends. Speed, acceleration and jerk stay below
    `source.speed` times those of `GEN3`; joint stops are not checked.

    Args:
        source: Motion like that on which the twin was trained.

    Raises:
        ArgumentError: s is negative or not finite, or > 0 of an autoencoder, or the source has no cycle.
        ValueError: the source has other joints than the twin.
    """
    if not 0 <= s < np.inf:
        raise ArgumentError(f"The perturbation s must be a number >= 0 of posterior standard deviations (got {s}).")
    if len(source.cycle.profile) == 0:
        raise ArgumentError(f"The plan of arm '{source.arm}' has no cycle to vary.")
    if s > 0 and twin.config.kind == "ae":
        raise ArgumentError(
            f"A plain autoencoder has no posterior to draw from: give s = 0 (--s 0), or a twin of kind vae (got {s:g})."
        )
    phases, errors = [], []
    paths = [_decoded(twin, resample(phase.profile, RATE_HZ, twin.config.rate_hz), s, rng) for phase in source.phases]
    for phase, path, (begin, end) in zip(source.phases, paths, _phase_ends(source, paths), strict=True):
        motion = _time_phase(phase, path, begin, end, twin.config.rate_hz, source.speed)
        phases.append(motion)
        errors.append(_position_errors(phase, motion))
    error_rad = np.concatenate(errors)
    return Variation(
        phases=tuple(phases),
        distance_rad=float(np.sqrt(np.mean(error_rad**2))),
        distance_z=float(np.sqrt(np.mean((error_rad / twin.scaler.std[:, Q]) ** 2))),
    )


def _decoded(twin: Twin, samples: Array, s: float, rng: np.random.Generator) -> Array:
    """Positions of one phase decoded from perturbed latents, [time, joint], overlapping windows cross-faded."""
    config = twin.config
    if len(samples) == 0:
        return np.zeros((0, samples.shape[-1]))
    stride = max(1, config.window // OVERLAP)
    windows = cut(samples, config.window, stride)
    mu, sigma = twin.posterior(windows)
    eps = _correlated_noise(mu.shape, 1.0 - stride / config.window, rng)
    q = twin.decode((mu + s * eps * sigma).astype(np.float32))[..., Q]
    q = _align_turns(q, windows[..., Q])
    return _crossfade(q, starts(len(samples), config.window, stride), len(samples))


def _correlated_noise(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> Array:
    """Standard normal noise with correlation `share` from row to row."""
    eps = rng.standard_normal(shape)
    for i in range(1, len(eps)):
        eps[i] = share * eps[i - 1] + np.sqrt(1.0 - share**2) * eps[i]
    return eps


def _align_turns(q: Array, source_q: Array) -> Array:
    """Decoded angles [window, time, joint] shifted by whole turns to near the source's."""
    turns = np.round((source_q.mean(axis=1) - q.mean(axis=1)) / (2 * np.pi))
    return q + 2 * np.pi * np.where(np.isin(np.arange(q.shape[-1]), CONTINUOUS), turns, 0.0)[:, None]


def _crossfade(windows: Array, first: Array, length: int) -> Array:
    """Mean of overlapping windows [window, time, joint], weighted most in their middle, [length, joint]."""
    window = windows.shape[1]
    ramp = np.minimum(np.arange(1.0, window + 1), np.arange(window, 0.0, -1))
    index = first[:, None] + np.arange(window)
    inside = index < length
    total, weight = np.zeros((length, windows.shape[-1])), np.zeros(length)
    np.add.at(total, index[inside], (windows * ramp[:, None])[inside])
    np.add.at(weight, index[inside], np.broadcast_to(ramp, index.shape)[inside])
    return total / weight[:, None]


def _phase_ends(source: Plan, paths: Sequence[Array]) -> list[tuple[Array, Array]]:
    """Positions [joint] at which each phase starts and ends: home, and the mean of the decoded ends of the cycle."""
    home = next(phase.profile[0, Q] for phase in source.phases if len(phase.profile)).astype(float)
    approach, cycle, retreat = paths
    meet = home if len(approach) == 0 or len(retreat) == 0 else 0.5 * (cycle[0] + cycle[-1])
    return [(home, meet), (meet, meet), (meet, home)]


def _time_phase(phase: Phase, path: Array, begin: Array, end: Array, rate_hz: float, speed: float) -> PhaseMotion:
    """Motion along a decoded path with a rest at each change of payload."""
    borders_s = np.array([0.0, *(np.flatnonzero(np.diff(phase.payload_kg)) + 1), len(phase.profile)]) / RATE_HZ
    moments = (np.arange(len(path)) + 0.5) / rate_hz
    joints = phase.profile.shape[-1]
    pieces, loads = [np.zeros((3, 0, joints))], []
    here = begin
    for from_s, to_s in pairwise(borders_s.tolist()):
        if to_s == from_s:
            continue
        last = to_s == borders_s[-1]
        there = end if last else np.array([np.interp(to_s, moments, q) for q in path.T])
        own = (moments >= from_s) & (moments <= to_s)
        spline = rest_to_rest(moments[own] - from_s, path[own], here, there, to_s - from_s)
        motion = time_spline(spline, to_s - from_s, speed)
        pieces.append(motion)
        loads.append(np.full(motion.shape[1], phase.payload_kg[round(from_s * RATE_HZ)]))
        here = there
    q, qd, qdd = np.concatenate(pieces, axis=1)
    return PhaseMotion(q, qd, qdd, np.concatenate([np.zeros(0), *loads]))


def rest_to_rest(moments_s: Array, path: Array, begin: Array, end: Array, duration_s: float) -> BSpline:
    """The least-squares spline of a path that starts and ends at rest (zero speed and acceleration) at two postures.

    The path is first shifted, linearly in time, to meet the postures. The first and last three control points are the
    postures.

    Args:
        moments_s: [sample], within 0 … duration_s.
        path: rad, [sample, joint].
        begin, end: rad, [joint].
    """
    pieces = max(1, round(duration_s / KNOT_S))
    inner = np.linspace(0.0, duration_s, pieces + 1)
    knots = np.concatenate([np.zeros(DEGREE), inner, np.full(DEGREE, duration_s)])
    count = len(knots) - DEGREE - 1
    # Control points on the straight line give the straight line; the fit adds the rest.
    ramp = np.clip((np.arange(count) - 2) / max(count - 5, 1), 0.0, 1.0)[:, None]
    control = begin + (end - begin) * ramp
    free = slice(3, count - 3)
    if len(path) and count > 6:
        share = (moments_s / duration_s)[:, None]
        bend = (begin - path[0]) * (1 - share) + (end - path[-1]) * share
        basis = BSpline.design_matrix(moments_s, knots, DEGREE).toarray()
        missing = path + bend - basis @ control
        control[free] += np.linalg.lstsq(basis[:, free], missing, rcond=1e-6)[0]
    return BSpline(knots, control, DEGREE)


def time_spline(spline: BSpline, duration_s: float, speed: float) -> Array:
    """Position, speed and acceleration along a spline, [3, time, joint].

    The motion takes `duration_s` if the limits allow it, else the shortest time that keeps `speed` times the speed,
    acceleration and jerk of `GEN3`; rounded up to whole samples.
    """
    dense = np.linspace(0.0, duration_s, max(2, round(duration_s * DENSE_HZ)) + 1)
    factor = 1.0
    limits = (GEN3.velocity, GEN3.acceleration, GEN3.jerk)
    for order, limit in enumerate(limits, start=1):
        most = np.abs(spline.derivative(order)(dense)).max(axis=0)
        share = float(np.max(most / (speed * np.array(limit[: len(most)]))))
        factor = max(factor, share ** (1.0 / order))
    samples = max(1, int(np.ceil(factor * duration_s * RATE_HZ - 1e-9)))
    shrink = duration_s * RATE_HZ / samples
    moments = np.arange(samples) / RATE_HZ * shrink
    return np.stack(
        [spline.derivative(order)(moments) * shrink**order if order else spline(moments) for order in range(3)]
    )


def _position_errors(phase: Phase, motion: PhaseMotion) -> Array:
    """Generated minus source positions at equal shares of the phase's time, [time, joint]."""
    source_q = resample(phase.profile, RATE_HZ, RATE_HZ)[:, Q]
    if len(source_q) == 0:
        return source_q
    at, samples = np.linspace(0.0, len(motion.q) - 1.0, len(source_q)), np.arange(len(motion.q))
    return np.stack([np.interp(at, samples, q) for q in motion.q.T], axis=-1) - source_q
