"""Snapshot of a fleet: who is present, the last message of each participant and its age, and the state of every job.

`FleetView` takes messages and real time, and has no clock and no I/O. Its memory is bounded, however many names are
published: the least recent are dropped. `FleetListener` keeps one up to date from the bus, without taking part in the
fleet.
"""

import logging
import math
import re
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from itertools import repeat
from statistics import median_low
from typing import Literal, TypeVar

import msgspec
from msgspec.structs import replace

from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import auction, keys
from fleet.bus.protocol.auction import (
    Announcement,
    ArmEvent,
    Clock,
    ClockRequest,
    JobStatus,
    Result,
    Status,
)
from fleet.bus.protocol.keys import PUBLISHED
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.bus.protocol.operator import ALL_ARMS, Alarm, ControlRequest, Operation, Pause, Resume, by_whom
from fleet.errors import BusError
from fleet.events import EVENT_KINDS
from fleet.live.clock import FleetClock
from fleet.live.job_client import query_statuses
from fleet.live.job_rules import Position, urgency
from fleet.live.sensors import ArmSensors
from fleet.telemetry import Mode

_LOG = logging.getLogger(__name__)

FRESH_S = 3.0
"""Real seconds: an arm is present when it shows its token and its last state is no older than this."""
QUIET_S = 2.5
"""Real seconds without any message after which a listener to several arms has no connection: before they count as
absent."""
MOST_STARTS, STARTS_S = 2, 5.0
"""How often the ticks of an arm may fail to count up in that many real seconds: more often, it is as if two processes
publish them."""
MAX_NAMES, MAX_JOBS, MAX_ALARMS = 1024, 4096, 256
ENDED: tuple[auction.JobState, ...] = ("finished", *auction.ABANDONED)
"""States of jobs that need nobody any more."""

STATUS_EVERY_S = 5.0
"""Real seconds between two requests of the clock and of all jobs, whose results may be older than the listener."""
SILENT_S = 3 * STATUS_EVERY_S
"""Real seconds without a reply about the jobs, after which nobody allocates them."""

Role = Literal["arm", "auction"]
Message = TypeVar("Message", bound=msgspec.Struct)
Key = TypeVar("Key")
Value = TypeVar("Value")
OnMessage = Callable[[str, str, msgspec.Struct], None]
"""Called with the topic, the name in the key, and the message."""
OnPresence = Callable[[Role, str, bool], None]
"""Called with the role and name of a participant, and whether it is present."""


class Recent(OrderedDict[Key, Value]):
    """A dict of at most `most` keys in the order of their last setting; of too many, the first is dropped.

    Args:
        lasts: Values that are dropped only if there are no others.
    """

    def __init__(self, most: int, lasts: Callable[[Value], bool] = lambda value: False) -> None:
        super().__init__()
        self._most, self._lasts = most, lasts

    def __setitem__(self, key: Key, value: Value) -> None:
        super().__setitem__(key, value)
        self.move_to_end(key)
        if len(self) > self._most:
            del self[next((key for key, value in self.items() if not self._lasts(value)), next(iter(self)))]


class JobScore(msgspec.Struct, frozen=True):
    """Predictions of an arm for a job; None for unknown."""

    peak_c: float | None = None
    """Predicted temperature of the hottest motor during the job."""
    p_saturation: float | None = None
    difficulty: float | None = None


class ArmSnapshot(msgspec.Struct, frozen=True):
    """State of an arm, from its messages; ages are real seconds, None without a message."""

    arm: str
    token: bool
    present: bool
    """It shows its token and a fresh state."""
    mode: Mode | None = None
    time_s: float | None = None
    """Fleet time of its last state."""
    hottest_c: float | None = None
    joint: int | None = None
    """The hottest motor, 1..7."""
    headroom_k: float | None = None
    temp_c: tuple[float, ...] = ()
    """Last possible temperature, [joint]."""
    bad_sensor: str = ""
    """Sentence on motors whose last temperatures are impossible."""
    motion_difficulty: float | None = None
    """d of the last executed motion."""
    expected_c: tuple[float, ...] = ()
    """Motor temperatures that its thermal network yields for the measured heat, [joint]."""
    job: str = ""
    busy_s: float = 0.0
    """Fleet seconds until it is home with its current job done."""
    away: bool = False
    """It reports that it is away from home."""
    leaving: bool = False
    """Its last state says that its process ends in order."""
    left: bool = False
    """It has ended in order: it shows no token, and its last state says so, without job and space."""
    doubled: bool = False
    """The ticks of its states do not count up: two processes publish them, or the arm does not count."""
    scores: dict[str, JobScore] = {}
    """Of the jobs that have not ended."""
    p_saturation: float | None = None
    """P that a motor passes the warning limit in the rest of its current job."""
    break_end_s: float | None = None
    """Fleet time at which its present break ends; None outside of breaks."""
    worked_s: float = 0.0
    """Fleet seconds of work since this listener began."""
    heat_n2m2s: float = 0.0
    """Sum of squared motor torques over that time: the losses in the windings grow with it."""
    events: dict[str, int] = {}
    """Number of its events since then, and of those that it still cached, by kind."""
    idle: str = ""
    """Why a present arm has no job; "" if it has one."""
    joints: int | None = None
    twin: str = ""
    event: str = ""
    """Its last event."""
    state_age_s: float | None = None
    """Since it arrived."""
    state_gap_s: float | None = None
    """Between the arrivals of its last two states."""
    difficulty_age_s: float | None = None
    """Since it was sent, by the arm's clock; since it arrived while the fleet's speed is unknown."""


class AuctioneerSnapshot(msgspec.Struct, frozen=True):
    """State of an auctioneer, from its messages."""

    auctioneer: str
    token: bool
    heard_age_s: float | None = None
    """Real seconds since its last message."""
    trouble: str = ""
    """Why it accepts and awards no jobs, from its last status reply; "" if it does."""


class FleetSnapshot(msgspec.Struct, frozen=True):
    """A fleet at one moment."""

    fleet: str
    arms: tuple[ArmSnapshot, ...]
    """Without those that left in order `FRESH_S` ago or earlier and neither have a job nor close space."""
    auctioneers: tuple[AuctioneerSnapshot, ...]
    counts: dict[str, int]
    """Number of all jobs by state."""
    jobs: tuple[JobStatus, ...]
    """At most `MAX_JOBS`, in the order of `Status.jobs`: of ended jobs the newest first. Of more, the oldest of those
    that have ended are dropped first."""
    space: dict[str, tuple[str, ...]] = {}
    """Names of the spaces that are closed to other arms, by arm, from the last status reply."""
    left: tuple[str, ...] = ()
    """Names of the arms that are left out of `arms`."""
    paused: dict[str, str] = {}
    """Who paused an arm, by arm, from the last status reply; "*" for all arms."""
    left_out: dict[str, str] = {}
    """Why an arm is awarded no job for a while, by arm, from the last status reply."""
    time_s: float | None = None
    """Fleet time by the last reply of a clock; without one the median of the present arms; None if unknown."""
    speed: float | None = None
    """Fleet seconds per real second."""
    changes: dict[str, int] = {}
    """Number of changes of jobs by new state, since this listener began and of those that were still cached."""
    alarms: tuple[Alarm, ...] = ()
    """Those that last, and the last of the others; the most recently changed last."""
    listened_s: float = 0.0
    """Real seconds since this listener began."""
    lost_s: float | None = None
    """Real seconds since this listener lost its connection to the router; None if it has one."""
    expiry: str = ""
    """Sentence that the certificate of this listener has expired; "" if it has not."""

    @property
    def last_reply(self) -> tuple[str, float]:
        """Who was the last to send a message about the jobs, "" for nobody, and how many real seconds ago."""
        age_s, name = _last_reply(self.auctioneers, self.listened_s)
        return name, age_s


@dataclass
class _Arm:
    token: bool = False
    messages: dict[type, tuple[msgspec.Struct, float]] = field(default_factory=dict[type, tuple[msgspec.Struct, float]])
    """The last message of each type, and the real second it came."""
    sensors: ArmSensors = field(default_factory=ArmSensors)
    worked_s: float = 0.0
    heat_n2m2s: float = 0.0
    break_end_s: float | None = None
    events: Counter[str] = field(default_factory=Counter[str])
    starts_s: deque[float] = field(default_factory=lambda: deque[float](maxlen=MOST_STARTS + 1))
    """Real seconds of the last states whose tick is not above that of the one before."""
    gap_s: float | None = None
    """Real seconds between its last two states."""

    def follow(self, state: State, now_s: float) -> None:
        """Add the time since the last state to the work and heat of the arm."""
        before, before_s = self.last(State)
        self.gap_s = None if before is None else now_s - before_s
        if before is not None and state.tick <= before.tick and state.time_s != before.time_s:
            self.starts_s.append(now_s)
        passed_s = 0.0 if before is None else state.time_s - before.time_s
        if before is not None and passed_s > 0.0 and state.epoch == before.epoch:
            self.worked_s += passed_s if before.mode == "working" else 0.0
            self.heat_n2m2s += passed_s * sum(torque * torque for torque in before.tau)

    def count(self, event: ArmEvent) -> None:
        """Count an event; those of unknown kinds together, so that no sender can fill the memory."""
        self.events[event.kind if event.kind in EVENT_KINDS else "other"] += 1
        if event.kind in ("break", "break_end"):
            self.break_end_s = event.time_s + (event.value or 0.0) if event.kind == "break" else None

    def is_doubled(self, now_s: float) -> bool:
        """Return whether the ticks of its states do not count up, as if two processes publish them."""
        return len(self.starts_s) > MOST_STARTS and now_s - self.starts_s[0] <= STARTS_S

    def last(self, kind: type[Message]) -> tuple[Message | None, float]:
        message, at_s = self.messages.get(kind, (None, 0.0))
        return message if isinstance(message, kind) else None, at_s


@dataclass
class _Auctioneer:
    token: bool = False
    heard_s: float | None = None
    time_s: float = -math.inf
    """Fleet time of its last reply."""
    trouble: str = ""
    counted: tuple[str, int] = "", -1
    """Epoch and number of its last result."""

    def count(self, result: Result, changes: Counter[str]) -> None:
        """Count a result by the new state of its job; repeated ones, as after a restart, are not counted."""
        epoch, number = self.counted
        if result.epoch != epoch or result.number > number:
            changes[result.status.state] += 1
            self.counted = result.epoch, result.number


@dataclass
class _Job:
    status: JobStatus
    heard_s: float
    """Real second of the last message about it."""
    number: int = 0
    """Number of its last result: an older one changes nothing."""


@dataclass
class FleetView:
    """State of a fleet, as its messages show it."""

    fleet: str
    clock: FleetClock | None = None
    """Fleet time and its speed; None while nobody has replied."""
    began_s: float | None = None
    """Real second at which a listener began."""
    heard_s: float = math.inf
    """Real second at which anything arrived there last."""
    lost_s: float | None = None
    """Real second at which it lost its connection to the router; None if it has one."""
    expiry: str = ""
    """As in a snapshot."""
    _arms: "Recent[str, _Arm]" = field(default_factory=lambda: Recent(MAX_NAMES))
    _auctioneers: "Recent[str, _Auctioneer]" = field(default_factory=lambda: Recent(MAX_NAMES))
    _space: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    _paused: dict[str, str] = field(default_factory=dict[str, str])
    _left_out: dict[str, str] = field(default_factory=dict[str, str])
    _jobs: "Recent[str, _Job]" = field(
        default_factory=lambda: Recent(MAX_JOBS, lambda job: job.status.state not in ENDED)
    )
    _others: Counter[str] = field(default_factory=Counter[str])
    """Number of jobs by state, of those that are not kept."""
    _changes: Counter[str] = field(default_factory=Counter[str])
    alarms: "Recent[str, Alarm]" = field(default_factory=lambda: Recent(MAX_ALARMS, lambda one: one.ended_s is None))
    """The last message of each alarm, by name."""

    def set_token(self, role: Role, name: str, present: bool) -> bool:
        """Note that a token appeared or disappeared; return whether that is a change."""
        participant = self._arm(name) if role == "arm" else self._auctioneer(name)
        changed, participant.token = participant.token != present, present
        return changed

    def update(self, name: str, message: msgspec.Struct, now_s: float) -> None:
        """Apply a message that arrived at the real second `now_s`; other types are ignored."""
        if isinstance(message, Announcement | Result):
            auctioneer = self._auctioneer(name)
            auctioneer.heard_s = now_s
            if isinstance(message, Result):
                auctioneer.count(message, self._changes)
                self._set_status(message.status, now_s, message.number)
        elif isinstance(message, Operation):
            if message.time_s >= max((known.time_s for known in self._auctioneers.values()), default=-math.inf):
                self._pause(message.request)
        elif isinstance(message, Alarm):
            if _is_later(message, self.alarms.get(message.alarm)):
                self.alarms[message.alarm] = message
        elif isinstance(message, State):
            arm = self._arm(name)
            arm.follow(message, now_s)
            arm.messages[State] = arm.sensors.check(message), now_s
        elif isinstance(message, DifficultyScores | Info | ArmEvent):
            if isinstance(message, ArmEvent):
                self._arm(name).count(message)
            self._arm(name).messages[type(message)] = message, now_s

    def follow_connection(self, connected: bool, now_s: float) -> None:
        """Note whether the listener has a connection: a router that hangs keeps it, and forwards nothing.

        Arms that publish states do not all fall silent in the same second, with whoever replies about the jobs.
        """
        telling = sum(arm.token and State in arm.messages for arm in self._arms.values())
        if connected and not (telling > 1 and now_s - self.heard_s > QUIET_S):
            self.lost_s = None
        elif self.lost_s is None:
            self.lost_s = now_s

    def update_jobs(self, reply: Status, now_s: float) -> None:
        """Apply the auctioneer's reply to a status request."""
        auctioneer = self._auctioneer(reply.auctioneer)
        if reply.time_s < auctioneer.time_s:  # another fleet, or one that was restarted with new result numbers
            if not _has_all(reply):
                self._jobs.clear()
            for job in self._jobs.values():
                job.number = 0
        auctioneer.heard_s, auctioneer.time_s, auctioneer.trouble = now_s, reply.time_s, reply.trouble
        self._space, self._paused, self._left_out = dict(reply.space), dict(reply.paused), dict(reply.left_out)
        for status in reversed(reply.jobs):  # the newest of those that have ended come first in a reply
            self._set_status(status, now_s)

    def forget_other_jobs(self, replies: Sequence[Status], asked_s: float) -> None:
        """Evict jobs that are in no reply to a request for all jobs, and in no message since `asked_s`.

        They are of an earlier fleet, or follow the first `MAX_JOBS` of a large one and are only counted. A reply that
        lacks other jobs changes nothing.
        """
        if not replies or not all(_has_all(reply) or len(reply.jobs) >= MAX_JOBS for reply in replies):
            return
        named = {status.job for reply in replies for status in reply.jobs}
        for name, job in list(self._jobs.items()):
            if name not in named and job.heard_s < asked_s:
                del self._jobs[name]
        self._others.clear()
        if following := next((reply for reply in replies if reply.next), None):
            self._others = Counter[str](following.counts) - self._count()

    def _count(self) -> Counter[str]:
        """Number of kept jobs by state."""
        return Counter(job.status.state for job in self._jobs.values())

    def snapshot(self, now_s: float, jobs: int = MAX_JOBS) -> FleetSnapshot:
        """The fleet at the real second `now_s`, with at most `jobs` jobs.

        They are those that need a person, then those in work, those that wait, by release, and the others, of which
        those that ended last come first.
        """
        statuses = [job.status for job in self._jobs.values()]
        ended = {status.job for status in statuses if status.state in ("finished", "unfinished")}
        waiting = {status.job: status.reason for status in statuses if status.state == "waiting"}
        speed = None if self.clock is None else self.clock.speed
        every = [_arm_snapshot(name, self._arms[name], now_s, speed, ended) for name in sorted(self._arms)]
        needed = {each.arm for each in statuses if each.state not in ("waiting", *ENDED) and not each.shift_ended}
        space, gone = self._space, {arm.arm for arm in every if arm.left}
        auctioneers = tuple(
            AuctioneerSnapshot(name, each.token, _age_s(each.heard_s, now_s), each.trouble)
            for name, each in sorted(self._auctioneers.items())
        )
        tokens = {each.auctioneer for each in auctioneers if each.token} | {arm.arm for arm in every if arm.token}
        if _last_reply(auctioneers)[1] not in tokens:  # nobody notes any more that they have freed their space
            space = {arm: spaces for arm, spaces in space.items() if arm not in gone}
        gone -= needed | space.keys()
        left = {arm.arm for arm in every if arm.arm in gone and (arm.state_age_s or 0.0) > FRESH_S}
        arms = tuple(arm for arm in every if arm.arm not in left)
        now = FleetSnapshot(
            fleet=self.fleet,
            arms=arms,
            auctioneers=auctioneers,
            counts=dict(self._count() + self._others),
            changes=dict(self._changes),
            jobs=_most_urgent(statuses, jobs),
            space=space,
            left=tuple(sorted(left)),
            paused=dict(self._paused),
            left_out=dict(self._left_out),
            time_s=_median_s(arms) if self.clock is None else self.clock.now_s(now_s),
            speed=speed,
            alarms=tuple(self.alarms.values()),
            listened_s=_age_s(self.began_s, now_s) or 0.0,
            lost_s=_age_s(self.lost_s, now_s),
            expiry=self.expiry,
        )
        unserved = why_unserved(now)
        return replace(now, arms=tuple(replace(arm, idle=why_idle(arm, waiting, now, unserved)) for arm in now.arms))

    def _pause(self, request: ControlRequest) -> None:
        """Apply a pause or its end, which the next status reply confirms."""
        match request.action:
            case Pause(arm):
                self._paused[arm] = request.by
            case Resume(arm):
                kept = {} if arm == ALL_ARMS else {name: by for name, by in self._paused.items() if name != arm}
                self._paused = kept
            case _:
                pass

    def _arm(self, name: str) -> _Arm:
        arm = self._arms[name] = self._arms.get(name) or _Arm()
        return arm

    def _auctioneer(self, name: str) -> _Auctioneer:
        auctioneer = self._auctioneers[name] = self._auctioneers.get(name) or _Auctioneer()
        return auctioneer

    def _set_status(self, status: JobStatus, now_s: float, number: int | None = None) -> None:
        """Set the status of a job; `number` is that of the result that has it."""
        job = self._jobs.get(status.job)
        last = 0 if job is None else job.number
        if number is not None and number < last:
            return
        # A result has neither a predicted end nor why a job waits: it replaces a status that it changes.
        if job is None or (job.status != status if number is None else _progress(job.status) != _progress(status)):
            job = self._jobs[status.job] = _Job(status, now_s)
        elif number is None:
            self._jobs.move_to_end(status.job)
        job.heard_s, job.number = now_s, max(last, number or 0)


class FleetListener:
    """`FleetListener(link).serve(until_s)` in a loop keeps `view` up to date.

    Attributes:
        view: The fleet as its messages show it.
    """

    def __init__(
        self,
        link: BusClient,
        *,
        on_message: OnMessage = lambda topic, name, message: None,
        on_presence: OnPresence = lambda role, name, present: None,
    ) -> None:
        """Subscribe to all that is published in the fleet; `link` is open.

        Args:
            on_message: Called after `view` was updated.
        """
        self.view = FleetView(link.fleet, began_s=time.monotonic())
        self._link, self._on_message, self._on_presence = link, on_message, on_presence
        self._status_due_s = time.monotonic()
        for channel, message in PUBLISHED.items():
            expression = keys.of_every(link.fleet, channel.role, channel.topic)
            most = 1 if channel.topic == "state" else None  # of a thousand cached states only the last one matters
            link.subscribe(expression, message, partial(self._message, channel.topic), history=True, most=most)
        link.watch_tokens(keys.of_every_arm(link.fleet, "alive"), partial(self._token, "arm"))
        link.watch_tokens(keys.of_every_auction(link.fleet, "alive"), partial(self._token, "auction"))

    def serve(self, until_s: float) -> None:
        """Handle messages until the real second `until_s`; request the fleet's clock and all jobs when that is due."""
        asked_s = time.monotonic()
        if asked_s >= self._status_due_s:
            self._status_due_s = asked_s + STATUS_EVERY_S
            fleet, done = self._link.fleet, partial(self._statuses, asked_s)
            try:
                clocks = partial(self._clocks, asked_s)
                self._link.query(keys.of_clock(fleet), ClockRequest(), Clock, clocks, timeout_s=STATUS_EVERY_S)
                query_statuses(self._link, done, timeout_s=STATUS_EVERY_S, most=MAX_JOBS)
            except BusError as error:
                _LOG.warning("%s", error)
        while time.monotonic() < until_s:
            if self._link.serve(until_s):
                self.view.heard_s = time.monotonic()
        self.view.follow_connection(self._link.connected, time.monotonic())
        self.view.expiry = self._link.expiry

    def _message(self, topic: str, name: str, message: msgspec.Struct) -> None:
        self.view.update(name, message, time.monotonic())
        self._on_message(topic, name, message)

    def _token(self, role: Role, name: str, present: bool) -> None:
        if self.view.set_token(role, name, present):
            self._on_presence(role, name, present)

    def _clocks(self, asked_s: float, answers: Replies[Clock]) -> None:
        for reply in answers.messages.values():
            self.view.clock = FleetClock(reply.speed).set_to(asked_s, asked_s + answers.took_s, reply.time_s)

    def _statuses(self, asked_s: float, answers: Replies[Status]) -> None:
        replies = list(answers.messages.values())
        for reply in replies:
            self.view.update_jobs(reply, time.monotonic())
        if not answers.refused:
            self.view.forget_other_jobs(replies, asked_s)


def _is_later(alarm: Alarm, kept: Alarm | None) -> bool:
    """Whether a message of an alarm replaces the one kept: of the same monitor by its number, otherwise by its time."""
    if kept is None or (alarm.monitor == kept.monitor and alarm.number > kept.number):
        return True
    order, kept_order = ((each.time_s, each.by != "", each.ended_s is not None) for each in (alarm, kept))
    return order > kept_order or (order == kept_order and alarm.monitor != kept.monitor)


def _progress(status: JobStatus) -> tuple[object, ...]:
    return status.state, status.arm, status.award, status.cycles, status.due_s, status.value


def describe_event(event: ArmEvent) -> str:
    """Short text of an event, for example `warning joint 2 60.0 (crate_1)`."""
    parts = [
        event.kind,
        f"joint {event.joint}" if event.joint else "",
        "" if event.value is None else f"{event.value:.1f}",
        f"({event.job})" if event.job else "",
        event.reason,
    ]
    return " ".join(filter(None, parts))


def describe_status(status: JobStatus) -> str:
    """Short text of a job's status, for example `crate_1: finished by arm_0 at 842 s`."""
    link = {"awarded": "to", "finishing": "by", "finished": "by"}.get(status.state, "last at")
    arm = f" {link} {status.arm}" if status.arm else ""
    end = "" if status.finished_s is None else f" at {status.finished_s:.0f} s"
    return f"{status.job}: {status.state}{arm}{end}{f': {status.reason}' if status.reason else ''}"


def why_unserved(fleet: FleetSnapshot) -> str:
    """Why no arm gets a job, as far as it is not for the arms or the jobs; "" for no such reason."""
    last, age_s = fleet.last_reply
    if age_s > SILENT_S:
        return f"{last} has not replied for {age_s:.0f} s." if last else "Nobody has replied about the jobs."
    return next((each.trouble for each in fleet.auctioneers if each.trouble and each.auctioneer == last), "")


def why_idle(arm: ArmSnapshot, waiting: Mapping[str, str], fleet: FleetSnapshot, unserved: str = "") -> str:
    """Why an arm has no job now; "" for one that has a job or is not present.

    Args:
        waiting: Reasons of the waiting jobs, by job.
        fleet: Which arms are paused, left out or take space.
        unserved: Why no arm gets a job.
    """
    if not arm.present or arm.job:
        return ""
    if (pause := next((name for name in (ALL_ARMS, arm.arm) if name in fleet.paused), None)) is not None:
        return f"It is paused{by_whom(fleet.paused[pause])}."
    if arm.mode == "faulted":
        return "It is faulted."
    if arm.break_end_s is not None:
        return f"It is in a break until {timedelta(seconds=round(arm.break_end_s))} of fleet time."
    if arm.headroom_k is not None and arm.headroom_k <= 0.0:
        return "Its temperatures are impossible." if arm.bad_sensor else "It is above its warning limit."
    if unserved:
        return unserved
    if arm.arm in fleet.left_out:
        return f"It {fleet.left_out[arm.arm]}."
    if not waiting:
        return "No job waits."
    word = re.compile(rf"(?<!\w){re.escape(arm.arm)}(?!\w)")
    named = next((f" {job}: {reason}" for job, reason in waiting.items() if word.search(reason)), "")
    named = "" if arm.arm in fleet.space else named  # of an arm in the way the sentence is about others
    others = ", ".join(sorted(fleet.space.keys() - {arm.arm}))
    in_way = f" Space is closed by {others}, which may be in its way." if others else ""
    return f"It has bids for {bids_of(arm, waiting)} of {len(waiting)} waiting jobs.{in_way}{named}"


def bids_of(arm: ArmSnapshot, waiting: Container[str]) -> int:
    """Number of the waiting jobs that an arm has said it can do."""
    return sum(job in waiting and score != JobScore() for job, score in arm.scores.items())


def _last_reply(auctioneers: Sequence[AuctioneerSnapshot], listened_s: float = 0.0) -> tuple[float, str]:
    """Age of the last message about the jobs, and its sender; the given age and "" without a message."""
    ages_s = [(each.heard_age_s, each.auctioneer) for each in auctioneers if each.heard_age_s is not None]
    return min(ages_s, default=(listened_s, ""))


def _median_s(arms: Sequence[ArmSnapshot]) -> float | None:
    """Median of the times of the present arms, or of all without one: an arm may have a wrong clock."""
    times_s = [(arm.present, arm.time_s) for arm in arms if arm.time_s is not None]
    some = any(present for present, _ in times_s)
    return median_low(time_s for present, time_s in times_s if present or not some) if times_s else None


def _age_s(at_s: float | None, now_s: float) -> float | None:
    return None if at_s is None else now_s - at_s


def _has_all(reply: Status) -> bool:
    """Whether a status reply names all jobs.

    A job that changes its state between two pages may be on none. A sender that does not count jobs may have had no
    room for more.
    """
    counted = sum(reply.counts.values()) <= len(reply.jobs) if reply.counts else len(reply.jobs) < auction.MOST_JOBS
    return counted and not reply.next


def _most_urgent(statuses: Sequence[JobStatus], most: int) -> tuple[JobStatus, ...]:
    """Return the first `most` statuses in the order of `Status.jobs`; of the ended ones, the last is the newest."""

    def position(i: int) -> Position:
        status = statuses[i]
        order = -i if status.state in ENDED else status.release_s or 0.0
        return Position(urgency(status.state, shift_ended=status.shift_ended), order, status.job)

    return tuple(statuses[i] for i in sorted(range(len(statuses)), key=position)[:most])


def _arm_snapshot(name: str, arm: _Arm, now_s: float, speed: float | None, ended: Container[str]) -> ArmSnapshot:
    (state, state_s), (scores, scores_s) = arm.last(State), arm.last(DifficultyScores)
    (info, _), (event, _) = arm.last(Info), arm.last(ArmEvent)
    age_s = now_s - state_s if state else None
    columns = (scores.peak_c or repeat(None), scores.p_saturation, scores.difficulty) if scores else ()
    by_job = zip(scores.jobs, map(JobScore, *columns), strict=True) if scores else ()
    difficulty_age_s = now_s - scores_s if scores else None
    if scores and state and speed:  # from a cache it may arrive long after it was sent
        difficulty_age_s = max(now_s - scores_s, now_s - state_s + (state.time_s - scores.time_s) / speed)
    temps_c = state.temp_c if state else ()
    hottest_c = max(temps_c, default=None)
    return ArmSnapshot(
        arm=name,
        token=arm.token,
        present=arm.token and age_s is not None and age_s <= FRESH_S,
        mode=state.mode if state else None,
        time_s=state.time_s if state else None,
        hottest_c=hottest_c,
        joint=None if hottest_c is None else temps_c.index(hottest_c) + 1,
        headroom_k=state.headroom_k if state else None,
        temp_c=temps_c,
        bad_sensor=arm.sensors.fault,
        motion_difficulty=state.motion_difficulty if state else None,
        expected_c=state.expected_c if state else (),
        p_saturation=state.job_p_saturation if state else None,
        break_end_s=arm.break_end_s,
        worked_s=arm.worked_s,
        heat_n2m2s=arm.heat_n2m2s,
        events=dict(arm.events),
        job=state.job if state else "",
        busy_s=state.busy_s if state else 0.0,
        away=bool(state and state.space),
        leaving=bool(state and state.leaving),
        left=bool(not arm.token and state and state.leaving and not state.job and not state.space),
        doubled=arm.is_doubled(now_s),
        scores={job: score for job, score in by_job if job not in ended},
        joints=info.joints if info else None,
        twin=info.twin if info else "",
        event=describe_event(event) if event else "",
        state_age_s=age_s,
        state_gap_s=arm.gap_s,
        difficulty_age_s=difficulty_age_s,
    )
