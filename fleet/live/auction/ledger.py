"""What an auctioneer knows about its jobs: a state that follows from journal records and from nothing else.

Whatever happens to a job is a record: it is written to the journal first and applied here after that, so a replay of
the journal gives the same ledger again, with the same numbers on its results. What cannot be known after a crash, how
long an arm still holds its lease, is not in here: whoever replays lets every open award count as leased from then.
"""

from bisect import insort
from collections import deque
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

from fleet.bus.protocol.auction import Admission, JobSpec, JobStatus
from fleet.live.auction.admission import MOST_JOBS, admit
from fleet.live.auction.journal_records import (
    AuctionRecord,
    Awarded,
    AwardState,
    Change,
    ClockTick,
    Closed,
    CommitPermitted,
    ContactLost,
    ContactRegained,
    Entry,
    JobsAccepted,
    LedgerSnapshot,
    ShiftEnded,
    Started,
)
from fleet.live.journal import JournalState

REMEMBERED = 64
"""Last changes, for those who may have missed them when the auctioneer was gone."""


@dataclass
class Ledger(JournalState[AuctionRecord]):
    """Jobs and awards. Only `apply` changes it."""

    places: frozenset[str] | None = None
    """Places of the cell; None: any name goes."""
    most: int = MOST_JOBS
    jobs: dict[str, Entry] = field(default_factory=dict)
    awards: dict[str, AwardState] = field(default_factory=dict)
    time_s: float = 0.0
    """Latest of all records."""
    number: int = 0
    """Of the next change."""
    ended: bool = False
    recent: deque[Change] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    open: dict[str, AwardState] = field(default_factory=dict)
    """Awards that an arm may still hold, by name."""
    _waiting: list[str] = field(default_factory=list)
    """Jobs that nobody holds, in the order of their release, then of their names."""

    # What is asked

    def admit(self, words: Sequence[JobSpec]) -> tuple[Admission, ...]:
        """What becomes of jobs that are handed in together; nothing is changed yet."""
        if self.ended:
            return tuple(Admission(word.name, False, "The shift is over, no more jobs are taken.") for word in words)
        there = {name: entry.word for name, entry in self.jobs.items()}
        return admit(words, there, places=self.places, most=self.most)

    def ready(self, time_s: float, most: int, *, but: Container[str] = ()) -> list[JobSpec]:
        """The first jobs, `but` for some, that may begin now: released, after their predecessors, at free stations."""
        if self.ended:
            return []
        taken = self.taken()
        found = (
            word
            for name in self._waiting
            for word in [self.jobs[name].word]
            if word.release_s <= time_s
            and name not in but
            and not taken & frozenset(word.places)
            and all(self.jobs[before].state == "finished" for before in word.after)
        )
        return list(islice(found, most))

    def taken(self) -> frozenset[str]:
        """Stations at which an arm may be at work. One that went silent in its last cycle does not bar its station."""
        return frozenset(
            place
            for promise in self.open.values()
            if not promise.silent
            for place in self.jobs[promise.made.job].word.places
        )

    def returned(self, words: Iterable[JobSpec]) -> dict[str, tuple[int, float]]:
        """How often each of these jobs came back unfinished, and when last; those that never did are left out."""
        entries = {word.name: self.jobs[word.name] for word in words}
        return {name: (entry.returns, entry.returned_s) for name, entry in entries.items() if entry.returns}

    def unsettled(self) -> list[str]:
        """Names of the jobs that are neither finished nor given up."""
        return [name for name, entry in self.jobs.items() if entry.state not in ("finished", "unfinished")]

    def status(self, names: Iterable[str] = ()) -> list[JobStatus]:
        """Where jobs stand, all of them if none is named; names that nobody knows are left out."""
        wanted = dict.fromkeys(names) or self.jobs
        return [self._status(self.jobs[name]) for name in wanted if name in self.jobs]

    def compact(self) -> tuple[LedgerSnapshot]:
        """Return the fewest records that give the same ledger: one.

        Of an award that was refused, and of those for a finished job but the one that finished it, nothing is kept:
        whatever may still be said of them changes nothing.
        """
        kept = [
            promise
            for name, promise in self.awards.items()
            if name in self.open or self._of(name).award == name or self._may_count(promise)
        ]
        snapshot = LedgerSnapshot(
            time_s=self.time_s,
            number=self.number,
            ended=self.ended,
            jobs=tuple(map(replace, self.jobs.values())),
            awards=tuple(map(replace, kept)),
            open=tuple(self.open),
            recent=tuple(self.recent),
        )
        return (snapshot,)

    # What happens

    def apply(self, record: AuctionRecord) -> list[Change]:
        """Let a record that is in the journal take effect; returns whose state has changed."""
        match record:
            case JobsAccepted():
                touched = self._accept(record)
            case Awarded():
                entry = self.jobs[record.job]
                self.awards[record.award] = self.open[record.award] = AwardState(record)
                entry.state, entry.award, entry.reason = "awarded", record.award, ""
                self._waiting.remove(record.job)
                touched = [entry]
            case CommitPermitted():
                touched = [self._of(record.award)]
                self.awards[record.award].may_commit = True
                touched[0].state = "finishing"
            case ContactLost():
                touched = [self._of(record.award)]
                self.awards[record.award].silent = True
                arm = self.awards[record.award].made.arm
                touched[0].state = "unfinished"
                touched[0].reason = f"'{arm}' was about to finish it and has not been heard of since."
            case ContactRegained():
                touched = [self._of(record.award)]
                self.awards[record.award].silent = False
                touched[0].state, touched[0].reason = "finishing", ""
            case Closed():
                touched = self._close(record)
            case ShiftEnded():
                self.ended = True
                touched = [self.jobs[name] for name in self.unsettled()]
                for entry in touched:
                    entry.reason = entry.reason or "The shift ended before it was done."
                    entry.state = "unfinished"
                self._waiting = []
            case LedgerSnapshot():
                self._stand(record)
                touched = []
            case Started() | ClockTick():
                touched = []
        self.time_s = max(self.time_s, record.time_s)
        return [self._change(entry, record.time_s) for entry in touched]

    # Inside

    def _accept(self, record: JobsAccepted) -> list[Entry]:
        fresh = [Entry(word, record.by) for word in record.jobs if word.name not in self.jobs]
        self.jobs |= {entry.word.name: entry for entry in fresh}
        self._waiting = sorted([*self._waiting, *(e.word.name for e in fresh)], key=self._release)
        return fresh

    def _close(self, record: Closed) -> list[Entry]:
        promise = self.awards[record.award]
        promise.silent, promise.outcome = False, record.outcome
        self.open.pop(record.award, None)
        entry = self.jobs[promise.made.job]
        if entry.state == "finished":
            return []
        entry.cycles = max(entry.cycles, min(record.cycles, entry.word.repetitions))
        if record.outcome == "finished":
            self.open.pop(entry.award, None)  # done is done, whoever else was given it meanwhile
            if entry.word.name in self._waiting:
                self._waiting.remove(entry.word.name)
            entry.state, entry.award, entry.reason, entry.finished_s = "finished", record.award, "", record.time_s
        elif entry.award != record.award:
            return []  # another one holds it now
        elif record.unsure or self.ended:
            entry.state = "unfinished"
            entry.reason = record.reason or "Nobody knows whether its last cycle was done."
        else:
            entry.state, entry.reason = "waiting", record.reason
            if record.outcome == "returned":
                entry.returns, entry.returned_s = entry.returns + 1, record.time_s
            # Somebody has to do at least the last cycle of it.
            entry.cycles = min(entry.cycles, entry.word.repetitions - 1)
            if entry.word.name not in self._waiting:
                insort(self._waiting, entry.word.name, key=self._release)
        return [entry]

    def _stand(self, record: LedgerSnapshot) -> None:
        self.number, self.ended = record.number, record.ended
        self.jobs = {entry.word.name: replace(entry) for entry in record.jobs}
        self.awards = {promise.made.award: replace(promise) for promise in record.awards}
        self.open = {name: self.awards[name] for name in record.open}
        self.recent = deque(record.recent, maxlen=REMEMBERED)
        self._waiting = sorted((n for n, entry in self.jobs.items() if entry.state == "waiting"), key=self._release)

    def _may_count(self, promise: AwardState) -> bool:
        """Whether a report on an award that nobody holds any more could change where its job stands."""
        return promise.outcome != "refused" and self.jobs[promise.made.job].state != "finished"

    def _release(self, name: str) -> tuple[float, str]:
        return self.jobs[name].word.release_s, name

    def _of(self, award: str) -> Entry:
        return self.jobs[self.awards[award].made.job]

    def _status(self, entry: Entry) -> JobStatus:
        held = entry.state in ("awarded", "finishing", "finished") or (
            entry.state == "unfinished" and entry.award in self.open
        )
        return JobStatus(
            job=entry.word.name,
            state=entry.state,
            arm=self.awards[entry.award].made.arm if held else "",
            award=entry.award if held else "",
            cycles=entry.cycles,
            finished_s=entry.finished_s,
            reason=entry.reason,
        )

    def _change(self, entry: Entry, time_s: float) -> Change:
        made = self.awards[entry.award].made if entry.award else None
        change = Change(
            number=self.number,
            time_s=time_s,
            status=self._status(entry),
            auction="" if made is None else made.auction,
            difficulty=None if made is None else made.difficulty,
            p_saturation=None if made is None else made.p_saturation,
        )
        self.number += 1
        self.recent.append(change)
        return change
