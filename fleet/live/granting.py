"""What an arm grants to its peers: the side of a claim that must never forget.

A state machine without a clock and without I/O: real time comes as an argument; records go to `keep`, which returns
once they are on disk, and only then take effect. The rules, of which the head of `fleet.bus.council` says why:

- a job is granted to one arm at a time, and to another only when the lease of the first is over, or it has let go;
- no job is granted at a station at which another one is;
- leave to finish is granted once and for good, but for an arm that says that it has let go of the job;
- what is settled is granted to nobody;
- after a crash every grant counts as leased from the restart.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import msgspec

from fleet.bus.council import Claim, Denied, Grant, Granted, Settled, Stake
from fleet.bus.trade import Count, JobWord, Name
from fleet.errors import JournalFull
from fleet.live.auctioneer import Objection
from fleet.live.timing import Timing


class Given(msgspec.Struct, frozen=True, tag="given"):
    """A job is granted to an arm, or goes on with more cycles done."""

    arm: Name
    number: Count
    """Of the claim."""
    award: Name
    job: Name
    places: tuple[Name, ...]
    cycles: Count
    leave: bool = False


class Freed(msgspec.Struct, frozen=True, tag="freed"):
    """The arm it was granted to has let go of it."""

    arm: Name
    number: Count
    award: Name
    job: Name


class Ended(msgspec.Struct, frozen=True, tag="ended"):
    """A job, or an attempt at one, has come to its end."""

    settled: Settled


class Known(msgspec.Struct, frozen=True, tag="known"):
    """Somebody wants these jobs done."""

    jobs: tuple[JobWord, ...]
    by: str = ""


class Ticked(msgspec.Struct, frozen=True, tag="ticked"):
    """The fleet's time has come so far."""

    time_s: float


class Numbered(msgspec.Struct, frozen=True, tag="numbered"):
    """The last claim of an arm had this number."""

    arm: Name
    number: Count


class Counted(msgspec.Struct, frozen=True, tag="counted"):
    """So many cycles of a job are done."""

    job: Name
    cycles: Count


Deed = Given | Freed | Ended | Known | Ticked | Numbered | Counted


@dataclass(eq=False)
class Gift:
    """A job that is granted to an arm."""

    arm: str
    award: str
    places: tuple[str, ...]
    leave: bool = False
    until_s: float = 0.0
    """Real second at which it is leased no longer."""


@dataclass(eq=False)
class Register:
    """What the records add up to; only `apply` changes it."""

    gifts: dict[str, Gift] = field(default_factory=dict)
    """By job."""
    settled: dict[str, Settled] = field(default_factory=dict)
    """By job; finished or unfinished for good."""
    cycles: dict[str, int] = field(default_factory=dict)
    """Known to be done, by job."""
    numbers: dict[str, int] = field(default_factory=dict)
    """Of the last claim, by arm."""
    jobs: dict[str, JobWord] = field(default_factory=dict)
    """Handed in by others."""
    time_s: float = 0.0

    def apply(self, record: Deed) -> None:
        """Let a record that is on disk take effect."""
        match record:
            case Given():
                self._count(record.job, record.cycles)
                self._number(record.arm, record.number)
                self.gifts[record.job] = Gift(record.arm, record.award, record.places, record.leave)
            case Freed():
                self._number(record.arm, record.number)
                gift = self.gifts.get(record.job)
                if gift is not None and gift.award == record.award:
                    del self.gifts[record.job]
            case Ended(settled):
                self._count(settled.job, settled.cycles)
                self.time_s = max(self.time_s, settled.time_s)
                if settled.outcome != "returned":
                    self.settled[settled.job] = settled
                    self.gifts.pop(settled.job, None)
            case Known(jobs):
                self.jobs |= {word.name: word for word in jobs}
            case Ticked(time_s):
                self.time_s = max(self.time_s, time_s)
            case Numbered(arm, number):
                self._number(arm, number)
            case Counted(job, cycles):
                self._count(job, cycles)

    def _count(self, job: str, cycles: int) -> None:
        self.cycles[job] = max(cycles, self.cycles.get(job, 0))

    def _number(self, arm: str, number: int) -> None:
        self.numbers[arm] = max(number, self.numbers.get(arm, -1))


def recalled(records: Iterable[Deed]) -> Register:
    """What an arm knows of its grants when it starts again."""
    register = Register()
    for record in records:
        register.apply(record)
    return register


def retold(register: Register) -> tuple[Deed, ...]:
    """The fewest records that add up to a register, for a journal to begin anew with."""
    out: list[Deed] = [Ticked(register.time_s)]
    out += [Numbered(arm, number) for arm, number in register.numbers.items()]
    out += [Counted(job, cycles) for job, cycles in register.cycles.items()]
    out += [Known((word,)) for word in register.jobs.values()]
    for job, gift in register.gifts.items():
        number, cycles = register.numbers.get(gift.arm, 0), register.cycles.get(job, 0)
        out.append(Given(gift.arm, number, gift.award, job, gift.places, cycles, gift.leave))
    out += [Ended(settled) for settled in register.settled.values()]
    return tuple(out)


class Grantor:
    """What one arm has granted, and to whom.

    Attributes:
        register: What is on its disk.
    """

    def __init__(
        self,
        arm: str,
        roster: Iterable[str],
        register: Register,
        keep: Callable[..., None],
        *,
        real_s: float,
        timing: Timing | None = None,
    ) -> None:
        """Begin, or go on where the register stands.

        Args:
            roster: All arms of the fleet, whether they are there or not.
            keep: Writes records; returns when they are on disk, or raises `JournalError` and has written none.
        """
        self.arm, self.roster = arm, frozenset(roster)
        self.register = register
        self._keep, self._timing = keep, timing or Timing()
        for gift in register.gifts.values():
            gift.until_s = real_s + self._timing.hold_s

    def asked(self, claim: Claim, real_s: float) -> Grant:
        """Answer to a claim; what it grants is on disk.

        Raises:
            Objection: the one who asks is not of this fleet, has claimed something else since, or there is no room.
        """
        if claim.arm not in self.roster:
            raise Objection(f"'{claim.arm}' is no arm of this fleet. Arms: {', '.join(sorted(self.roster))}.")
        last = self.register.numbers.get(claim.arm, -1)
        if claim.number <= last:
            raise Objection(f"Claim {claim.number} of '{claim.arm}' comes after its claim {last}.")
        try:
            self.admit(claim.jobs)
            self._happen([Ended(settled) for settled in claim.settled if self._is_news(settled)])
            self._happen(self._let_go(claim))
        except JournalFull as error:
            raise Objection(str(error)) from error
        self.register.numbers[claim.arm] = claim.number
        granted: list[Granted] = []
        denied: list[Denied] = []
        for stake in claim.stakes:
            why = self._objection(claim.arm, stake, real_s)
            if not why:
                why = self._give(claim, stake, real_s)
            if why:
                denied.append(Denied(stake.award, why, self.register.settled.get(stake.job)))
            else:
                gift = self.register.gifts[stake.job]
                granted.append(Granted(stake.award, self.register.cycles.get(stake.job, 0), gift.leave))
        return Grant(self.arm, claim.number, self._timing.lease_s, tuple(granted), tuple(denied))

    def learn(self, settled: Settled) -> None:
        """Somebody knows that a job is settled.

        Raises:
            JournalError: it is not on disk, and nothing has changed.
        """
        if self._is_news(settled):
            self._happen([Ended(settled)])

    def admit(self, jobs: tuple[JobWord, ...], by: str = "") -> None:
        """Take jobs into the register.

        Raises:
            JournalError: none is on disk.
        """
        fresh = tuple(word for word in jobs if word.name not in self.register.jobs)
        self._happen([Known(fresh, by)] if fresh else [])

    def tick(self, time_s: float) -> None:
        """Note the fleet's time.

        Raises:
            JournalError: it is not on disk.
        """
        self._happen([Ticked(time_s)])

    def bars(self, job: str, real_s: float) -> bool:
        """Whether somebody has a job, or may have."""
        gift = self.register.gifts.get(job)
        return gift is not None and (gift.leave or real_s < gift.until_s)

    def taken(self, real_s: float) -> frozenset[str]:
        """Stations at which somebody may be at work."""
        return frozenset(
            place for gift in self.register.gifts.values() if real_s < gift.until_s for place in gift.places
        )

    def silent(self, real_s: float) -> frozenset[str]:
        """Jobs whose arm had leave to finish and has not been heard of since."""
        gifts = self.register.gifts.items()
        return frozenset(job for job, gift in gifts if gift.leave and real_s >= gift.until_s)

    # Inside

    def _is_news(self, settled: Settled) -> bool:
        if settled.outcome == "returned":
            return settled.cycles > self.register.cycles.get(settled.job, 0)
        return settled.job not in self.register.settled

    def _let_go(self, claim: Claim) -> list[Deed]:
        kept = {stake.award for stake in claim.stakes}
        return [
            Freed(claim.arm, claim.number, gift.award, job)
            for job, gift in self.register.gifts.items()
            if gift.arm == claim.arm and gift.award not in kept
        ]

    def _objection(self, arm: str, stake: Stake, real_s: float) -> str:
        if stake.job in self.register.settled:
            return f"'{stake.job}' is settled"
        gift = self.register.gifts.get(stake.job)
        mine = gift is not None and (gift.arm, gift.award) == (arm, stake.award)
        if gift is not None and not mine and self.bars(stake.job, real_s):
            return f"'{gift.arm}' has '{stake.job}'"
        if mine and gift is not None and (gift.leave or real_s < gift.until_s):
            return ""
        for job, other in self.register.gifts.items():
            if job != stake.job and real_s < other.until_s and set(other.places) & set(stake.places):
                return f"'{other.arm}' is at the same station with '{job}'"
        return ""

    def _give(self, claim: Claim, stake: Stake, real_s: float) -> str:
        """Grant what there is nothing to say against; why not, if it cannot be written down."""
        before = self.register.gifts.get(stake.job)
        same = before is not None and before.award == stake.award
        leave = stake.phase == "finishing" or (same and before is not None and before.leave)
        cycles = max(stake.cycles, self.register.cycles.get(stake.job, 0))
        news = cycles > self.register.cycles.get(stake.job, 0)
        if before is None or not same or leave != before.leave or news:
            record = Given(claim.arm, claim.number, stake.award, stake.job, stake.places, cycles, leave)
            try:
                self._happen([record])
            except JournalFull as error:
                return str(error)
        self.register.gifts[stake.job].until_s = real_s + self._timing.hold_s
        return ""

    def _happen(self, records: list[Deed]) -> None:
        """Records first, then their effect."""
        if not records:
            return
        self._keep(*records)
        for record in records:
            self.register.apply(record)
