"""Causes of one event of a run or a recording, as far as they were recorded."""

import re
from bisect import bisect
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from difflib import get_close_matches
from math import isfinite
from pathlib import Path
from typing import Any  # values of run.json

from fleet.errors import FleetError, nearest
from fleet.events import EVENT_KINDS, MEANINGS, Event
from scenarios.live.recording import CARD, read_parts
from scenarios.live.recording_report import open_recording
from scenarios.run.log import open_run
from scenarios.run.records import Offer, ShiftLog
from scenarios.show.late_jobs import late_jobs, lateness_text
from scenarios.show.words import clock, offer_text, value_text
from scenarios.table import Table

CONFIGURATION = ("scenario_hash", "policy", "seed", "plant", "bus", "difficulty", "risk", "environment", "channel")
NOT_RECORDED = "not recorded"
MOST_OFFERS, MOST_HISTORY = 8, 8
"""Lines of a table."""


@dataclass(frozen=True)
class Thread:
    """Records about one event."""

    folder: str
    row: int
    """Row of the event log, from 0."""
    alike: tuple[int, ...]
    """Rows of all events that fit the request; the first one is shown."""
    event: Event
    job: Mapping[str, Any]
    """Record of the job; empty if the event has none, or it was not recorded."""
    award: Event | None
    """Award of the job to the arm, if any."""
    offers: tuple[Offer, ...]
    """Of all arms at the award."""
    history: tuple[Event, ...]
    """All events of the job."""
    twin: Mapping[str, Any]
    """Version of the difficulty model of the event's arm, or of the arm that got the job; for a twin also the hash of
    its training data, its seed and its calibration."""
    configuration: Mapping[str, Any]
    code: Mapping[str, Any]
    """Hash of the code, and versions of the libraries."""
    begin: datetime | None = None
    """Date of the begin of the shift, for times of day; None if it is unknown."""

    def as_json(self) -> dict[str, Any]:
        """The thread as values for JSON, events without the env."""
        values = asdict(self)
        for event in filter(None, (values["event"], values["award"], *values["history"])):
            del event["env"]
        del values["begin"]
        return values


def thread_of(folder: Path, asked: str) -> Thread:
    """The thread of an event in the folder of a run or a recording.

    Args:
        asked: A row of the event log from 0; a kind, also with an arm or a job as KIND@NAME; or a job, for its award.
            If several events fit, the first one.

    Raises:
        FleetError: no run or recording, no such event, or a job without a recorded award.
    """
    log: ShiftLog
    results: Sequence[Mapping[str, Any]] = ()
    if (folder / "run.json").exists():
        log = open_run(folder)
        events, jobs = log.events, {record.job: asdict(record) for record in log.jobs}
    elif (folder / CARD).exists():
        log = open_recording(folder)
        events = tuple(sorted(log.events, key=lambda event: event.time_s))
        results = read_parts(folder, "results").to_pylist()
        jobs = _recorded_jobs(results)
    else:
        raise FleetError(f"'{folder}' is neither a folder of `thermofleet run` nor of `thermofleet bus record`.")
    job = asked.removeprefix("award@")
    awarded = {event.job for event in events if event.kind == "award"}
    if job in jobs and job not in awarded and not asked.isdecimal():
        raise FleetError(_without_award(log, job, str(jobs[job]["state"]), events))
    rows = rows_of(events, asked, {notice.kind for notice in log.notices})
    event = events[rows[0]]
    work = log.plan.at(event.arm, event.time_s)
    job = event.job or (work.job if work else "")
    history = tuple(e for e in events if job and e.job == job)
    awards = [e for e in history if e.kind == "award" and e.time_s <= event.time_s + 1e-6 and event.arm in ("", e.arm)]
    award = event if event.kind == "award" else awards[-1] if awards else None
    arm = event.arm or (award.arm if award else "")
    stated = award.reason.partition(", twin ")[2] if award else ""  # by a live arm
    twins = log.card.get("twins", {})
    scenario = {"scenario": log.card["scenario"]["name"], "status": log.card["status"]}
    return Thread(
        folder=str(folder),
        row=rows[0],
        alike=tuple(rows),
        event=replace(event, job=job),
        job=jobs.get(job, {}) | _recorded_award(results, award),
        award=award,
        offers=() if award is None else log.offers_behind(award.job, award.arm, award.time_s),
        history=history,
        twin={"arm": arm} | dict(twins.get(arm) or {"version": stated or NOT_RECORDED}) if arm else {},
        configuration=scenario | {name: log.card.get(name, NOT_RECORDED) for name in CONFIGURATION},
        code={"hash": log.card.get("code_hash", NOT_RECORDED)} | log.card.get("versions", {}),
        begin=log.begin,
    )


def _without_award(log: ShiftLog, job: str, state: str, events: Sequence[Event]) -> str:
    """That no award of a job is recorded, why it is late, and its events."""
    late = [each for each in late_jobs(log) if each.job == job]
    why = f" {lateness_text(log, late)}" if late else ""
    kinds = dict.fromkeys(event.kind for event in events if event.job == job)
    listed = f" Trace another event: {', '.join(f'{kind}@{job}' for kind in kinds)}." if kinds else ""
    return f"No award of '{job}' is recorded; its state is {state.replace('_', ' ')}.{why}{listed}"


def _recorded_jobs(results: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Last state of each job of a recording, by name."""
    names = ("job", "state", "release_s", "due_s", "finished_s", "value", "cycles", "repetitions")
    return {row["job"]: {name: row[name] for name in names} for row in results}


def _recorded_award(results: Sequence[Mapping[str, Any]], award: Event | None) -> dict[str, Any]:
    """Identifier and figures of an award of a recording, as its auctioneer published them; empty if it did not.

    Its time is that of another clock, so of all awards of the job to the arm the nearest is meant.
    """
    if award is None:
        return {}
    first = dict[str, Mapping[str, Any]]()
    for row in results:
        if row["award"] and (row["job"], row["arm"]) == (award.job, award.arm):
            first.setdefault(row["award"], row)
    nearest = min(first.values(), key=lambda row: abs(row["time_s"] - award.time_s), default=None)
    names = ("award", "auctioneer", "difficulty", "p_saturation", "peak_c")
    return {} if nearest is None else {name: nearest[name] for name in names}


def rows_of(events: Sequence[Event], asked: str, untraced: Collection[str] = ()) -> list[int]:
    """Rows of the events that are asked for, as in `thread_of`; at least one.

    Args:
        untraced: Kinds of requests and alarms in the report.

    Raises:
        FleetError: no such event.
    """
    if not events:
        raise FleetError("No event was recorded.")
    if asked.isdecimal():
        if int(asked) >= len(events):
            raise FleetError(f"No event {asked}: rows of the event log are 0 to {len(events) - 1}.")
        return [int(asked)]
    kind, at, name = asked.partition("@")
    jobs = dict.fromkeys(event.job for event in events if event.job)
    if not at and asked in jobs:
        kind, name = "award", asked
    elif kind not in EVENT_KINDS:
        close = get_close_matches(asked, [*EVENT_KINDS, *jobs], n=1)
        kinds = ", ".join(dict.fromkeys(event.kind for event in events))
        if kind in untraced:
            raise FleetError(
                f"'{kind}' is a request or an alarm, which has no causes to trace: the report names who or what caused "
                f"it. Recorded kinds of events to trace: {kinds}."
            )
        hint = f"; did you mean '{close[0]}'?" if close else "."
        raise FleetError(
            f"No row, kind of event or job '{asked}'{hint} Recorded kinds of events: {kinds}. Rows: 0 to "
            f"{len(events) - 1}."
        )
    rows = [i for i, e in enumerate(events) if e.kind == kind and name in ("", e.arm, e.job)]
    if rows:
        return rows
    of_kind = dict.fromkeys(n for e in events if e.kind == kind for n in (e.arm, e.job) if n)
    if not of_kind:
        kinds = ", ".join(dict.fromkeys(event.kind for event in events))
        raise FleetError(f"No event of kind '{kind}' was recorded. Recorded: {kinds}.")
    raise FleetError(f"No event '{kind}' of '{name}'{nearest(name, of_kind)}")


def thread_table(thread: Thread) -> Table:
    """The thread as a table without headings, about 30 lines."""
    event, begin = thread.event, thread.begin
    rows: list[tuple[str, str]] = []

    def row(name: str, *parts: object) -> None:
        if text := ", ".join(str(part) for part in parts if part not in ("", None)):
            rows.append((name, text))

    others = [str(each) for each in thread.alike if each != thread.row]
    alike = f"the first of {len(thread.alike)}, others in rows {', '.join(others[:5])}" if others else ""
    row("event", f"row {thread.row} of {thread.folder}", alike, "…" if len(others) > 5 else "")
    row(
        "", *_words(event, begin), MEANINGS[event.kind].text.replace("`joint`", f"joint {event.joint}").replace("`", "")
    )
    if thread.job:
        row(
            "job", *_pairs({name.removesuffix("_s"): _moment(name, value, begin) for name, value in thread.job.items()})
        )
    if thread.award is not None:
        award = thread.award
        d = f"d {award.value:.2f}" if award.value == award.value else ""
        row("award", f"{clock(award.time_s, begin)} to {award.arm}", d, award.reason)
        row("plan", *_plan(thread.offers, award))
    shown = sorted(thread.offers, key=lambda o: (not o.awarded, not o.free, o.arm))
    for i, offer in enumerate(shown[:MOST_OFFERS]):
        row("" if i else "offers", f"{offer.arm}{' (awarded)' * offer.awarded}", offer_text(offer))
    if len(shown) > MOST_OFFERS:
        row("", f"and {len(shown) - MOST_OFFERS} more; offers.parquet has all of them")
    if thread.award is not None and not shown:
        row("offers", NOT_RECORDED)
    if thread.twin:
        row("twin", *_pairs({k: v for k, v in thread.twin.items() if not isinstance(v, Mapping)}))
        if "twin" in thread.twin:
            row("trained on", value_text({key.replace("_", " "): each for key, each in thread.twin["twin"].items()}))
    row("configuration", *_pairs({k: v for k, v in thread.configuration.items() if k != "channel"}))
    if isinstance(channel := thread.configuration.get("channel"), Mapping):
        row("channel", *_pairs(channel))
    row("code", *_pairs(thread.code))
    nearest_row = bisect([one.time_s for one in thread.history], event.time_s)
    first = max(0, min(nearest_row - MOST_HISTORY // 2, len(thread.history) - MOST_HISTORY))
    for i, one in enumerate(thread.history[first : first + MOST_HISTORY]):
        row("" if i else "history", *_words(one, begin))
    caption = f"{event.kind.replace('_', ' ')} at {clock(event.time_s, begin)}"
    return Table(caption=caption, head=("", ""), rows=tuple(rows), numbers=False)


def _words(event: Event, begin: datetime | None) -> list[str]:
    joint = f"joint {event.joint}" if event.joint else ""
    what, _, unit = (MEANINGS[event.kind].value or "value").partition(", ")
    value = f"{what} {event.value:.4g} {unit.split(';')[0]}".rstrip() if event.value == event.value else ""
    return [
        clock(event.time_s, begin),
        event.kind.replace("_", " "),
        event.arm,
        event.job,
        joint,
        value,
        event.reason,
    ]


def _plan(offers: tuple[Offer, ...], award: Event) -> list[str]:
    chosen = next((offer for offer in offers if offer.awarded), None)
    duration = f"{chosen.duration_s:.0f} s" if chosen is not None and chosen.duration_s is not None else ""
    stated = re.match(r"plan (\d+), twin ", award.reason)  # by a live arm
    number = int(stated[1]) if stated else None if chosen is None else chosen.plan
    if number is None:
        return [NOT_RECORDED, duration]
    return [f"plan {number}, the {'coolest' if number else 'fastest'} that was offered", duration]


def _moment(name: str, value: object, begin: datetime | None) -> object:
    """A value of a job, a time in seconds as a time of the shift."""
    return clock(value, begin) if name.endswith("_s") and isinstance(value, float) and isfinite(value) else value


def _pairs(values: Mapping[str, Any]) -> list[str]:
    return [f"{key.replace('_', ' ')} {value_text(value)}" for key, value in values.items() if value is not None]
