"""Selection of the plans that an arm offers for a job; it does not depend on the difficulty model."""

from collections.abc import Sequence
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np

from fleet.heat.motor import Motors, gen3_motors
from fleet.heat.thermal import NODES, WINDING, ThermalModel, advance, drive_heat, gen3_network, thermal_model
from fleet.motion import Drive, Plan, drives
from fleet.robot import JOINTS

Array = np.ndarray

PLANS = 2
"""Maximum number of plans that an arm offers for a job."""
COOLER_K, COOLER_SHARE = 1.0, 0.1
"""The coolest plan is offered too if its rise is below that of the fastest by this much, or by this share."""
AMBIENT_C = 25.0
"""Ambient temperature of the prediction; rises hardly depend on it."""


def offered_plans(variants: Sequence[Plan], repetitions: int) -> list[Plan]:
    """The fastest plan, then the coolest if it is clearly cooler (`COOLER_K`); empty without variants.

    Where there are plans at other stations, the second plan is the coolest of those: one station may be taken.

    Args:
        variants: Plans for the same work, or for works that serve alike.
        repetitions: Cycles of the job.
    """
    if not variants:
        return []
    fastest = min(variants, key=lambda plan: plan.duration_s(repetitions))
    if elsewhere := [plan for plan in variants if not set(plan.work.stations) & set(fastest.work.stations)]:
        return [fastest, elsewhere[int(predicted_rise(tuple(elsewhere), repetitions).argmin())]]
    rise_k = predicted_rise(tuple(variants), repetitions)
    coolest, least_k = variants[int(rise_k.argmin())], float(rise_k.min())
    most_k = float(rise_k[[plan is fastest for plan in variants]][0])
    saved_k = most_k - least_k
    clearly = coolest is not fastest and (saved_k >= COOLER_K or saved_k >= COOLER_SHARE * most_k)
    return [fastest, coolest] if clearly else [fastest]


def predicted_rise(variants: tuple[Plan, ...], repetitions: int) -> Array:
    """Temperature rise of the hottest motor of a nominal arm at the end of each plan, from idle, K, [plan].

    One exact step with the mean heat of the job. Copper and magnets have the mean of first and last temperature.
    """
    motors, thermal, idle_c = _nominal()
    loads = _loads(variants)
    share = np.stack([plan.weights(repetitions) for plan in variants])[:, None, :]
    load = Drive((share @ loads.current_sq)[:, 0], (share @ loads.friction_w)[:, 0])
    phi, gamma = thermal.step_matrices(np.array([plan.duration_s(repetitions) for plan in variants]))
    end_c = np.broadcast_to(idle_c, (len(variants), NODES))
    for _ in range(2):
        heat_w = drive_heat((end_c + idle_c) / 2.0, load.current_sq, load.friction_w, motors)
        end_c = advance(idle_c, heat_w, AMBIENT_C, phi, gamma, thermal.to_ambient)
    return (end_c - idle_c)[:, WINDING].max(axis=1)


@lru_cache(maxsize=1)
def _nominal() -> tuple[Motors, ThermalModel, Array]:
    """Motors and thermal model of a nominal arm, and its steady temperatures without load, °C, [node]."""
    motors, thermal = gen3_motors(), thermal_model(gen3_network())
    none = np.zeros(JOINTS)
    return motors, thermal, thermal.steady(drive_heat(np.full(NODES, AMBIENT_C), none, none, motors), AMBIENT_C)


_DRIVES: WeakKeyDictionary[Plan, Drive] = WeakKeyDictionary()


def nominal_drive(plan: Plan) -> Drive:
    """Mean drive of each phase in the motors of a nominal arm, [phase, joint]; computed once while the plan exists."""
    if plan not in _DRIVES:
        _DRIVES[plan] = drives([phase.profile for phase in plan.phases], _nominal()[0])
    return _DRIVES[plan]


def _loads(variants: Sequence[Plan]) -> Drive:
    """Mean drives of the phases, [plan, phase, joint]."""
    each = [nominal_drive(plan) for plan in variants]
    return Drive(np.stack([one.current_sq for one in each]), np.stack([one.friction_w for one in each]))
