"""Epochs: who has lost a journal, or has an older copy, must not have jobs done again that arms have done.

The epoch is the name of a journal of the auctioneer, which arms get with every award and keep on disk. Before an arm
counts as present, the auctioneer asks what it has finished and what it has. If an arm knows another epoch, the journal
was lost: no jobs are accepted, unless a new epoch was requested. Then the auctioneer adopts what the arms know.

An older copy of the journal lacks what was done since. So after a restart no job is awarded until all arms have sent
what they have finished, what they have, and what they may have done: such a job is unfinished, and a person settles it.
The auctioneer waits for at most 20 s: what only an arm knows that comes online later may be done again.

Without an auctioneer all arms keep one epoch. An arm whose journals are lost has forgotten what it granted and what was
done: it does not take part beside arms that know it, unless a person requests it (`--new-epoch`). Then it waits for
the length of a lease, adopts what the present arms have done and have, and takes them to be anywhere until they repeat
their claims. An arm takes part only after a majority, with itself, has replied with its history. All record the first
claim of each start: an older copy is noticed only if a replying peer knows a later start.
"""

from collections.abc import Iterable, Iterator
from statistics import median_high

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ABANDONED, MOST_JOBS, Award, JobSpec, JobState
from fleet.bus.protocol.consensus import History, HistoryRequest, JobOutcome, with_finished
from fleet.errors import BusError
from fleet.live.book import JobBook
from fleet.live.job_rules import is_same_work
from fleet.live.journal import CommitPermitted, EpochBegun, JobsAccepted
from fleet.live.records import (
    FINISHED_BY,
    NO_AWARD,
    BookRecord,
    ClaimNumbered,
    Granted,
    HistoryAdopted,
    JobEntry,
    JobSettled,
)

REPLY_S = 1.0
"""Real seconds that an arm has to reply."""
MAX_NAMED = 5
"""Jobs that an error names."""
REMEDY = (
    "Stop the auctioneer and bring the journal back, or {}start with --new-epoch: then jobs that the arms have done "
    "are not done again, and all other jobs must be submitted again."
)


def ask_arms(link: BusClient) -> tuple[History, ...]:
    """Return what the present arms have done and have."""
    key = keys.of_every_arm(link.fleet, "history")
    return tuple(link.query_and_wait(key, HistoryRequest(), History, timeout_s=REPLY_S).messages.values())


def kept_time_s(histories: Iterable[History], epoch: str) -> float:
    """Return the fleet time of an epoch that arms have kept without an auctioneer, the median; 0 if none has."""
    times_s = [history.time_s for history in histories if history.time_s > 0.0 and history.epoch == epoch != ""]
    return median_high(times_s) if times_s else 0.0


def check_begin(fleet: str, histories: Iterable[History]) -> None:
    """Check that no arm knows an epoch, so that an auctioneer may begin with an empty journal.

    Raises:
        BusError: an arm does.
    """
    for history in histories:
        if history.epoch:
            raise BusError(
                f"The journal is empty, but fleet '{fleet}' has worked: {describe(history)}. {REMEDY.format('')}"
            )


def describe(history: History) -> str:
    """Return what an arm knows, in words."""
    names = [job.name for job in history.finished[-MAX_NAMED:]]
    done = f"{len(history.finished)} finished job(s), the last ones {', '.join(names)}" if names else "no finished job"
    return f"'{history.arm}' knows the epoch '{history.epoch}', {done}, and has {len(history.awards)} job(s)"


REMEDY_OF_ARM = (
    "Jobs could be done twice. Stop this arm and bring its journals back, or start it with --new-epoch: then it adopts "
    "what the present arms have done and have; what only absent arms know is lost."
)


def check_journals(arm: str, number: int, epoch: str, histories: Iterable[History], *, new_epoch: bool = False) -> None:
    """Check that the journals of an arm are those that its peers know.

    Args:
        number: Least number of claims of the next start of the arm, by those in its journals.
        new_epoch: Whether a person has requested that the arm begins without the journals that its peers know.

    Raises:
        BusError: they are lost, older copies, or of another epoch: jobs might be done twice.
    """
    for peer in (history for history in histories if history.arm != arm):
        if "" not in (epoch, peer.epoch) and epoch != peer.epoch:
            raise BusError(
                f"The journals of '{arm}' are of the epoch '{epoch}', but {describe(peer)}. Jobs could be done twice. "
                "Bring the right journals back, or put these aside and start the arm with --new-epoch."
            )
        if peer.claims.get(arm, -1) >= number and not new_epoch:
            raise BusError(
                f"'{peer.arm}' knows claims of '{arm}' that its journals do not: they are lost, or older copies; "
                f"{describe(peer)}. {REMEDY_OF_ARM}"
            )


def history_of(arm: str, book: JobBook) -> History:
    """Return the jobs that finished last, and those with permission to commit, as many as one message holds."""
    committed = [each for entry in book.jobs.values() if (each := committed_job(arm, entry, book.time_s)) is not None]
    entries = (book.jobs[name] for _, name in book.settled if book.is_finished(name))
    jobs = [job for entry in entries if (job := entry.original) is not None]
    history = History(arm, book.epoch, (), claims=dict(book.numbers), committed=tuple(committed[:MOST_JOBS]))
    return with_finished(history, jobs)


def committed_job(granter: str, entry: JobEntry, time_s: float) -> JobOutcome | None:
    """Return a job with permission to commit as what it becomes if its arm has lost it; None without permission."""
    if (grant := entry.grant) is None or not grant.may_commit:
        return None
    reason = f"The journals of its arm were lost; '{granter}' had granted it permission to commit."
    return JobOutcome(entry.name, entry.award, grant.record.arm, "unfinished", entry.cycles, time_s, reason)


def adopted(book: JobBook, history: History) -> list[BookRecord]:
    """Return what this participant takes over from an arm: jobs that it finished, and jobs that it or others have.

    An arm leases its awards at the auctioneer that gave them; arms without one name those to whom they have given
    permission to commit. An older copy of a journal may have a job as awarded that an arm has finished since, or that
    it, or another arm, has permission to commit.
    """
    records: list[BookRecord] = []
    if history.epoch and not book.epoch:
        records.append(EpochBegun(history.epoch))
    unknown = tuple(job for job in history.finished if _is_unknown(book, job))
    if unknown:
        records.append(HistoryAdopted(history.arm, unknown, book.time_s))
    records += _finished_last_cycles(book, history)
    done = {job.name for job in unknown}
    for award in history.awards:
        if award.job.name not in done:
            records += _of_award(book, history, award)
    for outcome in history.committed:
        records += _unreported(book, outcome) if book.is_central else _of_commit(book, history, outcome)
    return records


def _is_open(book: JobBook, job: JobSpec, *states: JobState) -> bool:
    """Return whether a job is new here, or in one of these states with the same work."""
    if (entry := book.jobs.get(job.name)) is None:
        return job.name not in book.past
    return entry.state in states and (entry.spec is None or is_same_work(entry.spec, job))


def _is_unknown(book: JobBook, job: JobSpec) -> bool:
    """Return whether it is unknown here that a job is finished: it is open, or unfinished and no arm has it."""
    entry = book.jobs.get(job.name)
    unfinished = entry is not None and entry.grant is None and _is_open(book, job, "unfinished")
    return unfinished or _is_open(book, job, "waiting", "awarded")


def _finished_last_cycles(book: JobBook, history: History) -> Iterator[BookRecord]:
    """Yield the end of jobs that the arm had permission to commit, or that are abandoned: an older copy lacks it."""
    held = {award.award for award in history.awards}
    for job in history.finished:
        entry, award = book.jobs.get(job.name), NO_AWARD
        if not _is_abandoned(book, job):
            grant = None if entry is None or not _is_open(book, job, "finishing", "unfinished") else entry.grant
            if grant is None or not grant.may_commit or grant.record.arm != history.arm:
                continue
            award = grant.record.award
        if award not in held:
            terms = (award, history.arm, "finished", job.repetitions, book.time_s, FINISHED_BY.format(history.arm))
            yield JobSettled(JobOutcome(job.name, *terms))


def _is_abandoned(book: JobBook, job: JobSpec) -> bool:
    """Return whether a job is abandoned here, such as one that was late before its arm replied."""
    if job.name in book.jobs:
        return _is_open(book, job, *ABANDONED)
    return book.past.is_given_up(job.name) and book.past.is_same(job)


def _of_award(book: JobBook, history: History, award: Award) -> Iterator[BookRecord]:
    """Yield what an award that the arm has changes here."""
    permitted = award.award in history.may_commit
    accepted = JobsAccepted((award.job,), f"adopted from {history.arm}", book.time_s)
    if award.auctioneer != book.name:  # it reports the end of the award to an auctioneer that is gone
        reason = f"'{history.arm}' has permission to commit from another auctioneer, '{award.auctioneer}'."
        terms = (award.award, history.arm, "unfinished", award.cycles, book.time_s, reason)
        lost = JobOutcome(award.job.name, *terms)
        if permitted and _is_open(book, award.job, "waiting", "awarded") and book.is_news(lost):
            yield accepted
            yield JobSettled(lost)
        return
    states: tuple[JobState, ...] = ("waiting", "awarded") if permitted else ("waiting",)
    if (grant := book.open.get(award.award)) is not None:
        own = (grant.record.arm, grant.record.job) == (history.arm, award.job.name)
        if own and permitted and not grant.may_commit:
            yield CommitPermitted(award.award, book.time_s, award.cycles)
    elif book.grant_of(award.award) is None and _is_open(book, award.job, *states):
        yield accepted
        yield _adopted_award(award, history, book.time_s)


def _unreported(book: JobBook, outcome: JobOutcome) -> Iterator[BookRecord]:
    """Yield an unsure end that the arm has reported: an older copy lacks the report."""
    if not book.is_settled(outcome.job) and book.is_news(outcome):
        yield JobSettled(outcome)


def _of_commit(book: JobBook, history: History, outcome: JobOutcome) -> Iterator[BookRecord]:
    """Yield what a permission to commit changes that the arm has given, without an auctioneer."""
    entry = book.jobs.get(outcome.job)
    grant = None if entry is None else entry.grant
    if book.is_settled(outcome.job) or (grant is not None and grant.may_commit):
        return
    before = book.grant_of(outcome.award, outcome.job)
    is_over = before is not None and before.outcome not in ("", "dropped")  # its arm has reported or released it
    if is_over or outcome.award in book.operations.redone(outcome.job):
        return
    if outcome.arm == book.name:  # it may have done the last cycle, and does not know
        yield JobSettled(outcome)
        return
    if grant is not None and (grant.record.arm, grant.record.award) == (outcome.arm, outcome.award):
        yield CommitPermitted(outcome.award, book.time_s, outcome.cycles)
    else:
        terms = (outcome.award, outcome.job, outcome.arm, book.time_s, outcome.cycles, (outcome.job,))
        yield Granted(*terms, may_commit=True)
    yield ClaimNumbered(outcome.arm, history.claims.get(outcome.arm, 0))


def _adopted_award(award: Award, history: History, time_s: float) -> Granted:
    terms = (award.award, award.job.name, history.arm, time_s, award.cycles, award.job.stations)
    may_commit = award.award in history.may_commit
    return Granted(*terms, may_commit=may_commit, auction=award.auction, quote=award.quote, plan=award.plan)
