"""Status of jobs, by what one arm has granted."""

from fleet.bus.protocol.auction import JobStatus
from fleet.live.consensus.granter import Granter


def status_by_grants(job: str, granter: Granter, real_s: float) -> JobStatus:
    """Status of a job, as far as an arm knows from its grants and from outcomes that it received."""
    register = granter.register
    settled, grant, cycles = register.settled.get(job), register.grants.get(job), register.cycles.get(job, 0)
    if settled is not None and settled.outcome == "finished":
        return JobStatus(job, "finished", settled.arm, settled.award, cycles, settled.time_s)
    if settled is not None:
        return JobStatus(job, "unfinished", settled.arm, settled.award, cycles, None, settled.reason)
    if grant is None or not granter.is_granted(job, real_s):
        return JobStatus(job, "waiting", cycles=cycles)
    silent = grant.may_commit and real_s >= grant.until_s
    state = "unfinished" if silent else "finishing" if grant.may_commit else "awarded"
    reason = f"'{grant.arm}' was about to finish it and has not been heard of since." if silent else ""
    return JobStatus(job, state, grant.arm, grant.award, cycles, None, reason)
