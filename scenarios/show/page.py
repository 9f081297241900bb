"""HTML pages that open offline: one file with style, tables and figures inside, and nothing loaded from elsewhere."""

import base64
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any  # values of JSON

from markupsafe import Markup

from fleet.errors import visible
from scenarios.show.replay import compressed, three_js
from scenarios.show.table import Table, render, static

Figure = Mapping[str, Any]
"""`data` and `layout` in Plotly's schema: a plain dict, because Plotly's own objects take longer than a report."""

PNG_HEAD = b"\x89PNG\r\n\x1a\n"
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
INK, GRID, FRAME = "#222222", "#e6e6e6", "#bbbbbb"
LAYOUT = {
    "template": "none",
    "font": {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "hovermode": "closest",
    "hoverlabel": {"align": "left", "bgcolor": "white", "bordercolor": FRAME, "font": {"color": INK}},
}
"""Of every figure; a dark page changes its colours."""
AXIS = {"showgrid": True, "gridcolor": GRID, "zeroline": False, "linecolor": FRAME, "ticks": "outside"}


def plain(text: str, most: int | None = None) -> str:
    """Text escaped for Plotly, which interprets some HTML and `%{…}`; with `most`, its start and end are kept."""
    shown = visible(text)
    if most is not None and len(shown) > most:
        shown = f"{shown[: most - most // 2 - 1]}…{shown[-(most // 2) :]}"
    return html.escape(shown, quote=False).replace("%{", "%&#123;")


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One PNG of a section."""

    name: str
    """File name without its ending."""
    png: bytes
    alt: str
    """Text in place of the picture."""

    def __post_init__(self) -> None:
        if not self.png.startswith(PNG_HEAD):
            raise ValueError(f"Picture.png must be a PNG (got {self.png[:8]!r}).")
        if not self.alt:
            raise ValueError(f"Picture '{self.name}' needs an alt text.")

    @property
    def base64(self) -> str:
        """The PNG as text."""
        return base64.b64encode(self.png).decode("ascii")


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """One Plotly figure of a page."""

    key: str
    """Id of the element that holds its data; unique in the page."""
    figure: Figure
    alt: str
    """Text in place of the figure."""
    shrinks: bool = True
    """Whether it is readable on a phone; if not, it keeps its width there and is scrolled."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """One question of a report and its answer."""

    key: str = ""
    title: str = ""
    sentences: tuple[str, ...] = ()
    """Findings."""
    how: str = ""
    """Method."""
    pictures: tuple[Picture, ...] = ()
    charts: tuple[Chart, ...] = ()
    tables: tuple[Table, ...] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)  # plain values for report.json
    failed: str | None = None
    """Why there is no result; None for a complete section."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """A shift to be played in 3-D."""

    model: Mapping[str, Any]
    """`fleet.arm.cell.cell_model`."""
    playback: str
    """`scenarios.show.replay.packed`."""
    unit_s: float
    """Unit of the figure's time axis."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Page:
    """A page: a template, what it shows, and the figures and the replay whose places are in the template."""

    title: str
    template: str
    content: Mapping[str, object]
    """Values of the template."""
    charts: Sequence[Chart] = ()
    replay: Replay | None = None
    narrow: bool = False
    """For text; the default width is for figures over a shift."""

    def html(self) -> str:
        """The whole file; the same page gives the same text."""
        data = self._data()
        policy = f"script-src 'unsafe-inline'; {_POLICY}" if data else _POLICY
        own = {"title": self.title, "narrow": self.narrow, "policy": policy, "css": Markup(static("page.css"))}
        held = {key: Markup(text) for key, text in data.items()}
        code = Markup(self._code()) if data else ""
        return str(render(self.template, **self.content, **own, data=held, code=code))

    def _data(self) -> dict[str, str]:
        """What scripts read, by the id of the element that holds it."""
        data: dict[str, str] = {}
        if self.charts:
            from plotly.offline import get_plotlyjs

            data["plotly"] = compressed([get_plotlyjs().encode()])
            data |= {chart.key: _json(chart.figure) for chart in self.charts}
        if self.replay:
            data["three"] = compressed([three_js().encode()])
            data |= {"cell-model": _json(self.replay.model), "playback": self.replay.playback}
        return data

    def _code(self) -> str:
        """The scripts, and the function that begins; the replay comes first, since a figure takes longer."""
        replay = self.replay
        code = [static(name) for name in ("unpack.js", "figure.js", *(("cell.js", "replay.js") if replay else ()))]
        play = f'await runLibrary("three");const shift=await startReplay({replay.unit_s});' if replay else ""
        draw = f"const figure=await drawFigures({json.dumps(_PLOTLY_OPTIONS)});" if self.charts else ""
        join = "shift.attach(figure);" if replay and self.charts else ""
        start = f'async function start(){{startFilters();{play}{draw}{join}document.body.dataset.ready="all";}}'
        failed = "start().catch((error)=>{document.title+=' (incomplete)';console.error(error);});"
        return f"{''.join(code)}\n{start}\n{failed}"


def sections_page(title: str, lead: Sequence[str], sections: Sequence[Section]) -> str:
    """A report in sections, as HTML text; the same input gives the same text."""
    failed = [section.title for section in sections if section.failed]
    content = {"lead": lead, "sections": sections, "failed": failed}
    charts = [chart for section in sections for chart in section.charts]
    return Page(title=title, template="sections.html", content=content, charts=charts, narrow=True).html()


def _json(value: object) -> str:
    """JSON with "<" escaped, so that no name can end the element that holds it."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
