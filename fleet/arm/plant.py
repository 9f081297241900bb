"""Plant that simulates all arms in one MuJoCo scene, each under computed-torque control along its plan."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from mujoco import rollout

from fleet.arm.cell import ContactFinder
from fleet.arm.model import build_cell, payload_bodies, set_payload_balls
from fleet.engine.profile_plant import sample_row
from fleet.engine.shift import StepRecord
from fleet.engine.state import State
from fleet.engine.world import World
from fleet.errors import FleetError, listed
from fleet.events import Event
from fleet.heat.motor import friction_heat, reference_current
from fleet.job import Fixture, Place
from fleet.motion import RATE_HZ, Drive, Plan
from fleet.robot import JOINTS, Robot, rotation
from fleet.telemetry import FAULTED, WORKING

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class ArmReference:
    """Planned motion of one arm over samples of 1/RATE_HZ, and the load at its hand from each sample on."""

    motion: Array
    """[sample + 1, channel, joint]; the last row is the end of the last sample."""
    payload_kg: Array
    """[sample + 1]."""
    force_n: Array
    """Force on the tool point, world frame, [sample + 1, 3]."""


def still(q: Array, tau: Array, samples: int) -> ArmReference:
    """Standstill at `q` rad, held by `tau` N·m, both [joint], with an empty hand."""
    motion = np.broadcast_to(np.stack([q, np.zeros(JOINTS), tau]), (samples + 1, 3, JOINTS))
    return ArmReference(motion, np.zeros(samples + 1), np.zeros((samples + 1, 3)))


def reference(plan: Plan, repetitions: int, progress_s: float, samples: int, home: ArmReference) -> ArmReference:
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
    return ArmReference(motion, payload_kg, force_n)


def control(references: list[ArmReference], steps: int, kp: Array, kv: Array) -> Array:
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


def _same_load(r: ArmReference) -> Array:
    """Whether the load is the same at each sample and the next, bool [sample]."""
    return (np.diff(r.payload_kg) == 0) & (np.diff(r.force_n, axis=0) == 0).all(axis=1)


TIMESTEP_S = 0.002
STRIDE = 5
"""Simulation steps between two motor samples: 100 samples per second, two per planned sample."""

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)
_CTRL_AND_FORCE = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED)
_DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


class MujocoPlant:
    """Arms that follow their plans in closed loop, in one scene; one env.

    Finish times come from the engine, as with `ProfilePlant`; motor motion, heat and readings come from the simulation.
    The payload has mass from grasp to release, and the contact force of a press acts on the tool point. A faulted arm
    is braked in its posture, without current and with an empty hand, since its job returned to the queue. It recovers
    at home, where the operator who cleared the fault has jogged it.

    Arms, payloads, floor and fixtures in contact push each other, which changes no finish times; `contacts` reports
    contacts.

    Ticks must be simulated in order, from tick 0.

    Args:
        robots: The arms in the order of the world.
        plans: The plans of the rows of the world's plan table.
        rest_tau: Torque that holds the home postures, N·m, [arm, joint].
        places: Stations to show.
        fixtures: Boxes in the cell.
        timestep_s: Simulation step; a whole multiple of `STRIDE` steps must make up a planned sample.
    """

    follows_plans = False
    most_steps = 1

    def __init__(
        self,
        robots: Sequence[Robot],
        plans: Sequence[Plan],
        rest_tau: Array,
        places: Sequence[Place] = (),
        fixtures: Sequence[Fixture] = (),
        *,
        timestep_s: float = TIMESTEP_S,
    ) -> None:
        self._steps = round(1.0 / (RATE_HZ * timestep_s))
        """Simulation steps per planned sample."""
        if self._steps < STRIDE or self._steps % STRIDE or not np.isclose(self._steps * timestep_s * RATE_HZ, 1.0):
            allowed = ", ".join(f"{1e3 / RATE_HZ / n:g}" for n in (STRIDE, 2 * STRIDE, 4 * STRIDE))
            raise ValueError(f"MujocoPlant.timestep_s must be {allowed}, ... ms (got {timestep_s * 1e3:g} ms).")
        self.model = build_cell(robots, places, fixtures, timestep_s=timestep_s)
        self.data = mujoco.MjData(self.model)
        self._scratch = mujoco.MjData(self.model)
        self._plans = tuple(plans)
        self._home_q = np.stack([robot.home_q() for robot in robots])
        self._home_tau = np.array(rest_tau, dtype=float)
        self._payload = payload_bodies(self.model, robots)
        self._contacts = ContactFinder(self.model, robots)
        self._kp: Array = self.model.actuator_gainprm[:, 0].copy()
        self._kv: Array = -self.model.actuator_biasprm[:, 2]
        self._clip: Array = self.model.actuator_forcerange[:, 1].copy()
        assert np.array_equal(self.model.actuator_trnid[:, 0], self.model.dof_jntid), "servos in the order of joints"
        self._reset()

    def _reset(self) -> None:
        arms = len(self._home_q)
        self._tick = -1
        self._at = np.concatenate([[0.0], self._home_q.ravel(), np.zeros(arms * JOINTS)])
        """Time, then joint positions, then speeds: MuJoCo's physics state."""
        self._held: dict[int, ArmReference] = {}
        """References of the braked arms."""
        self._faults = np.zeros(arms, dtype=int)
        self._lost_s = np.zeros(arms)
        self._motion = np.zeros((0, arms, 3, JOINTS))
        """Motion in the last tick, [sample, arm, channel, joint]."""
        self._carried_kg = np.zeros((0, arms))
        """Payloads in the last tick, [sample, arm]."""
        self._contacts.reset()

    def drive(self, world: World, state: State) -> Drive:
        """Simulate the coming step; return its mean heat drive from the servos' true torque, each [env, arm, joint].

        Raises:
            ValueError: more than one env, a tick out of order, or a step that is no whole number of planned samples.
            FleetError: the simulation diverges.
        """
        samples = self._samples(world)
        self._follow(world, state, samples)
        references = [self._reference(world, state, a, samples) for a in range(len(self._home_q))]
        self._simulate(references)
        qd, tau = self._motion[:, :, 1], self._motion[:, :, 2]
        turning = (state.mode[0] != FAULTED)[:, None]
        current_sq = (reference_current(tau, qd, world.motors) ** 2).mean(axis=0)
        friction_w = friction_heat(qd, world.motors).mean(axis=0)
        return Drive((turning * current_sq)[None], (turning * friction_w)[None])

    def motion(self, world: World, record: StepRecord, offsets_s: Array) -> Array:
        """Joint motion at times in the last simulated step, [1, sample, arm, channel, joint].

        Args:
            offsets_s: Moments within the step, [sample], in (0, dt_s].

        Raises:
            ValueError: another step.
        """
        if record.tick.tolist() != [self._tick]:
            raise ValueError(f"MujocoPlant can read tick {self._tick} only (got {listed(record.tick.tolist())}).")
        faulted, cut_s = record.mode[0] == FAULTED, record.cut_s[0]
        braked = faulted | ((offsets_s[:, None] >= cut_s) & (cut_s < world.dt_s))  # [sample, arm]
        moments = self._sample_of(np.minimum(offsets_s[:, None], np.where(faulted, np.inf, cut_s)))
        motion = self._motion[moments, np.arange(len(cut_s))]
        motion[braked, 1:] = 0.0
        return motion[None]

    def contacts(self, world: World, record: StepRecord) -> list[Event]:
        """Contacts that began in the last simulated step; called for each step once, in order.

        Raises:
            ValueError: another step.
        """
        offsets_s = np.arange(1, len(self._motion) + 1) * (STRIDE * self.model.opt.timestep)
        q = self.motion(world, record, offsets_s)[0, :, :, 0]
        cut_s = record.cut_s[0]
        dropped = (record.mode[0] == FAULTED) | ((offsets_s[:, None] >= cut_s) & (cut_s < world.dt_s))
        time_s = self._tick * world.dt_s + offsets_s
        return self._contacts.events(time_s, q, np.where(dropped, 0.0, self._carried_kg))

    def _samples(self, world: World) -> int:
        """Planned samples in a step."""
        if len(world.shifts) != 1:
            raise ValueError(f"MujocoPlant simulates one env (got {len(world.shifts)}); ProfilePlant takes any number.")
        if len(world.arms) != len(self._home_q):
            raise ValueError(f"MujocoPlant has {len(self._home_q)} arms, the world {len(world.arms)}.")
        samples = round(world.dt_s * RATE_HZ)
        if samples < 1 or abs(world.dt_s * RATE_HZ - samples) > 1e-6:
            raise ValueError(f"MujocoPlant needs steps of whole {1 / RATE_HZ:g} s (got {world.dt_s:g} s).")
        return samples

    def _follow(self, world: World, state: State, samples: int) -> None:
        """Apply the faults and recoveries of the previous tick: brake arms, or place moved ones at home."""
        tick = int(state.tick[0])
        if tick == 0:
            self._reset()
        elif tick != self._tick + 1:
            raise ValueError(f"MujocoPlant must be driven tick by tick: {self._tick + 1} is next (got {tick}).")
        for a in np.flatnonzero(state.faults[0] > self._faults).tolist():
            # A fault loses the rest of its tick, which gives its time.
            at_s = world.dt_s - (state.lost_s[0, a] - self._lost_s[a])
            q = self._motion[self._sample_of(np.array(at_s)), a, 0]
            self._place(a, q)
            self._held[a] = still(q, self._gravity(a), samples)
        for a in list(self._held):
            if state.plan[0, a] < 0:  # moved there
                self._place(a, self._home_q[a])
                self._held[a] = still(self._home_q[a], self._home_tau[a], samples)
            if state.mode[0, a] != FAULTED:
                del self._held[a]
        self._tick = tick
        self._faults, self._lost_s = state.faults[0].copy(), state.lost_s[0].copy()

    def _reference(self, world: World, state: State, a: int, samples: int) -> ArmReference:
        if a in self._held:
            return self._held[a]
        home = still(self._home_q[a], self._home_tau[a], samples)
        if state.mode[0, a] != WORKING:
            return home
        plan = self._plans[state.plan[0, a]]
        return reference(plan, int(state.todo[0, a]), float(state.progress_s[0, a]), samples, home)

    def _simulate(self, references: list[ArmReference]) -> None:
        ctrl = control(references, self._steps, self._kp, self._kv)
        payload_kg = np.stack([r.payload_kg for r in references], axis=1)[:-1]  # [sample, arm]
        force_n = np.stack([r.force_n for r in references], axis=1)[:-1]
        changed = (np.diff(payload_kg, axis=0) != 0).any(axis=1) | (np.diff(force_n, axis=0) != 0).any(axis=(1, 2))
        borders = [0, *(np.flatnonzero(changed) + 1).tolist(), len(payload_kg)]
        path = np.empty((1, len(ctrl), len(self._at)))
        for first, last in pairwise(borders):
            part = slice(first * self._steps, last * self._steps)
            self._load(payload_kg[first])
            self._roll(ctrl[part], force_n[first], path[:, part])
        self._carried_kg = np.repeat(payload_kg, self._steps // STRIDE, axis=0)
        self._motion = self._motion_of(ctrl, path[0])

    def _roll(self, ctrl: Array, force_n: Array, path: Array) -> None:
        """Simulate under constant load and fill path [1, step, state]."""
        spec = _CTRL
        if force_n.any():
            applied = np.zeros((self.model.nbody, 6))
            applied[self._payload, :3] = force_n  # the payload's frame is the tool's: no moment
            ctrl = np.concatenate([ctrl, np.broadcast_to(applied.ravel(), (len(ctrl), applied.size))], axis=1)
            spec = _CTRL_AND_FORCE
        rollout.rollout(self.model, self.data, self._at[None], ctrl[None], control_spec=spec, state=path)
        if any(self.data.warning[kind].number for kind in _DIVERGED):
            raise FleetError(f"The simulation diverged in tick {self._tick}; a smaller timestep_s may help.")
        self._at = path[0, -1].copy()

    def _motion_of(self, ctrl: Array, path: Array) -> Array:
        """Motion every `STRIDE` steps, [sample, arm, channel, joint], with the torque exerted in the step before.

        The integrator applies a servo's force at the start of a step and its damping at the end, unless the force is
        clipped.
        """
        joints = len(self._kp)
        before, after = path[STRIDE - 2 :: STRIDE, 1:], path[STRIDE - 1 :: STRIDE, 1:]
        q, qd, qd_after = before[:, :joints], before[:, joints:], after[:, joints:]
        force = self._kp * (ctrl[STRIDE - 1 :: STRIDE] - q) - self._kv * qd
        tau = np.where(
            np.abs(force) < self._clip,
            force - self._kv * (qd_after - qd),
            np.clip(force, -self._clip, self._clip),
        )
        motion = np.stack([after[:, :joints], qd_after, tau], axis=1)
        return motion.reshape(len(motion), 3, -1, JOINTS).swapaxes(1, 2)

    def _sample_of(self, offset_s: Array) -> Array:
        """Row of `_motion` at moments within the tick."""
        row = np.floor(offset_s / (STRIDE * self.model.opt.timestep) + 1e-6).astype(int) - 1
        return np.clip(row, 0, len(self._motion) - 1)

    def _load(self, payload_kg: Array) -> None:
        """Set the payloads' masses and the sizes of their balls, [arm]."""
        if not np.array_equal(self.model.body_mass[self._payload], payload_kg):
            set_payload_balls(self.model, self._payload, payload_kg)
            load_hands(self.model, self._scratch, self._payload, payload_kg)

    def _place(self, a: int, q: Array) -> None:
        """Place an arm at rest in a posture."""
        joints = len(self._kp)
        own = slice(1 + a * JOINTS, 1 + (a + 1) * JOINTS)
        self._at[own] = q
        self._at[own.start + joints : own.stop + joints] = 0.0

    def _gravity(self, a: int) -> Array:
        """Torque that holds an arm with an empty hand in its present posture, N·m, [joint]."""
        self._load(np.zeros(len(self._payload)))
        mujoco.mj_setState(self.model, self.data, self._at, _STATE)
        mujoco.mj_forward(self.model, self.data)
        return self.data.qfrc_bias[a * JOINTS : (a + 1) * JOINTS].copy()


def load_hands(model: mujoco.MjModel, scratch: mujoco.MjData, bodies: Array, payload_kg: Array) -> None:
    """Set the masses, kg, of the payload bodies, by id, and update all quantities of the model that depend on them.

    Accelerations need only the masses; centres of mass and joint stops also use subtree masses and inverse weights.
    """
    model.body_mass[bodies] = payload_kg
    mujoco.mj_setConst(model, scratch)
