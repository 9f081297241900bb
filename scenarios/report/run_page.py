"""The report of a run: one HTML file that opens offline."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any  # values of run.json

from fleet.env.render.heat import heat_scale
from fleet.events import Event
from fleet.telemetry import Telemetry
from scenarios.report.choices import choices
from scenarios.report.gantt import clock
from scenarios.report.page import Moment, Replay, escape, figure_place, html_page, paragraph, replay_place, table
from scenarios.report.playback import packed, payloads
from scenarios.report.schedule import schedule
from scenarios.report.timeline import figure, time_unit
from scenarios.report.verdict import Verdict, duration, verdict
from scenarios.shift_records import Offer

NO_PAYLOADS: Mapping[str, float] = {}
ROWS = 300
"""Most rows of the event table."""

BEFORE_S = 5.0
"""A click on an event goes to this time before it."""

NOTABLE = ("fault", "contact", "recover", "return", "warning", "torque_warning", "lost")
"""Event kinds of the event table, most important first; the least important are dropped first."""


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
    body = [
        *_head(run, arms, verdict(run, events, plan, offers)),
        key_figures(run.get("metrics") or {}),
        *([replay_place()] if replay else []),
        figure_place(),
        *_event_table(events),
        *choices(offers, arms),
        *_request_table(run.get("requests") or ()),
        _provenance(run),
    ]
    scenario = run.get("scenario", {}).get("name", "unnamed scenario")
    title = f"{scenario} · {run.get('policy', 'unknown policy')}" + (f" · seed {run['seed']}" if "seed" in run else "")
    return html_page(title, body, figure=drawing, replay=replay)


def _head(run: Mapping[str, Any], arms: Sequence[str], told: Verdict) -> list[str]:
    scenario = run.get("scenario", {})
    horizon_s = scenario.get("horizon_s")
    length = f"{duration(horizon_s)} shift" if horizon_s is not None else "Shift"
    how = [f"{length} of {len(arms)} arm{'s' if len(arms) != 1 else ''}"]
    how += [f"{name} {run[name]}" for name in ("plant", "bus", "difficulty") if run.get(name) is not None]
    lines = [paragraph(str(scenario["description"]), "faint")] if scenario.get("description") else []
    moments = {sentence: _before(fault) for sentence, fault in told.faults.items()}
    first = next(iter(moments.values()), None)
    return [
        paragraph(told.badge, "status good" if told.good else "status bad", first),
        *(paragraph(sentence, "verdict", moments.get(sentence)) for sentence in told.sentences),
        *lines,
        paragraph(" · ".join(how), "faint"),
    ]


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
    ("availability", "availability", ".1%", "", ""),
    ("utilisation", "utilisation", ".1%", "", ""),
    ("energy to heat", "energy_wh", ",.0f", " Wh", ""),
    ("claims lost to another arm", "lost_claims", ",.0f", "", ""),
)
"""Label, metric, format, unit, and the metric it is a part of."""


def key_figures(metrics: Mapping[str, Any]) -> str:
    """The most important metrics as a row of tiles; metrics without a number are left out."""
    values = {k: float(v) for k, v in metrics.items() if isinstance(v, int | float) and math.isfinite(v)}
    peaks = {k: v for k, v in (metrics.get("peak_c") or {}).items() if v is not None and math.isfinite(v)}
    hottest = max(peaks, key=lambda arm: peaks[arm], default="")
    if hottest:
        values["hottest_c"] = peaks[hottest]
    tiles = []
    for label, name, form, unit, whole in KEY_FIGURES:
        if name in values and (name != "contacts" or values[name] > 0):
            small = f" of {values[whole]:{form}}" if whole in values else f"{unit} {hottest * (name == 'hottest_c')}"
            style = ' class="bad"' if name in ("faults", "contacts") and values[name] > 0 else ""
            number = f"<dd>{values[name]:{form}}<small>{escape(small.rstrip())}</small></dd>"
            tiles.append(f"<div{style}><dt>{label}</dt>{number}</div>")
    return f'<dl class="figures">{"".join(tiles)}</dl>'


def _event_table(events: Sequence[Event]) -> list[str]:
    """The notable events by time, and the number of events without a row."""
    notable = [e for e in events if e.kind in NOTABLE]
    first = sorted(notable, key=lambda e: (NOTABLE.index(e.kind), e.time_s))
    listed, rest = first[:ROWS], first[ROWS:]
    lines = ["<h2>Events</h2>"]
    if not notable:
        return [*lines, paragraph("No fault, no warning, no lost claim.")]
    counts = Counter(e.kind for e in notable)
    lines.append(paragraph(f"{_counted(counts)}.", "faint"))
    if rest:
        omitted = _counted(Counter(e.kind for e in rest))
        lines.append(
            paragraph(
                f"{len(listed)} of {len(notable)} are listed; left out: {omitted}. The event log has all of them."
            )
        )
    if counts["lost"]:
        on = "" if len(counts) > 1 else " checked"
        lines.append(f'<input type="checkbox" id="lost"{on}> <label for="lost">show lost claims</label>')
    listed.sort(key=lambda e: (e.time_s, e.arm, NOTABLE.index(e.kind)))
    rows = [(clock(e.time_s), _label(e.kind), e.arm, e.job, e.reason) for e in listed]
    head = ("time", "event", "arm", "job", "reason")
    return [
        *lines,
        table(
            head,
            rows,
            style="events",
            key="events",
            kinds=[e.kind for e in listed],
            moments=[_before(event) for event in listed],
        ),
    ]


def _before(event: Event) -> Moment:
    return Moment(max(0.0, event.time_s - BEFORE_S), event.arm)


def _request_table(requests: Sequence[Sequence[str]]) -> list[str]:
    """What people asked of a live fleet, if anything."""
    if not requests:
        return []
    rows = [tuple(request) for request in requests[-ROWS:]]
    lines = ["<h2>Requests of people</h2>"]
    if len(rows) < len(requests):
        lines.append(paragraph(f"The last {len(rows)} of {len(requests)}.", "faint"))
    return [*lines, table(("time", "request", "job or arm", "by"), rows)]


def _label(kind: str) -> str:
    return {"lost": "claim lost", "return": "job returned", "recover": "recovered"}.get(kind, kind.replace("_", " "))


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[kind]} × {_label(kind)}" for kind in NOTABLE if counts.get(kind))


def _provenance(run: Mapping[str, Any]) -> str:
    """Everything else in `run.json`, folded away."""
    rows = []
    scenario = {f"scenario {k}": v for k, v in run.get("scenario", {}).items() if k not in ("name", "description")}
    rest = {k: v for k, v in run.items() if k not in ("scenario", "status", "policy", "seed", "requests")}
    for key, value in (rest | scenario).items():
        parts = value.items() if isinstance(value, Mapping) else [("", value)]
        rows += [(f"{key} {part}".strip(), _plain(inner)) for part, inner in parts]
    return f"<details><summary>Provenance and all figures</summary>{table((), rows)}</details>"


def _plain(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(inner)}" for key, inner in value.items())
    if isinstance(value, list | tuple) and any(isinstance(inner, Mapping | list | tuple) for inner in value):
        return f"list of {len(value)}"
    return ", ".join(map(_plain, value)) if isinstance(value, list | tuple) else str(value)
