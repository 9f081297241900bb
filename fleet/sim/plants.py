"""The plant that follows the plan: heat and readings straight from the planned profiles."""

from collections.abc import Sequence

import numpy as np

from fleet.motion import RATE_HZ, Drive, Plan
from fleet.motor import current
from fleet.sim.kernel import Step, Timeline
from fleet.sim.state import State, World
from fleet.telemetry import FAULTED, WORKING, Telemetry
from fleet.thermal import HOUSING, WINDING

Array = np.ndarray


class ProfilePlant:
    """Every arm does exactly what it planned; any number of envs.

    Args:
        plans: The plans behind the rows of the world's plan table.
        rest_q: Home posture of each arm, rad, [arm, joint].
        rest_tau: Torque that holds it, N·m, [arm, joint].
    """

    def __init__(self, plans: Sequence[Plan], rest_q: Array, rest_tau: Array) -> None:
        self._plans = tuple(plans)
        self._rest = np.stack([rest_q, np.zeros_like(rest_q), rest_tau], axis=1)  # [arm, channel, joint]
        self._stood = self._rest.copy()
        """Where the brakes stopped it last."""

    def drive(self, world: World, state: State, timeline: Timeline) -> Drive:
        """Mean heat drive over the step, each [env, arm, joint]: phases weighted by their time in it."""
        share = timeline.spans_s / world.dt_s
        rest = share[..., 3, None]

        def mean(per_phase: Array, at_rest: Array) -> Array:
            return np.einsum("eap,eapj->eaj", share[..., :3], per_phase[timeline.plan]) + rest * at_rest

        return Drive(
            mean(world.plans.current_sq, world.rest.current_sq), mean(world.plans.friction_w, world.rest.friction_w)
        )

    def readings(self, world: World, step: Step, offsets_s: Array, rng: np.random.Generator) -> Telemetry:
        """What the sensors of env 0 said at some moments of a step.

        Args:
            offsets_s: Moments within the step, [sample], in (0, dt_s].
        """
        motion = np.stack([self._motion(world, step, a, offsets_s) for a in range(len(world.arms))], axis=1)
        return read(world, step, offsets_s, motion, rng)

    def _motion(self, world: World, step: Step, a: int, offsets_s: Array) -> Array:
        """[sample, channel, joint] of one arm."""
        mode, cut_s = step.began.mode[0, a], step.cut_s[0, a]
        if mode == FAULTED:
            return np.broadcast_to(self._stood[a], (len(offsets_s), *self._stood[a].shape))
        moments = np.append(offsets_s, cut_s)
        out = np.broadcast_to(self._rest[a], (len(moments), *self._rest[a].shape)).copy()
        if mode == WORKING:
            plan = self._plans[step.path.plan[0, a]]
            away = moments < step.path.home_s[0, a]
            progress_s = step.began.progress_s[0, a] + moments[away]
            out[away] = sample(plan, progress_s, int(step.began.todo[0, a]))
        if cut_s < world.dt_s:
            out[-1, 1:] = 0.0
            self._stood[a] = out[-1]
            out[moments >= cut_s] = out[-1]
        return out[:-1]


def row(plan: Plan, time_s: Array, repetitions: int) -> Array:
    """Which sample of the plan's phases, one after the other, is due at moments since leaving home, s.

    The cycle counts as often as it is repeated; before and after the job it is the first and the last sample.
    """
    lengths = [len(phase.profile) for phase in plan.phases]
    index = np.floor(np.asarray(time_s) * RATE_HZ + 1e-6).astype(int)
    total = lengths[0] + repetitions * lengths[1] + lengths[2]
    index = np.clip(index, 0, total - 1)
    into = index - lengths[0]
    after = into - repetitions * lengths[1]
    return np.where(
        into < 0,
        index,
        np.where(after < 0, lengths[0] + into % max(lengths[1], 1), lengths[0] + lengths[1] + after),
    )


def sample(plan: Plan, time_s: Array, repetitions: int) -> Array:
    """Planned [time, channel, joint] at moments since leaving home, s, of a job of so many cycles."""
    return np.concatenate([phase.profile for phase in plan.phases])[row(plan, time_s, repetitions)]


def read(world: World, step: Step, offsets_s: Array, motion: Array, rng: np.random.Generator) -> Telemetry:
    """Readings of env 0 from true motion [sample, arm, channel, joint]: current from the law, noisy temperature."""
    share = (offsets_s / world.dt_s)[:, None, None]
    temp = step.heating.start_c[0] + share * (step.heating.end_c[0] - step.heating.start_c[0])  # [sample, arm, node]
    q, qd, tau = motion[:, :, 0], motion[:, :, 1], motion[:, :, 2]
    faulted = (step.began.mode[0] == FAULTED) | (
        offsets_s[:, None] >= np.where(step.cut_s < world.dt_s, step.cut_s, np.inf)[0]
    )
    amps = np.where(faulted[..., None], 0.0, current(tau, qd, temp[..., HOUSING], world.motors))
    noise = rng.standard_normal(amps.shape) * world.motors.sensor_noise_k
    working = (step.began.mode[0] == WORKING) & (offsets_s[:, None] < step.path.home_s[0])
    return Telemetry(
        time_s=step.began.tick[0] * world.dt_s + offsets_s,
        mode=np.where(faulted, FAULTED, np.where(working, WORKING, 0)),
        q=q,
        qd=qd,
        tau=tau,
        current_a=amps,
        temp_c=temp[..., WINDING] + noise,
    )
