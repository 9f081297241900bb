"""The report of a run, the two reports of a demo side by side, and a run in a notebook."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import TYPE_CHECKING, Any  # values of run.json
from urllib.parse import quote

from fleet.env.render.heat import heat_scale
from fleet.events import Event
from fleet.telemetry import Telemetry
from scenarios.run.schedule import payloads, schedule
from scenarios.shift_records import Offer
from scenarios.show.html import render
from scenarios.show.page import Chart, Page, Replay
from scenarios.show.replay import packed
from scenarios.show.table import Moment, Table
from scenarios.show.timeline import figure, time_unit
from scenarios.show.verdict import Verdict, verdict
from scenarios.show.words import CANNOT, by_joint, clock, duration, kind_text, scores_text

if TYPE_CHECKING:
    from markupsafe import Markup

NO_PAYLOADS: Mapping[str, float] = {}
ROWS = 300
"""Most rows of the event table, and of the table of requests."""
BEFORE_S = 5.0
"""A click on an event goes to this time before it."""
NOTABLE = ("fault", "contact", "recover", "return", "warning", "torque_warning", "lost")
"""Event kinds of the event table, most important first; the least important are dropped first."""
MOST_AWARDS = 300
MOST_ARMS = 8
"""With more arms, the columns of an award are the best other offers instead of the arms."""


@dataclass(frozen=True)
class EventTable:
    """The notable events by time."""

    counts: str
    omitted: str
    """Why some are not listed; "" if all are."""
    lost: bool
    """Whether claims were lost, whose rows are hidden at first."""
    only_lost: bool
    rows: "Markup"


@dataclass(frozen=True)
class Tile:
    """A key figure."""

    label: str
    number: str
    small: str
    """Unit, whole or arm beside the number."""
    bad: bool


def report_html(
    run: Mapping[str, Any],
    telemetry: Telemetry,
    events: Sequence[Event],
    arms: Sequence[str],
    *,
    warning_c: float,
    error_c: float,
    model: Mapping[str, Any] | None = None,
    payload_of: Mapping[str, float] = NO_PAYLOADS,
    offers: Sequence[Offer] = (),
) -> str:
    """The report of a run as one HTML page; the same input gives the same text.

    Args:
        run: Content of `run.json`; missing metrics are left out of the report.
        telemetry: Arms in the order of `arms`; may be empty.
        events: Event log of the run, in any order.
        warning_c, error_c: Limits of the motor temperature.
        model: `fleet.physics.cell_model.cell_model` with the same arms; without it nothing is shown in 3-D.
        payload_of: Payload of each job, kg.
        offers: What each arm knew at each award.

    Raises:
        ValueError: the telemetry has another number of arms, or the events contradict each other.
    """
    if telemetry.temp_c.shape[1] != len(arms):
        raise ValueError(f"The telemetry has {telemetry.temp_c.shape[1]} arms, the fleet {len(arms)}.")
    events = sorted(events, key=lambda e: (e.time_s, e.arm, e.kind, e.job))
    last = [*telemetry.time_s[-1:].tolist(), *(e.time_s for e in events)]
    reached_s = max(last, default=float(run.get("scenario", {}).get("horizon_s", 0.0)))
    plan = schedule(events, arms, reached_s)
    drawing = figure(plan, telemetry, events, arms, warning_c=warning_c, error_c=error_c)
    replay = None
    if model is not None and len(telemetry.time_s):
        playback = packed(telemetry, payloads(telemetry, plan, arms, payload_of))
        shown = {**model, "heat": heat_scale(warning_c, error_c)}
        replay = Replay(model=shown, playback=playback, unit_s=time_unit(plan.horizon_s)[1])
    scenario = run.get("scenario", {})
    name = scenario.get("name", "unnamed scenario")
    told = verdict(run, events, plan, offers)
    moments = {sentence: _before(fault) for sentence, fault in told.faults.items()}
    content = {
        "verdict": told,
        "moments": moments,
        "first": next(iter(moments.values()), None),
        "description": str(scenario.get("description") or ""),
        "how": " · ".join(_settings(run, arms)),
        "tiles": key_figures(run.get("metrics") or {}),
        "replay": replay is not None,
        "events": _event_table(events),
        "awards": _award_table(offers, arms),
        "requests": _request_table(run.get("requests") or ()),
        "provenance": _provenance(run),
    }
    title = f"{name} · {run.get('policy', 'unknown policy')}" + (f" · seed {run['seed']}" if "seed" in run else "")
    chart = Chart(key="drawn", figure=drawing, alt="Work and motor temperatures of each arm over the shift")
    return Page(title=title, template="run.html", content=content, charts=(chart,), replay=replay).html()


def run_html(run: Mapping[str, Any], events: Sequence[Event], offers: Sequence[Offer]) -> str:
    """A run in words, and its key figures, as a notebook shows them.

    Args:
        run: Content of `run.json`.
        events: In order of time.
        offers: What each arm knew at each award.
    """
    arms = [arm["name"] for arm in run["scenario"]["arms"]]
    told = verdict(run, events, schedule(events, arms, run["time_s"]), offers)
    title = f"{run['scenario']['name']} · {run['policy']} · seed {run['seed']}"
    return str(render("notebook.html", title=title, verdict=told, tiles=key_figures(run["metrics"])))


def _settings(run: Mapping[str, Any], arms: Sequence[str]) -> list[str]:
    horizon_s = run.get("scenario", {}).get("horizon_s")
    length = f"{duration(horizon_s)} shift" if horizon_s is not None else "Shift"
    how = [f"{length} of {len(arms)} arm{'s' if len(arms) != 1 else ''}"]
    return how + [f"{name} {run[name]}" for name in ("plant", "bus", "difficulty") if run.get(name) is not None]


KEY_FIGURES = (
    ("jobs finished", "finished", ",.4g", "", "jobs"),
    ("value", "value", ",.4g", "", "value_offered"),
    ("on time", "on_time", ",.4g", "", "finished"),
    ("tardiness", "tardiness_min", ",.1f", " min", ""),
    ("jobs per hour", "jobs_per_hour", ".1f", "", ""),
    ("faults", "faults", ".0f", "", ""),
    ("contacts", "contacts", ",.0f", "", ""),
    ("above warning", "above_warning_min", ",.1f", " min", ""),
    ("hottest motor", "hottest_c", ".1f", " °C", ""),
    ("too hot to touch", "hot_surface_min", ",.1f", " min", ""),
    ("availability", "availability", ".1%", "", ""),
    ("utilisation", "utilisation", ".1%", "", ""),
    ("energy to heat", "energy_wh", ",.0f", " Wh", ""),
    ("tool drift", "most_drift_mm", ".2f", " mm", ""),
    ("insulation used", "most_insulation_ppb", ",.3g", " ppb", ""),
    ("claims lost to another arm", "lost_claims", ",.0f", "", ""),
)
"""Label, metric, format, unit, and the metric it is a part of."""


def key_figures(metrics: Mapping[str, Any]) -> list[Tile]:
    """The most important metrics; those without a number are left out."""
    values = {k: float(v) for k, v in metrics.items() if isinstance(v, int | float) and math.isfinite(v)}
    peaks = {k: v for k, v in (metrics.get("peak_c") or {}).items() if v is not None and math.isfinite(v)}
    hottest = max(peaks, key=lambda arm: peaks[arm], default="")
    if hottest:
        values["hottest_c"] = peaks[hottest]
    for name, own in (("most_drift_mm", "tool_drift_mm"), ("most_insulation_ppb", "insulation_ppb")):
        if metrics.get(own):
            values[name] = max(metrics[own].values())
    tiles: list[Tile] = []
    for label, name, form, unit, whole in KEY_FIGURES:
        if name in values and (name != "contacts" or values[name] > 0):
            small = f" of {values[whole]:{form}}" if whole in values else f"{unit} {hottest * (name == 'hottest_c')}"
            bad = name in ("faults", "contacts") and values[name] > 0
            tiles.append(Tile(label, f"{values[name]:{form}}", small.rstrip(), bad))
    return tiles


def _event_table(events: Sequence[Event]) -> EventTable | None:
    """The notable events; None if there are none."""
    notable = [e for e in events if e.kind in NOTABLE]
    if not notable:
        return None
    first = sorted(notable, key=lambda e: (NOTABLE.index(e.kind), e.time_s))
    listed, rest = first[:ROWS], first[ROWS:]
    counts = Counter(e.kind for e in notable)
    omitted = _counted(Counter(e.kind for e in rest))
    left_out = f"{len(listed)} of {len(notable)} are listed; left out: {omitted}. The event log has all of them."
    listed.sort(key=lambda e: (e.time_s, e.arm, NOTABLE.index(e.kind)))
    table = Table(
        head=("time", "event", "arm", "job", "reason"),
        rows=tuple((clock(e.time_s), kind_text(e.kind), e.arm, e.job, by_joint(e.reason)) for e in listed),
        numbers=False,
    )
    kinds, moments = [e.kind for e in listed], [_before(event) for event in listed]
    return EventTable(
        counts=f"{_counted(counts)}.",
        omitted=left_out if rest else "",
        lost=bool(counts["lost"]),
        only_lost=len(counts) == 1,
        rows=table.html(style="events", key="events", kinds=kinds, moments=moments),
    )


def _before(event: Event) -> Moment:
    return Moment(max(0.0, event.time_s - BEFORE_S), event.arm)


def _award_table(offers: Sequence[Offer], arms: Sequence[str]) -> Mapping[str, object] | None:
    """Why each arm got its job: the offers behind each award, side by side; None without offers.

    Args:
        offers: In order of time; those of one award are neighbours.
    """
    awards = [list(group) for _, group in groupby(offers, key=lambda o: (o.time_s, o.job))]
    if not awards:
        return None
    every_arm = len(arms) <= MOST_ARMS
    head = ("time", "job", "awarded to", *(arms if every_arm else ("its offer", "best other offers", "", "")))
    rows, moments = list[tuple[str, ...]](), list[Moment]()
    for award in awards[:MOST_AWARDS]:
        winner = next(offer for offer in award if offer.awarded)
        if every_arm:
            of = {offer.arm: offer for offer in award}
            cells = [_offer_text(of[arm]) if arm in of else "" for arm in arms]
        else:
            others = sorted(
                (o for o in award if o.free and not o.awarded), key=lambda o: (o.p_saturation or 0.0, o.arm)
            )
            cells = [_offer_text(winner), *(f"{o.arm}: {_offer_text(o)}" for o in others[:3])]
            cells += [""] * (4 - len(cells))
        rows.append((clock(winner.time_s), winner.job, winner.arm, *cells))
        moments.append(Moment(winner.time_s, winner.arm))
    table = Table(head=head, rows=tuple(rows), numbers=False)
    left = f" The first {MOST_AWARDS} of {len(awards)} are listed; offers.parquet has all of them."
    return {
        "count": len(awards),
        "more": left if len(awards) > MOST_AWARDS else "",
        "rows": table.html(key="choices", moments=moments),
    }


def _offer_text(offer: Offer) -> str:
    if not offer.feasible:
        return CANNOT
    parts = [*scores_text(offer), f"{(offer.duration_s or 0.0) / 60:.0f} min"]
    barred = "" if offer.free else f" ({offer.state if offer.state != 'idle' else 'place or space taken'})"
    return ", ".join(parts) + barred


def _request_table(requests: Sequence[Sequence[str]]) -> Table | None:
    """What people asked of a live fleet, if anything."""
    rows = tuple(tuple(request) for request in requests[-ROWS:])
    caption = f"The last {len(rows)} of {len(requests)}." if len(rows) < len(requests) else ""
    head = ("time", "request", "job or arm", "by")
    return Table(head=head, rows=rows, caption=caption, numbers=False) if rows else None


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[kind]} × {kind_text(kind)}" for kind in NOTABLE if counts.get(kind))


def _provenance(run: Mapping[str, Any]) -> Table:
    """Everything else in `run.json`."""
    rows = list[tuple[str, str]]()
    scenario = {f"scenario {k}": v for k, v in run.get("scenario", {}).items() if k not in ("name", "description")}
    rest = {k: v for k, v in run.items() if k not in ("scenario", "status", "policy", "seed", "requests")}
    for key, value in (rest | scenario).items():
        parts = value.items() if isinstance(value, Mapping) else [("", value)]
        rows += [(f"{key} {part}".strip(), _plain(inner)) for part, inner in parts]
    return Table(head=("", ""), rows=tuple(rows), numbers=False)


def _plain(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(inner)}" for key, inner in value.items())
    if isinstance(value, list | tuple) and any(isinstance(inner, Mapping | list | tuple) for inner in value):
        return f"list of {len(value)}"
    return ", ".join(map(_plain, value)) if isinstance(value, list | tuple) else str(value)


@dataclass(frozen=True, kw_only=True)
class Side:
    """One of two runs of the same jobs."""

    run: Mapping[str, Any]
    """Content of its run.json."""
    events: Sequence[Event]
    arms: Sequence[str]
    time_s: float
    """Simulated time at its end."""
    report: str
    """Path of its report, relative to the page."""
    offers: Sequence[Offer] = field(default=())

    @property
    def name(self) -> str:
        """Name of its policy."""
        return str(self.run.get("policy", "unknown policy"))

    @property
    def faults(self) -> list[Event]:
        """Its faults, in order of time."""
        return sorted((event for event in self.events if event.kind == "fault"), key=lambda event: event.time_s)

    @property
    def verdict(self) -> Verdict:
        """What happened, in words."""
        return verdict(self.run, self.events, schedule(self.events, self.arms, self.time_s), self.offers)


def pair_page(title: str, description: str, sides: tuple[Side, Side]) -> str:
    """Two runs of the same jobs side by side: verdicts, key figures and links to their reports, as one HTML page.

    The same input gives the same text.
    """
    columns = [
        {
            "name": side.name,
            "verdict": side.verdict,
            "other_choices": other_choices(side, other),
            "tiles": key_figures(side.run.get("metrics") or {}),
            "report": quote(side.report),
        }
        for side, other in (sides, sides[::-1])
    ]
    return Page(title=title, template="pair.html", content={"description": description, "sides": columns}).html()


def other_choices(side: Side, other: Side) -> list[str]:
    """Of the job of each fault, what became of it in the other run."""
    lines: list[str] = []
    for job in dict.fromkeys(fault.job for fault in side.faults if fault.job):
        own = [event for event in other.events if event.job == job]
        faults = [event for event in own if event.kind == "fault"]
        finish = next((event for event in own if event.kind == "finish"), None)
        if finish is not None:
            after = f", after {len(faults)} fault{'s' * (len(faults) > 1)}" if faults else " without a fault"
            lines.append(f"Under {other.name}, {finish.arm} finished {job} at {clock(finish.time_s)}{after}.")
        else:
            began = any(event.kind == "award" for event in own)
            lines.append(f"Under {other.name}, {job} was not {'finished' if began else 'begun'}.")
    return lines
