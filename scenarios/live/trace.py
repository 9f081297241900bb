"""Causes of one event of a run or a recording, as far as they were recorded."""

import re
from bisect import bisect
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any  # values of run.json

from fleet.errors import FleetError, nearest
from fleet.events import EVENT_KINDS, MEANINGS, Event
from scenarios.live.recording import CARD, read_parts
from scenarios.live.recording_report import open_recording
from scenarios.run.log import open_run
from scenarios.run.records import Offer, ShiftLog
from scenarios.show.words import CANNOT, clock, value_text
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

    def as_json(self) -> dict[str, Any]:
        """The thread as JSON values."""
        award = None if self.award is None else _plain(self.award)
        events = {"event": _plain(self.event), "award": award, "history": [_plain(each) for each in self.history]}
        return asdict(self) | events


def thread_of(folder: Path, asked: str) -> Thread:
    """The thread of an event in the folder of a run or a recording.

    Args:
        asked: A row of the event log from 0; a kind, also with an arm or a job as KIND@NAME; or a job, for its award.
            If several events fit, the first one.

    Raises:
        FleetError: no run or recording, or no such event.
    """
    log: ShiftLog
    if (folder / "run.json").exists():
        log = open_run(folder)
        events, jobs = log.events, {record.job: asdict(record) for record in log.jobs}
    elif (folder / CARD).exists():
        log = open_recording(folder)
        events, jobs = tuple(sorted(log.events, key=lambda event: event.time_s)), _recorded_jobs(folder)
    else:
        raise FleetError(f"'{folder}' is neither a folder of `thermofleet run` nor of `thermofleet bus record`.")
    rows = rows_of(events, asked)
    event = events[rows[0]]
    job = event.job or _job_at(log, event)
    history = tuple(e for e in events if job and e.job == job)
    award = _award_of(history, event)
    arm = event.arm or (award.arm if award else "")
    twins = log.card.get("twins", {})
    scenario = {"scenario": log.card["scenario"]["name"], "status": log.card["status"]}
    return Thread(
        folder=str(folder),
        row=rows[0],
        alike=tuple(rows),
        event=replace(event, job=job),
        job=jobs.get(job, {}),
        award=award,
        offers=() if award is None else _offers_at(log.offers, award),
        history=history,
        twin={"arm": arm} | dict(twins.get(arm) or {"version": _live_twin(award)}) if arm else {},
        configuration=scenario | {name: log.card.get(name, NOT_RECORDED) for name in CONFIGURATION},
        code={"hash": log.card.get("code_hash", NOT_RECORDED)} | log.card.get("versions", {}),
    )


def _job_at(log: ShiftLog, event: Event) -> str:
    """Job of the arm of an event at its time; "" for none."""
    own = (each for each in log.plan.assignments if each.arm == event.arm)
    return next((each.job for each in own if each.start_s <= event.time_s <= each.end_s), "")


def _offers_at(offers: Sequence[Offer], award: Event) -> tuple[Offer, ...]:
    """Offers behind an award; in a recording their times are those of another clock, so the nearest ones."""
    times_s = [o.time_s for o in offers if o.awarded and (o.job, o.arm) == (award.job, award.arm)]
    time_s = min(times_s, key=lambda each: abs(each - award.time_s), default=None)
    return tuple(o for o in offers if (o.job, o.time_s) == (award.job, time_s))


def _recorded_jobs(folder: Path) -> dict[str, dict[str, Any]]:
    """Last state and last award of each job of a recording."""
    jobs: dict[str, dict[str, Any]] = {}
    for row in read_parts(folder, "results").to_pylist():
        job = jobs.setdefault(row["job"], {})
        job |= {name: row[name] for name in ("job", "state", "due_s", "finished_s", "value", "cycles", "repetitions")}
        if row["award"]:
            job |= {name: row[name] for name in ("award", "auctioneer", "difficulty", "p_saturation", "peak_c")}
    return jobs


def rows_of(events: Sequence[Event], asked: str) -> list[int]:
    """Rows of the events that are asked for, as in `thread_of`; at least one.

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
        hint = f"; did you mean '{close[0]}'?" if close else "."
        raise FleetError(
            f"No row, kind of event or job '{asked}'{hint} Kinds that were recorded: {kinds}. Rows: 0 to "
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


def _award_of(history: Sequence[Event], event: Event) -> Event | None:
    """The last award of a job before an event, to its arm if it has one; that of the event itself if it is one."""
    awards = [e for e in history if e.kind == "award" and e.time_s <= event.time_s + 1e-6]
    own = [e for e in awards if event.arm in ("", e.arm)]
    return event if event.kind == "award" else own[-1] if own else None


def _live_twin(award: Event | None) -> str:
    """Version of the twin that a live arm stated in its award."""
    _, stated, version = award.reason.partition(", twin ") if award else ("", "", "")
    return version if stated else NOT_RECORDED


def _plain(event: Event) -> dict[str, Any]:
    """An event as JSON values, without the env."""
    fields = asdict(event)
    del fields["env"]
    return fields | {"value": event.value if event.value == event.value else None}


def thread_table(thread: Thread) -> Table:
    """The thread as a table without headings, about 30 lines."""
    event = thread.event
    rows: list[tuple[str, str]] = []

    def row(name: str, *parts: object) -> None:
        if text := ", ".join(str(part) for part in parts if part not in ("", None)):
            rows.append((name, text))

    row("event", f"row {thread.row} of {thread.folder}", _alike(thread))
    row("", *_words(event), MEANINGS[event.kind].text)
    if thread.job:
        row("job", *_pairs(thread.job))
    if thread.award is not None:
        award = thread.award
        row("award", f"{clock(award.time_s)} to {award.arm}", *_number("d", award.value), award.reason)
        row("plan", *_plan(thread.offers, award))
    shown = sorted(thread.offers, key=lambda o: (not o.awarded, not o.free, o.arm))
    for i, offer in enumerate(shown[:MOST_OFFERS]):
        row("" if i else "offers", *_offer(offer))
    if len(shown) > MOST_OFFERS:
        row("", f"and {len(shown) - MOST_OFFERS} more; offers.parquet has all of them")
    if thread.award is not None and not shown:
        row("offers", NOT_RECORDED)
    if thread.twin:
        row("twin", *_pairs({k: v for k, v in thread.twin.items() if not isinstance(v, Mapping)}))
        if "twin" in thread.twin:
            row("trained on", *_pairs(thread.twin["twin"]))
    row("configuration", *_pairs({k: v for k, v in thread.configuration.items() if k != "channel"}))
    if isinstance(channel := thread.configuration.get("channel"), Mapping):
        row("channel", *_pairs(channel))
    row("code", *_pairs(thread.code))
    for i, one in enumerate(_around(thread)):
        row("" if i else "history", *_words(one))
    caption = f"{event.kind.replace('_', ' ')} at {clock(event.time_s)}"
    return Table(caption=caption, head=("", ""), rows=tuple(rows), numbers=False)


def _around(thread: Thread) -> tuple[Event, ...]:
    """Events of the job, the shown one among them."""
    times_s = [event.time_s for event in thread.history]
    begin = bisect(times_s, thread.event.time_s) - MOST_HISTORY // 2
    begin = max(0, min(begin, len(times_s) - MOST_HISTORY))
    return thread.history[begin : begin + MOST_HISTORY]


def _alike(thread: Thread) -> str:
    others = [row for row in thread.alike if row != thread.row]
    more = ", …" if len(others) > 5 else ""
    return f"the first of {len(thread.alike)}, others in rows {', '.join(map(str, others[:5]))}{more}" if others else ""


def _words(event: Event) -> list[str]:
    joint = f"joint {event.joint}" if event.joint else ""
    value = f"{MEANINGS[event.kind].value or 'value'} {event.value:.4g}" if event.value == event.value else ""
    return [
        clock(event.time_s),
        event.kind.replace("_", " "),
        event.arm,
        event.job,
        joint,
        value,
        event.reason,
    ]


def _number(name: str, value: float) -> list[str]:
    return [f"{name} {value:.2f}"] if value == value else []


def _plan(offers: tuple[Offer, ...], award: Event) -> list[str]:
    chosen = next((offer for offer in offers if offer.awarded), None)
    duration = f"{chosen.duration_s:.0f} s" if chosen is not None and chosen.duration_s is not None else ""
    stated = re.match(r"plan (\d+), twin ", award.reason)  # by a live arm
    number = int(stated[1]) if stated else None if chosen is None else chosen.plan
    if number is None:
        return [NOT_RECORDED, duration]
    return [f"plan {number}, the {'coolest' if number else 'fastest'} that was offered", duration]


def _offer(offer: Offer) -> list[str]:
    if not offer.feasible:
        return [offer.arm, CANNOT]
    known = {"d": (offer.difficulty, ".2f"), "P": (offer.p_saturation, ".2f"), "peak °C": (offer.peak_c, ".1f")}
    parts = [f"{name} {value:{form}}" for name, (value, form) in known.items() if value is not None]
    duration = [f"{offer.duration_s:.0f} s"] if offer.duration_s is not None else []
    reason = "" if offer.free else f"not free ({offer.state})"
    return [offer.arm + (" (awarded)" if offer.awarded else ""), *parts, *duration, reason]


def _pairs(values: Mapping[str, Any]) -> list[str]:
    return [f"{key.replace('_', ' ')} {value_text(value)}" for key, value in values.items() if value is not None]
