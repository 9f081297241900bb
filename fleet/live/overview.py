"""Who is in a fleet, what each said last and how old that is: what watch, doctor and gateway know.

Words and real time come in, a picture goes out; no clock, no I/O. However many names somebody invents, what is
remembered is bounded: the ones not heard of for longest go first.
"""

import math
from collections import Counter, OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import msgspec

from fleet.bus import trade
from fleet.bus.messages import DifficultyWord, Info, State, encode
from fleet.bus.trade import Announce, ArmEvent, JobStatus, Result, Status
from fleet.telemetry import Mode

FRESH_S = 3.0
"""Real seconds: an arm is present when its token is there and its last state is no older than this."""
MOST_ARMS, MOST_JOBS = 1024, 4096
WHOLE_BYTES = 32_000
"""An answer where jobs stand that is smaller, and of fewer jobs than one may hold, tells of all there are."""

Role = Literal["arm", "auction"]
Seen = TypeVar("Seen")


class ArmNow(msgspec.Struct, frozen=True):
    """An arm as others see it now; ages are real seconds, None where nothing was said."""

    arm: str
    token: bool
    present: bool
    """Token and fresh state."""
    mode: Mode | None = None
    time_s: float | None = None
    """The fleet's time in its last state."""
    hottest_c: float | None = None
    joint: int | None = None
    """The hottest motor, 1..7."""
    headroom_k: float | None = None
    job: str = ""
    difficulty: dict[str, float | None] = {}
    """d of the jobs on offer."""
    joints: int | None = None
    twin: str = ""
    event: str = ""
    """The last thing that happened to it."""
    state_age_s: float | None = None
    difficulty_age_s: float | None = None


class AuctioneerNow(msgspec.Struct, frozen=True):
    """An auctioneer as others see it now."""

    auctioneer: str
    token: bool
    heard_age_s: float | None = None
    """Real seconds since it last said or answered something."""


class FleetNow(msgspec.Struct, frozen=True):
    """A fleet at one moment."""

    fleet: str
    arms: tuple[ArmNow, ...]
    auctioneers: tuple[AuctioneerNow, ...]
    counts: dict[str, int]
    """Jobs by state."""
    jobs: tuple[JobStatus, ...]
    """Newest last."""


@dataclass
class _Arm:
    token: bool = False
    state: State | None = None
    state_s: float = 0.0
    difficulty: DifficultyWord | None = None
    difficulty_s: float = 0.0
    info: Info | None = None
    event: ArmEvent | None = None


@dataclass
class _Auctioneer:
    token: bool = False
    heard_s: float | None = None
    time_s: float = -math.inf
    """The fleet's, when it last answered."""


@dataclass
class Overview:
    """What was heard of a fleet so far."""

    fleet: str
    _arms: "OrderedDict[str, _Arm]" = field(default_factory=OrderedDict[str, _Arm])
    _auctioneers: "OrderedDict[str, _Auctioneer]" = field(default_factory=OrderedDict[str, _Auctioneer])
    _jobs: "OrderedDict[str, JobStatus]" = field(default_factory=OrderedDict[str, JobStatus])
    _numbers: dict[str, int] = field(default_factory=dict[str, int])
    """Number of the last result by job, so that an older one changes nothing."""
    _heard_s: dict[str, float] = field(default_factory=dict[str, float])
    """Real second in which a job was last heard of."""

    def token(self, role: Role, name: str, there: bool) -> bool:
        """Somebody came or went; says whether that is news."""
        seen = (
            _latest(self._arms, name, _Arm(), MOST_ARMS)
            if role == "arm"
            else _latest(self._auctioneers, name, _Auctioneer(), MOST_ARMS)
        )
        news, seen.token = seen.token != there, there
        return news

    def hear(self, name: str, word: msgspec.Struct, now_s: float) -> None:
        """Somebody said something at the real second `now_s`; words that are none of ours change nothing."""
        if isinstance(word, Announce | Result):
            _latest(self._auctioneers, name, _Auctioneer(), MOST_ARMS).heard_s = now_s
            if isinstance(word, Result) and word.number >= self._numbers.get(word.status.job, 0):
                self._numbers[word.status.job] = word.number
                self._stands(word.status, now_s)
            return
        if not isinstance(word, State | DifficultyWord | Info | ArmEvent):
            return
        arm = _latest(self._arms, name, _Arm(), MOST_ARMS)
        if isinstance(word, State):
            arm.state, arm.state_s = word, now_s
        elif isinstance(word, DifficultyWord):
            arm.difficulty, arm.difficulty_s = word, now_s
        elif isinstance(word, Info):
            arm.info = word
        else:
            arm.event = word

    def told(self, status: Status, now_s: float) -> None:
        """The auctioneer answered where jobs stand."""
        seen = _latest(self._auctioneers, status.auctioneer, _Auctioneer(), MOST_ARMS)
        if status.time_s < seen.time_s:  # time does not run back: another fleet, or one that counts its results anew
            self._numbers.clear()
            if not _whole(status):
                self._jobs.clear()
        seen.heard_s, seen.time_s = now_s, status.time_s
        for job in status.jobs:
            self._stands(job, now_s)

    def forget_all_but(self, told: Sequence[Status], asked_s: float) -> None:
        """Forget jobs of which nobody knows who was asked for all of them at the real second `asked_s`.

        They are of a fleet that was there before. An answer that may have had no room for all settles nothing.
        """
        if not told or not all(map(_whole, told)):
            return
        known = {job.job for status in told for job in status.jobs}
        for name in [name for name in self._jobs if name not in known and self._heard_s[name] < asked_s]:
            del self._jobs[name], self._heard_s[name]
            self._numbers.pop(name, None)

    def now(self, now_s: float, jobs: int = MOST_JOBS) -> FleetNow:
        """The fleet at the real second `now_s`, with so many of the jobs that changed last."""
        names = list(self._jobs)[-jobs:] if jobs > 0 else []
        return FleetNow(
            fleet=self.fleet,
            arms=tuple(_arm_now(name, self._arms[name], now_s) for name in sorted(self._arms)),
            auctioneers=tuple(
                AuctioneerNow(name, seen.token, None if seen.heard_s is None else now_s - seen.heard_s)
                for name, seen in sorted(self._auctioneers.items())
            ),
            counts=counted(self._jobs.values()),
            jobs=tuple(self._jobs[name] for name in names),
        )

    def _stands(self, status: JobStatus, now_s: float) -> None:
        self._heard_s[status.job] = now_s
        if self._jobs.get(status.job) != status:
            _latest(self._jobs, status.job, status, MOST_JOBS)
            self._jobs[status.job] = status
        for kept in (self._numbers, self._heard_s):
            if len(kept) > 2 * MOST_JOBS:
                for name in [name for name in kept if name not in self._jobs]:
                    del kept[name]


def counted(jobs: Iterable[JobStatus]) -> dict[str, int]:
    """Jobs by state, for example {'waiting': 3, 'finished': 12}."""
    return dict(Counter(job.state for job in jobs))


def _whole(status: Status) -> bool:
    """Whether an answer had room for every job there is."""
    return len(status.jobs) < trade.MOST_JOBS and len(encode(status)) < WHOLE_BYTES


def _arm_now(name: str, seen: _Arm, now_s: float) -> ArmNow:
    state, said = seen.state, seen.difficulty
    age_s = now_s - seen.state_s if state else None
    temps_c = state.temp_c if state else ()
    hottest_c = max(temps_c, default=None)
    return ArmNow(
        arm=name,
        token=seen.token,
        present=seen.token and age_s is not None and age_s <= FRESH_S,
        mode=state.mode if state else None,
        time_s=state.time_s if state else None,
        hottest_c=hottest_c,
        joint=None if hottest_c is None else temps_c.index(hottest_c) + 1,
        headroom_k=state.headroom_k if state else None,
        job=state.job if state else "",
        difficulty=dict(zip(said.jobs, said.difficulty, strict=True)) if said else {},
        joints=seen.info.joints if seen.info else None,
        twin=seen.info.twin if seen.info else "",
        event=described(seen.event) if seen.event else "",
        state_age_s=age_s,
        difficulty_age_s=now_s - seen.difficulty_s if said else None,
    )


def described(event: ArmEvent) -> str:
    """An event in few words, for example `warning joint 2 60.0 (crate_1)`."""
    parts = [
        event.kind,
        f"joint {event.joint}" if event.joint else "",
        "" if event.value is None else f"{event.value:.1f}",
        f"({event.job})" if event.job else "",
        event.reason,
    ]
    return " ".join(filter(None, parts))


def _latest(seen: "OrderedDict[str, Seen]", name: str, new: Seen, most: int) -> Seen:
    """What is remembered under a name, made if there is nothing, and now the last to be forgotten."""
    known = seen.setdefault(name, new)
    seen.move_to_end(name)
    if len(seen) > most:
        seen.popitem(last=False)
    return known
