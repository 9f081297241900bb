"""A cell as its arms know it, for policies that plan in a simulator."""

from dataclasses import replace

import numpy as np

from fleet.difficulty import Blind
from fleet.engine.lookahead import CellSimulator
from fleet.engine.tables import Tables, tables_of
from scenarios.fault_price import weights_of
from scenarios.prepare.fleet import Fleet, ShiftFactory


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


def simulator_of_shift(fleet: Fleet, seed: int) -> CellSimulator:
    """The simulator of a cell for the shift of one seed, in which every job is a kind of its own."""
    world = ShiftFactory(as_known(fleet))(np.random.SeedSequence(seed)).world
    return simulator_of(fleet, tables_of(world)[0])
