"""What a servo is told: the planned samples of one tick, and the control that follows them between the samples."""

from dataclasses import dataclass

import numpy as np

from fleet.motion import RATE_HZ, Plan
from fleet.robot import JOINTS, rotation
from fleet.sim.plants import row

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Reference:
    """Planned motion of one arm over some samples of 1/RATE_HZ, and what its hand bears from each on."""

    motion: Array
    """[sample + 1, channel, joint]; the last row is where the samples end."""
    payload_kg: Array
    """[sample + 1]."""
    force_n: Array
    """On the tool point, world frame, [sample + 1, 3]."""


def still(q: Array, tau: Array, samples: int) -> Reference:
    """Standing at `q` rad, held by `tau` N·m, both [joint], with an empty hand."""
    motion = np.broadcast_to(np.stack([q, np.zeros(JOINTS), tau]), (samples + 1, 3, JOINTS))
    return Reference(motion, np.zeros(samples + 1), np.zeros((samples + 1, 3)))


def reference(plan: Plan, repetitions: int, progress_s: float, samples: int, home: Reference) -> Reference:
    """The stretch of a job of so many cycles that begins so long after leaving home, and then standing at home.

    Args:
        progress_s: A whole number of samples.
        home: Standing at home, as many samples.
    """
    lengths = [len(phase.profile) for phase in plan.phases]
    first = round(progress_s * RATE_HZ)
    last = lengths[0] + repetitions * lengths[1] + lengths[2]
    moving = max(0, min(last - first, samples + 1))
    rows = row(plan, np.arange(first, first + moving) / RATE_HZ, repetitions)
    presses = (rows >= lengths[0]) & (rows < lengths[0] + lengths[1]) & (plan.work.kind == "press")
    # The hand pushes along its own z; the environment pushes back.
    back_n = -plan.work.force_n * rotation(plan.work.places[0].tool_deg)[:, 2]
    motion, payload_kg, force_n = home.motion.copy(), home.payload_kg.copy(), home.force_n.copy()
    motion[:moving] = np.concatenate([phase.profile for phase in plan.phases])[rows]
    payload_kg[:moving] = np.concatenate([phase.payload_kg for phase in plan.phases])[rows]
    force_n[:moving] = np.where(presses[:, None], back_n, 0.0)
    return Reference(motion, payload_kg, force_n)


def control(references: list[Reference], steps: int, kp: Array, kv: Array) -> Array:
    """Computed torque through position servos, [sample · steps, arm · joint].

    A servo exerts kp (ctrl − q) − kv qd, so ctrl = q_ref + (kv qd_ref + tau_ref)/kp makes that
    tau_ref + kp (q_ref − q) + kv (qd_ref − qd). Between samples q_ref is the cubic that meets q and qd at both ends.
    The speed is the one that takes q_ref to its next step, since semi-implicit Euler moves with the speed at the
    end of a step. Torque goes straight from sample to sample, and stays where the load changes between two: the arm
    stands still then, and the payload changes at once.

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
    """Whether the load stays as it is from each sample to the next, bool [sample]."""
    return (np.diff(r.payload_kg) == 0) & (np.diff(r.force_n, axis=0) == 0).all(axis=1)
