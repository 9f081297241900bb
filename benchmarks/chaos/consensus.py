"""Partitions of a fleet without an auctioneer."""

from benchmarks.chaos.fleet_under_test import Fleet
from benchmarks.chaos.partition import CUT_S, cut_at_work

LEASE_S = 8.0
"""Real seconds after which no job continues without a majority: a lease, its margins, and a last cycle."""


def cut_off_half(fleet: Fleet) -> float:
    """Cut off half of the arms during their jobs: neither half may begin a job."""
    return _cut(fleet, may_work=False)


def cut_off_one(fleet: Fleet) -> float:
    """Cut off one arm during a job: the others are a majority and must continue.

    They have to finish more than their current jobs. Jobs whose space the absent arm takes have to wait.
    """
    return _cut(fleet, may_work=True)


def _cut(fleet: Fleet, *, may_work: bool) -> float:
    cut, cut_arms, seen_s = cut_at_work(fleet)
    at_cut = _ended(fleet)
    fleet.wait_until(lambda: False, LEASE_S)
    before = _ended(fleet)
    fleet.wait_until(lambda: False, CUT_S - LEASE_S)
    after = _ended(fleet)
    if after - before and not may_work:
        fleet.violations.append(f"{', '.join(sorted(after - before))} done without a majority")
    waiting = any(job.state == "waiting" for job in fleet.status().values())
    if may_work and waiting and len(after - at_cut) <= len(fleet.arms) - len(cut_arms):
        fleet.violations.append(f"a majority finished only {len(after - at_cut)} jobs")
    cut.heal()
    healed_s = fleet.wait_until(lambda: not any(map(fleet.is_absent, cut_arms)), 30.0)
    fleet.note(
        f"{', '.join(sorted(cut_arms))} cut off for {CUT_S + min(seen_s, 10.0):.0f} s; {len(after - at_cut)} jobs were "
        f"finished since its detection, {len(after - before)} of them in its last {CUT_S - LEASE_S:.0f} s; present "
        f"again {healed_s:.1f} s after the cut ended"
    )
    return seen_s


def _ended(fleet: Fleet) -> set[str]:
    """Return the finished jobs, by the journals of all arms."""
    return set(fleet.count_finished())
