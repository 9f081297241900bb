"""The thread of one event of a run or a recording: everything that led to it, as far as it was recorded."""

import re
from bisect import bisect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any  # values of run.json

from fleet.errors import FleetError, nearest
from fleet.events import EVENT_KINDS, MEANINGS, Event
from scenarios.live.recording import CARD, read_card, read_parts
from scenarios.live.recording_report import arm_events, offers_of
from scenarios.run.log import RunLog, open_run
from scenarios.run.records import JobRecord, Offer
from scenarios.show.words import CANNOT, by_joint, clock, value_text
from scenarios.table import Table

CONFIGURATION = ("scenario_hash", "policy", "seed", "plant", "bus", "difficulty", "risk", "environment", "channel")
NOT_RECORDED = "not recorded"
MOST_OFFERS, MOST_HISTORY = 8, 8
"""Lines of a table."""


@dataclass(frozen=True)
class Thread:
    """What is recorded about one event."""

    folder: str
    row: int
    """Of the event log, from 0."""
    alike: tuple[int, ...]
    """Rows of all events that were asked for; the first of them is shown."""
    event: Event
    job: Mapping[str, Any]
    """Of the event's job; empty if it has none, or if the job is not recorded."""
    award: Event | None
    """By which the arm had the job; None for none."""
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


@dataclass(frozen=True)
class _Log:
    """Events of a run or a recording, in the order of their file, and what else is known."""

    events: Sequence[Event]
    job: Callable[[str], Mapping[str, Any]]
    holder: Callable[[Event], str]
    """Job that the arm of an event without a job worked on; "" for none."""
    offers: Callable[[Event], Sequence[Offer]]
    """Of all arms, at an award."""
    twins: Mapping[str, Mapping[str, Any]]
    configuration: Mapping[str, Any]
    code: Mapping[str, Any]


def thread_of(folder: Path, asked: str) -> Thread:
    """The thread of an event in the folder of a run or a recording.

    Args:
        asked: A row of the event log from 0; a kind, also with an arm or a job as KIND@NAME; or a job, for its award.
            If several events fit, the first one.

    Raises:
        FleetError: no run or recording, or no such event.
    """
    if (folder / "run.json").exists():
        log = _of_run(open_run(folder))
    elif (folder / CARD).exists():
        log = _of_recording(folder)
    else:
        raise FleetError(f"'{folder}' is neither a folder of `thermofleet run` nor of `thermofleet bus record`.")
    rows = rows_of(log.events, asked)
    event = log.events[rows[0]]
    job = event.job or log.holder(event)
    history = tuple(e for e in log.events if job and e.job == job)
    award = _award_of(history, event)
    offers = () if award is None else tuple(log.offers(award))
    arm = event.arm or (award.arm if award else "")
    return Thread(
        folder=str(folder),
        row=rows[0],
        alike=tuple(rows),
        event=replace(event, job=job),
        job=log.job(job) if job else {},
        award=award,
        offers=offers,
        history=history,
        twin={"arm": arm} | dict(log.twins.get(arm) or {"version": _live_twin(award)}) if arm else {},
        configuration=log.configuration,
        code=log.code,
    )


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


def _of_run(run: RunLog) -> _Log:
    card = run.card
    records: dict[str, JobRecord] = {record.job: record for record in run.jobs}

    def holder(event: Event) -> str:
        if not event.arm:
            return ""
        return next(
            (w.job for w in run.plan.assignments if w.arm == event.arm and w.start_s <= event.time_s <= w.end_s), ""
        )

    configuration = {"scenario": run.scenario.name} | {name: card.get(name, NOT_RECORDED) for name in CONFIGURATION}
    return _Log(
        events=run.events,
        job=lambda name: asdict(records[name]) if name in records else {},
        holder=holder,
        offers=lambda award: [o for o in run.offers if (o.time_s, o.job) == (award.time_s, award.job)],
        twins=card["twins"],
        configuration=configuration,
        code={"hash": card.get("code_hash", NOT_RECORDED)} | card["versions"],
    )


def _of_recording(folder: Path) -> _Log:
    card = read_card(folder)
    results = read_parts(folder, "results").to_pylist()
    events = arm_events(read_parts(folder, "events"))
    last = {row["job"]: row for row in results}
    busy = read_parts(folder, "telemetry").select(["time_s", "arm", "job"]).to_pylist()

    def job(name: str) -> Mapping[str, Any]:
        shown = ("job", "state", "due_s", "finished_s", "value", "cycles", "repetitions")
        awarded = [row for row in results if row["job"] == name and row["award"]]
        quoted = ("award", "auction", "auctioneer", "difficulty", "p_saturation", "peak_c")
        own = {key: last[name][key] for key in shown} if name in last else {"job": name}
        return own | ({key: awarded[-1][key] for key in quoted} if awarded else {})

    def offers(award: Event) -> list[Offer]:
        """Those of the award to the arm that is the next one in time: auctioneer and arm have clocks of their own."""
        own = [row for row in results if (row["job"], row["arm"]) == (award.job, award.arm) and row["offers"]]
        row = min(own, key=lambda row: abs(row["time_s"] - award.time_s), default=None)
        return [] if row is None else list(offers_of(row))

    def holder(event: Event) -> str:
        before = (row for row in reversed(busy) if row["arm"] == event.arm and row["time_s"] <= event.time_s)
        return next((row["job"] for row in before), "")

    return _Log(
        events=events,
        job=job,
        holder=holder,
        offers=offers,
        twins={},
        configuration={"fleet": card.fleet, "status": card.status, "recording format": card.format},
        code={"hash": NOT_RECORDED},
    )


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
        by_joint(event.reason),
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
