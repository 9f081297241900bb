"""What a person looks at after a run: one HTML file that opens anywhere, also offline."""

import html
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from plotly.offline import get_plotlyjs

from fleet.events import Event
from fleet.schedule import schedule
from fleet.telemetry import Telemetry
from scenarios.figure import figure
from scenarios.gantt import clock

ROWS = 300
"""Most rows of the event table."""

NOTABLE = ("fault", "recover", "return", "warning", "torque_warning", "lost")
"""What the event table shows; where it is too much, the first of these are kept first."""

_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""The browser itself holds the promise that nothing is fetched."""

_OPTIONS = {
    "responsive": True,
    "displaylogo": False,
    "modeBarButtonsToRemove": ["select2d", "lasso2d"],
    # Plotly offers by default to share the chart on its own server.
    "showSendToCloud": False,
    "plotlyServerURL": "",
}

_STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 1320px; padding: 20px 28px 48px; color: #222; background: #fff;
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 22px; margin: 0 0 2px; overflow-wrap: anywhere; }
h2 { font-size: 15px; margin: 28px 0 8px; }
p { margin: 2px 0; max-width: 90ch; overflow-wrap: anywhere; }
.faint { color: #666; }
.status { display: inline-block; margin: 8px 0 0; padding: 2px 10px; border-radius: 4px; font-weight: 600; }
.finished { background: #e8f3ea; color: #1c6b32; }
.interrupted { background: #fbe5e5; color: #a31515; }
.figures { display: grid; grid-template-columns: repeat(6, 1fr); gap: 8px; margin: 18px 0 10px; }
@media (max-width: 900px) { .figures { grid-template-columns: repeat(3, 1fr); } }
.figures div { border: 1px solid #e2e2e2; border-radius: 6px; padding: 7px 10px; }
.figures dt { color: #666; font-size: 12px; }
.figures dd { margin: 0; font-size: 18px; font-weight: 600; font-variant-numeric: tabular-nums; }
.figures small { font-size: 12px; font-weight: 400; color: #666; }
.bad dd { color: #b51d1d; }
table { border-collapse: collapse; font-size: 13px; width: 100%; }
th, td { text-align: left; padding: 3px 12px 3px 0; border-bottom: 1px solid #eee; vertical-align: top;
  overflow-wrap: anywhere; }
th { color: #666; font-weight: 600; }
td.time { font-variant-numeric: tabular-nums; white-space: nowrap; }
#lost:not(:checked) ~ table tr.lost { display: none; }
tr.fault td { color: #b51d1d; font-weight: 600; }
tr.warning td { color: #8a5600; }
details { margin: 8px 0; }
summary { cursor: pointer; color: #444; }
details table { width: auto; margin-top: 6px; }
"""


def report_html(
    run: Mapping[str, Any],
    telemetry: Telemetry,
    events: Sequence[Event],
    arms: Sequence[str],
    *,
    warning_c: float,
    error_c: float,
) -> str:
    """The report of a run as one HTML page; the same input gives the same text.

    Args:
        run: The content of `run.json`; metrics that are missing are left out of the report.
        telemetry: Of the arms in the order of `arms`; may be empty.
        events: The log of the run, in any order.
        warning_c, error_c: Limits of the motor temperature.

    Raises:
        ValueError: the telemetry is of another number of arms, or the log tells what cannot be.
    """
    if telemetry.temp_c.shape[1] != len(arms):
        raise ValueError(f"The telemetry is of {telemetry.temp_c.shape[1]} arms, the fleet has {len(arms)}.")
    events = sorted(events, key=lambda e: (e.time_s, e.arm, e.kind, e.job))
    reached_s = _reached_s(run, telemetry, events)
    plan = schedule(events, arms, reached_s)
    drawing = figure(plan, telemetry, events, arms, warning_c=warning_c, error_c=error_c)
    title = _title(run)
    body = [
        f"<h1>{_text(title)}</h1>",
        *_head(run, arms, reached_s),
        _key_figures(run.get("metrics") or {}),
        '<div id="shift"></div>',
        "<noscript><p>The figure needs JavaScript; everything it needs is in this file.</p></noscript>",
        *_event_table(events),
        _origin(run),
    ]
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{_text(title)}</title>",
            f"<style>{_STYLE}</style>",
            f"<script>{get_plotlyjs()}</script>",
            "</head>\n<body>",
            *body,
            f"<script>{_draw(drawing)}</script>",
            "</body>\n</html>\n",
        ]
    )


def _draw(drawing: Mapping[str, Any]) -> str:
    # "<" escaped, so that no name can end the script element.
    values = json.dumps(drawing, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    options = json.dumps(_OPTIONS, separators=(",", ":"))
    return f'const drawn={values};Plotly.newPlot("shift",drawn.data,drawn.layout,{options});'


def _reached_s(run: Mapping[str, Any], telemetry: Telemetry, events: Sequence[Event]) -> float:
    """How far the shift came, s."""
    last = [float(t) for t in telemetry.time_s[-1:]] + [e.time_s for e in events]
    return max(last, default=float(run.get("scenario", {}).get("horizon_s", 0.0)))


def _title(run: Mapping[str, Any]) -> str:
    scenario = run.get("scenario", {}).get("name", "unnamed scenario")
    return f"{scenario} · {run.get('policy', 'unknown policy')} · seed {run.get('seed', '?')}"


def _head(run: Mapping[str, Any], arms: Sequence[str], reached_s: float) -> list[str]:
    scenario = run.get("scenario", {})
    horizon_s = scenario.get("horizon_s")
    length = f"{_duration(horizon_s)} shift" if horizon_s is not None else "Shift"
    how = [f"{length} of {len(arms)} arm{'s' if len(arms) != 1 else ''}"]
    how += [f"{name} {run[name]}" for name in ("plant", "bus", "difficulty") if run.get(name) is not None]
    status = str(run.get("status", "unknown"))
    words = {
        "finished": "Finished",
        "interrupted": f"Interrupted after {_duration(reached_s)}: everything here covers that part only",
    }.get(status, f"Status: {status}")
    lines = [f"<p>{_text(str(scenario['description']))}</p>"] if scenario.get("description") else []
    look = "finished" if status == "finished" else "interrupted"
    return [
        *lines,
        f'<p class="faint">{_text(" · ".join(how))}</p>',
        f'<p class="status {look}">{_text(words)}</p>',
    ]


Shown = tuple[str, str, bool]
"""Value, small print after it, and whether it is bad news."""


def _key_figures(metrics: Mapping[str, Any]) -> str:
    """The row of figures one looks at first; those without a number are left out."""

    def number(name: str) -> float | None:
        value = metrics.get(name)
        return float(value) if isinstance(value, int | float) and math.isfinite(value) else None

    def one(name: str, shown: Callable[[float], Shown]) -> Shown | None:
        value = number(name)
        return None if value is None else shown(value)

    def of(value: float, whole: float | None) -> Shown:
        return f"{value:,.4g}", "" if whole is None else f" of {whole:,.4g}", False

    peaks = {k: v for k, v in (metrics.get("peak_c") or {}).items() if v is not None and math.isfinite(v)}
    hottest = max(peaks, key=lambda arm: peaks[arm]) if peaks else None
    tiles: dict[str, Shown | None] = {
        "jobs finished": one("finished", lambda v: of(v, number("jobs"))),
        "value": one("value", lambda v: of(v, number("value_offered"))),
        "on time": one("on_time", lambda v: of(v, number("finished"))),
        "tardiness": one("tardiness_min", lambda v: (f"{v:,.1f}", " min", False)),
        "jobs per hour": one("jobs_per_hour", lambda v: (f"{v:.1f}", "", False)),
        "faults": one("faults", lambda v: (f"{v:.0f}", "", v > 0)),
        "above warning": one("above_warning_min", lambda v: (f"{v:,.1f}", " min", False)),
        "hottest motor": None if hottest is None else (f"{peaks[hottest]:.1f} °C", f" {hottest}", False),
        "availability": one("availability", lambda v: (f"{v:.1%}", "", False)),
        "utilisation": one("utilisation", lambda v: (f"{v:.1%}", "", False)),
        "energy to heat": one("energy_wh", lambda v: (f"{v:,.0f}", " Wh", False)),
        "lost claims": one("lost_claims", lambda v: (f"{v:,.0f}", "", False)),
    }
    cells = [
        f"<div{' class=bad' if bad else ''}><dt>{label}</dt><dd>{_text(value)}<small>{_text(small)}</small></dd></div>"
        for label, shown in tiles.items()
        if shown is not None
        for value, small, bad in (shown,)
    ]
    return f'<dl class="figures">{"".join(cells)}</dl>'


def _event_table(events: Sequence[Event]) -> list[str]:
    """The notable events in order of time, and a word on those left out."""
    notable = [e for e in events if e.kind in NOTABLE]
    first = sorted(notable, key=lambda e: (NOTABLE.index(e.kind), e.time_s))
    kept, left = first[:ROWS], first[ROWS:]
    lines = ["<h2>Events</h2>"]
    if not notable:
        return [*lines, "<p>No fault, no warning, no lost claim.</p>"]
    counts = Counter(e.kind for e in notable)
    lines.append(f'<p class="faint">{_counted(counts)}.</p>')
    if left:
        omitted = _counted(Counter(e.kind for e in left))
        lines.append(f"<p>{len(kept)} of {len(notable)} are listed; left out: {omitted}. All are in the event log.</p>")
    if counts["lost"]:
        on = "" if len(counts) > 1 else " checked"
        lines.append(f'<input type="checkbox" id="lost"{on}> <label for="lost">show lost claims</label>')
    lines.append("<table><thead><tr><th>time</th><th>what</th><th>arm</th><th>job</th><th>why</th></tr></thead><tbody>")
    for e in sorted(kept, key=lambda e: (e.time_s, e.arm, NOTABLE.index(e.kind))):
        cells = "".join(f"<td>{_text(word)}</td>" for word in (_words(e.kind), e.arm, e.job, e.reason))
        lines.append(f'<tr class="{e.kind}"><td class="time">{clock(e.time_s)}</td>{cells}</tr>')
    return [*lines, "</tbody></table>"]


def _words(kind: str) -> str:
    return {"lost": "claim lost", "return": "job returned", "recover": "recovered"}.get(kind, kind.replace("_", " "))


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[kind]} × {_words(kind)}" for kind in NOTABLE if counts.get(kind))


def _origin(run: Mapping[str, Any]) -> str:
    """All else that the run says about itself, folded away."""
    rows = []
    scenario = {f"scenario {k}": v for k, v in run.get("scenario", {}).items() if k not in ("name", "description")}
    rest = {k: v for k, v in run.items() if k not in ("scenario", "status", "policy", "seed")}
    for key, value in (rest | scenario).items():
        parts = value.items() if isinstance(value, Mapping) else [("", value)]
        rows += [(f"{key} {part}".strip(), inner) for part, inner in parts]
    cells = "".join(f"<tr><td>{_text(key)}</td><td>{_text(_said(v))}</td></tr>" for key, v in rows)
    return f"<details><summary>How this run was made, and all its figures</summary><table>{cells}</table></details>"


def _said(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_said(inner)}" for key, inner in value.items())
    if isinstance(value, list | tuple) and any(isinstance(inner, Mapping | list | tuple) for inner in value):
        return f"{len(value)} of them"
    return ", ".join(map(_said, value)) if isinstance(value, list | tuple) else str(value)


def _duration(time_s: float) -> str:
    """3 h, 54 min, 1 h 30 min, 20 s."""
    hours, minutes = divmod(round(time_s / 60), 60)
    if time_s < 60:
        return f"{time_s:.0f} s"
    return " ".join(f"{n} {unit}" for n, unit in ((hours, "h"), (minutes, "min")) if n)


def _text(words: str) -> str:
    return html.escape(words)
