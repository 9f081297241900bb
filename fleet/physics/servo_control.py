"""Servo control: the planned samples of one tick, and the control signal that follows them between the samples."""

from dataclasses import dataclass

import numpy as np

from fleet.engine.profile_plant import sample_row
from fleet.motion import RATE_HZ, Plan
from fleet.robot import JOINTS, rotation

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Reference:
    """Planned motion of one arm over samples of 1/RATE_HZ, and the load at its hand from each sample on."""

    motion: Array
    """[sample + 1, channel, joint]; the last row is the end of the last sample."""
    payload_kg: Array
    """[sample + 1]."""
    force_n: Array
    """Force on the tool point, world frame, [sample + 1, 3]."""


def still(q: Array, tau: Array, samples: int) -> Reference:
    """Standstill at `q` rad, held by `tau` N·m, both [joint], with an empty hand."""
    motion = np.broadcast_to(np.stack([q, np.zeros(JOINTS), tau]), (samples + 1, 3, JOINTS))
    return Reference(motion, np.zeros(samples + 1), np.zeros((samples + 1, 3)))


def reference(plan: Plan, repetitions: int, progress_s: float, samples: int, home: Reference) -> Reference:
    """Part of a job with `repetitions` cycles that starts `progress_s` after leaving home, then standstill at home.

    Args:
        progress_s: A whole number of samples.
        home: Standstill at home for `samples` samples.
    """
    lengths = np.array([len(phase.profile) for phase in plan.phases])
    first = round(progress_s * RATE_HZ)
    last = lengths[0] + repetitions * lengths[1] + lengths[2]
    moving = max(0, min(last - first, samples + 1))
    rows = sample_row(lengths, np.arange(first, first + moving) / RATE_HZ, repetitions)
    presses = (rows >= lengths[0]) & (rows < lengths[0] + lengths[1]) & (plan.work.kind == "press")
    # The hand presses along its own z axis; the environment exerts the opposite force.
    back_n = -plan.work.force_n * rotation(plan.work.places[0].tool_deg)[:, 2]
    motion, payload_kg, force_n = home.motion.copy(), home.payload_kg.copy(), home.force_n.copy()
    motion[:moving] = np.concatenate([phase.profile for phase in plan.phases])[rows]
    payload_kg[:moving] = np.concatenate([phase.payload_kg for phase in plan.phases])[rows]
    force_n[:moving] = np.where(presses[:, None], back_n, 0.0)
    return Reference(motion, payload_kg, force_n)


def control(references: list[Reference], steps: int, kp: Array, kv: Array) -> Array:
    """Control signal of position servos for computed-torque control, [sample · steps, arm · joint].

    A servo exerts kp (ctrl − q) − kv qd. With ctrl = q_ref + (kv qd_ref + tau_ref)/kp this is
    tau_ref + kp (q_ref − q) + kv (qd_ref − qd). Between samples q_ref is the cubic with both ends' q and qd.
    qd_ref is the difference quotient of q_ref to its next step, since semi-implicit Euler moves with the speed at the
    end of a step. tau_ref is linear between samples. If the load changes between two samples it is constant, because
    the arm stands still and the payload changes at once.

    Args:
        steps: Simulation steps per sample.
        kp, kv: Servo gains, N·m/rad and N·m·s/rad, [arm · joint].
    """
    motion = np.concatenate([r.motion for r in references], axis=-1)  # [sample + 1, channel, arm · joint]
    q, qd, tau = motion[:, 0], motion[:, 1], motion[:, 2]
    after = np.concatenate([np.where(_same_load(r)[:, None], r.motion[1:, 2], r.motion[:-1, 2]) for r in references], 1)
    ends = np.stack([q[:-1], qd[:-1] / RATE_HZ, q[1:], qd[1:] / RATE_HZ], axis=1)  # [sample, 4, arm · joint]
    share = np.arange(steps + 1) / steps
    cubic = np.stack(
        [
            1 - 3 * share**2 + 2 * share**3,
            share - 2 * share**2 + share**3,
            3 * share**2 - 2 * share**3,
            share**3 - share**2,
        ],
        axis=1,
    )  # [step + 1, 4]
    speed = np.diff(cubic, axis=0) * steps * RATE_HZ
    straight = np.stack([1 - share[:-1], share[:-1]], axis=1)
    torque = np.stack([tau[:-1], after], axis=1)
    out = cubic[:-1] @ ends + (speed @ ends) * (kv / kp) + straight @ (torque / kp)
    return out.reshape(-1, out.shape[-1])


def _same_load(r: Reference) -> Array:
    """Whether the load is the same at each sample and the next, bool [sample]."""
    return (np.diff(r.payload_kg) == 0) & (np.diff(r.force_n, axis=0) == 0).all(axis=1)
