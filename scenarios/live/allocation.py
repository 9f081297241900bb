"""Central policies in a live fleet: they allocate the jobs of each round of the auctioneer."""

import logging

from agents.policy import Policy
from fleet.env.validation import actions_of
from fleet.errors import BusError, FleetError
from fleet.live.auction.knowledge import LiveFleet, claimed_jobs, observe
from fleet.live.auction.round import Allocate, Assignment, Bidding, resolve_claims
from scenarios.policy_loader import ON_BUS, OnBus, policy_at, scope_of, without_simulator
from scenarios.schema import Scenario

_LOG = logging.getLogger(__name__)

ON_BUS_S = 1.0
"""Most real seconds for a decision of a policy in another process: meanwhile the auctioneer renews no lease."""


class CentralAllocation:
    """An allocation rule of the auctioneer, made of a central policy."""

    def __init__(self, policy: Policy, fleet: LiveFleet) -> None:
        """Take a policy that was reset."""
        self._policy, self._fleet = policy, fleet
        self._last: dict[str, int] = {}
        self._problem = ""

    def __call__(self, bidding: Bidding) -> dict[str, Assignment]:
        """Arm and plan of each job that is assigned: the claims of the policy, resolved as in simulation.

        None if the policy is in another process that does not reply; the auctioneer offers the jobs again.
        """
        seen = observe(bidding, self._fleet, last=self._last)
        try:
            actions = actions_of(list(seen), self._policy.act(seen)).tolist()
        except BusError as error:
            if str(error) != self._problem:  # once, not in every round
                _LOG.error("Nothing is awarded until the policy replies: %s", error)
            self._problem = str(error)
            return {}
        if self._problem:
            _LOG.warning("The policy replies again.")
            self._problem = ""
        claims = claimed_jobs(bidding, seen, dict(zip(seen, actions, strict=True)))
        awarded = resolve_claims(bidding, claims, self._fleet.order(bidding.quotes))
        winners = {assignment.arm for assignment in awarded.values()}
        self._last = {arm: 1 if arm in winners else -1 for arm in claims}
        return awarded


def live_fleet(scenario: Scenario, *, ends: bool = True) -> LiveFleet:
    """Parameters of a scenario that live policies see.

    Args:
        ends: Whether the shift ends at the scenario's horizon; a fleet without the scenario's jobs has no end.
    """
    return LiveFleet(
        arms=tuple(arm.name for arm in scenario.arms),
        limits=scenario.limits,
        horizon_s=scenario.horizon_s if ends else float("inf"),
    )


def central_allocation(
    policy: str, scenario: Scenario, seed: int, *, ends: bool = True, bus: OnBus = ON_BUS
) -> Allocate:
    """Allocation rule of the auctioneer of a scenario.

    Args:
        policy: As `scenarios.policy_loader` takes it.
        ends: As of `live_fleet`.
        bus: Fleet and router, for a policy in another process.

    Raises:
        FleetError: no such policy, or one of scope `arm`, which takes no auctioneer.
    """
    if scope_of(policy) == "arm":
        raise FleetError(
            f"Policy '{policy}' of scope arm runs without an auctioneer. "
            f"Start each arm with: thermofleet arm run SCENARIO NAME --policy {policy}"
        )
    made = without_simulator(policy, policy_at(policy, seed, bus))
    return CentralAllocation(made, live_fleet(scenario, ends=ends))
