"""Epochs without an auctioneer: an arm whose journals are lost has forgotten what it granted and what was done.

It does not take part beside arms that know it, unless a person requests it (`--new-epoch`). Then it adopts what the
present arms have done and have, as an auctioneer does (`fleet.live.auction.epochs`).
"""

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from fleet.bus.protocol.auction import MOST_JOBS, JobSpec
from fleet.bus.protocol.consensus import JobOutcome
from fleet.bus.protocol.history import MOST_FINISHED, History
from fleet.bus.protocol.messages import encode
from fleet.errors import BusError
from fleet.live.arm.journal_records import MAX_BYTES
from fleet.live.auction.epochs import describe
from fleet.live.consensus.claimant import NUMBERS_PER_BOOT
from fleet.live.consensus.records import GrantRecord, JobGranted, JobSettled
from fleet.live.consensus.register import Register
from fleet.live.journal_records import EpochBegun

REMEDY = (
    "Jobs could be done twice. Stop this arm and bring its journals back, or start it with --new-epoch: then it adopts "
    "what the present arms have done and have; what only absent arms know is lost."
)


def first_number(arm: str, boot: int, register: Register) -> int:
    """Return the number after which the claims and bids of a start of an arm are counted."""
    return max(boot, register.numbers.get(arm, -1) // NUMBERS_PER_BOOT + 1) * NUMBERS_PER_BOOT


def check_journals(arm: str, number: int, epoch: str, histories: Iterable[History], *, new_epoch: bool = False) -> None:
    """Check that the journals of an arm are those that its peers know.

    Args:
        number: As `first_number` returns it.
        new_epoch: Whether a person has requested that the arm begins without the journals that its peers know.

    Raises:
        BusError: they are lost, older copies, or of another epoch: jobs might be done twice.
    """
    for peer in (history for history in histories if history.arm != arm):
        claimed = peer.claims.get(arm, -1)
        if "" not in (epoch, peer.epoch) and epoch != peer.epoch:
            raise BusError(
                f"The journals of '{arm}' are of the epoch '{epoch}', but {describe(peer)}. Jobs could be done twice. "
                "Bring the right journals back, or put these aside and start the arm with --new-epoch."
            )
        lost = claimed >= number or (claimed >= 0 and peer.epoch and not epoch)
        if lost and not new_epoch:
            raise BusError(
                f"'{peer.arm}' knows claims of '{arm}' that its journals do not: they are lost, or older copies; "
                f"{describe(peer)}. {REMEDY}"
            )


def adopted(arm: str, register: Register, histories: Iterable[History]) -> list[GrantRecord]:
    """Return the records of what other arms have done and have, as far as a register does not know it."""
    records: list[GrantRecord] = []
    for peer in (history for history in histories if history.arm != arm):
        if peer.epoch and not register.epoch and not any(isinstance(each, EpochBegun) for each in records):
            records.append(EpochBegun(peer.epoch))
        for job in peer.finished:
            outcome = JobOutcome(job.name, "?", peer.arm, "finished", job.repetitions, 0.0)
            if not register.is_settled(job.name):
                records.append(JobSettled(outcome))
        for outcome in peer.committed:
            if outcome.job in register.grants or register.is_settled(outcome.job):
                continue
            if outcome.arm == arm:  # it may have done the last cycle, and does not know
                records.append(JobSettled(outcome))
            else:
                number = peer.claims.get(outcome.arm, 0)
                records.append(
                    JobGranted(outcome.arm, number, outcome.award, outcome.job, (outcome.job,), outcome.cycles, True)
                )
    return records


def history_of(arm: str, register: Register, jobs: Mapping[str, JobSpec]) -> History:
    """Return what an arm knows to be done, and to whom it has given permission to commit, as much as one message holds.

    Args:
        jobs: Jobs that the arm knows, by name.
    """
    reason = f"The journals of its arm were lost; '{arm}' had granted it permission to commit."
    committed = tuple(
        JobOutcome(job, grant.award, grant.arm, "unfinished", register.cycles.get(job, 0), register.time_s, reason)
        for job, grant in register.grants.items()
        if grant.may_commit
    )[:MOST_JOBS]
    history = History(arm, register.epoch, (), claims=dict(register.numbers), committed=committed)
    size, finished = len(encode(history)), list[JobSpec]()
    for job in [job for name, job in jobs.items() if register.is_finished(name)][-MOST_FINISHED:]:
        if (size := size + len(encode(job)) + 1) <= MAX_BYTES:
            finished.append(job)
    return replace(history, finished=tuple(finished))
