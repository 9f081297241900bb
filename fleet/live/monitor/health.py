"""Health of a fleet: findings from a snapshot, clock replies and malformed messages."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from shlex import quote
from statistics import median
from typing import Literal, get_args

import msgspec

from fleet.bus.client import under
from fleet.bus.protocol import keys
from fleet.bus.protocol.operator import ALL_ARMS, by_whom
from fleet.bus.security.tls import UNKNOWN_CERTIFICATE
from fleet.errors import listed
from fleet.live.clock import FleetClock
from fleet.live.job_rules import NO_CYCLE
from fleet.live.monitor.snapshot import FRESH_S, SILENT_S, ArmSnapshot, FleetSnapshot
from fleet.readings import TEMP_RANGE_C

REASONS = {
    "It is released at": "release", "It waits for": "predecessor", "are paused": "paused",
    "waits to be offered": "queue", "has refused it": "refused", "has not answered": "unanswered",
    "not answer its award": "unanswered", "no valid quote": "quote", "quoted for another round": "quote",
    "did not quote": "quote", "paused by": "paused", "is paused": "paused", "has a break": "break",
    "are planning": "planning", "is above its warning limit": "hot", "has impossible temperatures": "sensor",
    "is faulted": "faulted", "It waits until": "space", "No arm can do it": "no_arm",
    "No arm that has answered": "no_arm",
    "The policy lets it wait": "policy", "Its place was in use": "place", "is in use": "place", "has a job": "busy",
    "is on its way home": "busy",
}  # fmt: skip
"""Class of the reason of a waiting job, by a part of it; the first part that it has counts."""
OTHER = "other"
"""Class of any other reason."""
EXPECTED = ("release", "predecessor", "paused", "queue", "break", "planning", "hot", "sensor", "faulted")
"""Classes of jobs that wait in order."""
MOST_REASONS = 5
NO_OFFSETS: Mapping[str, float] = {}
NO_COMPLAINTS: Mapping[str, str] = {}
MOST_LIMIT_C = TEMP_RANGE_C[1]
"""No motor has a higher warning limit."""
OFFSET_S, SLOW_S = 1.0, 0.1
"""Real seconds: clock offsets and round trips above these are findings."""


AlarmKind = Literal[
    "fault",
    "sensor",
    "absent",
    "silent",
    "stopped",
    "connection",
    "given_up",
    "unfinished",
    "no_progress",
    "space",
    "webhook",
]
ALARM_KINDS: tuple[AlarmKind, ...] = get_args(AlarmKind)


class Finding(msgspec.Struct, frozen=True):
    """One statement about the fleet."""

    level: Literal["fault", "warning", "note"]
    """fault: the fleet cannot work; warning: it works, but needs attention; note: it is as it should be."""
    what: str
    kind: AlarmKind | Literal[""] = ""
    """Kind of the alarm that it raises; "" for none."""
    subject: str = ""
    """Of the alarm, for example an arm or a job; it lasts while there is a finding of its kind and subject."""
    since_s: float = 0.0
    """Real seconds for which it has been so before it was found."""
    lasting: str = ""
    """Text of its alarm, if `what` names a state of the moment."""


@dataclass(frozen=True)
class ClockProbe:
    """One request for the fleet time; real seconds are of this machine's monotonic clock."""

    asked_s: float
    answered_s: float
    time_s: float | None = None
    """The reply; None if the router answered but no participant did."""
    speed: float = 1.0


class HealthReport(msgspec.Struct, frozen=True):
    """Health of a fleet."""

    fleet: str
    round_trip_s: float | None
    """Median of the clock requests, real seconds."""
    time_s: float | None
    """Fleet time now; None without a clock reply."""
    offsets_s: dict[str, float]
    """Real seconds by which each arm's clock is ahead of the auctioneer's."""
    malformed: int
    findings: tuple[Finding, ...]

    @property
    def healthy(self) -> bool:
        """Whether there is no fault."""
        return all(finding.level != "fault" for finding in self.findings)


def check_health(
    fleet: FleetSnapshot,
    now_s: float,
    probes: Sequence[ClockProbe],
    *,
    malformed: int = 0,
    complaints: Mapping[str, str] = NO_COMPLAINTS,
    overrun: int = 0,
    auctioneer: bool = True,
    secure: bool = False,
    expected: Sequence[str] = (),
    other_versions: Sequence[str] = (),
    earlier: FleetSnapshot | None = None,
    reach: str = "",
) -> HealthReport:
    """Check a fleet that was listened to for a while.

    Args:
        fleet: Snapshot at the real second `now_s`.
        complaints: Why the last malformed message at each place was dropped, as `BusClient.complaints`.
        overrun: Messages lost because the queue was full.
        auctioneer: Whether the fleet should have one.
        secure: Whether the listener used a certificate; one that the router does not know receives nothing.
        expected: Arms that should be present: one that left earlier leaves no trace.
        other_versions: A sentence on each participant that uses another version of the bus.
        earlier: Snapshot of a second before or more; None: whether jobs wait in vain is not checked.
        reach: Options with which a command reaches this fleet.
    """
    trips_s = [probe.answered_s - probe.asked_s for probe in probes]
    clock = best_clock(probes)
    offsets_s = {arm.arm: offset_s(arm, now_s, clock) for arm in fleet.arms if arm.time_s is not None} if clock else {}
    common_s = common_offset_s(offsets_s.values())
    findings = [
        *check_auctioneers(fleet, probes, auctioneer),
        *check_fleet(
            fleet,
            earlier,
            {a: off_s for a, off_s in offsets_s.items() if abs(off_s - common_s) > OFFSET_S},
            complaints_of_states(fleet, complaints),
            reach,
        ),
    ]
    if abs(common_s) > OFFSET_S:
        way = "ahead of" if common_s > 0 else "behind"
        off = f"Every arm is {abs(common_s):.1f} real seconds or more {way} fleet time."
        why = "After a restart of the auctioneer that ends within 2 min; otherwise its machine may be overloaded."
        findings.append(Finding("warning", f"{off} {why}"))
    shown = {arm.arm for arm in fleet.arms if arm.token}
    if missing := [name for name in expected if name not in shown]:
        findings.append(Finding("fault", f"Not present: {', '.join(missing)}."))
    accounted = {arm.arm for arm in fleet.arms} | {*expected, *fleet.left}
    findings += [
        Finding("fault", f"An alarm of '{alarm.monitor}' that nobody has acknowledged: {alarm.what}")
        for alarm in fleet.alarms
        if alarm.kind == "absent" and alarm.ended_s is None and not alarm.by and alarm.subject not in accounted
    ]
    if not any(arm.present for arm in fleet.arms):
        unheard = secure and not any(arm.token for arm in fleet.arms)
        hint = UNKNOWN_CERTIFICATE if unheard else ""
        findings.append(Finding("fault", f"No arm is present: none shows both a token and a fresh state.{hint}"))
    if fleet.left:
        findings.append(Finding("note", f"Left in order: {listed(fleet.left)}."))
    if trips_s and median(trips_s) > SLOW_S:
        findings.append(Finding("warning", f"The router is slow: a round trip takes {1000 * median(trips_s):.0f} ms."))
    if malformed:
        reasons = "; ".join(list(dict.fromkeys(complaints.values()))[-MOST_REASONS:])  # each reason once
        findings.append(Finding("fault", f"{malformed} malformed message(s), the last: {reasons}"))
    if overrun:
        findings.append(
            Finding("warning", f"{overrun} message(s) dropped: they arrived faster than they were processed.")
        )
    findings += [Finding("fault", sentence) for sentence in other_versions]
    return HealthReport(
        fleet=fleet.fleet,
        round_trip_s=median(trips_s) if trips_s else None,
        time_s=clock.now_s(now_s) if clock else None,
        offsets_s=offsets_s,
        malformed=malformed,
        findings=tuple(findings),
    )


def check_fleet(
    fleet: FleetSnapshot,
    earlier: FleetSnapshot | None,
    offsets_s: Mapping[str, float] = NO_OFFSETS,
    malformed: Mapping[str, str] = NO_COMPLAINTS,
    reach: str = "",
) -> list[Finding]:
    """What snapshots show of arms, jobs and space: the findings that raise alarms, except that of a lost connection.

    Args:
        earlier: As in `check_health`.
        offsets_s: As in a report, of the arms whose offset is to be checked.
        malformed: Why the last state of an arm was dropped as malformed, as far as it is known.
        reach: As in `check_health`.
    """
    arms = (
        finding
        for arm in fleet.arms
        for finding in check_arm(arm, offsets_s.get(arm.arm), malformed=malformed.get(arm.arm, ""))
    )
    left_out = (check_left_out(arm, why) for arm, why in sorted(fleet.left_out.items()))
    return [
        *arms,
        *left_out,
        *check_pauses(fleet),
        *check_awards(fleet),
        *check_jobs(fleet),
        *check_progress(fleet, earlier),
        *check_space(fleet, reach),
    ]


def check_left_out(arm: str, why: str) -> Finding:
    """Return the finding of an arm that is awarded no jobs for a while."""
    hangs = " Its process may hang." if why.startswith("has not ") else ""
    return Finding("warning", f"{arm} {why}: it is awarded no job for a while.{hangs}")


def check_pauses(fleet: FleetSnapshot) -> list[Finding]:
    """Return the findings of the arms that people have paused, one of each person."""
    arms: dict[str, list[str]] = {}
    for arm, by in sorted(fleet.paused.items()):
        arms.setdefault(by, []).append(arm)
    return [Finding("note", f"{_paused(names)} paused{by_whom(by)}.") for by, names in arms.items()]


def _paused(arms: Sequence[str]) -> str:
    """Subject and verb for arms, or all."""
    return "All arms are" if ALL_ARMS in arms else f"{', '.join(arms)} {'are' if arms[1:] else 'is'}"


def check_connection(fleet: FleetSnapshot) -> list[Finding]:
    """Check that the listener has a connection to the router: without one a snapshot shows an earlier fleet.

    It is as it should be that a router ends after all arms.
    """
    if fleet.lost_s is None:
        return []
    if (fleet.arms or fleet.left) and all(arm.leaving for arm in fleet.arms):
        return [Finding("note", "All arms have left, and the router has ended.")]
    why = (
        fleet.expiry.rstrip(".")
        or "The connection to the router is lost: the router has ended, hangs, or is unreachable"
    )
    lost = f"{why}. What is shown is from before"
    what = f"{lost}, {fleet.lost_s:.0f} s ago."
    return [Finding("fault", what, "connection", since_s=fleet.lost_s, lasting=f"{lost}.")]


def check_awards(fleet: FleetSnapshot) -> list[Finding]:
    """Check that somebody replies about the jobs while arms are present, and awards them: an auctioneer, or an arm
    without one."""
    last, age_s = fleet.last_reply
    if age_s <= SILENT_S:
        stopped = [each for each in fleet.auctioneers if each.trouble and (each.heard_age_s or 0.0) <= SILENT_S]
        return [Finding("fault", each.trouble, "stopped", each.auctioneer) for each in stopped]
    if not any(arm.present for arm in fleet.arms):
        return []
    silent = f"{last or 'Nobody'} has {'not ' if last else ''}replied about the jobs"
    why = "its process hangs or has ended, and no job is awarded." if last else "no job is awarded."
    return [Finding("fault", f"{silent} for {age_s:.0f} s: {why}", "silent", last, age_s, f"{silent}: {why}")]


def check_jobs(fleet: FleetSnapshot) -> list[Finding]:
    """Check that no job is unfinished or abandoned, except by the end of the shift, and that each one in work proceeds.

    An abandoned job whose alarm somebody has acknowledged is only noted.
    """
    findings: list[Finding] = []
    seen_by = {alarm.subject: alarm.by for alarm in fleet.alarms if alarm.kind == "given_up" and alarm.by}
    for job in fleet.jobs:
        why = job.reason or "no reason"
        if job.state == "unfinished" and not job.shift_ended:  # a person must look at the cell
            what = f"'{job.job}' is unfinished, so its outcome is unknown: {why}"
            findings.append(Finding("fault", what, "unfinished", job.job))
        elif job.state == "given_up" and not job.shift_ended:
            by = seen_by.get(job.job, "")
            what = f"'{job.job}' is abandoned{f', as {by} has acknowledged' if by else ''}: {why}"
            findings.append(Finding("note" if by else "warning", what, "given_up", job.job))
        elif job.state in ("awarded", "finishing") and NO_CYCLE in why:
            what = f"'{job.job}' makes no progress: {why}"
            findings.append(Finding("warning", what, "no_progress", job.job))
    return findings


def check_progress(fleet: FleetSnapshot, earlier: FleetSnapshot | None) -> list[Finding]:
    """Check that no job waits while arms are idle and none works, by the reasons that the fleet gives."""
    if earlier is None or _is_at_work(fleet) or _is_at_work(earlier):
        return []
    before = {status.job for status in earlier.jobs if status.state == "waiting"}
    waiting = [status for status in fleet.jobs if status.state == "waiting" and status.job in before]
    reasons = Counter(status.reason for status in waiting if reason_class(status.reason) not in EXPECTED)
    idle = [arm.arm for arm in fleet.arms if arm.present and arm.mode == "idle" and not arm.job]
    return [
        Finding(
            "warning" if reason_class(reason) == "policy" else "fault",
            f"{f'{count} jobs wait' if count > 1 else '1 job waits'} though no arm works and "
            f"{f'{len(idle)} arms are' if idle[1:] else f'{idle[0]} is'} idle. {reason}",
            "no_progress",
            reason_class(reason),
        )
        for reason, count in reasons.most_common(MOST_REASONS if idle else 0)
    ]


def reason_class(reason: str) -> str:
    """Class of the reason of a waiting job, of `REASONS` or `OTHER`; "queue" for none yet."""
    return "queue" if not reason else next((name for part, name in REASONS.items() if part in reason), OTHER)


def _in_the_way(reason: str) -> list[str]:
    """Arms until whose way a job waits, by its reason."""
    _, _, rest = reason.partition("It waits until ")
    return _OUT_OF_THE_WAY.split(rest, maxsplit=1)[0].split(", ")


_OUT_OF_THE_WAY = re.compile(" (?:is|are) out of the way")


def _is_at_work(fleet: FleetSnapshot) -> bool:
    """Whether an arm has a job, or moves: it may be on its way home after one."""
    awarded = fleet.counts.get("awarded", 0) + fleet.counts.get("finishing", 0)
    return awarded > 0 or any(arm.present and arm.mode == "working" for arm in fleet.arms)


def check_space(fleet: FleetSnapshot, reach: str = "") -> list[Finding]:
    """Check that no arm that is not present keeps space closed; a fault if jobs wait for it."""
    present = {arm.arm for arm in fleet.arms if arm.present}
    silent_s = {arm.arm: arm.state_age_s for arm in fleet.arms if arm.state_age_s is not None}
    findings: list[Finding] = []
    for arm in sorted(fleet.space.keys() - present):
        waits = sum(status.state == "waiting" and arm in _in_the_way(status.reason) for status in fleet.jobs)
        since = f" for {silent_s[arm]:.0f} s" if arm in silent_s else ""
        findings.append(
            Finding(
                "fault" if waits else "warning",
                f"The space of {arm} stays closed to other arms, as {arm} is not present{since}"
                f"{f'; {waits} job(s) wait for it' if waits else ''}. If you have seen that it is at home or removed, "
                f"and is switched off: thermofleet arm clear {' '.join(filter(None, (quote(arm), reach)))}",
                "space",
                arm,
                lasting=f"The space of {arm} stays closed to other arms, as it is not present. Clear it once a person "
                "has seen that it is at home or removed, and is switched off.",
            )
        )
    return findings


def check_auctioneers(fleet: FleetSnapshot, probes: Sequence[ClockProbe], wanted: bool = True) -> list[Finding]:
    """Check that exactly one auctioneer replies; or, where none is wanted, that none is present."""
    names = [auctioneer.auctioneer for auctioneer in fleet.auctioneers if auctioneer.token]
    present = ", ".join(names)
    if len(names) > 1:
        problem = f"{len(names)} auctioneers are present ({present}), but a fleet has one: stop all but one."
    elif not wanted:
        unwanted = f"Auctioneer {present} is present, though the fleet should have none."
        return [Finding("warning", unwanted)] if names else []
    elif any(probe.time_s is not None for probe in probes) or _is_without_auctioneer(fleet):
        return []
    elif names:
        problem = f"Auctioneer {present} shows its token but does not answer: its process may hang."
    else:
        problem = (
            "No auctioneer shows a token or answers: jobs are not awarded, and every arm keeps its own time. "
            "If this fleet needs none, give --no-auctioneer."
        )
    return [Finding("fault", problem)]


def _is_without_auctioneer(fleet: FleetSnapshot) -> bool:
    """Return whether an arm replies about the jobs, also before the fleet's time begins."""
    last, age_s = fleet.last_reply
    return age_s <= SILENT_S and any(arm.arm == last for arm in fleet.arms)


def complaints_of_states(fleet: FleetSnapshot, complaints: Mapping[str, str]) -> dict[str, str]:
    """The last complaint about a state of each arm, without the key that it names."""
    places = {arm.arm: under(keys.of_arm(fleet.fleet, arm.arm, "state")) for arm in fleet.arms}
    return {arm: complaints[place].removeprefix(f"{place}: ") for arm, place in places.items() if place in complaints}


def check_arm(arm: ArmSnapshot, offset_s: float | None, *, malformed: str = "") -> list[Finding]:
    """Check the token, state, mode and clock of one arm.

    Args:
        malformed: Why its last state was dropped as malformed; "" if it was not.
    """
    age_s = arm.state_age_s
    if not arm.token and age_s is None:
        return [Finding("warning", f"{arm.arm} has left: it has no token, but some of its messages are still cached.")]
    if arm.left:
        return [Finding("note", f"{arm.arm} has left in order.")]
    problem, cause = "", "its process may hang."
    why = "it has left, or its process hangs or has ended."
    if malformed:
        cause, why = "its states are malformed.", f"its states are malformed: {malformed}"
    elif arm.token and arm.state_gap_s is not None and arm.state_gap_s > FRESH_S:
        why = cause = f"its last two states came {arm.state_gap_s:.1f} s apart, and at least two a second are needed."
    if arm.leaving and not arm.token:
        problem = f"was stopped {'away from home' if arm.away else 'with a job'}."
        why = f"it {problem}"
    elif not arm.token:
        problem = "publishes its state but shows no token: it left, or another process uses its name."
        why = f"it {problem}" if age_s is not None and age_s <= FRESH_S else why
    elif age_s is None:
        problem = f"shows its token but publishes no {'valid ' if malformed else ''}state: {cause}"
    elif age_s > FRESH_S:
        problem = f"is stale, with a last state {age_s:.1f} s old: {cause}"
    absent = f"{arm.arm} is absent: {why}"
    findings = [Finding("fault", f"{arm.arm} {problem}", "absent", arm.arm, lasting=absent)] if problem else []
    if arm.doubled:
        findings.append(
            Finding(
                "fault",
                f"The ticks of {arm.arm} do not count up: two processes publish as this arm, so stop one, or it does "
                "not count its states.",
            )
        )
    if arm.mode == "faulted":
        hot = f"{arm.arm} is faulted: joint {arm.joint} is at {arm.hottest_c:.1f} °C."
        findings.append(Finding("warning", hot, "fault", arm.arm))
    if arm.break_end_s is not None:
        findings.append(
            Finding("note", f"{arm.arm} is in a break until {timedelta(seconds=round(arm.break_end_s))} of fleet time.")
        )
    if arm.bad_sensor:
        wrong = f"{arm.arm} has impossible temperatures: {arm.bad_sensor}."
        findings.append(Finding("warning", wrong, "sensor", arm.arm))
    if arm.joints and arm.temp_c and arm.joints != len(arm.temp_c):
        counts = f"{len(arm.temp_c)} temperatures in its state, but {arm.joints} joints in its info"
        findings.append(Finding("warning", f"{arm.arm} has {counts}."))
    if arm.hottest_c is not None and arm.headroom_k is not None and arm.hottest_c + arm.headroom_k > MOST_LIMIT_C:
        limit = f"a headroom of {arm.headroom_k:.1f} K at {arm.hottest_c:.1f} °C"
        what = f"{arm.arm} reports {limit}: its warning limit would be above {MOST_LIMIT_C:.0f} °C."
        findings.append(Finding("warning", what))
    if offset_s is not None and abs(offset_s) > OFFSET_S:
        unset = "it does not set its clock by the replies to clock/now"
        way = f"ahead of fleet time: {unset}."
        if offset_s < 0:
            way = f"behind fleet time: {unset}, or its machine may be overloaded, or its process hang."
        findings.append(Finding("fault", f"{arm.arm} is {abs(offset_s):.1f} real seconds {way}"))
    return findings


def common_offset_s(offsets_s: Collection[float]) -> float:
    """The least offset if all have the same sign, as after a change of the auctioneer's clock; otherwise 0."""
    return max(0.0, min(offsets_s, default=0.0)) + min(0.0, max(offsets_s, default=0.0))


def best_clock(probes: Sequence[ClockProbe]) -> FleetClock | None:
    """Fleet clock from the request with the shortest round trip; None without a reply."""
    answered = [probe for probe in probes if probe.time_s is not None]
    if not answered:
        return None
    best = min(answered, key=lambda probe: probe.answered_s - probe.asked_s)
    assert best.time_s is not None
    return FleetClock(best.speed).set_to(best.asked_s, best.answered_s, best.time_s)


def offset_s(arm: ArmSnapshot, now_s: float, clock: FleetClock) -> float:
    """Real seconds by which an arm's clock was ahead when it last published its state."""
    assert arm.time_s is not None
    assert arm.state_age_s is not None
    return (arm.time_s - clock.now_s(now_s)) / clock.speed + arm.state_age_s
