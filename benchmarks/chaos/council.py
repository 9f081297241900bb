"""Faults of a fleet without an auctioneer, whose arms share the jobs out among themselves."""

from partition import CUT_S, cut_at_work
from struck import Fleet

LEASE_S = 8.0
"""Real seconds after which nothing goes on without a majority: a lease, its margins, and a last cycle."""


def cut_in_halves(fleet: Fleet) -> float:
    """Half of the arms are cut off in the middle of their jobs: neither half may begin anything."""
    return _cut(fleet, may_work=False)


def cut_one_off(fleet: Fleet) -> float:
    """One arm is cut off in the middle of a job: the others, a majority, go on without it."""
    return _cut(fleet, may_work=True)


def _cut(fleet: Fleet, *, may_work: bool) -> float:
    line, away, seen_s = cut_at_work(fleet)
    fleet.until(lambda: False, LEASE_S)
    before = _ended(fleet)
    fleet.until(lambda: False, CUT_S - LEASE_S)
    after = _ended(fleet)
    if after - before and not may_work:
        fleet.wrong.append(f"{', '.join(sorted(after - before))} done without a majority")
    if may_work and after == before and any(job.state == "waiting" for job in fleet.status().values()):
        fleet.wrong.append("a majority did nothing")
    line.heal()
    healed_s = fleet.until(lambda: not any(map(fleet.unwell, away)), 30.0)
    fleet.note(
        f"{', '.join(sorted(away))} cut off for {CUT_S + min(seen_s, 10.0):.0f} s; {len(after - before)} jobs were "
        f"ended in the last {CUT_S - LEASE_S:.0f} s of it; back {healed_s:.1f} s after it was healed"
    )
    return seen_s


def _ended(fleet: Fleet) -> set[str]:
    """Jobs that are finished, as the journals of the arms say: those that are cut off too."""
    return set(fleet.done_by())
