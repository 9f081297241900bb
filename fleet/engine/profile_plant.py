"""The plant whose arms follow their plans exactly, and the sensor readings of any plant."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from fleet.engine.shift import StepRecord
from fleet.engine.state import State
from fleet.engine.world import World
from fleet.events import Event
from fleet.heat.motor import current
from fleet.heat.thermal import HOUSING, WINDING
from fleet.motion import RATE_HZ, Drive, Plan
from fleet.robot import JOINTS
from fleet.seeding import random_normal
from fleet.telemetry import FAULTED, IDLE, WORKING, Telemetry

Array = np.ndarray


class ProfilePlant:
    """Every arm does exactly what it planned.

    Args:
        plans: The plans behind the rows of the world's plan table.
        rest_q: Home posture of each arm, rad, [arm, joint].
        rest_tau: Torque that holds it, N·m, [arm, joint].
    """

    follows_plans = True
    most_steps = 4096

    def __init__(self, plans: Sequence[Plan], rest_q: Array, rest_tau: Array) -> None:
        self._rest = np.stack([rest_q, np.zeros_like(rest_q), rest_tau], axis=1)  # [arm, channel, joint]
        self._phases = [phase for plan in plans for phase in plan.phases]

    @cached_property
    def _lengths(self) -> Array:
        """Samples of each phase, [plan, phase]."""
        return np.array([len(phase.profile) for phase in self._phases], dtype=int).reshape(-1, 3)

    @cached_property
    def _first(self) -> Array:
        """Where the samples of each plan begin."""
        return np.cumsum([0, *self._lengths.sum(axis=1)])

    @cached_property
    def _samples(self) -> Array:
        """Of all plans, one after the other."""
        profiles = [phase.profile for phase in self._phases]
        return np.concatenate(profiles) if profiles else np.zeros((1, 3, JOINTS))

    def drive(self, world: World, state: State) -> Drive:
        """Not asked for: the engine has the plans' drive in its tables."""
        raise NotImplementedError("ProfilePlant follows plans: the engine computes the drive.")

    def motion(self, world: World, record: StepRecord, offsets_s: Array) -> Array:
        """Joint motion at moments of steps, [step, sample, arm, channel, joint]."""
        return np.stack([self._motion(world, record, a, offsets_s) for a in range(len(world.arms))], axis=2)

    def contacts(self, world: World, record: StepRecord) -> Sequence[Event]:
        """None: the plans' motion is not checked for contacts."""
        return ()

    def _motion(self, world: World, record: StepRecord, a: int, offsets_s: Array) -> Array:
        """Motion of one arm, [step, sample, channel, joint]."""
        mode, cut_s = record.mode[:, a, None], record.cut_s[:, a, None]
        moved_s = np.where(mode == FAULTED, 0.0, np.minimum(offsets_s, cut_s))  # [step, sample]
        away = (record.plan[:, a, None] >= 0) & (moved_s < record.home_s[:, a, None])
        out = np.broadcast_to(self._rest[a], (*moved_s.shape, *self._rest[a].shape)).copy()
        step = np.nonzero(away)[0]
        plan = record.plan[step, a]
        row = sample_row(self._lengths[plan], record.progress_s[step, a] + moved_s[away], record.todo[step, a])
        out[away] = self._samples[self._first[plan] + row]
        braked = (mode == FAULTED) | ((cut_s < world.dt_s) & (offsets_s >= cut_s))
        out[braked, 1:] = 0.0
        return out


def sample_row(lengths: Array, time_s: Array, repetitions: Array | int) -> Array:
    """Which sample of a plan's phases, one after the other, is due at moments since leaving home.

    The cycle repeats; before and after the job it is the first and the last sample.

    Args:
        lengths: Samples of approach, cycle and retreat, int [..., 3].
        time_s: [...].
        repetitions: int [...].
    """
    approach, cycle, retreat = np.moveaxis(lengths, -1, 0)
    index = np.floor(np.asarray(time_s) * RATE_HZ + 1e-6).astype(int)
    index = np.clip(index, 0, approach + repetitions * cycle + retreat - 1)
    into = index - approach
    after = into - repetitions * cycle
    within = np.where(after < 0, approach + into % np.maximum(cycle, 1), approach + cycle + after)
    return np.where(into < 0, index, within)


def sample(plan: Plan, time_s: Array, repetitions: int) -> Array:
    """Planned [time, channel, joint] at moments since leaving home, s, of a job with a number of cycles."""
    lengths = np.array([len(phase.profile) for phase in plan.phases])
    return np.concatenate([phase.profile for phase in plan.phases])[sample_row(lengths, time_s, repetitions)]


def sensor_noise(key: int, tick: Array, arms: int, joints: int) -> Array:
    """Standard normal noise of the temperature sensors at the beginning of ticks, [..., arm, joint].

    Args:
        tick: int [...].
    """
    count = np.asarray(tick, np.uint64)[..., None] * np.uint64(arms * joints)
    count = count + np.arange(1, arms * joints + 1, dtype=np.uint64)
    return random_normal(np.uint64(key), count).reshape((*np.shape(tick), arms, joints))


def recorded_noise(key: int, record: StepRecord, offsets_s: Array, dt_s: float, arms: int) -> Array:
    """Standard normal sensor noise, [step, sample, arm, joint]; at the end of a step it is what policies observe.

    Args:
        key: Of the sensors; see `fleet.seeding`.
    """
    steps, samples, size = len(record.tick), len(offsets_s), arms * JOINTS
    shape = (steps, samples, arms, JOINTS)
    first = record.tick.astype(np.uint64)[:, None, None] * np.uint64(samples * size)
    count = first + np.arange(samples * size, dtype=np.uint64).reshape(samples, size)
    between = np.uint64(key ^ 0xA5A5A5A5A5A5A5A5)  # another stream than that of the policies' observations
    noise = random_normal(between, count).reshape(shape)
    noise[:, np.isclose(offsets_s, dt_s)] = sensor_noise(key, record.tick + 1, arms, JOINTS)[:, None]
    return noise


def telemetry_of(world: World, record: StepRecord, offsets_s: Array, motion: Array, noise: Array) -> Telemetry:
    """Sensor readings: current from the law, temperature with noise.

    Args:
        offsets_s: Moments within each step, [sample], in (0, dt_s].
        motion: True motion, [step, sample, arm, channel, joint].
        noise: Standard normal, [step, sample, arm, joint].
    """
    share = (offsets_s / world.dt_s)[:, None, None]
    temp_c = record.start_c[:, None] + share * (record.end_c - record.start_c)[:, None]  # [step, sample, arm, node]
    q, qd, tau = np.moveaxis(motion, -2, 0)
    moments = offsets_s[:, None]
    cut_s, home_s = record.cut_s[:, None], record.home_s[:, None]
    faulted = (record.mode[:, None] == FAULTED) | ((cut_s < world.dt_s) & (moments >= cut_s))
    amps = np.where(faulted[..., None], 0.0, current(tau, qd, temp_c[..., HOUSING], world.motors))
    working = (record.mode[:, None] == WORKING) & (moments < home_s)

    time_s = record.tick[:, None] * world.dt_s + offsets_s  # [step, sample]
    drift_k = (time_s[..., None] * np.array([arm.drift_k_per_s for arm in world.fleet]))[..., None]

    def flat(values: Array) -> Array:
        return values.reshape(-1, *values.shape[2:])

    return Telemetry(
        time_s=time_s.ravel(),
        mode=flat(np.where(faulted, FAULTED, np.where(working, WORKING, IDLE))),
        q=flat(q),
        qd=flat(qd),
        tau=flat(tau),
        current_a=flat(amps),
        temp_c=flat(temp_c[..., WINDING] + drift_k + noise * world.motors.sensor_noise_k),
    )
