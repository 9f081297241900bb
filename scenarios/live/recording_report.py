"""A live recording as the log of a shift, from what was recorded of arms and auctioneer, and its report.

A live log has what a simulated one has not: awards that queue, jobs that are returned without a fault, arms that crash
and messages that are lost. `order_events` turns it into a sequence that a schedule can have.
"""

import json
import math
from collections import Counter, defaultdict, deque
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median_low
from typing import Any  # values of a card

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet.arm.cell import cell_model
from fleet.bus.protocol.auction import ArmOffer, PlanQuote
from fleet.bus.protocol.cell import Cell
from fleet.bus.protocol.operator import ALL_ARMS, Alarm, by_whom
from fleet.errors import FleetError
from fleet.events import EVENT_KINDS, Event
from fleet.heat.effects import arrhenius_rate, life_used, most_drift_m, segment_temperatures
from fleet.live.job_rules import EXPIRED
from fleet.readings import BAD_SENSOR, TemperatureFilter, all_possible
from fleet.robot import JOINTS, ThermalLimits
from fleet.telemetry import FAULTED, MODES, WORKING, Telemetry
from scenarios.live.cell import described_model
from scenarios.live.recording import Kind, SenderCount, alarms_of, lost_rows, read_card, read_parts
from scenarios.run.log import UNITS, joint_values
from scenarios.run.records import SAME_MOMENT_DIGITS, Halt, JobRecord, Notice, Offer, ShiftLog
from scenarios.show.run_page import report_html
from scenarios.show.words import clock, names_text
from scenarios.spec.schema import Scenario

MOST_SAMPLES = 20_000
"""Samples of telemetry in a report, in time."""
ABSENT_SAMPLES = 30
"""Without a state for this many typical intervals, an arm has no temperature in the report."""
AHEAD_S = 60.0
"""Fleet seconds after the end of the fleet, from which on a state without an epoch is of a wrong clock."""
TELEMETRY = "telemetry of "
"""Before the name of an arm, its states in the card."""
RESTARTED, ABSENT = "the arm was restarted", "no later state of the arm is recorded"
UNKNOWN_RETURN = "the reason is not recorded"
"""Why an arm has a job no more."""
NO_STATES = (
    "No auctioneer published the states of jobs: those that no arm began are missing here, and so are outcomes and due "
    "dates that no arm reported."
)
_ENDED = ("waiting", "given_up", "unfinished", "cancelled")
"""States of a job in which the arm that had it has it no more."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordingLog(ShiftLog):
    """A live recording as the log of a shift: its last epoch."""

    model: Mapping[str, Any] | None
    """`fleet.arm.cell.cell_model`; None if the cell is not known."""

    def page(self) -> str:
        """The report as one HTML page."""
        return report_html(self, self.model)


def open_recording(folder: Path, scenario: Scenario | None = None) -> RecordingLog:
    """Read a recording, which may still grow.

    Args:
        scenario: Gives the limits and the cell of the fleet; by default they are those that the recording has from
            the auctioneer. With neither, there is no model of the cell.

    Raises:
        FleetError: it is no recording, has no states of arms yet, or has arms that the scenario does not have.
    """
    card = read_card(folder)
    epochs = epochs_of(card.senders)
    kinds: tuple[Kind, ...] = ("telemetry", "events", "results", "operations")
    table, log, results, operations = (_of_epoch(read_parts(folder, kind), epochs) for kind in kinds)
    end_s, ahead = _end_s(table, results, operations), pc.field("epoch") == ""
    ahead &= pc.field("time_s") > end_s + AHEAD_S
    wrong = names_text(sorted(set(table.filter(ahead)["arm"].to_pylist())))
    table, log = (each.filter(~ahead) for each in (table, log))
    arms = tuple(sorted(set(table["arm"].to_pylist())))
    if not arms:
        which = f" of the epoch {epochs[-1]}" if epochs else ""
        raise FleetError(f"'{folder}' holds no state of an arm{which} yet; record longer.")
    limits, model = _cell(scenario, card.cell, arms)
    table, bad = without_bad_sensors(table, arms)
    alarms = alarms_of(folder) if len(epochs) < 2 else []  # they name no epoch
    if len(epochs) > 1:
        operations = operations.filter(pc.field("epoch") != "")
    reported, telemetry, pauses = arm_events(log), telemetry_of(table, arms), tuple(_pauses(operations))
    work = [] if results.num_rows else work_in_states(table, _absent_s(telemetry))
    unreported = unreported_work(results, reported)
    returned = (*_returns(results), *returns_in_states(work, reported, pauses, operations))
    ordered = order_events((*reported, *unreported), returned)
    published = tuple(job_records(results))
    ended = {job.job for job in published} | {event.job for event in reported if event.kind == "finish"}
    jobs = (*published, *steered_jobs(operations, ended))
    # As last changed; an arm knows the date of its award.
    due_s = changed_due_s(operations) | {job.job: job.due_s for job in published}
    events = tuple(
        replace(event, value=max(0.0, event.time_s - due_s[event.job]))
        if event.kind == "finish" and event.job in due_s
        else event
        for event in ordered
        if event.arm in arms
    )
    begun = {event.job for event in events if event.kind == "finish"}
    finished = [job.job for job in jobs if job.state == "finished"]
    unknown = sum(job not in begun for job in finished)
    shown = {
        "status": "running" if card.status == "recording" else card.status,
        "scenario": {"name": card.fleet},
        "policy": "live recording",
        "metrics": _metrics(telemetry, events, jobs, arms, limits.warning_c, states_published=results.num_rows > 0)
        | heat_use(table, arms),
        "messages": {
            sender: f"{count.kept} recorded, {count.missed} missing" for sender, count in sorted(card.senders.items())
        },
        "missing": _missing(read_parts(folder, "gaps"), lost_rows(folder)),
        "jobs submitted by": _submitters(results),
    }
    return RecordingLog(
        card=shown,
        arms=arms,
        limits=limits,
        readings=telemetry,
        events=events,
        jobs=jobs,
        notices=(*map(_request_notice, operations.to_pylist()), *_alarm_notices(alarms, arms, jobs)),
        halts=(*_silences(alarms, results["time_s"].to_pylist(), arms), *pauses),
        ended_s=min((row["time_s"] for row in results.to_pylist() if row["shift_ended"]), default=math.inf),
        offers=tuple(offer for row in results.to_pylist() for offer in offers_of(row)),
        remarks=(
            *_left_out(epochs, card.senders),
            *([f"The clock of {wrong} was ahead: what has a time after {clock(end_s)} is left out."] if wrong else []),
            *([] if results.num_rows else [NO_STATES]),
            *bad,
            *(
                [f"No begin is recorded of {unknown} of {len(finished)} finished jobs: they are in no arm's work."]
                if unknown
                else []
            ),
        ),
        unknown="" if results.num_rows else "unknown: jobs that no arm finished",
        model=model,
    )


def epochs_of(senders: Mapping[str, SenderCount]) -> tuple[str, ...]:
    """Epochs of the fleet in the order in which they began, as those who allocate jobs published them.

    Without an auctioneer they are those of most arms; so is one in which an auctioneer has published nothing yet. One
    arm alone may publish a wrong one.
    """
    central = [count for name, count in senders.items() if name.startswith(("results of ", "operations of "))]
    allocated = tuple(dict.fromkeys(epoch for count in central for epoch in count.epochs))
    own = [count.epochs for name, count in senders.items() if name.startswith(TELEMETRY) and count.epochs]
    if not own:
        return allocated
    arms, last = Counter(epoch for epochs in own for epoch in epochs), Counter(epochs[-1] for epochs in own)
    newest = max(last, key=lambda epoch: (last[epoch], arms[epoch]))
    if not allocated:
        return (*(epoch for epoch, count in arms.items() if epoch != newest and 2 * count > len(own)), newest)
    begun = newest not in allocated and last[newest] > max(1.0, len(own) / 2)
    return (*allocated, newest) if begun else allocated


def _left_out(epochs: Sequence[str], senders: Mapping[str, SenderCount]) -> Iterator[str]:
    """What the report leaves out, in sentences."""
    if len(epochs) > 1:
        which = f"{len(epochs)} epochs are recorded; this page shows the last one, {epochs[-1]}"
        yield f"{which}, without alarms and requests that name no epoch."
    others = {
        name.removeprefix(TELEMETRY): other
        for name, count in sorted(senders.items())
        if name.startswith(TELEMETRY) and (other := [epoch for epoch in count.epochs if epoch not in epochs])
    }
    if others:
        names = names_text([*dict.fromkeys(epoch for other in others.values() for epoch in other)])
        yield f"{names_text([*others])} published states of another epoch, {names}: this page leaves them out."


def _end_s(table: pa.Table, *others: pa.Table) -> float:
    """Latest fleet time by messages that name an epoch, and by half of the arms; infinite if none does."""
    named_s = [each.filter(pc.field("epoch") != "")["time_s"].to_numpy() for each in (table, *others)]
    if not (ends_s := [float(times_s.max()) for times_s in named_s if len(times_s)]):
        return math.inf
    last_s = table.group_by("arm").aggregate([("time_s", "max")])["time_s_max"].to_pylist()
    return max([*ends_s, *([median_low(last_s)] if last_s else [])])


def _cell(
    scenario: Scenario | None, described: Cell | None, arms: Sequence[str]
) -> tuple[ThermalLimits, dict[str, Any] | None]:
    """Limits of the motors, and the cell in three dimensions."""
    if scenario is not None:
        robots = {arm.name: arm.robot() for arm in scenario.arms}
        if missing := [arm for arm in arms if arm not in robots]:
            raise FleetError(
                f"The recording has the arm '{missing[0]}', and scenario '{scenario.name}' has only "
                f"{', '.join(robots)}; give the scenario that the fleet was started with."
            )
        return scenario.limits, cell_model([robots[arm] for arm in arms], scenario.places, scenario.fixtures)
    limits, model = ThermalLimits(), None
    if described is not None:
        with suppress(ValueError):  # of numbers that no cell has, or of arms that joined later
            restart_c = min(limits.restart_c, described.warning_c - 1.0)
            limits = ThermalLimits(warning_c=described.warning_c, error_c=described.error_c, restart_c=restart_c)
            model = described_model(described, arms)
    return limits, model


def order_events(events: Iterable[Event], returns: Iterable[Event]) -> list[Event]:
    """Events of arms that contradict each other nowhere, by arm and time.

    An award to a busy arm begins when the arm is free. A job that the arm neither finished nor lost by a fault ends
    with a `return`: a recorded one, or at the award of the job that the arm finished next.

    Args:
        events: As the arms reported them, in any order; some may be missing.
        returns: A `return` for every job that an arm had and has no more, as far as it is recorded.
    """
    own: dict[str, list[Event]] = defaultdict(list)
    for event in (*events, *returns):
        own[event.arm].append(event)
    return [event for arm in sorted(own) for event in _order_of_arm(own[arm])]


_ORDER = {kind: place for place, kind in enumerate(("recover", "finish", "home", "award", "fault", "return"))}


def _order_of_arm(log: list[Event]) -> list[Event]:
    out: list[Event] = []
    job, finished, faulted = "", False, False
    queue: deque[Event] = deque()
    last = (-math.inf, 0)

    def emit(event: Event) -> None:
        """Append an event; in its turn, should it be of the same moment as the one before."""
        nonlocal last
        time_s, place = round(event.time_s, SAME_MOMENT_DIGITS), _ORDER[event.kind]
        if (time_s, place) < last:
            time_s = last[0] + 2 * 10**-SAME_MOMENT_DIGITS
            event = replace(event, time_s=time_s)
        last = (time_s, place)
        out.append(event)

    def begin(time_s: float) -> None:
        nonlocal job, finished
        job, finished = "", False
        if queue:
            award = queue.popleft()
            emit(replace(award, time_s=max(time_s, award.time_s)))
            job = award.job

    def end(event: Event) -> None:
        """End the current job without a fault."""
        kind = "home" if finished else "return"
        emit(replace(event, kind=kind, job=job))
        begin(event.time_s)

    for event in sorted(log, key=lambda e: (round(e.time_s, SAME_MOMENT_DIGITS), _ORDER.get(e.kind, len(_ORDER)))):
        waiting = {award.job for award in queue}
        match event.kind:
            case "award":
                if event.job not in waiting and (event.job != job or finished):
                    queue.append(event)
                    if not job and not faulted:
                        begin(event.time_s)
            case "finish":
                while event.job != job and event.job in waiting and job:
                    end(replace(event, time_s=queue[0].time_s, value=math.nan, reason=UNKNOWN_RETURN))
                if event.job == job and not finished:
                    emit(event)
                    finished = True
            case "home":
                if finished and not faulted:
                    end(event)
            case "fault" if not faulted:
                emit(event)
                job, finished, faulted = "", False, True
                queue.clear()
            case "recover" if faulted:
                emit(event)
                faulted = False
                begin(event.time_s)
            case "return":
                if event.job == job and not finished:
                    end(event)
                elif event.job in waiting:
                    queue = deque(award for award in queue if award.job != event.job)
                elif faulted:
                    emit(event)
            case "fault" | "recover":
                pass
            case _:
                out.append(event)
    return out


def arm_events(table: pa.Table) -> list[Event]:
    """Events as the arms reported them, in the order of their rows."""
    rows = (row for row in table.to_pylist() if row["kind"] in EVENT_KINDS)
    names = ("time_s", "kind", "arm", "job", "joint", "reason")
    return [
        Event(**{name: row[name] for name in names}, value=float("nan") if row["value"] is None else row["value"])
        for row in rows
    ]


def job_records(results: pa.Table) -> Iterator[JobRecord]:
    """Jobs as at the end of a recording, in order of their first result; payloads are not recorded and count as 0."""
    last: dict[str, dict[str, Any]] = {}
    for row in results.to_pylist():
        if row["job"] not in last or last[row["job"]]["state"] != "finished":  # final; what was reported late came late
            last[row["job"]] = row
    for job, row in last.items():
        release_s = row["release_s"] or row["accepted_s"]  # 0: as soon as it is accepted
        yield JobRecord(
            job=job,
            state="expired" if row["reason"] == EXPIRED else row["state"],
            release_s=math.nan if release_s is None else release_s,
            due_s=math.inf if row["due_s"] is None else row["due_s"],
            finished_s=row["finished_s"],
            value=math.nan if row["value"] is None else row["value"],
            payload_kg=0.0,
            cycles=row["repetitions"],
        )


def unreported_work(results: pa.Table, reported: Iterable[Event]) -> list[Event]:
    """Awards and ends of jobs by their published states, of which the arm reported none: some publish no events.

    An arm without any event counts as home at the end of each job.
    """
    there = {(event.kind, event.arm, event.job) for event in reported}
    heard, out = {arm for _, arm, _ in there}, list[Event]()
    for row in results.to_pylist():
        arm, job, state, ended_s = row["arm"], row["job"], row["state"], row["finished_s"]
        if state == "awarded" and ("award", arm, job) not in there:
            out.append(Event(time_s=row["time_s"], kind="award", arm=arm, job=job))
        elif state == "finished" and arm and ended_s is not None and ("finish", arm, job) not in there:
            there.add(("finish", arm, job))
            late_s = 0.0 if row["due_s"] is None else max(0.0, ended_s - row["due_s"])
            out.append(Event(time_s=ended_s, kind="finish", arm=arm, job=job, value=late_s))
            out += [] if arm in heard else [Event(time_s=ended_s, kind="home", arm=arm, job=job)]
    return out


def without_bad_sensors(table: pa.Table, arms: Sequence[str]) -> tuple[pa.Table, list[str]]:
    """Return states without impossible temperatures, and a sentence on those that are left out, if there are any.

    They are judged as in a live fleet.
    """
    names, all_s = np.array(table["arm"].to_pylist()), table["time_s"].to_numpy()
    temp_c, wrong = joint_values(table, "temp_c"), dict[str, str]()
    for arm in arms:
        rows = np.flatnonzero(names == arm)
        joints = np.flatnonzero(np.isfinite(temp_c[rows]).any(axis=0))
        rows = rows[np.isfinite(temp_c[np.ix_(rows, joints)]).all(axis=1)]
        if not len(joints) or all_possible(all_s[rows], temp_c[np.ix_(rows, joints)]):
            continue
        sensors = TemperatureFilter()
        for row in rows:
            sensors.update(float(all_s[row]), {int(joint): float(temp_c[row, joint]) for joint in joints})
            temp_c[row, list(sensors.bad)] = np.nan
            if sensors.bad:
                wrong.setdefault(arm, sensors.bad[min(sensors.bad)])
    if not wrong:
        return table, []
    for j in range(JOINTS):
        name = f"temp_c_{j + 1}"
        values = pa.array(temp_c[:, j], table.schema.field(name).type, from_pandas=True)
        table = table.set_column(table.schema.get_field_index(name), name, values)
    first = next(iter(wrong))
    which = f"{first}, {wrong[first]}" if len(wrong) > 1 else wrong[first]
    return table, [f"Impossible temperatures of {names_text([*wrong])} are left out ({which}): {BAD_SENSOR}."]


def _returns(results: pa.Table) -> list[Event]:
    """A `return` for each job that an arm had and has no more, though it did not finish it."""
    out: list[Event] = []
    holder: dict[str, str] = {}
    for row in results.to_pylist():
        if row["shift_ended"]:
            continue
        if row["state"] in _ENDED and (arm := holder.pop(row["job"], "")):
            reason = row["reason"] or "the arm returned the job, or lost its lease"
            out.append(
                Event(time_s=row["time_s"], kind="return", arm=arm, job=row["job"], value=row["cycles"], reason=reason)
            )
        elif row["state"] == "awarded":
            holder[row["job"]] = row["arm"]
        elif row["state"] == "finished":
            holder.pop(row["job"], None)
    return out


@dataclass(frozen=True)
class Work:
    """A job of an arm by its states: from the first one that names the job to the last one in a row."""

    arm: str
    job: str
    begin_s: float
    last_s: float
    end_s: float
    """Time of the next state, or of the last one of an absent arm."""
    lost: str
    """Why the arm lost it: it was restarted, or is absent; "" if it had it to the end."""


def _absent_s(telemetry: Telemetry) -> float:
    """Time after which an arm without a state is absent at the end."""
    step_s = telemetry.time_s[1] - telemetry.time_s[0] if len(telemetry.time_s) > 1 else 0.0
    return float(telemetry.time_s[-1] - ABSENT_SAMPLES * step_s)


def work_in_states(table: pa.Table, absent_s: float) -> list[Work]:
    """The jobs of the arms by their states, without those that they still have, in order of arm and time.

    Args:
        absent_s: An arm without a state after this time is absent.
    """
    states: dict[str, list[tuple[float, int, str]]] = defaultdict(list)
    columns = (table[name].to_pylist() for name in ("arm", "time_s", "tick", "job"))
    for arm, time_s, tick, job in zip(*columns, strict=True):
        states[arm].append((time_s, tick, job))
    out: list[Work] = []
    for arm, own in sorted(states.items()):
        begin_s = own[0][0]
        for (time_s, tick, job), (next_s, next_tick, next_job) in pairwise(own):
            lost = RESTARTED if next_tick <= tick else ""
            if next_job != job or lost:
                out += [Work(arm, job, begin_s, time_s, next_s, lost)] if job else []
                begin_s = next_s
        last_s, _, job = own[-1]
        if job and last_s < absent_s:
            out.append(Work(arm, job, begin_s, last_s, last_s, ABSENT))
    return out


def returns_in_states(
    work: Iterable[Work], events: Iterable[Event], pauses: Sequence[Halt], operations: pa.Table
) -> list[Event]:
    """A `return` for each job that an arm had by its states and has no more, though it reported no end of it.

    Without an auctioneer nobody publishes why an arm returns a job. The reason is what was recorded: a restart,
    a request of a person, or a break.

    Args:
        pauses: Of arms, by people.
    """
    ends_s: dict[tuple[str, str], list[float]] = defaultdict(list)
    breaks: dict[str, list[Event]] = defaultdict(list)
    for event in events:
        if event.kind in ("finish", "fault", "return"):
            ends_s[event.arm, event.job].append(event.time_s)
        elif event.kind in ("break", "break_end"):
            breaks[event.arm].append(event)
    requests = operations.to_pylist()
    out: list[Event] = []
    for each in work:
        if not any(each.begin_s <= time_s <= each.end_s for time_s in ends_s[each.arm, each.job]):
            time_s = each.last_s if each.lost else each.end_s
            reason = each.lost or _reason_to_return(each, breaks[each.arm], pauses, requests)
            out.append(Event(time_s=time_s, kind="return", arm=each.arm, job=each.job, reason=reason))
    return out


def _reason_to_return(
    work: Work, breaks: Iterable[Event], pauses: Iterable[Halt], requests: Iterable[Mapping[str, Any]]
) -> str:
    """Why an arm returned a job, as far as it was recorded.

    Args:
        breaks: Begins and ends of the breaks of the arm.
    """
    for row in requests:
        if row["note"] or not work.begin_s <= row["time_s"] <= work.end_s:
            continue
        if row["action"] == "cancel" and row["job"] == work.job:
            return f"it was cancelled{by_whom(row['by'])}"
        if row["action"] == "clear" and row["arm"] == work.arm:
            return f"the space of {work.arm} was cleared{by_whom(row['by'])}"
    for pause in pauses:
        if pause.arm in ("", work.arm) and pause.start_s <= work.end_s and pause.end_s > work.begin_s:
            return pause.reason
    last = max((each for each in breaks if each.time_s <= work.end_s), key=lambda each: each.time_s, default=None)
    return UNKNOWN_RETURN if last is None or last.kind == "break_end" else f"a break, '{last.reason}'"


def steered_jobs(operations: pa.Table, known: Container[str]) -> Iterator[JobRecord]:
    """Jobs that people cancelled or settled, where no auctioneer publishes the states of jobs.

    Args:
        known: Jobs whose states or ends were published.
    """
    ends: dict[str, tuple[str, float | None]] = {}
    for row in operations.to_pylist():
        job, outcome = row["job"], json.loads(row["content"])["action"].get("outcome")
        if row["note"] or job in known:
            continue
        if row["action"] == "cancel":
            ends[job] = "cancelled", None
        elif outcome == "done":
            ends[job] = "finished", row["time_s"]
        elif outcome == "redo":
            ends[job] = "waiting", None
    for job, (state, finished_s) in ends.items():
        yield JobRecord(
            job=job,
            state=state,
            release_s=math.nan,
            due_s=math.nan,
            finished_s=finished_s,
            value=math.nan,
            payload_kg=0.0,
            cycles=0,
        )


def changed_due_s(operations: pa.Table) -> dict[str, float]:
    """Due dates that people have set, by job; infinite for none."""
    due_s: dict[str, float] = {}
    for row in operations.to_pylist():
        action = json.loads(row["content"])["action"]
        if "due_s" in action and not row["note"]:
            due_s[row["job"]] = math.inf if action["due_s"] is None else action["due_s"]
    return due_s


def telemetry_of(table: pa.Table, arms: Sequence[str]) -> Telemetry:
    """Telemetry of a recording on common times: at each, the last reading of every arm, or NaN if it was absent."""
    all_s = table["time_s"].to_numpy()
    names = np.array(table["arm"].to_pylist())
    own_s = [all_s[names == arm] for arm in arms]
    steps = np.concatenate([np.diff(times) for times in own_s if len(times) > 1] or [np.ones(1)])
    step_s = max(float(np.median(steps)), float(all_s[-1] - all_s[0]) / MOST_SAMPLES, 1e-3)
    time_s = np.arange(all_s[0], all_s[-1] + step_s, step_s)
    modes = np.array([MODES.index(mode) for mode in table["mode"].to_pylist()])
    readings = {name: joint_values(table, name) for name in UNITS}
    shape = (len(time_s), len(arms), JOINTS)
    out = {name: np.full(shape, np.nan, np.float32) for name in readings}
    mode = np.full(shape[:2], -1)
    for a, arm in enumerate(arms):
        rows, times = np.flatnonzero(names == arm), own_s[a]
        last = np.maximum(np.searchsorted(times, time_s, side="right") - 1, 0)  # its first one also shortly before
        fresh = np.abs(time_s - times[last]) <= ABSENT_SAMPLES * step_s
        mode[fresh, a] = modes[rows[last[fresh]]]
        for name, values in readings.items():
            out[name][fresh, a] = values[rows[last[fresh]]]
    return Telemetry(time_s=time_s, mode=mode, **out)


def offers_of(row: Mapping[str, Any]) -> Iterator[Offer]:
    """What the arms offered for a job that was awarded, from a row of the results."""
    for offer in msgspec.json.decode(row["offers"] or "[]", type=tuple[ArmOffer, ...]):
        plan = offer.plan or PlanQuote()
        yield Offer(
            time_s=row["time_s"],
            job=row["job"],
            arm=offer.arm,
            awarded=offer.arm == row["arm"],
            state=offer.mode,
            feasible=offer.plan is not None,
            free=offer.free,
            difficulty=plan.difficulty,
            peak_c=plan.peak_c,
            p_saturation=plan.p_saturation,
            duration_s=plan.duration_s,
        )


def _metrics(
    telemetry: Telemetry,
    events: Sequence[Event],
    jobs: Sequence[JobRecord],
    arms: Sequence[str],
    warning_c: float,
    *,
    states_published: bool,
) -> dict[str, Any]:
    """Key figures, named as in a run; what only the simulator knows is left out.

    Args:
        states_published: Whether an auctioneer published the states of jobs; without them, counts of states are None.
    """
    late_by_job = {job.job: job.finished_s - job.due_s for job in jobs if job.finished_s is not None}
    late_by_job |= {event.job: event.value for event in events if event.kind == "finish"}
    late_s = [each if math.isnan(each) else max(0.0, each) for each in late_by_job.values()]
    states = Counter(job.state for job in jobs)
    names = {job.job for job in jobs} | {event.job for event in events if event.job}
    step_s = float(telemetry.time_s[1] - telemetry.time_s[0]) if len(telemetry.time_s) > 1 else 0.0
    span_h = float(telemetry.time_s[-1] - telemetry.time_s[0]) / 3600.0
    seen, known = telemetry.mode >= 0, np.asarray(np.isfinite(telemetry.temp_c).any(axis=(0, 2)))
    finished = len(late_by_job.keys() | {job.job for job in jobs if job.state == "finished"})
    hot = (np.nan_to_num(telemetry.temp_c, nan=-np.inf) > warning_c).any(axis=2)
    peaks = {arm: float(np.nanmax(telemetry.temp_c[:, a])) for a, arm in enumerate(arms) if known[a]}
    return {
        "jobs": len(names),
        "finished": finished,
        "on_time": sum(not late for late in late_s),
        "tardiness_min": float(np.nansum(late_s)) / 60.0,
        "faults": sum(event.kind == "fault" for event in events),
        **{state: states[state] if states_published else None for state in ("given_up", "expired", "unfinished")},
        "above_warning_min": float(hot.sum()) * step_s / 60.0,
        "availability": float(1.0 - (telemetry.mode[seen] == FAULTED).mean()) if seen.any() else None,
        "utilisation": float((telemetry.mode[seen] == WORKING).mean()) if seen.any() else None,
        "jobs_per_hour": finished / span_h if span_h else None,
        "peak_c": peaks,
    }


def heat_use(table: pa.Table, arms: Sequence[str]) -> dict[str, dict[str, float]]:
    """Insulation life that was used, and drift of the tool points, of each arm whose temperatures were recorded.

    As in the metrics of a run, but from measured winding temperatures and the arms' own estimates of their housings.
    The tool points are calibrated at the first state.
    """
    names = np.array(table["arm"].to_pylist())
    used: dict[str, float] = {}
    drift: dict[str, float] = {}
    for arm in arms:
        rows = table.filter(pa.array(names == arm))
        winding_c, housing_c = (joint_values(rows, name) for name in ("temp_c", "housing_c"))
        measured, estimated = (np.isfinite(values).all(axis=1) for values in (winding_c, housing_c))
        if measured.sum() > 1:
            time_s, rate = rows["time_s"].to_numpy()[measured], arrhenius_rate(winding_c[measured])
            used[arm] = 1e9 * float(life_used(rate[:-1], rate[1:], np.diff(time_s)[:, None]).sum(axis=0).max())
        if estimated.any():
            segments_c = segment_temperatures(housing_c[estimated])
            drift[arm] = 1e3 * float(most_drift_m(segments_c - segments_c[0]).max())
    return {"insulation_ppb": used, "tool_drift_mm": drift}


def _missing(gaps: pa.Table, lost: Mapping[Kind, int]) -> Mapping[str, str]:
    rows = gaps.to_pylist()
    missing = {f"{row['sender']}, numbers {row['first']} to {row['last']}": row["reason"] for row in rows}
    missing |= {f"{number} rows of {kind}": "parts of the recording were removed" for kind, number in lost.items()}
    return missing or {"": "none"}


def _of_epoch(table: pa.Table, epochs: Sequence[str]) -> pa.Table:
    """Rows of the last epoch, each of which begins its time again."""
    if not epochs:
        return table
    return table.filter(pc.field("epoch").isin(["", epochs[-1]]))  # "": before an arm knew it


def _submitters(results: pa.Table) -> Mapping[str, int]:
    """Number of jobs by who submitted them; "nobody named" for none."""
    first = {row["job"]: row["by"] for row in reversed(results.to_pylist()) if row["state"] == "waiting"}
    return Counter(by or "nobody named" for by in first.values())


def _request_notice(row: Mapping[str, Any]) -> Notice:
    """What a person requested, from a row of the operations."""
    action = json.loads(row["content"])["action"]
    details = [f"as {action['outcome']}"] if "outcome" in action else []
    if "due_s" in action:
        details.append("no due date" if action["due_s"] is None else f"due at {clock(action['due_s'])}")
    details += [f"value {action['value']:g}"] if "value" in action else []
    arm = "all arms" if row["arm"] == ALL_ARMS else row["arm"]
    details.append(f"by {row['by'] or 'nobody named'}")
    note = f" ({row['note']})" if row["note"] else ""
    reason = f"{', '.join(details)}{note}"
    return Notice(time_s=row["time_s"], kind=row["action"], arm=arm, job=row["job"], reason=reason)


def _alarm_notices(alarms: Sequence[Alarm], arms: Sequence[str], jobs: Sequence[JobRecord]) -> Iterator[Notice]:
    """When each alarm began, and was acknowledged by whom, and ended."""
    names, before = {job.job for job in jobs}, dict[str, Alarm]()
    for alarm in alarms:
        known = before.get(alarm.alarm)
        before[alarm.alarm] = alarm
        if known and known.ended_s is not None and alarm.ended_s is None:  # it begins again
            known = None
        changes = [(known is None, alarm.began_s, "alarm", alarm.what)]
        seen = alarm.by and not (known and known.by)
        changes.append((bool(seen), alarm.time_s, "alarm_acknowledged", f"by {alarm.by}: {alarm.what}"))
        ended = alarm.ended_s is not None and (known is None or known.ended_s is None)
        changes.append((ended, alarm.ended_s or 0.0, "alarm_ended", alarm.what))
        arm, job = (alarm.subject if alarm.subject in those else "" for those in (arms, names))
        for changed, time_s, kind, reason in changes:
            if changed:
                yield Notice(time_s=time_s, kind=kind, arm=arm, job=job, reason=reason)


def _silences(alarms: Sequence[Alarm], results_s: Sequence[float], arms: Container[str]) -> Iterator[Halt]:
    """When nobody replied about the jobs or awarded them.

    Args:
        results_s: Times of the results, ascending: the next one ends an alarm whose gateway has exited.
    """
    kinds = {"silent": "did not reply", "stopped": "awarded no jobs"}
    for alarm in {(alarm.alarm, alarm.began_s): alarm for alarm in alarms if alarm.kind in kinds}.values():
        end_s = next((s for s in results_s if s > alarm.time_s), math.inf) if alarm.ended_s is None else alarm.ended_s
        reason = f"{alarm.subject} {kinds[alarm.kind]}" if alarm.subject else "nobody replied"
        one = alarm.subject if alarm.kind == "stopped" and alarm.subject in arms else ""  # it allocates with its peers
        yield Halt(arm=one, start_s=alarm.began_s, end_s=end_s, reason=reason)


def _pauses(operations: pa.Table) -> Iterator[Halt]:
    """When people had paused arms."""
    paused: dict[str, Halt] = {}
    for row in operations.to_pylist():
        arm = "" if row["arm"] == ALL_ARMS else row["arm"]
        if row["action"] == "pause":
            reason = f"{f'{arm} was' if arm else 'all arms were'} paused by {row['by'] or 'nobody named'}"
            paused.setdefault(arm, Halt(arm=arm, start_s=row["time_s"], end_s=math.inf, reason=reason))
        elif row["action"] == "resume":
            for ended in [each for each in paused if arm in ("", each)]:
                yield replace(paused.pop(ended), end_s=row["time_s"])
    yield from paused.values()
