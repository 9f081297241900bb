"""Rules of auction, consensus, arms and journals, each broken on purpose."""

import math
from typing import Any

from msgspec.structs import replace as changed

from benchmarks.simulation.mutation import add_mutation, unwritten
from fleet.errors import JournalError
from fleet.live import journal as journal_module
from fleet.live.arm.awards import ArmHistory, AwardAccepted, AwardExecutor
from fleet.live.auction import rounds as round_module
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.records import Awarded, PastJobs
from fleet.live.auction.rounds import LedgerWriter, Timing
from fleet.live.consensus.grants import Claimant, Granter
from fleet.live.consensus.jobs import JobGranted
from fleet.live.journal import Closed, CommitPermitted, JobsAccepted, Journal
from fleet.live.supervisor import Supervisor


def _forgetful(start: Any) -> Any:
    """Start without leases."""

    return lambda self, name, ledger, keep, counted_until_s: start(self, name, ledger, keep, -math.inf)


def _forgetful_granter(start: Any) -> Any:
    def patched(self: Any, *arguments: Any, **options: Any) -> None:
        start(self, *arguments, **options)
        for grant in self.register.grants.values():
            grant.until_s = options["real_s"]

    return patched


def _duplicate(answer: Any) -> Any:
    """Take a repeated award for a new one, on a new quote."""

    def patched(self: Any, award: Any, now_s: float, unfit: str = "") -> Any:
        if all(active.award.award != award.award for active in self.active):
            self._accepted.pop(award.award, None)
            for quote in self._quotes.values():
                if quote.answers.pop(award.job.name, None) is not None:
                    quote.made_s = now_s
        return answer(self, award, now_s, unfit)

    return patched


def _dropped(due: Any) -> Any:
    """Send each report once."""

    def patched(self: Any, now_s: float) -> Any:
        reports = due(self, now_s)
        for _, report in reports:
            self._reports.pop(report.award)
        return reports

    return patched


def _sure(after: Any) -> Any:
    """Return a job as surely not done after a crash in its last cycle."""

    def patched(self: Any, arm: str, time_s: float) -> Any:
        history = after(self, arm, time_s)
        history.reports = {name: (award, changed(r, unsure=False)) for name, (award, r) in history.reports.items()}
        return history

    return patched


def _silent(report: Any) -> Any:
    """Send the receipt without a record."""

    def patched(self: Any, message: Any, real_s: float, time_s: float) -> Any:
        self._writer.record = lambda *records: None
        try:
            return report(self, message, real_s, time_s)
        finally:
            del self._writer.record

    return patched


def _expires_all(expire: Any) -> Any:
    """Take a job back although its arm was permitted to commit."""

    def patched(self: Any, real_s: float, time_s: float) -> None:
        for name in [name for name, lease in self._writer.leases.items() if real_s >= lease.until_s]:
            self._writer.record(Closed(name, "dropped", 0, time_s, "mutation"))

    return patched


def _ends_free(end: Any) -> Any:
    """Free the space of a closed award at once."""
    return lambda self, award, *, moved=True: end(self, award, moved=False)


def _reads_torn_lines(lines: Any) -> Any:
    """Take an unfinished last line for a record."""

    def patched(self: Any, put_aside: Any) -> Any:
        size = sum(len(line) for line, _ in lines(self, None))
        if size < journal_module.os.fstat(self._file).st_size:
            raise JournalError("damaged")
        yield from lines(self, put_aside)

    return patched


def _nobody_in_the_way(original: Any) -> Any:
    return lambda arm, space, taken, excludes: ()


add_mutation(
    "award-unwritten", "an award is on disk before it is sent", (Journal, "append", unwritten(Awarded)), alone=False
)
add_mutation(
    "commit-unwritten",
    "permission to commit is on disk before it is given",
    (Journal, "append", unwritten(CommitPermitted)),
)
add_mutation("accept-unwritten", "an arm accepts an award on disk", (Journal, "append", unwritten(AwardAccepted)))
add_mutation("submission-unwritten", "an accepted job is on disk", (Journal, "append", unwritten(JobsAccepted)))
add_mutation(
    "grant-unwritten", "a grant is on disk before the reply", (Journal, "append", unwritten(JobGranted)), alone=True
)
add_mutation(
    "end-unwritten",
    "the end of a job is on disk before its report and receipt",
    (Journal, "append", unwritten(Closed)),
)
add_mutation(
    "no-fsync",
    "a record is written through",
    (Journal, "__init__", lambda start: lambda self, *a, **k: start(self, *a, **{**k, "sync": lambda file: None})),
)
add_mutation("torn-line-read", "an unfinished last line is removed", (Journal, "_lines", _reads_torn_lines))
add_mutation(
    "lease-forgotten",
    "after a restart open awards count as leased",
    (LedgerWriter, "__init__", _forgetful),
    alone=False,
)
add_mutation(
    "grant-forgotten", "after a restart grants count as leased", (Granter, "__init__", _forgetful_granter), alone=True
)
add_mutation(
    "lease-too-short",
    "the granting side counts leases longer",
    (Timing, "counted_lease_s", lambda _: property(lambda self: 0.5 * self.lease_s)),
)
add_mutation(
    "lease-ignored",
    "an arm begins cycles under a lease only",
    (
        AwardExecutor,
        "allowed_cycles",
        lambda _: lambda self, now_s: self._current.award.job.repetitions - (not self._current.may_commit),
    ),
)
add_mutation(
    "commit-ignored",
    "the last cycle needs permission to commit",
    (AwardExecutor, "allowed_cycles", lambda _: lambda self, now_s: self._current.award.job.repetitions),
    (
        AwardExecutor,
        "finish",
        lambda finish: (
            lambda self, time_s, now_s: (setattr(self._current, "may_commit", True), finish(self, time_s, now_s))[1]
        ),
    ),
)
add_mutation(
    "commit-taken-back",
    "after permission to commit a job goes to no other arm",
    (Auctioneer, "_expire", _expires_all),
    alone=False,
)
add_mutation(
    "duplicate-accepted",
    "a repeated award gets the same answer",
    (AwardExecutor, "answer_award", _duplicate),
    alone=False,
)
add_mutation(
    "past-forgotten",
    "the name of a settled job is not used again",
    (PastJobs, "__contains__", lambda _: lambda self, name: False),
    alone=False,
)
add_mutation("report-dropped", "a report is repeated until its receipt", (AwardExecutor, "due_reports", _dropped))
add_mutation(
    "receipt-first", "a report is on disk before its receipt", (Auctioneer, "apply_report", _silent), alone=False
)
add_mutation("crash-is-sure", "after a crash in the last cycle nobody repeats it", (ArmHistory, "after_restart", _sure))
add_mutation(
    "space-ignored",
    "plans that exclude each other are not awarded at a time",
    *((module, "arms_in_the_way", _nobody_in_the_way) for module in (round_module,)),
    alone=False,
)
add_mutation(
    "space-freed-early",
    "closed awards keep their space until the arm is at home",
    (Ledger, "_end", _ends_free),
    alone=False,
)
add_mutation(
    "claim-space-ignored",
    "an arm grants one of two plans that exclude each other",
    (Granter, "in_the_way", lambda _: lambda self, arm, space: ()),
    alone=True,
)
add_mutation(
    "minority",
    "a claim needs a majority",
    (Claimant, "__init__", lambda start: lambda self, *a, **k: (start(self, *a, **k), setattr(self, "majority", 1))[0]),
    alone=True,
)
add_mutation(
    "no-restart",
    "the supervisor starts ended processes again",
    (Supervisor, "_handle_exit", lambda _: lambda self, running: False),
)
add_mutation(
    "no-backstop",
    "an unanswered award is sent again, or expires",
    (Auctioneer, "_expire", lambda _: lambda self, real_s, time_s: None),
    alone=False,
)
