"""An arm that allocates jobs with its peers, without an auctioneer: `thermofleet arm --policy consensus`."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.errors import BusError
from fleet.live.arm.node import ArmNode
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Membership
from fleet.live.consensus.records import GrantRecord
from fleet.live.journal import Journal
from scenarios.cli.live.auction import own_jobs, summary
from scenarios.cli.signals import Stop
from scenarios.cli.terminal import echo
from scenarios.live.allocation import live_fleet
from scenarios.live.cell import cell_message, cell_space
from scenarios.policy_loader import arm_policy_of
from scenarios.schema import Scenario

TURN_S = 0.25
"""Real seconds between two checks whether all jobs are settled."""
FAREWELL_S = 2.0
"""Real seconds to serve after that: peers that do not know it yet request the missing outcomes."""


def membership_of(scenario: Scenario, name: str, policy: str, *, jobs: str, seed: int) -> Membership:
    """How the arm `name` of a scenario takes part in the consensus of its fleet, by a policy of scope `arm`.

    Raises:
        FleetError: the scenario has no such arm, or there is no such policy.
    """
    place = scenario.index_of(name)
    chosen = arm_policy_of(policy)
    chosen.reset(np.random.default_rng(np.random.SeedSequence([seed, 1, place])))
    stream = jobs == "scenario"
    fleet = live_fleet(scenario, ends=stream)
    return Membership(
        fleet=fleet,
        choose=chosen.choose,
        slots=scenario.slots,
        places=frozenset(place.name for place in scenario.places),
        stream=tuple(own_jobs(scenario, seed)) if stream else (),
        horizon_s=fleet.horizon_s,
        excludes=cell_space(scenario),
        cell=cell_message(scenario, name),
    )


def refuse_auctioneer(link: BusClient) -> None:
    """Check that the fleet has no auctioneer: it would award jobs that the arms allocate too.

    Raises:
        BusError: the fleet has one.
    """
    if present := link.tokens(keys.of_every_auction(link.fleet, "alive"), timeout_s=2.0):
        names = ", ".join(sorted(present))
        raise BusError(f"Fleet '{link.fleet}' has an auctioneer: '{names}'. Stop it first, or leave --policy out.")


@contextmanager
def work_source(
    path: Path, membership: Membership, *, new_epoch: bool = False
) -> Iterator[Callable[[ArmNode, int], ConsensusNode]]:
    """Factory of an arm's work source, from the arm and its boot number; the journal of its grants is open meanwhile.

    Raises:
        FleetError: the journal cannot be used.
    """
    with Journal[GrantRecord](path, GrantRecord) as book:
        yield lambda arm, boot: ConsensusNode(arm, membership, book, boot=boot, new_epoch=new_epoch)


def serve_until_done(node: ArmNode, stop: Stop) -> bool:
    """Serve until all jobs are settled, and print a summary; return False if stopped before that."""
    source = node.work_source
    assert isinstance(source, ConsensusNode)
    while not stop.is_set() and not source.over:
        node.serve(time.monotonic() + TURN_S)
    if stop.is_set():
        return False
    left = source.participant.granter.register.settled.left
    echo(summary(source.statuses(), node.clock.now_s(time.monotonic()), left))
    echo(f"This is the view of one arm, after {source.participant.rounds} rounds of allocation.")
    until_s = time.monotonic() + FAREWELL_S
    while not stop.is_set() and time.monotonic() < until_s:
        node.serve(min(until_s, time.monotonic() + TURN_S))
    return True
