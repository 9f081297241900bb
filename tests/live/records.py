"""Records of a job book, made by few words."""

from typing import Any

from fleet.bus.protocol.auction import Report
from fleet.live.journal import Released
from fleet.live.records import BookRecord, Granted, JobSettled, outcome_of


def awarded(award: str, job: str, arm: str = "arm_0", cycles: int = 0, *, place: str = "rack", **more) -> Granted:
    return Granted(award, job, arm, more.pop("time_s", 1.0), cycles, (place,), **more)


def closed(
    award: str, outcome: Any, cycles: int, time_s: float, reason: str = "", *, job="", arm="arm_0", **more: bool
) -> BookRecord:
    """The end of an award; `unsure` and `faulted` as in `Report`."""
    job = job or award.partition(":")[2]
    if outcome in ("refused", "dropped"):
        return Released(award, job, arm, outcome, cycles, time_s, reason)
    report = Report(arm, award, job, outcome, cycles, time_s, reason, **more)
    return JobSettled(outcome_of(report, {award: arm} if report.faulted else {}))
