"""Jobs of a shift that passed their due date, and why: from recorded awards, offers, outages and temperatures."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from statistics import median

import numpy as np

from scenarios.run.records import ShiftLog
from scenarios.show.timeline import stream_of
from scenarios.show.words import clock, duration, names_text


@dataclass(frozen=True, kw_only=True)
class LateJob:
    """A job that passed its due date."""

    job: str
    due_s: float
    late_s: float
    """Tardiness; of an unfinished job until the end of the shift."""
    state: str
    """finished, waiting or running; or, of an abandoned job, given_up or expired."""

    @property
    def abandoned(self) -> bool:
        """Whether it left the queue unfinished."""
        return self.state in ("given_up", "expired")


def late_jobs(log: ShiftLog) -> list[LateJob]:
    """Jobs that passed their due date, finished or not: the latest first, abandoned ones last.

    A recording of a live fleet states no due dates, so it has only those that finished late.
    """
    late = [
        LateJob(job=event.job, due_s=event.time_s - event.value, late_s=event.value, state="finished")
        for event in log.events
        if event.kind == "finish" and event.value > 0
    ]
    late += [
        LateJob(job=job.job, due_s=job.due_s, late_s=log.plan.horizon_s - job.due_s, state=job.state)
        for job in log.jobs
        if job.state != "finished" and job.due_s < log.plan.horizon_s
    ]
    return sorted(late, key=lambda each: (each.abandoned, -each.late_s, each.job))


def lateness_text(log: ShiftLog, late: Sequence[LateJob]) -> str:
    """The first of one or more late jobs with the reason, in a sentence, and the number of all."""
    first, finished = late[0], sum(each.state == "finished" for each in late)
    over = duration(first.late_s)
    how = f"finished {over} late" if first.state == "finished" else f"is unfinished {over} after its due date"
    if first.abandoned:
        how = f"was abandoned, due at {clock(first.due_s)}"
    if len(late) == 1:
        return f"{first.job} {how}: {_reason(log, first)}."
    counts = ((finished, "finished late"), (len(late) - finished, "unfinished at the due date"))
    jobs = ", ".join(f"{number} {what}" for number, what in counts if number)
    return f"Late jobs: {jobs}. The latest, {first.job}, {how}: {_reason(log, first)}."


def _reason(log: ShiftLog, late: LateJob) -> str:
    """What delayed a job most: its own work, or what the arms that can do it did while it waited."""
    own = sorted((span for span in log.plan.assignments if span.job == late.job), key=lambda span: span.start_s)
    for span in own:
        if span.outcome in ("returned", "given_up"):
            return f"{span.arm} {'faulted during' if span.faulted else 'returned'} it at {clock(span.end_s)}"
    times_s = {event.kind: event.time_s for event in log.events if event.job == late.job}
    begin_s = times_s.get("release")
    if begin_s is None:
        return "its release is not recorded"
    end_s = own[0].start_s if own else times_s.get("expire", log.plan.horizon_s)
    took_s = (own[0].finished_s or own[0].end_s) - end_s if own else 0.0
    if begin_s + took_s > late.due_s:
        return f"its work takes {duration(took_s)}, and it was due {duration(late.due_s - begin_s)} after its release"
    offers = [offer for offer in log.offers if offer.job == late.job]
    offers = offers or [offer for offer in log.offers if stream_of(offer.job) == stream_of(late.job)]
    able = [arm for arm in log.arms if any(offer.feasible and offer.arm == arm for offer in offers)]
    if not able:
        return "no arm got a job of its kind"
    waits_s = _arm_time(log, able, begin_s, end_s)
    most = max(waits_s, key=lambda why: waits_s[why])
    if not waits_s[most]:
        return f"what {names_text(able)} did meanwhile is not recorded"
    return _passed(log, late, able, begin_s, end_s) if most == "" else f"{names_text(able)} {most}"


def _arm_time(log: ShiftLog, able: Sequence[str], begin_s: float, end_s: float) -> dict[str, float]:
    """Time of the arms that can do a job between its release and its award, s, by what they did; "": later jobs."""
    were = "were" if len(able) > 1 else "was"
    earlier, out = f"{were} at work since before its release", f"{were} out after a fault"
    failed, paused = f"{were} out after a failure", "had a break"
    hot, idle = f"{were} idle above the warning limit", f"{were} idle: its place was taken, or the policy let it wait"
    time_s: dict[str, float] = dict.fromkeys(("", earlier, out, failed, paused, hot, idle), 0.0)
    at_s = log.readings.time_s
    step_s = float(np.median(np.diff(at_s))) if len(at_s) > 1 else 0.0
    for arm in able:
        spans = [(s, earlier if s.start_s < begin_s else "") for s in log.plan.assignments if s.arm == arm]
        spans += [(each, out if each.kind == "fault" else failed) for each in log.plan.outages if each.arm == arm]
        spans += [(each, paused) for each in log.plan.breaks if each.arm == arm]
        free = (at_s >= begin_s) & (at_s < end_s)
        for span, why in spans:
            time_s[why] += max(0.0, min(span.end_s, end_s) - max(span.start_s, begin_s))
            free &= (at_s < span.start_s) | (at_s >= span.end_s)
        peak_c = np.fmax.reduce(log.readings.temp_c[free, log.arms.index(arm)], axis=-1, initial=-inf)
        time_s[hot] += step_s * float((peak_c >= log.limits.warning_c).sum())
        time_s[idle] += step_s * float((peak_c < log.limits.warning_c).sum())
    return time_s


def _passed(log: ShiftLog, late: LateJob, able: Sequence[str], begin_s: float, end_s: float) -> str:
    """How many jobs were awarded before a late one to arms that can do it, and what most of them have in common."""
    ahead = [a for a in log.plan.assignments if a.arm in able and begin_s <= a.start_s < end_s and a.job != late.job]
    records = {record.job: record for record in log.jobs}
    took_s = {(o.arm, o.job, o.time_s): o.duration_s for o in log.offers if o.duration_s}
    like = [s for (_, job, _), s in took_s.items() if job == late.job]
    own = records.get(late.job)
    if own is not None and not like:  # never awarded: by the time per cycle of jobs of its stream
        alike = [(s, records[job]) for (_, job, _), s in took_s.items() if stream_of(job) == stream_of(late.job)]
        like = [s / record.cycles * own.cycles for s, record in alike if record.cycles]
    own_s = median(like) if like else 0.0
    counts = dict.fromkeys(("shorter", "worth more", "due earlier", "worth more per minute"), 0)
    for span in ahead:
        span_s = took_s.get((span.arm, span.job, span.start_s), inf)
        counts["shorter"] += span_s < own_s
        if own is not None and (other := records.get(span.job)) is not None:
            counts["worth more"] += other.value > own.value
            counts["due earlier"] += other.due_s < own.due_s
            counts["worth more per minute"] += other.value * own_s > own.value * span_s
    most = max(counts, key=lambda trait: counts[trait])
    share = "all" if counts[most] == len(ahead) else str(counts[most])
    which = f", {share} of them {most}" if 2 * counts[most] > len(ahead) else ""
    arms = [arm for arm in log.arms if any(span.arm == arm for span in ahead)]
    return f"{len(ahead)} other job{'s' * (len(ahead) > 1)} went first on {names_text(arms)}{which}"
