"""HTML pages that open offline: one file with style, tables and figures inside, and nothing loaded from elsewhere."""

import base64
import gzip
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple  # Any: values of JSON
from zipfile import ZipFile

import numpy as np
from markupsafe import Markup

from fleet.errors import FleetError, install
from fleet.telemetry import Telemetry
from scenarios.show.charts import Figure
from scenarios.table import Moment, Table, render, static

Array = np.ndarray

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data: blob:; form-action 'none'; base-uri 'none'"
"""The browser itself prevents every request."""
_PLOTLY_OPTIONS = {
    "responsive": True,
    "displaylogo": False,
    "modeBarButtonsToRemove": ["select2d", "lasso2d"],
    # By default Plotly offers to share the chart on its own server.
    "showSendToCloud": False,
    "plotlyServerURL": "",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """One Plotly figure of a page."""

    key: str
    """Id of the element that holds its data; unique in the page."""
    figure: Figure
    alt: str
    """Text in place of the figure."""
    least_px: int = 0
    """Smallest width, px; on a narrower page it scrolls in its box."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """One question of a report and its answer."""

    key: str = ""
    title: str = ""
    sentences: tuple[str, ...] = ()
    """Findings."""
    how: str = ""
    """Method."""
    charts: tuple[Chart, ...] = ()
    tables: tuple[Table, ...] = ()
    html: str = ""
    """Further content, as Markup."""
    details: tuple[tuple[str, Table | str], ...] = ()
    """Headings, and what a click on each shows: a table, HTML, or text as it is."""
    numbers: Mapping[str, Any] = field(default_factory=dict)  # plain values for report.json
    failed: str | None = None
    """Why there is no result; None for a complete section."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Playback:
    """Shifts of one cell to be played in 3-D, side by side and in step."""

    model: Mapping[str, Any]
    """`fleet.arm.cell.cell_model`."""
    shifts: tuple[str, ...]
    """Each of `packed`."""
    unit_s: float
    """Unit of the figure's time axis."""
    begin: datetime | None = None
    """Date of the begin, with its zone; None if it is unknown."""

    @property
    def clock(self) -> dict[str, object] | None:
        """The begin, ms since 1970, and the name of its zone; of a zone without one, its local time as that in UTC."""
        if self.begin is None:
            return None
        zone = getattr(self.begin.tzinfo, "key", None)
        moment = self.begin if zone else self.begin.replace(tzinfo=UTC)
        return {"ms": 1000 * moment.timestamp(), "zone": zone or "UTC"}


class Badge(NamedTuple):
    """An outcome in a few words."""

    text: str
    good: bool
    moment: Moment | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Head:
    """What a page has above its sections."""

    badges: Sequence[Badge] = ()
    sentences: Sequence[str] = ()
    moments: Mapping[str, Moment] = field(default_factory=dict)
    """Of some of the sentences."""
    remarks: Sequence[str] = ()
    tiles: Sequence[tuple[str, str, str]] = ()
    """Key figures: name, text and style."""
    replay: Playback | None = None
    names: Sequence[str] = ("",)
    """Of the shifts of the replay."""
    links: Mapping[str, str] = field(default_factory=dict)
    """Addresses of reports by name."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Page:
    """A page of sections, with the figures and the replay inside."""

    title: str
    sections: Sequence[Section]
    head: Head = field(default_factory=Head)
    origin: Table | None = None
    """From what its figures come."""
    narrow: bool = True
    """For text, with links to the sections; otherwise for figures over a shift."""
    plan: Mapping[str, Any] | None = None
    """Cell that `layout.js` draws; Any: values of JSON."""

    def html(self) -> str:
        """The whole file; the same page gives the same text."""
        data = self._data()
        values = {
            "title": self.title,
            "sections": self.sections,
            "head": self.head,
            "origin": self.origin,
            "narrow": self.narrow,
            "failed": [each.title for each in self.sections if each.failed],
            "policy": f"script-src 'unsafe-inline'; {_POLICY}" if data else _POLICY,
            "css": Markup(static("page.css")),
            "data": {key: Markup(text) for key, text in data.items()},
            "code": Markup(self._code()) if data else "",
        }
        return str(render("page.html", **values)).lstrip()

    @property
    def charts(self) -> list[Chart]:
        """Of all sections."""
        return [chart for each in self.sections for chart in each.charts]

    def _data(self) -> dict[str, str]:
        """What scripts read, by the id of the element that holds it."""
        data: dict[str, str] = {}
        if self.charts:
            data["plotly"] = _plotly_js()
            data |= {chart.key: _json(chart.figure) for chart in self.charts}
        if self.plan:
            data["layout"] = _json(self.plan)
        if self.head.replay:
            data |= {"three": _packed_three_js(), "cell-model": _json(self.head.replay.model)}
            data |= {f"playback-{number}": shift for number, shift in enumerate(self.head.replay.shifts)}
        return data

    def _code(self) -> str:
        """The scripts, and the function that begins; the replay comes first, since a figure takes longer."""
        replay = self.head.replay
        code = [static(name) for name in ("unpack.js", "figure.js", *(("cell.js", "replay.js") if replay else ()))]
        code += [static("layout.js")] if self.plan else []
        begin = f"startReplay({replay.unit_s},{json.dumps(replay.clock)})" if replay else ""
        play = f'await runLibrary("three");const shift=await {begin};' if replay else ""
        draw = f"const figures=await drawFigures({json.dumps(_PLOTLY_OPTIONS)});" if self.charts else ""
        join = "shift.attach(figures);" if replay and self.charts else ""
        plan = "startLayout();" if self.plan else ""
        start = f'async function start(){{startFilters();{plan}{play}{draw}{join}document.body.dataset.ready="all";}}'
        failed = "start().catch((error)=>{document.title+=' (incomplete)';console.error(error);});"
        return f"{''.join(code)}\n{start}\n{failed}"


def origin_table(origin: Mapping[str, str]) -> Table:
    """From what the figures of a page come, by name."""
    return Table(head=("", ""), rows=tuple(origin.items()), numbers=False)


@cache
def _plotly_js() -> str:
    from plotly.offline import get_plotlyjs

    return compressed(get_plotlyjs().encode())


@cache
def _packed_three_js() -> str:
    return compressed(three_js().encode())


def _json(value: object) -> str:
    """JSON with "<" escaped, so that no name can end the element that holds it."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


# The replays of a page: movement and temperatures of shifts, packed, and three.js.

MOST_VALUES = 3_000_000
"""Joint angles in a page; longer shifts of larger fleets keep fewer moments."""
HEAT_STEP_S = 10.0
"""Motors take minutes to heat up; temperatures keep one moment in this time."""
ANGLE_RAD, HEAT_C, LOAD_KG = 1e-3, 0.1, 0.01
"""Resolution."""
_LIBRARY = re.compile(r"<script>(/\*\*\n \* @license\n \* Copyright [\d-]+ Three\.js Authors\n(?: \*[^\n]*\n)+[^\n]+)")
"""The licence, then the whole library on one line; trimesh's own viewer follows."""


def packed(telemetry: Telemetry, payload_kg: Array | None = None) -> str:
    """Angles, temperatures, modes and payloads of a shift as text: base64 of a gzip stream.

    The stream is a line of JSON that lists the arrays (name, shape, scale, first moment and step in s), then their
    values: 16-bit little-endian integers, [arm, joint, moment] or [arm, moment], each but the first as the
    difference to its predecessor along the moments, modulo 2^16.

    Args:
        telemetry: At least one sample, equally spaced in time. An arm that is absent (NaN) keeps its last values, and
            its mode is -1.
        payload_kg: [sample, arm]; no payloads by default.
    """
    samples, arms = telemetry.mode.shape
    time_s = telemetry.time_s
    step_s = float(np.median(np.diff(time_s))) if samples > 1 else 1.0
    dense = max(1, -(-telemetry.q.size // MOST_VALUES))
    sparse = max(1, round(HEAT_STEP_S / step_s))
    mode = np.where(np.isfinite(telemetry.q[..., 0]), telemetry.mode, np.int8(-1))
    load = np.zeros((samples, arms), np.float32) if payload_kg is None else payload_kg
    arrays = [
        ("q", telemetry.q, ANGLE_RAD, dense),
        ("temp_c", telemetry.temp_c, HEAT_C, sparse),
        ("mode", mode, 1.0, dense),
        ("payload_kg", load, LOAD_KG, dense),
    ]
    listed: list[dict[str, Any]] = [
        {
            "name": name,
            "shape": (arms, *values.shape[2:], len(time_s[::stride])),
            "scale": scale,
            "first_s": float(time_s[0]),
            "step_s": stride * step_s,
        }
        for name, values, scale, stride in arrays
    ]

    parts = [json.dumps(listed, separators=(",", ":")).encode() + b"\n"]
    for _, values, scale, stride in arrays:
        for arm in range(arms):  # one at a time, as large fleets have much
            steps = np.clip(np.round(_filled(values[::stride, arm]) / scale), -(2**15), 2**15 - 1)
            parts.append(np.diff(steps.astype(np.int32).T, axis=-1, prepend=0).astype("<i2").tobytes())
    return compressed(b"".join(parts))


def compressed(content: bytes) -> str:
    """Bytes as base64 of a gzip stream; the same content gives the same text."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def _filled(values: Array) -> Array:
    """Values along the first axis, NaN replaced by the last value before it, or the first after it."""
    known = np.isfinite(values)
    at = np.arange(len(values)).reshape(-1, *[1] * (values.ndim - 1))
    last = np.maximum.accumulate(np.where(known, at, 0))
    last = np.where(np.logical_or.accumulate(known), last, known.argmax(axis=0))
    return np.nan_to_num(np.take_along_axis(values, last, axis=0))


def three_js() -> str:
    """Source of three.js; it defines the global `THREE`.

    Raises:
        FleetError: trimesh is not installed, or is a version that does not carry three.js.
    """
    try:
        package = find_spec("trimesh")  # not imported, which would take 50 MB
        if package is None or package.origin is None:
            raise ModuleNotFoundError("it is not installed")
        with ZipFile(Path(package.origin).parent / "resources/templates/viewer.zip") as packed:
            page = packed.read("viewer.html.template").decode()
    except (ModuleNotFoundError, FileNotFoundError, KeyError) as error:
        raise FleetError(f"Pages in 3-D need trimesh: {install('report')} ({error}).") from error
    library = _LIBRARY.search(page)
    if library is None:
        raise FleetError(f"This version of trimesh carries no three.js: {install('report')}.")
    return library[1]
