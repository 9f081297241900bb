"""What is wrong with a fleet, in sentences: from one look at it, its clocks and the questions that were asked."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Literal

import msgspec

from fleet.live.clock import FleetClock
from fleet.live.overview import FRESH_S, ArmNow, FleetNow

OFFSET_S, SLOW_S = 1.0, 0.1
"""Real seconds: an arm whose clock is further off, a round trip that takes longer, is mentioned."""

Level = Literal["fault", "warning", "fine"]


class Finding(msgspec.Struct, frozen=True):
    """One thing about the fleet."""

    level: Level
    """fault: the fleet cannot do what it should; warning: it can, but somebody should look."""
    what: str


@dataclass(frozen=True)
class Sounding:
    """One question for the fleet's time, real seconds of this machine's monotonic clock."""

    asked_s: float
    answered_s: float
    time_s: float | None = None
    """What was answered; None where nobody did, though the router has."""
    speed: float = 1.0


class Diagnosis(msgspec.Struct, frozen=True):
    """What is known of a fleet's health."""

    fleet: str
    round_trip_s: float | None
    """Real seconds, median of the questions asked."""
    time_s: float | None
    """The fleet's time now; None where no auctioneer tells it."""
    offsets_s: dict[str, float]
    """Real seconds that each arm's clock is ahead of the auctioneer's."""
    malformed: int
    findings: tuple[Finding, ...]

    @property
    def healthy(self) -> bool:
        """Nothing is at fault."""
        return all(finding.level != "fault" for finding in self.findings)


def diagnosed(
    now: FleetNow,
    now_s: float,
    soundings: Sequence[Sounding],
    *,
    malformed: int = 0,
    complaints: Sequence[str] = (),
    overrun: int = 0,
    auctioneer: bool = True,
    secure: bool = False,
    expected: Sequence[str] = (),
) -> Diagnosis:
    """What is wrong with a fleet that was listened to for a while.

    Args:
        now: The fleet at the real second `now_s`.
        complaints: What was wrong with malformed words.
        overrun: Words lost because they came faster than we listened.
        auctioneer: Whether the fleet should have one.
        secure: Whether it was listened to with a certificate: one that the router does not know hears nothing.
        expected: Arms that should be there: one that went before anybody listened leaves no trace.
    """
    trips_s = [sounding.answered_s - sounding.asked_s for sounding in soundings]
    clock = best_clock(soundings)
    offsets_s = {arm.arm: offset_s(arm, now_s, clock) for arm in now.arms if arm.time_s is not None} if clock else {}
    findings = [
        *about_auctioneers(now, soundings, auctioneer),
        *(finding for arm in now.arms for finding in about_arm(arm, offsets_s.get(arm.arm))),
    ]
    if missing := [name for name in expected if name not in {arm.arm for arm in now.arms if arm.token}]:
        findings.append(Finding("fault", f"Not there: {', '.join(missing)}."))
    if not any(arm.present for arm in now.arms):
        deaf = secure and not any(arm.token for arm in now.arms)
        hint = " Or the router does not know this certificate: it reads its roster when it starts." if deaf else ""
        findings.append(Finding("fault", f"No arm is present: none shows both a token and a fresh state.{hint}"))
    if trips_s and median(trips_s) > SLOW_S:
        findings.append(Finding("warning", f"The router is slow: a round trip takes {1000 * median(trips_s):.0f} ms."))
    if malformed:
        told = "; ".join(dict.fromkeys(complaints))  # a flood says the same again and again
        findings.append(Finding("fault", f"{malformed} malformed word(s), the last: {told}"))
    if overrun:
        findings.append(Finding("warning", f"{overrun} word(s) came faster than they were listened to."))
    if unfinished := now.counts.get("unfinished", 0):
        findings.append(Finding("warning", f"{unfinished} job(s) are unfinished: nobody knows whether they were done."))
    return Diagnosis(
        fleet=now.fleet,
        round_trip_s=median(trips_s) if trips_s else None,
        time_s=clock.now_s(now_s) if clock else None,
        offsets_s=offsets_s,
        malformed=malformed,
        findings=tuple(findings),
    )


def about_auctioneers(now: FleetNow, soundings: Sequence[Sounding], wanted: bool = True) -> list[Finding]:
    """Whether one, and only one, takes jobs and tells the time; or none, where none is wanted."""
    there = [seen.auctioneer for seen in now.auctioneers if seen.token]
    if len(there) > 1:
        told = f"{len(there)} auctioneers are there ({', '.join(there)}): a fleet has one; stop all but one."
        return [Finding("fault", told)]
    if not wanted:
        told = f"Auctioneer {', '.join(there)} is there, though the fleet should have none."
        return [Finding("warning", told)] if there else []
    if any(sounding.time_s is not None for sounding in soundings):
        return []
    if there:
        return [Finding("fault", f"Auctioneer {', '.join(there)} shows its token but does not answer: does it hang?")]
    return [
        Finding(
            "fault",
            "No auctioneer shows a token or answers: nobody hands out jobs, and every arm keeps its own time. "
            "If this fleet has none by intention, say --no-auctioneer.",
        )
    ]


def about_arm(arm: ArmNow, offset_s: float | None) -> list[Finding]:
    """What is wrong with one arm."""
    found: list[Finding] = []
    age_s = arm.state_age_s
    if not arm.token and age_s is None:
        return [Finding("warning", f"{arm.arm} is gone: what it said once is remembered, but it shows no token.")]
    if not arm.token:
        found.append(Finding("fault", f"{arm.arm} says its state but shows no token: it left, or somebody plays it."))
    elif age_s is None:
        found.append(Finding("fault", f"{arm.arm} shows its token but says no state: does it hang?"))
    elif age_s > FRESH_S:
        found.append(Finding("fault", f"{arm.arm} is stale: its last state is {age_s:.1f} s old. Does it hang?"))
    if arm.mode == "faulted":
        found.append(Finding("warning", f"{arm.arm} is faulted: joint {arm.joint} is at {arm.hottest_c:.1f} °C."))
    if offset_s is not None and abs(offset_s) > OFFSET_S:
        way = "ahead of" if offset_s > 0 else "behind"
        found.append(Finding("fault", f"{arm.arm} is {abs(offset_s):.1f} s {way} the fleet's time: is it overloaded?"))
    return found


def best_clock(soundings: Sequence[Sounding]) -> FleetClock | None:
    """The fleet's clock from the question that was answered fastest; None if none was."""
    good = [sounding for sounding in soundings if sounding.time_s is not None]
    if not good:
        return None
    best = min(good, key=lambda sounding: sounding.answered_s - sounding.asked_s)
    assert best.time_s is not None
    return FleetClock(best.speed).set_by(best.asked_s, best.answered_s, best.time_s)


def offset_s(arm: ArmNow, now_s: float, clock: FleetClock) -> float:
    """Real seconds that an arm's clock was ahead when it last said its state."""
    assert arm.time_s is not None
    assert arm.state_age_s is not None
    return (arm.time_s - clock.now_s(now_s)) / clock.speed + arm.state_age_s
