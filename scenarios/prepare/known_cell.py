"""A cell as its arms know it, for policies that plan in a simulator."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from agents.policy import PlanningPolicy, Policy
from fleet.difficulty import Blind
from fleet.engine.tables import Tables, tables_of
from fleet.env.lookahead import CellSimulator
from scenarios.prepare.fleet import Fleet, ShiftFactory
from scenarios.spec.jobs import weights_of

if TYPE_CHECKING:
    from fleet.env.allocation_v1 import AllocationEnv


def as_known(fleet: Fleet) -> Fleet:
    """The fleet with the thermal networks and motors that its arms know, and without scores."""
    variants = tuple(as_known(each) for each in fleet.variants)
    arms = tuple(
        replace(arm, thermal=arm.beliefs[0], motors=arm.beliefs[1], model=Blind(), known=arm.beliefs)
        for arm in fleet.arms
    )
    return replace(fleet, arms=arms, variants=variants)


def simulator_of(fleet: Fleet, tables: Tables) -> CellSimulator:
    """The simulator of a cell.

    Args:
        tables: Of `as_known(fleet)`.
    """
    return CellSimulator(tables, len(fleet.arms), fleet.scenario.slots, weights_of(fleet.scenario))


def let_plan(policy: Policy, fleet: Fleet, env: "AllocationEnv", seed: int) -> None:
    """Give a policy that plans a simulator of the shift that an env has just begun, of a prepared fleet and a seed."""
    if isinstance(policy, PlanningPolicy):
        policy.plan_in(env.lookahead(simulator_of_shift(fleet, seed)))


def simulator_of_shift(fleet: Fleet, seed: int) -> CellSimulator:
    """The simulator of a cell for the shift of one seed, in which every job is a kind of its own."""
    world = ShiftFactory(as_known(fleet))(np.random.SeedSequence(seed)).world
    return simulator_of(fleet, tables_of(world)[0])
