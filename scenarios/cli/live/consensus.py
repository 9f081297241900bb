"""An arm that shares the jobs out with its peers, as `thermofleet arm --policy consensus` runs it."""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer

from fleet.errors import BusError, FleetError
from scenarios.live.allocation import live_fleet
from scenarios.policy_loader import arm_policy_of
from scenarios.schema import Scenario

if TYPE_CHECKING:
    from fleet.bus.client.client import BusClient
    from fleet.live.arm.node import ArmNode
    from fleet.live.consensus.node import ConsensusNode, Membership
    from scenarios.cli.signals import Stop

TURN_S = 0.25
"""Real seconds between two looks at what else is to be done."""
FAREWELL_S = 2.0
"""Real seconds for the last words: peers that do not know yet that all is done ask for it."""


def membership_of(scenario: Scenario, name: str, policy: str, *, jobs: str, seed: int) -> "Membership":
    """What an arm of a scenario needs to share out jobs with its peers.

    Args:
        name: Of the arm.
        policy: Of scope `arm`.
        jobs: scenario or none.
        seed: Of the scenario's jobs and the policy.

    Raises:
        FleetError: the scenario has no such arm, or there is no such policy.
    """
    from fleet.live.consensus.node import Membership
    from scenarios.cli.live.auction import own_jobs

    place = scenario.index_of(name)
    chosen = arm_policy_of(policy)
    chosen.reset(np.random.default_rng(np.random.SeedSequence([seed, 1, place])))
    stream = jobs == "scenario"
    return Membership(
        fleet=live_fleet(scenario),
        choose=chosen.choose,
        slots=scenario.slots,
        places=frozenset(place.name for place in scenario.places),
        stream=tuple(own_jobs(scenario, seed)) if stream else (),
        horizon_s=scenario.horizon_s if stream else float("inf"),
    )


def refuse_auctioneer(link: "BusClient") -> None:
    """Two ways to share the same jobs out would have them done twice.

    Raises:
        BusError: the fleet has an auctioneer.
    """
    from fleet.bus.protocol import keys

    if there := link.tokens(keys.of_every_auction(link.fleet, "alive"), timeout_s=2.0):
        names = ", ".join(sorted(there))
        raise BusError(f"Fleet '{link.fleet}' has an auctioneer: '{names}'. Stop it first, or leave --policy out.")


def refuse_other_way(folder: Path, arms: Iterable[str], *, alone: bool) -> None:
    """A shift that was begun in one way does not go on in the other, which would not know what is done.

    Args:
        folder: Of the journals.
        arms: Whose journals are looked at.
        alone: Whether they are to share the jobs out themselves.

    Raises:
        FleetError: a journal is of the other way.
    """
    for arm in arms:
        grants, journal = folder / f"{arm}.grants", folder / f"{arm}.journal"
        if alone and not grants.exists() and journal.exists() and journal.stat().st_size:
            raise FleetError(
                f"{journal} has no {grants.name} beside it: it is of a shift with an auctioneer, or the grants are "
                "lost, and jobs would be done twice. Take the --policy that it was begun with, or another folder for a "
                "new shift."
            )
        if not alone and grants.exists() and grants.stat().st_size:
            raise FleetError(
                f"{grants} is of a shift in which the arms shared the jobs out themselves, and jobs would be done "
                "twice. Take the --policy that it was begun with, or another folder for a new shift."
            )


@contextmanager
def seat(path: Path, membership: "Membership") -> Iterator[Any]:
    """What gives an arm its seat among its peers, with the journal of its grants at `path` held open.

    Raises:
        FleetError: the journal cannot be used.
    """
    from fleet.live.consensus.granter import GrantRecord
    from fleet.live.consensus.node import ConsensusNode
    from fleet.live.journal import Journal

    with Journal[GrantRecord](path, GrantRecord) as book:

        def take_seat(worker: "ArmNode", life: int) -> "ConsensusNode":
            return ConsensusNode(worker, membership, book, boot=life)

        yield take_seat


def work(node: "ArmNode", stop: "Stop") -> bool:
    """Live until all is done, and tell how it stands, or until told to stop; says which it was."""
    from fleet.live.consensus.node import ConsensusNode

    orders = node.work_source
    assert isinstance(orders, ConsensusNode)
    while not stop.is_set() and not orders.over:
        node.serve(time.monotonic() + TURN_S)
    done = not stop.is_set()
    if done:
        typer.echo(told(node))
    until_s = time.monotonic() + FAREWELL_S
    while done and not stop.is_set() and time.monotonic() < until_s:
        node.serve(min(until_s, time.monotonic() + TURN_S))
    return done


def told(node: "ArmNode") -> str:
    """How it stands, in a line or more."""
    from fleet.live.consensus.node import ConsensusNode

    orders = node.work_source
    assert isinstance(orders, ConsensusNode)
    statuses = orders.statuses()
    finished = sum(said.state == "finished" for said in statuses)
    lines = [
        f"{node.clock.now_s(time.monotonic()):.0f} s: {finished} of {len(statuses)} jobs finished, as this arm knows; "
        f"it worked out {orders.participant.rounds} times who gets what."
    ]
    lines += [
        f"  {said.job}: {said.state}{f' at {said.arm}' if said.arm else ''}{f', {said.reason}' if said.reason else ''}"
        for said in statuses
        if said.state != "finished"
    ]
    return "\n".join(lines)
