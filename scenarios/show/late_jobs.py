"""Late jobs, and jobs that waited at the end of a shift beside idle arms, with the reasons."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from agents.registry import WORTHLESS_MIN, claims_no_late_jobs
from fleet.events import Event
from scenarios.run.records import Halt, JobRecord, JobSpan, Outage, ShiftLog
from scenarios.show.words import clock, duration, names_text
from scenarios.table import Table

IDLE_S = 900.0
"""Time for which an arm without a job, beside a job that it can do, is worth a sentence."""
MOST_LATE = 50
"""Rows of the table of late jobs."""
SAME = 0.01
"""Times of work that differ by at most this share count as equal."""
PAUSED = "had a break"
ABANDONED = ("given_up", "expired")
"""States of jobs that left the queue unfinished."""


@dataclass(frozen=True, kw_only=True)
class Standstill:
    """Jobs that waited at the end of a shift while arms had long been idle."""

    waiting: int
    """Number of all jobs that waited at the end."""
    jobs: tuple[str, ...]
    """Those that waited for no other job, and that one of the arms can do by the record."""
    arms: tuple[str, ...]
    since_s: float
    """From then on all of these arms were idle, and each could do one of the jobs; NaN without arms."""
    unknown: tuple[str, ...] = ()
    """Jobs that waited as long, of which no record states which arms can do them."""

    @property
    def badge(self) -> str:
        """What was left, in a few words."""
        some = f", {len(self.jobs)} of them" if len(self.jobs) < self.waiting else ""
        return f"{_count_jobs(self.waiting)} left waiting{f'{some} beside idle arms' if self.jobs else ''}"


def _count_jobs(number: int) -> str:
    return f"{number} job{'s' * (number > 1)}"


def standstill(log: ShiftLog) -> Standstill | None:
    """The standstill at the end of a finished shift; None if there was none, or for less than `IDLE_S`."""
    if log.card.get("status") != "finished":
        return None
    end_s = min(log.plan.horizon_s, log.ended_s)
    spans = (*log.plan.assignments, *log.plan.outages, *log.plan.breaks)
    idle_s = {arm: max((span.end_s for span in spans if span.arm == arm), default=0.0) for arm in log.arms}
    for halt in log.halts:
        idle_s |= {arm: max(idle_s[arm], halt.end_s) for arm in log.arms if halt.arm in ("", arm)}
    absent = log.readings.mode < 0
    for a, arm in enumerate(log.arms):
        idle_s[arm] = max(idle_s[arm], float(log.readings.time_s[absent[:, a]].max(initial=0.0)))
    waiting = [job for job in log.jobs if job.state == "waiting" and not job.release_s > end_s]
    jobs, unknown, since_s = set[str](), set[str](), dict[str, float]()
    for job, job_s in ((record.job, log.ready_s(record)) for record in waiting):
        able = log.able_arms(job)
        for arm in log.arms if able is None else able:
            both_s = max(job_s, idle_s[arm])
            waited = end_s - both_s >= IDLE_S  # not if its release is unknown
            if waited and able is None:
                unknown.add(job)
            elif waited:
                jobs.add(job)
                since_s[arm] = min(both_s, since_s.get(arm, math.inf))
    if not jobs and not unknown:
        return None
    return Standstill(
        waiting=len(waiting),
        jobs=tuple(sorted(jobs)),
        arms=tuple(arm for arm in log.arms if arm in since_s),
        since_s=max(since_s.values(), default=math.nan),
        unknown=tuple(sorted(unknown)),
    )


def standstill_text(log: ShiftLog, stood: Standstill) -> str:
    """How many jobs waited, how many of them beside which arms since when, and of how many too little is recorded."""
    text = f"{_count_jobs(stood.waiting)} still waited at the end"
    if stood.jobs:
        some = f"{len(stood.jobs)} of them " if len(stood.jobs) < stood.waiting else ""
        be = "were" if len(stood.arms) > 1 else "was"
        text += (
            f", {some}though {names_text(stood.arms)} {be} idle from {clock(stood.since_s, log.begin)} to the end: "
            "run another policy"
        )
    if stood.unknown:
        text += (
            f". {_count_jobs(len(stood.unknown))} waited for at least {duration(IDLE_S)}; which arms can do "
            f"{'them' if len(stood.unknown) > 1 else 'it'} is not recorded"
        )
    return f"{text}."


@dataclass(frozen=True, kw_only=True)
class LateJob:
    """A job that passed its due date."""

    job: str
    due_s: float
    late_s: float
    """Tardiness; of an unfinished job until the end of the shift."""
    state: str
    """As in `JobRecord`."""

    @property
    def abandoned(self) -> bool:
        """Whether it left the queue unfinished."""
        return self.state in ABANDONED


def late_jobs(log: ShiftLog) -> list[LateJob]:
    """Jobs that passed their due date, finished or not but not cancelled: the latest first, abandoned ones last."""
    end_s = min(log.plan.horizon_s, log.ended_s)
    finished = {event.job for event in log.events if event.kind == "finish"}  # its result may not be recorded yet
    settled = [job for job in log.jobs if job.state == "finished" and job.job not in finished]
    late = [
        LateJob(job=event.job, due_s=event.time_s - event.value, late_s=event.value, state="finished")
        for event in log.events
        if event.kind == "finish" and event.value > 0
    ]
    late += [
        LateJob(job=job.job, due_s=job.due_s, late_s=job.finished_s - job.due_s, state="finished")
        for job in settled
        if job.finished_s is not None and job.finished_s > job.due_s
    ]
    late += [
        LateJob(job=job.job, due_s=job.due_s, late_s=end_s - job.due_s, state=job.state)
        for job in log.jobs
        if job.state not in ("finished", "cancelled") and job.job not in finished and job.due_s < end_s
    ]
    return sorted(late, key=lambda each: (each.abandoned, -each.late_s, each.job))


def lateness_text(log: ShiftLog, late: Sequence[LateJob]) -> str:
    """The first of one or more late jobs with the reason, in a sentence, and the number of all."""
    first, finished = late[0], sum(each.state == "finished" for each in late)
    over = duration(first.late_s)
    how = f"finished {over} late" if first.state == "finished" else f"is unfinished {over} after its due date"
    if first.abandoned:
        how = f"was abandoned, due at {clock(first.due_s, log.begin)}"
    if len(late) == 1:
        return f"{first.job} {how}: {_reason(log, first)}."
    counts = ((finished, "finished late"), (len(late) - finished, "unfinished at the due date"))
    jobs = ", ".join(f"{number} {what}" for number, what in counts if number)
    return f"Late jobs: {jobs}. The latest, {first.job}, {how}: {_reason(log, first)}."


def late_table(log: ShiftLog) -> Table | None:
    """The late jobs, with their reasons; None if there are none."""
    late = late_jobs(log)

    def row(each: LateJob) -> tuple[str, ...]:
        over = "" if each.abandoned else duration(each.late_s)
        return each.job, clock(each.due_s, log.begin), over, each.state.replace("_", " "), _reason(log, each)

    rows = tuple(map(row, late[:MOST_LATE]))
    caption = f"The first {MOST_LATE} of {len(late)}." if len(late) > MOST_LATE else ""
    head = ("job", "due", "late by", "state", "why")
    return Table(head=head, rows=rows, caption=caption, numbers=False) if late else None


def _reason(log: ShiftLog, late: LateJob) -> str:
    """Why a job did not begin in time: the first of these rules that applies."""
    own = sorted((span for span in log.plan.assignments if span.job == late.job), key=lambda span: span.start_s)
    if came_back := _came_back(log, own):
        return came_back
    if late.state == "given_up" and not own:
        return _given_up_with(log, late)
    record = log.records.get(late.job)
    if record is None or math.isnan(record.release_s):
        return "its release is not recorded"
    wait = _wait_of(log, late, record, own)
    return (
        _own_work(wait)
        or _predecessor(log, wait)
        or (
            "" if wait.able else "it was never awarded, and no offer for it or for a job with the same work is recorded"
        )
        or _begun_instead(log, wait)
        or _arms(log, wait)
    )


@dataclass(frozen=True, kw_only=True)
class _Wait:
    """A late job from its release to its first award."""

    late: LateJob
    released_s: float
    end_s: float
    """First award; without one the due date of an expired job, else the horizon."""
    begun: bool
    """Whether it was awarded."""
    able: Sequence[str]
    """Arms that can do it, by the record."""
    work_s: Mapping[str, float]
    """Time that it takes those of them of which it is recorded, s."""
    last: JobRecord
    """The job that finished last of those that it waited for; itself without such a job."""
    ready_s: float
    """When that job finished: inf for not yet, -inf without one."""

    @property
    def shortest_s(self) -> float:
        """Time that it takes the fastest arm, s; 0 for unknown."""
        return min(self.work_s.values(), default=0.0)

    @property
    def latest_s(self) -> float:
        """Latest begin with which it would have been on time."""
        return self.late.due_s - self.shortest_s

    @property
    def begin_s(self) -> float:
        """From then on it waited for nothing but an arm."""
        return max(self.released_s, self.ready_s)

    def ahead(self, log: ShiftLog, begin_s: float, end_s: float) -> list[JobSpan]:
        """Other jobs that the arms that can do it began between two times."""
        return [
            span
            for span in log.plan.assignments
            if span.arm in self.able and span.job != self.late.job and begin_s <= span.start_s < end_s
        ]


def _wait_of(log: ShiftLog, late: LateJob, record: JobRecord, own: Sequence[JobSpan]) -> _Wait:
    """The wait of a job with these assignments, in order."""
    able = log.able_arms(late.job) or []
    work_s = _work_s(log, late.job, able)
    end_s = late.due_s if late.state == "expired" else log.plan.horizon_s
    if own:
        first = own[0]
        end_s = first.start_s
        least_s = 0.0 if first.finished_s else work_s.get(first.arm, 0.0)  # an unfinished job takes longer
        work_s[first.arm] = max((first.finished_s or first.end_s) - end_s, least_s)
    last, ready_s = log.last_before.get(late.job, (record, -math.inf))
    return _Wait(
        late=late,
        released_s=record.release_s,
        end_s=end_s,
        begun=bool(own),
        able=able,
        work_s=work_s,
        last=last,
        ready_s=ready_s,
    )


def _came_back(log: ShiftLog, own: Sequence[JobSpan]) -> str:
    """Why an arm gave back a job that it had begun; "" if none did."""
    for span in own:
        if span.outcome in ("returned", "given_up"):
            absence = next((e for e in log.events if _absence_in(span, e)), None)
            if absence is not None:
                what = "had a break" if absence.kind == "break" else "failed, not by heat,"
                return f"{span.arm} {what} at {clock(absence.time_s, log.begin)}"
            how = f"{span.arm} {'faulted during' if span.faulted else 'returned'} it at {clock(span.end_s, log.begin)}"
            return how if span.faulted else f"{how}{_return_reason(log, span)}"
    return ""


def _given_up_with(log: ShiftLog, late: LateJob) -> str:
    """Why a job was abandoned that no arm began."""
    lost = next((each for each in log.jobs_before.get(late.job, ()) if each.state in ABANDONED), None)
    if lost is not None:
        return f"it waited for {lost.job}, which {'expired' if lost.state == 'expired' else 'was given up'}"
    why = next((e.reason for e in log.events if e.kind == "give_up" and e.job == late.job), "")
    return why or "a job that it waited for was abandoned"


def _own_work(wait: _Wait) -> str:
    """That it was due before any arm could have finished it; "" otherwise."""
    given_s, work_s = wait.late.due_s - wait.released_s, wait.shortest_s
    if work_s <= given_s:
        return ""
    due = f"it was due {duration(abs(given_s))} {'after' if given_s >= 0 else 'before'} its release"
    return f"its work takes {duration(work_s)}, and {due}" if work_s else due


def _predecessor(log: ShiftLog, wait: _Wait) -> str:
    """The job that it waited for beyond its latest begin; "" without one."""
    half_s = (wait.end_s - wait.released_s) / 2
    # One that never began waited for other reasons afterwards, if that was longer.
    if wait.ready_s <= wait.latest_s or not (wait.begun or wait.ready_s - wait.released_s > half_s):
        return ""
    if math.isinf(wait.ready_s):
        return f"it waits for {wait.last.job}, which is not finished ({wait.last.state.replace('_', ' ')})"
    then = _then(log, wait, wait.ready_s)
    return f"it waited for {wait.last.job}, which finished at {clock(wait.ready_s, log.begin)}{then}"


def _begun_instead(log: ShiftLog, wait: _Wait) -> str:
    """The other jobs that an arm began when this one would still have been on time with it; "" without any.

    Those after which the arm had a break or failed before the late job would have been finished are left out, and those
    at which the places of the late job were taken.
    """
    absences = (*log.plan.breaks, *log.plan.outages)

    def possible(span: JobSpan) -> bool:
        if span.arm not in wait.work_s:
            return False
        done_s = span.start_s + wait.work_s[span.arm]
        away = any(each.arm == span.arm and span.start_s < each.end_s and each.start_s < done_s for each in absences)
        return done_s <= wait.late.due_s and not away and not _place_taken(log, wait.late.job, span)

    in_time = list(filter(possible, wait.ahead(log, wait.begin_s, wait.end_s)))
    return _passed(log, wait, in_time, in_time=True) if in_time else ""


def _arms(log: ShiftLog, wait: _Wait) -> str:
    """What the arms that can do it did for the longest time, until its latest begin if that is recorded."""
    decided = wait.begin_s < wait.latest_s < wait.end_s and all(arm in wait.work_s for arm in wait.able)
    end_s = wait.latest_s if decided else wait.end_s
    halts = {halt_text(log, halt): halt for halt in log.halts if halt.start_s < wait.late.due_s}
    time_s = _arm_time(log, wait, end_s, halts)
    if all(each.start_s >= wait.late.due_s for each in log.plan.breaks):
        time_s.pop(PAUSED)  # it was late before
    most = max(time_s, key=lambda why: sum(time_s[why].values()))
    longest = {arm: max(halts, key=lambda why: time_s[why][arm]) for arm in wait.able} if halts else {}
    halted_s = {arm: time_s[why][arm] for arm, why in longest.items()}
    if 0 < sum(halted_s.values()) >= sum(time_s[most].values()):
        return names_text(list(dict.fromkeys(longest[arm] for arm in wait.able if halted_s[arm] > 0)))
    arms = [arm for arm, own_s in time_s[most].items() if own_s > 0]
    if not arms:
        return f"what {names_text(wait.able)} did meanwhile is not recorded"
    if not most:
        return _passed(log, wait, wait.ahead(log, wait.begin_s, end_s))
    be = "" if most == PAUSED else "were " if len(arms) > 1 else "was "
    why = f"{names_text(arms)} {be}{most}"
    if decided and all(_occupied(log, arm, wait.begin_s, wait.late.due_s - wait.work_s[arm]) for arm in wait.able):
        latest = clock(wait.latest_s, log.begin)
        why += f"; no arm was free by {latest}, its latest begin{_then(log, wait, wait.latest_s)}"
    return why


def _then(log: ShiftLog, wait: _Wait, begin_s: float) -> str:
    """The jobs that went before a late one from then on, after a semicolon; "" without such jobs."""
    ahead = wait.ahead(log, begin_s, wait.end_s)
    return f"; then {_passed(log, wait, ahead)}" if ahead else ""


def _work_s(log: ShiftLog, job: str, able: Sequence[str]) -> dict[str, float]:
    """Time that a job takes each arm, s, by its offers, else by its offers for jobs with the same work."""
    own, work, times_s = log.records.get(job), log.work(job), dict[str, float]()
    offers = {(each.arm, each.job, each.time_s): each for each in log.offers if each.duration_s and each.arm in able}
    for arm in able:
        of_arm = [(each.job, each.duration_s or 0.0) for each in offers.values() if each.arm == arm]
        like_s = [time_s for name, time_s in of_arm if name == job]
        if not like_s and work is not None and own is not None:
            alike = [(log.records[name], time_s) for name, time_s in of_arm if log.work(name) == work]
            like_s = [time_s / record.cycles * own.cycles for record, time_s in alike if record.cycles]
        if like_s:
            times_s[arm] = median(like_s)
    return times_s


def _place_taken(log: ShiftLog, job: str, span: JobSpan) -> bool:
    """Whether jobs of other arms surely had each place at which a job can be done when an arm began another one."""

    def ways(name: str) -> list[set[str]]:
        return [{way} if isinstance(way, str) else set(way) for way in log.stream(name).get("places", ())]

    others = [
        ways(each.job)
        for each in log.plan.assignments
        if each.arm != span.arm and each.start_s < span.start_s < each.end_s
    ]
    own = ways(job)
    taken = (any(other and all(way & theirs for theirs in other) for other in others) for way in own)
    return bool(own) and all(taken)


def _occupied(log: ShiftLog, arm: str, begin_s: float, end_s: float) -> bool:
    """Whether an arm had a break, was out, or was at work on jobs from before, throughout."""
    before = [each for each in log.plan.assignments if each.start_s < begin_s]
    spans = [each for each in (*before, *log.plan.breaks, *log.plan.outages) if each.arm == arm]
    at_s = begin_s
    for span in sorted(spans, key=lambda each: each.start_s):
        if span.start_s <= at_s:
            at_s = max(at_s, span.end_s)
    return at_s > end_s


def _absence_in(span: JobSpan, event: Event) -> bool:
    """Whether an event is a break or failure of the arm of a span that begins in it."""
    begins = event.kind in ("break", "failure") and event.arm == span.arm
    return begins and span.start_s <= event.time_s <= span.end_s


def halt_text(log: ShiftLog, halt: Halt) -> str:
    """What kept an arm, or all of them, from getting jobs, and when."""
    until = f"to {clock(halt.end_s, log.begin)}" if halt.end_s < log.plan.horizon_s else "to the end"
    return f"{halt.reason} from {clock(halt.start_s, log.begin)} {until}"


def _return_reason(log: ShiftLog, span: JobSpan) -> str:
    """Why an arm returned a job, after a colon; "" if it is unknown."""
    key = "return", span.arm, span.job, span.end_s
    reason = next((e.reason for e in log.events if (e.kind, e.arm, e.job, e.time_s) == key), "").rstrip(".")
    return f": {reason[0].lower()}{reason[1:]}" if reason else ""


def _passed(log: ShiftLog, wait: _Wait, ahead: Sequence[JobSpan], *, in_time: bool = False) -> str:
    """How many jobs went before a late one on arms that can do it, and what most of them have in common.

    Args:
        ahead: These jobs, at least one.
        in_time: Whether the late job would have been on time instead of each of them; the last one is named then.
    """
    last = max(ahead, key=lambda span: span.start_s)
    moment = clock(last.start_s, log.begin)
    if in_time and len(ahead) == 1:
        return f"at {moment}, still in time, {last.arm} was free and began {last.job} instead"
    records = log.records
    own = records.get(wait.late.job)
    took_s = {(o.arm, o.job, o.time_s): o.duration_s for o in log.offers if o.duration_s}
    counts = dict.fromkeys(("shorter", "worth more", "due earlier", "worth more per minute"), 0)
    for span in ahead:
        span_s, own_s = took_s.get((span.arm, span.job, span.start_s), math.inf), wait.work_s.get(span.arm, 0.0)
        counts["shorter"] += span_s < own_s * (1 - SAME)
        if own is not None and (other := records.get(span.job)) is not None:
            counts["worth more"] += other.value > own.value
            counts["due earlier"] += other.due_s < own.due_s
            counts["worth more per minute"] += other.value * own_s > own.value * span_s * (1 + SAME)
    most = max(counts, key=lambda trait: counts[trait])
    share = "all" if counts[most] == len(ahead) else str(counts[most])
    which = f", which was {most}" if len(ahead) == 1 else f", {share} of them {most}"
    which = which if 2 * counts[most] > len(ahead) else ""
    arms = [arm for arm in log.arms if any(span.arm == arm for span in ahead)]
    text = f"{len(ahead)} other job{'s' * (len(ahead) > 1)} went first on {names_text(arms)}{which}"
    return f"{text}; at {moment}, still in time, {last.arm} began {last.job}" if in_time else text


def _arm_time(log: ShiftLog, wait: _Wait, end_s: float, halts: Mapping[str, Halt]) -> dict[str, dict[str, float]]:
    """Time of each arm that can do a job, from when it waits for an arm until `end_s`, s, by what the arm did, or by
    what kept it from getting jobs; "": later jobs."""
    able, begin_s = wait.able, wait.begin_s
    slots = int(log.card.get("scenario", {}).get("slots", 0))
    waiting = _most_waiting(log, begin_s, end_s)
    earlier, out, failed = "at work since before its release", "out after a fault", "out after a failure"
    hot, idle = "idle above the warning limit", "idle: the job's place was taken, or the policy let the job wait"
    if 0 < slots < waiting:  # which jobs had the slots is not recorded
        idle = f"{idle}, or it had no slot ({slots} for up to {waiting} waiting jobs)"
    worthless = not wait.begun and wait.end_s - wait.late.due_s >= 60.0 * WORTHLESS_MIN
    if worthless and claims_no_late_jobs(log.policy):
        idle += f"; {log.policy} begins no job that would end {WORTHLESS_MIN:g} min late"
    absent = "absent, or no state was recorded"
    whys = (*halts, "", earlier, out, failed, PAUSED, hot, idle, absent)
    time_s = {why: dict.fromkeys(able, 0.0) for why in whys}
    at_s = log.readings.time_s
    step_s = float(np.median(np.diff(at_s))) if len(at_s) > 1 else 0.0
    for arm in able:
        spans = [(s, earlier if s.start_s < begin_s else "") for s in log.plan.assignments if s.arm == arm]
        spans += [(each, out if each.kind == "fault" else failed) for each in log.plan.outages if each.arm == arm]
        spans += [(each, PAUSED) for each in log.plan.breaks if each.arm == arm]
        kept = [(halt, why) for why, halt in halts.items() if halt.arm in ("", arm)]
        free = (at_s >= begin_s) & (at_s < end_s)
        for span, why in [*kept, *spans]:
            halted_s = 0.0 if why in halts else sum(_common_s(begin_s, end_s, span, halt) for halt, _ in kept)
            time_s[why][arm] += _common_s(begin_s, end_s, span) - halted_s
            free &= (at_s < span.start_s) | (at_s >= span.end_s)
        peak_c = np.fmax.reduce(log.readings.temp_c[free, log.arms.index(arm)], axis=-1, initial=-math.inf)
        gone, warm = log.readings.mode[free, log.arms.index(arm)] < 0, peak_c >= log.limits.warning_c
        for why, such in ((hot, warm), (absent, gone), (idle, ~warm & ~gone)):
            time_s[why][arm] += step_s * float(such.sum())
    return time_s


def _most_waiting(log: ShiftLog, begin_s: float, end_s: float) -> int:
    """Largest number of jobs that waited for nothing but an arm at one time, by their first awards."""
    ends_s = dict[str, float]()
    for event in sorted(log.events, key=lambda event: event.time_s):
        if event.kind in ("award", "expire", "give_up", "cancel"):
            ends_s.setdefault(event.job, event.time_s)
    changes = [(log.ready_s(record), 1) for record in log.jobs if log.ready_s(record) < end_s]
    changes += [(ends_s[record.job], -1) for record in log.jobs if ends_s.get(record.job, math.inf) < end_s]
    count = most = 0
    for time_s, change in sorted(changes):
        count += change
        most = max(most, count) if time_s >= begin_s else count
    return most


def _common_s(begin_s: float, end_s: float, *spans: JobSpan | Outage | Halt) -> float:
    """Time that some spans have in common between two times, s."""
    return max(0.0, min(end_s, *(span.end_s for span in spans)) - max(begin_s, *(span.start_s for span in spans)))
