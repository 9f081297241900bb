"""Perform one plan: one arm in MuJoCo under closed-loop control, with the resulting motor temperatures."""

from dataclasses import dataclass, replace

import numpy as np

from fleet.difficulty import Blind
from fleet.engine.profile_plant import sample
from fleet.engine.shift import step
from fleet.engine.state import initial
from fleet.engine.world import Arm, build_world
from fleet.job import Job
from fleet.motion import RATE_HZ, Phase, Plan
from fleet.motor import Motors
from fleet.physics.models import ArmModel
from fleet.physics.mujoco_plant import MujocoPlant
from fleet.robot import GEN3, Robot, ThermalLimits
from fleet.thermal import WINDING, ThermalModel

Array = np.ndarray

NEVER_C = 500.0
"""Warning limit above any motor temperature, so that the arm is never stopped."""
CLIPPED = 0.999
"""Share of the torque clip from which a servo counts as clipped."""


@dataclass(frozen=True, eq=False)
class Performance:
    """Measured motion and motor temperatures of a performed plan."""

    plan: Plan
    profile: Array
    """Measured q, qd, tau at RATE_HZ, [time, 3, joint]; row i belongs to the plan's sample i + 1."""
    planned: Array
    """Planned q, qd, tau at the same times, [time, 3, joint]."""
    time_s: Array
    """Time since leaving home, s, [tick + 1]; begins at zero."""
    temp_c: Array
    """True winding temperatures at those times, °C, [tick + 1, joint]."""

    @property
    def error_rad(self) -> float:
        """Largest deviation of a joint from its plan."""
        return float(np.abs(self.profile[:, 0] - self.planned[:, 0]).max())

    @property
    def clipped(self) -> bool:
        """Whether a servo reached its largest torque."""
        return bool(np.any(np.abs(self.profile[:, 2]) >= CLIPPED * np.array(GEN3.torque_clip)))

    def as_plan(self) -> Plan:
        """The plan with measured in place of planned motion, of one repetition.

        The first sample, home at rest, is as planned.
        """
        first = next(phase.profile[:1] for phase in self.plan.phases if len(phase.profile))
        whole = np.concatenate([first, self.profile]).astype(np.float32)
        parts = np.split(whole, np.cumsum([len(phase.profile) for phase in self.plan.phases])[:-1])
        approach, cycle, retreat = (
            Phase(part, phase.payload_kg) for part, phase in zip(parts, self.plan.phases, strict=True)
        )
        return replace(self.plan, approach=approach, cycle=cycle, retreat=retreat)


def bare_arm(robot: Robot, motors: Motors, thermal: ThermalModel) -> Arm:
    """An arm that performs plans; without difficulty model and without work."""
    rest_tau = ArmModel(robot).gravity_torque(robot.home_q())
    return Arm(robot=robot, motors=motors, thermal=thermal, rest_tau=rest_tau, model=Blind(), plans={})


def perform(arm: Arm, plan: Plan, *, start_c: Array, ambient_c: float, tick_s: float | None = None) -> Performance:
    """Perform a plan once in MuJoCo with a single arm; heat follows from the torque that its servos exert.

    No thermal limit stops the arm.

    Args:
        arm: Its robot, motors and thermal network; its plans and difficulty model are not used.
        start_c: Temperatures on leaving home, °C, [node].
        tick_s: Time step of temperatures, a whole number of samples; by default the whole plan.
    """
    length = sum(len(phase.profile) for phase in plan.phases)
    samples = length if tick_s is None else round(tick_s * RATE_HZ)
    ticks = -(-length // samples)
    job = Job(name="performed", work=plan.work, repetitions=1, release_s=0.0, due_s=1e9, value=1.0)
    single = replace(arm, model=Blind(), plans={plan.work: (plan,)})
    world, plans = build_world(
        [single],
        [[job]],
        limits=ThermalLimits(warning_c=NEVER_C, error_c=2 * NEVER_C, restart_c=1.0),
        dt_s=samples / RATE_HZ,
        ticks=ticks,
        slots=1,
        ambient_c=np.full((ticks, 1), ambient_c),
        start_warm=False,
    )
    world = replace(world, start_c=np.array(start_c, dtype=float)[None])
    plant = MujocoPlant([arm.robot], plans, arm.rest_tau[None])
    state = initial(world)
    offsets_s = np.arange(1, samples + 1) / RATE_HZ
    read, temps = [], [state.temp_c[0, 0, WINDING]]
    for tick in range(ticks):
        done = step(world, state, np.array([[int(tick == 0)]]), plant)
        read.append(plant.motion(world, done.record, offsets_s)[0, :, 0])
        state = done.state
        temps.append(state.temp_c[0, 0, WINDING])
    moments = np.arange(1, length) / RATE_HZ
    return Performance(
        plan=plan,
        profile=np.concatenate(read)[: length - 1],
        planned=sample(plan, moments, 1).astype(float),
        time_s=np.arange(ticks + 1) * world.dt_s,
        temp_c=np.stack(temps),
    )
