"""What an arm must not forget: the records of its journal, and what they add up to after a crash.

An award is accepted, worked on, and closed by a report that is said until there is a receipt. What was accepted and not
closed when the arm went down is given back: its body stands at home again, and only the cycles on disk count. Had it
leave to finish, nobody knows whether the last cycle was done, and the report says so.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import msgspec

from fleet.bus.trade import Ack, Award, Count, Name, Report

MOST_KNOWN = 256
"""Closed awards of which the answer is still known; their quotes are long over."""


class Booted(msgspec.Struct, frozen=True, tag="booted"):
    """The arm's process began."""

    boot: int
    """Counts from 1."""


class Accepted(msgspec.Struct, frozen=True, tag="accepted"):
    """The arm took a job."""

    award: Award


class Worked(msgspec.Struct, frozen=True, tag="worked"):
    """So many cycles of it are done, those of others included."""

    award: Name
    cycles: Count


class Leave(msgspec.Struct, frozen=True, tag="leave"):
    """The last cycle may begin."""

    award: Name


class Closed(msgspec.Struct, frozen=True, tag="closed"):
    """The arm is done with it, one way or the other."""

    report: Report


class Dropped(msgspec.Struct, frozen=True, tag="dropped"):
    """The award was no longer the arm's own: there is nothing to report."""

    award: Name


class Receipted(msgspec.Struct, frozen=True, tag="receipted"):
    """The auctioneer has the report on its disk."""

    award: Name


class Known(msgspec.Struct, frozen=True, tag="known"):
    """Of awards long closed only the answer is kept."""

    award: Name
    job: Name


Promise = Booted | Accepted | Worked | Leave | Closed | Dropped | Receipted | Known


@dataclass(eq=False)
class Held:
    """An award in hand."""

    award: Award
    cycles: int
    """Done so far, those of others included."""
    until_s: float = 0.0
    """Real second at which its lease is over."""
    leave: bool = False
    """Whether the last cycle may begin."""
    kept: int = 0
    """Cycles on disk."""
    lease_s: float = 0.0
    """Real seconds that a lease of its auctioneer lasts."""
    last_in_s: float = math.inf
    """Real seconds until its last cycle could begin."""
    asked_s: float = -math.inf
    """Real second at which leave to finish was asked for."""


@dataclass(eq=False)
class Memory:
    """What the records of a journal add up to."""

    boot: int = 0
    """Of the last start; 0 before the first."""
    held: dict[str, Held] = field(default_factory=dict)
    """By award."""
    reports: dict[str, tuple[Award, Report]] = field(default_factory=dict)
    """Without a receipt, by award."""
    known: dict[str, str] = field(default_factory=dict)
    """The job of every award that was accepted, oldest first; the last `MOST_KNOWN` closed ones and all others."""


def recall(records: Iterable[Promise]) -> Memory:
    """What an arm knows when it starts again: all records in the order in which they were written."""
    memory = Memory()
    for record in records:
        match record:
            case Booted(boot):
                memory.boot = boot
            case Accepted(award):
                memory.held[award.award] = Held(award, award.cycles, kept=award.cycles)
                memory.known[award.award] = award.job.name
            case Worked(name, cycles):
                if name in memory.held:
                    memory.held[name].cycles = memory.held[name].kept = cycles
            case Leave(name):
                if name in memory.held:
                    memory.held[name].leave = True
            case Closed(report):
                if report.award in memory.held:
                    memory.reports[report.award] = (memory.held.pop(report.award).award, report)
            case Dropped(name):
                memory.held.pop(name, None)
            case Receipted(name):
                memory.reports.pop(name, None)
            case Known(name, job):
                memory.known[name] = job
    return memory


def restarted(memory: Memory, arm: str, time_s: float) -> Memory:
    """What the arm knows once it stands at home again: the next boot, and everything in hand given back."""
    reports = dict(memory.reports)
    for name, held in memory.held.items():
        reports[name] = (
            held.award,
            Report(
                arm=arm,
                award=name,
                job=held.award.job.name,
                outcome="returned",
                cycles=held.cycles,
                time_s=time_s,
                reason="the arm started anew" + (" after it was given leave to finish" if held.leave else ""),
                unsure=held.leave,
            ),
        )
    return Memory(memory.boot + 1, {}, reports, bounded(memory.known, reports))


def bounded(known: dict[str, str], needed: Iterable[str]) -> dict[str, str]:
    """The awards that must be known, and the last `MOST_KNOWN` of the others."""
    keep = set(needed)
    others = [name for name in known if name not in keep][-MOST_KNOWN:]
    keep.update(others)
    return {name: job for name, job in known.items() if name in keep}


def retold(memory: Memory) -> tuple[Promise, ...]:
    """The fewest records that add up to a memory, for a journal to begin anew with."""
    records: list[Promise] = [Booted(memory.boot)]
    records += [Known(name, job) for name, job in memory.known.items()]
    for name, (award, report) in memory.reports.items():
        records += [Accepted(award), Closed(report)]
        assert name == report.award
    for name, held in memory.held.items():
        records += [Accepted(held.award), Worked(name, held.cycles), *([Leave(name)] if held.leave else [])]
    return tuple(records)


def accepted(arm: str, award: str) -> Ack:
    """The answer to an award that the arm took."""
    return Ack(arm=arm, award=award, accepted=True)
