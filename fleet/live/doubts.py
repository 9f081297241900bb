"""Replay of a journal that may be wrong.

A journal can be undamaged and yet wrong: written by a version with an error or other bounds, or edited by hand. What
contradicts is quarantined with its jobs, which no arm does until a person has settled them; the rest goes on. Each line
begins with what the line before has changed (`Checked`), so a missing record is noticed, too.
"""

import logging
from collections.abc import Iterable
from typing import NamedTuple

from fleet.bus.protocol.consensus import JobOutcome
from fleet.bus.protocol.messages import encode
from fleet.live.book import JobBook, digest
from fleet.live.journal import CommitPermitted, Quarantine, Released
from fleet.live.records import (
    NO_AWARD,
    BookRecord,
    Checked,
    ContactLost,
    ContactRegained,
    Granted,
    JobSettled,
    Requested,
    job_of,
    requested_job,
)

_LOG = logging.getLogger(__name__)

NUMBERS_SKIPPED = 1_000
"""Numbers of results and requests left out after a journal that was wrong, so that none is used twice."""


def replay(book: JobBook, records: Iterable[BookRecord], quarantine: Quarantine | None = None) -> JobBook:
    """Apply records to a book, oldest first, and return it.

    Records that contradict those before are not applied, and their jobs are quarantined.

    Args:
        quarantine: Gets each of these records, with the reason; None: it is logged.
    """
    before, doubts = set(book.quarantined()), 0
    for record in records:
        if (found := doubt(book, record)) is None:
            book.apply(record)
            continue
        doubts += 1
        _LOG.error("A record of the journal is wrong, %s: %s", found.reason, record)
        if quarantine is not None:
            quarantine(encode(record), found.reason)
        book.quarantine(dict.fromkeys(found.jobs, found.reason))
        if isinstance(record, Checked):
            book.apply_check(record)
    aside = [name for name in book.quarantined() if name not in before]
    if doubts or aside:  # the numbers of the last changes are uncertain
        book.recent.clear()
        book.requested.clear()
        book.number, book.operated = book.number + NUMBERS_SKIPPED, book.operated + NUMBERS_SKIPPED
    for name in aside:
        book.note_change(book.status((name,))[0], book.time_s, book.jobs.get(name))
    return book


class Doubt(NamedTuple):
    """Why a record is not applied."""

    reason: str
    jobs: tuple[str, ...] = ()
    """Jobs whose state is uncertain now; none if the record only repeats another one."""


def doubt(book: JobBook, record: BookRecord) -> Doubt | None:
    """Return why a record cannot follow those before; None if it can."""
    match record:
        case Granted():
            return _doubt_grant(book, record)
        case CommitPermitted() | ContactLost() | ContactRegained():
            if (grant := book.open.get(record.award)) is None:
                known = book.grant_of(record.award) is not None
                return Doubt("the award is closed already") if known else _unknown_award(book, record.award)
            expected = {CommitPermitted: (False, False), ContactLost: (True, False), ContactRegained: (True, True)}
            if (grant.may_commit, grant.silent) == expected[type(record)] or book.jobs[grant.record.job].aside:
                return None
            return Doubt("the award is in this state already", () if grant.may_commit else (grant.record.job,))
        case Released(award, job):
            grant = book.grant_of(award, job)
            if grant is None:
                return None if record.outcome == "refused" else _unknown_award(book, award)
            return Doubt("the award is closed already") if grant.outcome else None
        case JobSettled(outcome) if book.is_central:
            return _doubt_outcome(book, outcome)
        case Requested(operation) if book.is_central:
            if operation.request.request in book.operations.names:
                return Doubt("the request was carried out before")
            job = requested_job(operation.request)
            return None if not job or book.is_known(job) else _unknown_job(job)
        case Checked():
            return _doubt_check(book, record)
        case _:
            return None


def _unknown_job(job: str) -> Doubt:
    return Doubt(f"the journal does not say what '{job}' is", (job,))


def _doubt_grant(book: JobBook, record: Granted) -> Doubt | None:
    entry = book.jobs.get(record.job)
    if entry is None:
        return _unknown_job(record.job) if book.is_central else None
    before = entry.grants.get(record.award)
    if before is not None and (book.is_central or not before.outcome):
        return Doubt("the award was given before")
    if entry.state == "waiting":
        return None
    return Doubt(f"'{record.job}' was {entry.state} when it was awarded", (record.job,))


def _unknown_award(book: JobBook, award: str) -> Doubt:
    """Doubt for a record on an award that is not in the book."""
    job = job_of(award)
    entry = book.jobs.get(job)
    if job in book.past or (entry is not None and entry.state == "finished"):
        return Doubt(f"the job of '{award}' is done already")
    return Doubt(f"the journal has no award '{award}'", (job,) if job else ())


def _doubt_outcome(book: JobBook, outcome: JobOutcome) -> Doubt | None:
    entry = book.jobs.get(outcome.job)
    if entry is None:
        return None if book.is_known(outcome.job) else _unknown_job(outcome.job)
    if outcome.award == NO_AWARD:
        return None if outcome.job in book.waiting else Doubt("the job does not wait")
    if (grant := entry.grants.get(outcome.award)) is None:
        return _unknown_award(book, outcome.award)
    return Doubt("the award is closed already") if grant.outcome in ("finished", "returned", "unfinished") else None


def _doubt_check(book: JobBook, record: Checked) -> Doubt | None:
    """Compare the jobs that changed since the last check with what they were when it was written."""
    if record.number <= book.checks:
        return Doubt("it repeats a line")
    wrong = {name for name in book.unchecked - record.jobs.keys() if name in book.jobs}
    for name, expected in record.jobs.items():
        if name not in book.past and (name not in book.jobs or digest(book, name) != expected):
            wrong.add(name)
    wrong -= {name for name in wrong if name in book.aside or (name in book.jobs and book.jobs[name].aside)}
    counts = (record.changes, record.operated, record.paused)
    if not wrong and counts == (book.number, book.operated, book.operations.paused):
        return None
    return Doubt("the records before do not give the state that was noted", tuple(sorted(wrong)))
