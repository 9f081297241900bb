"""A shift as it was recorded: readings, events, jobs, the offers behind each award, and the schedule that follows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from itertools import pairwise, zip_longest
from math import inf, isfinite
from typing import Any, Literal  # Any: values of a card

import numpy as np

from fleet.engine.state import DONE, EXPIRED, GIVEN_UP, RUNNING, WAITING, State
from fleet.engine.world import World
from fleet.errors import nearest
from fleet.events import Event
from fleet.observation import Observation
from fleet.robot import ThermalLimits
from fleet.telemetry import Telemetry
from scenarios.spec.calendar import begin_of

Array = np.ndarray

Outcome = Literal["finished", "returned", "given_up", "running"]

_ORDER = (
    "recover", "break_end", "finish", "give_back", "home", "break", "award", "fault", "failure", "return", "give_up",
)  # fmt: skip
"""The event kinds that determine a schedule, in the order in which they can occur at the same time."""

SAME_MOMENT_DIGITS = 6
"""Times are rounded to microseconds: the end of a tick and the start of the next may differ in the last bit."""


@dataclass(frozen=True, kw_only=True)
class JobSpan:
    """One arm on one job, from the award until it is at home or faults."""

    arm: str
    job: str
    start_s: float
    end_s: float
    """Time of arrival at home or of the fault; at most the horizon."""
    finished_s: float | None = None
    """End of the last cycle; None if not reached."""
    outcome: Outcome
    """finished: all cycles done, even if the arm was not at home yet; returned: back in the queue, after a fault,
    by the policy, or because a live arm had to return it;
    given_up: abandoned after too many faults."""
    late_s: float | None = None
    """Tardiness of a finished job; 0 if on time."""
    faulted: bool = True
    """Whether a fault was the reason that the job was returned or abandoned."""
    cycles_kept: int | None = None
    """Cycles of a returned or abandoned job that this arm has done and that count."""
    difficulty: float = float("nan")
    """Of the job for the arm, at the award."""
    prediction: str = ""
    """Predicted peak temperature and P(saturation) at the award, in words."""


@dataclass(frozen=True, kw_only=True)
class Outage:
    """Time of one arm lost to a fault or another failure, or in a break."""

    arm: str
    start_s: float
    end_s: float
    """Time of recovery, or the horizon."""
    kind: Literal["fault", "failure", "break"] = "fault"
    joint: int = 0
    """Motor that caused a fault, 1..7."""
    recovered: bool
    reason: str = ""


@dataclass(frozen=True)
class Schedule:
    """Assignments, outages and breaks up to a horizon, in order of the arms, then of time."""

    assignments: tuple[JobSpan, ...]
    outages: tuple[Outage, ...]
    horizon_s: float
    breaks: tuple[Outage, ...] = ()
    """Each from when the arm is home from the job that it had when the break began."""

    def at(self, arm: str, time_s: float, job: str = "") -> JobSpan | None:
        """The work of an arm at a time; with a job, only that one."""
        own = (span for span in self.assignments if span.arm == arm and job in ("", span.job))
        return next((span for span in own if span.start_s <= time_s <= span.end_s), None)


def schedule(events: Sequence[Event], arms: Sequence[str], horizon_s: float) -> Schedule:
    """Schedule of an event log; the order of events within the log does not matter.

    Args:
        horizon_s: End of the log; open assignments and outages last until then.

    Raises:
        ValueError: an arm that is not in the fleet, or an impossible sequence (an award to a busy arm, an arrival
            home without a finished job).
    """
    own: dict[str, list[Event]] = {arm: [] for arm in arms}
    for event in events:
        if event.kind not in _ORDER or not event.arm:
            continue
        if event.arm not in own:
            raise ValueError(f"No arm '{event.arm}' in this fleet{nearest(event.arm, own)}")
        own[event.arm].append(event)
    assignments: list[JobSpan] = []
    outages: list[Outage] = []
    breaks: list[Outage] = []
    for arm, log in own.items():
        log.sort(key=lambda e: (round(e.time_s, SAME_MOMENT_DIGITS), _ORDER.index(e.kind)))
        work = _assignments(arm, log, horizon_s)
        assignments += work
        outages += _outages(arm, log, horizon_s)
        breaks += _breaks(arm, log, work, horizon_s)
    return Schedule(tuple(assignments), tuple(outages), horizon_s, tuple(breaks))


def _assignments(arm: str, log: Sequence[Event], horizon_s: float) -> list[JobSpan]:
    """Assignments of one arm, from its events in order."""
    out: list[JobSpan] = []
    award: Event | None = None
    finish: Event | None = None
    given_back: Event | None = None
    stopped = False  # by a fault, away from home
    for i, event in enumerate(log):
        if event.kind == "award":
            if award is not None:
                raise ValueError(f"{_at(event)}: '{arm}' is awarded '{event.job}' while at '{award.job}'.")
            award, finish, given_back, stopped = event, None, None, False
        elif event.kind == "finish":
            if award is None or award.job != event.job:
                raise ValueError(f"{_at(event)}: '{arm}' finishes '{event.job}', which it was not awarded.")
            finish = event
        elif event.kind == "give_back" and award is not None and award.job == event.job:
            given_back = event
        elif event.kind == "home" and not stopped and award is not None and given_back is not None:
            out.append(replace(_assignment(award, None, event.time_s, "returned", given_back), faulted=False))
            award = None
        elif event.kind == "home" and not stopped:
            if award is None or finish is None:
                raise ValueError(f"{_at(event)}: '{arm}' is home from '{event.job}', which it did not finish.")
            out.append(_assignment(award, finish, event.time_s, "finished"))
            award = None
        elif event.kind in ("fault", "failure") and award is not None:
            ends = (e for e in log[i + 1 :] if e.kind in ("return", "give_up") and e.job == award.job)
            after = given_back or next(ends, None)
            outcome = "given_up" if after and after.kind == "give_up" else "returned"
            stretch = _assignment(award, finish, event.time_s, outcome, after)
            out.append(replace(stretch, faulted=event.kind == "fault"))
            award, stopped = None, True
        elif (
            event.kind == "return" and award is not None and award.job == event.job
        ):  # in a live fleet, without a fault
            out.append(replace(_assignment(award, finish, event.time_s, "returned", event), faulted=False))
            award = None
    if award is not None:
        out.append(_assignment(award, finish, max(horizon_s, award.time_s), "running"))
    return out


def _assignment(
    award: Event, finish: Event | None, end_s: float, outcome: Outcome, returned: Event | None = None
) -> JobSpan:
    return JobSpan(
        arm=award.arm,
        job=award.job,
        start_s=award.time_s,
        end_s=end_s,
        finished_s=finish.time_s if finish else None,
        outcome="finished" if finish else outcome,
        late_s=finish.value if finish else None,
        cycles_kept=round(returned.value) if returned and not finish and isfinite(returned.value) else None,
        difficulty=award.value,
        prediction=award.reason,
    )


def _outages(arm: str, log: Sequence[Event], horizon_s: float) -> list[Outage]:
    """Outages of one arm, from its events in order."""
    changes = [event for event in log if event.kind in ("fault", "failure", "recover")]
    for i, event in enumerate(changes):
        if event.kind != "recover" and i % 2:
            raise ValueError(f"{_at(event)}: '{arm}' faults while it is faulted.")
        if event.kind == "recover" and not i % 2:
            raise ValueError(f"{_at(event)}: '{arm}' recovers without a fault.")
    return [
        Outage(
            arm=arm,
            start_s=fault.time_s,
            end_s=recovery.time_s if recovery else max(horizon_s, fault.time_s),
            kind="fault" if fault.kind == "fault" else "failure",
            joint=fault.joint,
            recovered=recovery is not None,
            reason=fault.reason,
        )
        for fault, recovery in zip_longest(changes[::2], changes[1::2])
    ]


def _breaks(arm: str, log: Sequence[Event], work: Sequence[JobSpan], horizon_s: float) -> list[Outage]:
    """Breaks of one arm, from its events in order; the log of one that began before may lack its begin.

    The end of a break may be missing, too, if the arm failed meanwhile; it has the planned one then. A break in which
    the arm is at work throughout is left out.
    """
    begins = [(event.time_s, event.time_s + event.value) for event in log if event.kind == "break"]
    ends = [event.time_s for event in log if event.kind == "break_end"]
    if ends and (not begins or ends[0] < begins[0][0]):
        begins.insert(0, (0.0, ends[0]))
    out: list[Outage] = []
    for (begin_s, planned_s), (following_s, _) in pairwise([*begins, (inf, inf)]):
        planned_s = planned_s if isfinite(planned_s) else horizon_s
        # Breaks that adjoin or overlap have one begin and one end.
        end_s = min((each for each in ends if begin_s < each <= following_s), default=max(begin_s, planned_s))
        over, end_s = end_s <= horizon_s, min(end_s, horizon_s)
        free_s = max((span.end_s for span in work if span.start_s < begin_s), default=0.0)
        if free_s < end_s:
            out.append(Outage(arm=arm, start_s=max(begin_s, free_s), end_s=end_s, kind="break", recovered=over))
    return out


def _at(event: Event) -> str:
    return f"Event log at {event.time_s:g} s"


JOB_STATES = {WAITING: "waiting", RUNNING: "running", DONE: "finished", GIVEN_UP: "given_up", EXPIRED: "expired"}


@dataclass(frozen=True, kw_only=True)
class JobRecord:
    """One job of a shift, as at its end."""

    job: str
    state: str
    """One of `JOB_STATES`; in a recording also another state of `fleet.bus.protocol.auction.JobState`."""
    release_s: float
    """NaN if it was not recorded."""
    due_s: float
    """Infinite without a due date, NaN if it was not recorded."""
    finished_s: float | None
    """None if it was not finished."""
    value: float
    """NaN if it was not recorded."""
    payload_kg: float
    cycles: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Offer:
    """What one arm knew of a job at the moment it was awarded."""

    time_s: float
    job: str
    arm: str
    awarded: bool
    state: str
    """idle, working or faulted."""
    feasible: bool
    """Whether the arm has a plan for it."""
    free: bool
    """Whether it was allowed to claim it then."""
    difficulty: float | None
    """d of the plan that was awarded, of other arms the least of their plans; None if unknown."""
    peak_c: float | None
    """Predicted peak of that plan; None if unknown."""
    p_saturation: float | None
    """P(saturation) of that plan; None without a plan."""
    duration_s: float | None
    """Time for the rest of the job by that plan; None without a plan."""
    plan: int | None = None
    """Number of that plan: 0 is the fastest, 1 the coolest; None without a plan, and in runs of earlier versions."""


@dataclass(frozen=True, kw_only=True)
class Notice:
    """In a live fleet: an alarm began, was acknowledged or ended, or a person requested something."""

    time_s: float
    kind: str
    """alarm, alarm_acknowledged or alarm_ended; of a request its action, such as pause."""
    arm: str
    """"" for none, as the job."""
    job: str
    reason: str
    """What is wrong, or who requested it."""


@dataclass(frozen=True, kw_only=True)
class Halt:
    """Time in which an arm of a live fleet got no job whatever it did."""

    arm: str
    """"" for all arms."""
    start_s: float
    end_s: float
    """Infinite if it lasted to the end."""
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class ShiftLog:
    """A shift of a simulated or of a live fleet, as its readers need it."""

    card: Mapping[str, Any]
    """Settings and figures: of a run, the content of run.json; of a recording, those that are known."""
    arms: tuple[str, ...]
    """Names of the arms."""
    limits: ThermalLimits
    readings: Telemetry
    """Sensor readings as arrays, arms in the order of `arms`; without samples if recording was off or the shift ended
    before its first step."""
    events: tuple[Event, ...]
    jobs: tuple[JobRecord, ...] = ()
    offers: tuple[Offer, ...] = ()
    """Offers of all arms at every award."""
    notices: tuple[Notice, ...] = ()
    halts: tuple[Halt, ...] = ()
    ended_s: float = inf
    """End of the shift, if it was before the last reading."""
    remarks: tuple[str, ...] = ()
    """What its records leave out, in sentences."""
    unknown: str = ""
    """What its jobs may lack, for the badge; "" if they are complete."""

    @cached_property
    def begin(self) -> datetime | None:
        """Date of the begin, in the zone of its times of day; None if it is unknown."""
        scenario = self.card.get("scenario", {})
        text = scenario.get("shift_begin")
        return None if text is None else begin_of(text, scenario.get("time_zone"))

    @property
    def policy(self) -> str:
        """Name of its policy."""
        return str(self.card.get("policy", "unknown policy"))

    @property
    def faults(self) -> list[Event]:
        """In order of time."""
        return sorted((event for event in self.events if event.kind == "fault"), key=lambda event: event.time_s)

    @cached_property
    def plan(self) -> Schedule:
        """Which arm worked on what, until the last reading or event.

        Raises:
            ValueError: as `schedule`.
        """
        ends_s = [float(self.readings.time_s[-1])] if len(self.readings.time_s) else []
        if not ends_s and "time_s" in self.card:
            ends_s.append(float(self.card["time_s"]))
        ends_s += [event.time_s for event in self.events]
        horizon_s = float(self.card.get("scenario", {}).get("horizon_s", 0.0))
        return schedule(self.events, self.arms, max(ends_s, default=horizon_s))

    @cached_property
    def records(self) -> Mapping[str, JobRecord]:
        """Jobs by name."""
        return {record.job: record for record in self.jobs}

    @cached_property
    def streams(self) -> Mapping[str, Mapping[str, Any]]:
        """Streams of the scenario by name; those that were recorded."""
        return {stream["name"]: stream for stream in self.card.get("scenario", {}).get("jobs", ())}

    def stream(self, job: str) -> Mapping[str, Any]:
        """The stream of a job; empty if it is not recorded."""
        return self.streams.get(job) or self.streams.get(job.rpartition("-")[0]) or {}

    def work(self, job: str) -> tuple[Any, ...] | None:
        """What an arm does in a cycle of a job: kind, places, payload, duration and force; None if it is not recorded.

        A common start of two names is no evidence: rows of a job table and submitted jobs may have any name.
        """
        stream, record = self.stream(job), self.records.get(job)
        if not stream or record is None:
            return None
        cycle = (_hashable(stream.get(name)) for name in ("kind", "places", "dwell_s", "force_n"))
        return *cycle, record.payload_kg

    @cached_property
    def _arms_by_job(self) -> Mapping[str, frozenset[str]]:
        """Of each job with an offer or an award the arms that can do it."""
        able = {offer.job: set[str]() for offer in self.offers}
        for offer in self.offers:
            able[offer.job] |= {offer.arm} if offer.feasible else set()
        for span in self.plan.assignments:
            able.setdefault(span.job, set()).add(span.arm)
        return {job: frozenset(arms) for job, arms in able.items()}

    @cached_property
    def _arms_by_work(self) -> Mapping[tuple[Any, ...], set[str]]:
        """Of each recorded work the arms that can do a job with it."""
        able = dict[tuple[Any, ...], set[str]]()
        for job, arms in self._arms_by_job.items():
            if (work := self.work(job)) is not None:
                able.setdefault(work, set()).update(arms)
        return able

    def able_arms(self, job: str) -> list[str] | None:
        """Arms that can do a job, by its own offers and awards, else by those of jobs with the same recorded work.

        None if nothing of that is recorded.
        """
        able = self._arms_by_job.get(job)
        if able is None and (work := self.work(job)) is not None:
            able = self._arms_by_work.get(work)
        return None if able is None else [arm for arm in self.arms if arm in able]

    @cached_property
    def jobs_before(self) -> Mapping[str, list[JobRecord]]:
        """Of each job that waits for others these others."""
        every = dict[str, list[JobRecord]]()
        for job in self.jobs:
            after = self.stream(job.job).get("after", ())
            if job.job not in self.streams:  # a row of a table has the name of its stream
                number = job.job.rpartition("-")[2]
                after = [name for each in after for name in (each, f"{each}-{number}")]
            before = [self.records[name] for name in after if name in self.records]
            if before:
                every[job.job] = before
        return every

    @cached_property
    def last_before(self) -> Mapping[str, tuple[JobRecord, float]]:
        """Of each job that waits for others the one that finishes last, and its finish, s: infinite if unfinished."""
        last = dict[str, tuple[JobRecord, float]]()
        for job, before in self.jobs_before.items():
            ends_s = [inf if each.finished_s is None else each.finished_s for each in before]
            last[job] = max(zip(before, ends_s, strict=True), key=lambda each: each[1])
        return last

    def ready_s(self, job: JobRecord) -> float:
        """Time from which a job waits for nothing but an arm; infinite if a job before it is unfinished."""
        _, finished_s = self.last_before.get(job.job, (job, -inf))
        return max(job.release_s, finished_s)

    @cached_property
    def known_offers(self) -> tuple[Offer, ...]:
        """`offers`, with the state `break` or `paused` of an idle arm that had a break, or that people had paused."""
        spans = [*((each, "break") for each in self.plan.breaks), *((each, "paused") for each in self.halts)]

        def known(offer: Offer) -> Offer:
            if offer.free or offer.state != "idle":
                return offer
            whys = (why for span, why in spans if span.arm == offer.arm and span.start_s <= offer.time_s < span.end_s)
            return replace(offer, state=next(whys, offer.state))

        return tuple(map(known, self.offers))

    def offers_behind(self, job: str, arm: str, time_s: float) -> tuple[Offer, ...]:
        """Offers of all arms at the award of a job to an arm; in a recording its time is that of another clock, so the
        award nearest the time is meant."""
        times_s = [each.time_s for each in self.known_offers if each.awarded and (each.job, each.arm) == (job, arm)]
        award_s = min(times_s, key=lambda each: abs(each - time_s), default=None)
        return tuple(each for each in self.known_offers if (each.job, each.time_s) == (job, award_s))

    @cached_property
    def load_kg(self) -> Array:
        """Payload in each hand, kg, [sample, arm]."""
        payload_of = {job.job: job.payload_kg for job in self.jobs}
        load_kg, time_s = np.zeros(self.readings.mode.shape, np.float32), self.readings.time_s
        for work in self.plan.assignments:
            rows = slice(*np.searchsorted(time_s, (work.start_s, work.finished_s or work.end_s)))
            load_kg[rows, self.arms.index(work.arm)] = payload_of.get(work.job, 0.0)
        return load_kg


def _hashable(value: Any) -> Any:
    """A value of a scenario's file, with its lists as tuples."""
    return tuple(map(_hashable, value)) if isinstance(value, list | tuple) else value


def job_records(world: World, state: State) -> tuple[JobRecord, ...]:
    """The jobs of env 0 in the order of the shift."""
    shift = world.shifts[0]
    return tuple(
        JobRecord(
            job=name,
            state=JOB_STATES[int(state.status[0, j])],
            release_s=float(shift.release_s[j]),
            due_s=float(shift.due_s[j]),
            finished_s=float(state.finished_s[0, j]) if state.status[0, j] == DONE else None,
            value=world.kinds[shift.kind[j]].value,
            payload_kg=world.kinds[shift.kind[j]].work.payload_kg,
            cycles=int(shift.repetitions[j]),
        )
        for j, name in enumerate(shift.names)
    )


def offers_of(event: Event, seen: Mapping[str, Observation], actions: Mapping[str, int], plans: int) -> Iterator[Offer]:
    """What each arm knew of the job of an award.

    Args:
        seen: Observation of each arm at the decision.
        actions: Of each arm at the decision.
        plans: Plans per slot.
    """
    chosen = actions[event.arm] - 1
    slot = range(chosen // plans * plans, (chosen // plans + 1) * plans)
    for arm, own in seen.items():
        able = [option for option in slot if own.feasible[option]]
        known = [option for option in able if own.known[option]]
        best = chosen if arm == event.arm else min(known or able, key=lambda o: own.difficulty[o], default=-1)
        peak_c = float(own.peak_c[best])
        predicted = best in known or (bool(able) and peak_c > 0.0)  # a P that is unknown is 0.5
        yield Offer(
            time_s=event.time_s,
            job=event.job,
            arm=arm,
            awarded=arm == event.arm,
            state="faulted" if own.faulted else "working" if own.working else "idle",
            feasible=bool(able),
            free=bool(any(own.action_mask[1 + option] for option in slot)),
            difficulty=float(own.difficulty[best]) if best in known else None,
            peak_c=peak_c if able and peak_c else None,
            p_saturation=float(own.p_saturation[best]) if predicted else None,
            duration_s=float(own.duration_s[best]) if able else None,
            plan=best % plans if able else None,
        )
