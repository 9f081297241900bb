"""An award executor with a disk in memory, and its auctioneer's part."""

from msgspec.structs import replace

from fleet.bus.protocol.auction import Award, JobSpec, Lease
from fleet.live.arm.awards import ArmHistory, AwardExecutor, ExecutorConfig
from tests.live.disk import Disk

JOB = JobSpec(name="j", kind="hold", places=("p",), repetitions=3)
OTHER = JobSpec(name="k", kind="hold", places=("p",))
VALID_S, LEASE_S = 5.0, 6.0


def shop(disk=None, boot_nonce="n", **config):
    """An executor at its start, and its disk."""
    disk = Disk() if disk is None else disk
    history = ArmHistory().replay(disk.records).after_restart("a", 7.0)
    disk.records[:] = history.compact()
    config = ExecutorConfig(**{"valid_s": VALID_S, **config})
    return AwardExecutor("a", disk.keep, history, nonce=boot_nonce, config=config), disk


def award_on(quote, job=JOB, **changes):
    base = Award(award=f"w-{job.name}", auction="r", auctioneer="x", quote=quote, job=job, lease_s=LEASE_S)
    return replace(base, **changes)


def quoted(executor, *jobs, now_s=0.0, can=True):
    return executor.add_quote({job.name: (job, can) for job in jobs or (JOB,)}, now_s)


def taken(executor, now_s=0.0, **changes):
    """An award that the arm has taken."""
    award = award_on(quoted(executor, now_s=now_s), **changes)
    assert executor.answer_award(award, now_s) == replace(executor.answer_award(award, now_s), accepted=True)
    return award


def finished(executor, award, now_s=1.0):
    executor.apply_lease(Lease("x", LEASE_S, (award.award,), (), (award.award,)), now_s)
    executor.finish(33.0, now_s)
