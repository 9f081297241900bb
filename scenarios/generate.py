"""Motion that an arm's twin makes up, verified before anybody gets it: executable, and cool over the whole horizon.

The twin proposes (`twin.generate`); inverse dynamics gives the torque; limits, clearance and the arm's knowledge of
its heat are asked first, then the motion is performed in closed loop in MuJoCo. Whatever fails is counted.

Verification uses what an arm can know: nominal or identified motors and thermal network. What its true motors would
do is measured beside it, `Motion.peak_c`, and decides nothing.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleet.errors import FleetError
from fleet.motion import RATE_HZ, Phase, Plan
from fleet.motor import Motors, gen3_motors
from fleet.robot import Robot
from fleet.sim.clearance import Clearance
from fleet.sim.limits import broken_limit
from fleet.sim.models import ArmModel
from fleet.sim.world import Arm
from fleet.thermal import NODES, ThermalModel, gen3_network, thermal_model
from scenarios.cool import cold_peaks
from scenarios.perform import perform
from twin.generate import Variation, check_source, vary
from twin.score import Twin

Array = np.ndarray

LOOK_S = 0.1
"""Postures of a motion are checked for clearance so far apart in time."""
MOST_DRAWS = 20
"""Per motion asked for; where more fail, what is asked for is not there."""


class GenerationError(FleetError):
    """No motion passed the verification; says what they failed at."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Verification:
    """What a generated motion must prove, and with which knowledge of the arm's heat."""

    motors: Motors
    thermal: ThermalModel
    ambient_c: float
    cool_c: float = 40.0
    """No motor may pass this while the cycle repeats over the horizon from a cold start."""
    margin_k: float = 1.0
    """Predicted temperatures stay so far below `cool_c`: what the arm knows of its heat is not exact."""
    horizon_s: float = 1800.0
    tracking_rad: float = 0.01
    """Farthest that a joint may be from its plan in closed loop."""

    @classmethod
    def nominal(cls, robot: Robot, ambient_c: float, **changes: float) -> "Verification":
        """With the heat of a nominal Gen3 in this robot's cooling; whoever identified an arm's own gives that."""
        network = gen3_network(cooling=robot.cooling, cooling_factor=robot.cooling_factor)
        return cls(motors=gen3_motors(wear=robot.wear), thermal=thermal_model(network), ambient_c=ambient_c, **changes)

    def peak_c(self, plan: Plan) -> Array:
        """Hottest winding temperatures as the arm predicts them, °C, [joint]."""
        return peak_of(plan, self.motors, self.thermal, self.ambient_c, self.horizon_s)


@dataclass(frozen=True, eq=False)
class Motion:
    """One generated motion that passed, what it was made from, and what came of it."""

    plan: Plan
    source: Plan
    distance_rad: float
    """Root mean square distance of the joint positions from the source's."""
    distance_z: float
    """The same in training standard deviations."""
    slowed: float
    """How much longer than the source its slowest piece takes, to keep the limits."""
    predicted_c: Array
    """Peak temperature as the arm predicts it from its measured torque, °C, [joint]."""
    peak_c: Array
    """Peak temperature of the true motors, °C, [joint]; decides nothing."""
    error_rad: float
    """Farthest that a joint was from its plan when MuJoCo performed it."""


@dataclass(frozen=True, eq=False)
class Generated:
    """What is handed out, and what was rejected on the way."""

    arm: str
    twin_version: str
    s: float
    seed: int
    asked: int
    verification: Verification
    motions: tuple[Motion, ...]
    rejected: Mapping[str, int]
    """Count by reason: joint limit, torque, collision, heat (predicted), tracking, torque clip."""

    @property
    def plans(self) -> tuple[Plan, ...]:
        """The motions as plans, to be scored, stored or learned from."""
        return tuple(motion.plan for motion in self.motions)

    @property
    def draws(self) -> int:
        """How many motions were made up in all."""
        return len(self.motions) + sum(self.rejected.values())

    @property
    def truly_cool(self) -> float:
        """Share of what is handed out whose true motors stay below `cool_c` over the horizon; NaN for nothing."""
        return float(np.mean([motion.peak_c.max() < self.verification.cool_c for motion in self.motions] or [np.nan]))


class _Rejected(Exception):
    """The reason, as it is counted."""


def generate(
    twin: Twin,
    arm: Arm,
    sources: Sequence[Plan],
    *,
    s: float = 1.0,
    count: int = 20,
    seed: int = 0,
    verification: Verification,
    progress: Callable[[float], None] = lambda share: None,
) -> Generated:
    """So many verified motions near known ones; fewer where most fail, with the reasons counted.

    The same arguments give the same motions, and more of them begin with the same.

    Args:
        arm: The true arm, to perform on and to measure `Motion.peak_c`.
        sources: Known, cool motion of this arm. Presses are left out: without the contact their motion is another.
        s: Perturbation in posterior standard deviations; 0 reconstructs.

    Raises:
        ValueError: s < 0, count < 1, or no source motion.
        GenerationError: nothing passed.
    """
    if count < 1:
        raise ValueError(f"The number of motions must be >= 1 (got {count}).")
    usable = [plan for plan in sources if plan.work.kind != "press"]
    if not usable:
        raise ValueError(f"Generation needs a source motion, not a press, for arm '{arm.robot.name}' (got none).")
    for plan in usable:
        check_source(plan, s)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    model, rejected = ArmModel(arm.robot), Counter[str]()
    clearance, motions, order = Clearance(model), list[Motion](), list[int]()
    while len(motions) < count and len(motions) + rejected.total() < MOST_DRAWS * count:
        order = order or rng.permutation(len(usable)).tolist()
        source = usable[order.pop()]
        try:
            motions.append(_verified(vary(twin, source, s, rng), source, arm, model, clearance, verification))
        except _Rejected as why:
            rejected[str(why)] += 1
        progress(len(motions) / count)
    if not motions:
        reasons = ", ".join(f"{reason} {times}" for reason, times in rejected.most_common())
        raise GenerationError(
            f"None of {rejected.total()} motions of arm '{arm.robot.name}' passed ({reasons}). Lower s (got {s:g}), "
            "give lighter source motions, or raise cool_c."
        )
    return Generated(arm.robot.name, twin.version, s, seed, count, verification, tuple(motions), dict(rejected))


def _verified(
    made: Variation, source: Plan, arm: Arm, model: ArmModel, clearance: Clearance, asked: Verification
) -> Motion:
    """The motion as a plan with everything known about it.

    Raises:
        _Rejected: it failed.
    """
    plan = planned(made, source, model)
    if clearance.first_hit(_postures(plan)):
        raise _Rejected("collision")
    allowed_c = asked.cool_c - asked.margin_k
    if asked.peak_c(plan).max() > allowed_c:
        raise _Rejected("heat")
    cold_c = np.full(NODES, asked.ambient_c)
    done = perform(arm, plan, start_c=cold_c, ambient_c=asked.ambient_c)
    if done.clipped:
        raise _Rejected("torque clip")
    if done.error_rad > asked.tracking_rad:
        raise _Rejected("tracking")
    measured = done.as_plan()
    predicted_c = asked.peak_c(measured)
    if predicted_c.max() > allowed_c:
        raise _Rejected("heat")
    return Motion(
        plan=plan,
        source=source,
        distance_rad=made.distance_rad,
        distance_z=made.distance_z,
        slowed=made.slowed,
        predicted_c=predicted_c,
        peak_c=peak_of(measured, arm.motors, arm.thermal, asked.ambient_c, asked.horizon_s),
        error_rad=done.error_rad,
    )


def planned(made: Variation, source: Plan, model: ArmModel) -> Plan:
    """The plan of a variation, with the torque of inverse dynamics and the payload of its source.

    Raises:
        _Rejected: a joint stop or a torque limit is in the way.
    """
    phases = []
    for part in made.stretches:
        tau = model.inverse_dynamics(part.q, part.qd, part.qdd, part.payload_kg)
        if broken := broken_limit(part.q, part.qd, part.qdd, tau, model.position_range):
            raise _Rejected(broken[1].split(":")[0])
        profile = np.stack([part.q, part.qd, tau], axis=1).astype(np.float32)
        phases.append(Phase(profile, part.payload_kg.astype(np.float32)))
    approach, cycle, retreat = phases
    return replace(source, approach=approach, cycle=cycle, retreat=retreat)


def peak_of(plan: Plan, motors: Motors, thermal: ThermalModel, ambient_c: float, horizon_s: float) -> Array:
    """Hottest winding temperatures when a plan's cycle repeats over the horizon from a cold start, °C, [joint]."""
    return cold_peaks([plan], motors, thermal, ambient_c=ambient_c, horizon_s=horizon_s)[0]


def _postures(plan: Plan) -> Array:
    every = max(1, round(LOOK_S * RATE_HZ))
    return np.concatenate([phase.profile[::every, 0] for phase in plan.phases]).astype(float)
