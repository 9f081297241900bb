"""What has changed of the arms since they were prepared: their true hardware, torques and sensors in a shift.

Plans, twins, networks and past jobs are those of the arms before. Only the simulator, and `oracle`, know the change.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fleet.engine.world import Arm
from fleet.motion import RATE_HZ, Phase, Plan, distinct
from scenarios.prepare.arms import hardware_of
from scenarios.spec.jobs import works_of
from scenarios.spec.schema import Scenario, Surprise

if TYPE_CHECKING:  # MuJoCo, which an arm whose plans are known does not load
    from fleet.arm.model import ArmModel

HOUR_S = 3600.0


def arms_with_surprises(scenario: Scenario, arms: Sequence[Arm]) -> tuple[Arm, ...]:
    """The arms as they are in the shift, each with itself as it was `before`, by the surprises of the scenario.

    Args:
        arms: Of the scenario; those that are already surprised are taken as they were before.
    """
    arms = [arm.before or arm for arm in arms]
    if not scenario.surprises:
        return tuple(arms)
    return tuple(_surprised(scenario, arm) for arm in arms)


def _surprised(scenario: Scenario, arm: Arm) -> Arm:
    own = [surprise for surprise in scenario.surprises if surprise.arm == arm.robot.name]
    loads = [surprise for surprise in scenario.surprises if surprise.kind == "payload"]
    heavier = _heavier(scenario, arm, loads)
    if not own and not heavier:
        return arm
    index = scenario.index_of(arm.robot.name)
    spec = scenario.arms[index]
    for surprise in own:
        if surprise.kind == "friction":
            spec = replace(spec, wear=spec.wear + surprise.size)
        elif surprise.kind == "fan":
            spec = replace(spec, cooling="still_air")
    changed: dict[str, Any] = {}  # fields of several types
    if spec != scenario.arms[index]:
        specs = (*scenario.arms[:index], spec, *scenario.arms[index + 1 :])
        _, changed["motors"], changed["thermal"] = hardware_of(replace(scenario, arms=specs), index)
    drift_k_per_s = sum(surprise.size for surprise in own if surprise.kind == "sensor") / HOUR_S
    return replace(arm, before=arm, executed=heavier, drift_k_per_s=drift_k_per_s, **changed)


def _heavier(scenario: Scenario, arm: Arm, loads: Sequence[Surprise]) -> dict[Plan, Plan]:
    """The plans of an arm for jobs with another load than declared, with the torques that they need."""
    if not loads:
        return {}
    from fleet.arm.model import ArmModel

    streams = {stream.name: stream for stream in scenario.jobs}
    factors = {work: each.size for each in loads for work in works_of(scenario, streams[each.jobs])}
    model = ArmModel(arm.robot)
    return {
        plan: replace(
            plan,
            **{name: phase_with_load(model, getattr(plan, name), factor) for name in ("approach", "cycle", "retreat")},
        )
        for work, factor in factors.items()
        for plan in arm.plans.get(work, ())
        if work.payload_kg
    }


def phase_with_load(model: "ArmModel", phase: Phase, factor: float) -> Phase:
    """A phase with the torques of another mass, `factor` times the declared one, where it carries one."""
    profile = distinct(phase.profile)
    count = len(profile)
    more_kg = (factor - 1.0) * phase.payload_kg[:count].astype(float)
    if not more_kg.any():
        return phase
    q, qd, _ = profile.astype(float).transpose(1, 0, 2)
    qdd = np.gradient(qd, 1.0 / RATE_HZ, axis=0) if count > 1 else np.zeros_like(qd)
    more_nm = model.inverse_dynamics(q, qd, qdd, more_kg) - model.inverse_dynamics(q, qd, qdd)
    loaded = profile.copy()
    loaded[:, 2] += more_nm
    if count == 1 < len(phase.profile):
        loaded = np.broadcast_to(loaded, phase.profile.shape)
    return Phase(loaded, phase.payload_kg * np.float32(factor))
