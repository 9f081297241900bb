"""HTML pages that open offline: one file with style, tables and figures inside, and nothing loaded from elsewhere."""

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any  # values of JSON

from fleet.errors import visible
from scenarios.report.playback import compressed
from scenarios.report.three import three_js

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


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of text; the first column names the row."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def __post_init__(self) -> None:
        odd = [row for row in self.rows if len(row) != len(self.head)]
        if odd:
            raise ValueError(f"Every row needs {len(self.head)} cells like the head (got {odd[0]}).")


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
    tables: tuple[Table, ...] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)  # plain values for report.json
    failed: str | None = None
    """Why there is no result; None for a complete section."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """A shift to be played in 3-D."""

    model: Mapping[str, Any]
    """`fleet.physics.cell_model.cell_model`."""
    playback: str
    """`scenarios.report.playback.packed`."""
    unit_s: float
    """Unit of the figure's time axis."""


def sections_page(title: str, lead: Sequence[str], sections: Sequence[Section]) -> str:
    """A report in sections, as HTML text; the same input gives the same text."""
    failed = [section for section in sections if section.failed]
    status = paragraph(f"All {len(sections)} sections were computed.", "status good")
    if failed:
        names = ", ".join(section.title for section in failed)
        status = paragraph(f"{len(failed)} of {len(sections)} sections could not be computed: {names}.", "status bad")
    links = "".join(f'<a href="#{escape(s.key)}">{escape(s.title)}</a> ' for s in sections)
    body = [*map(paragraph, lead), status, f"<nav>{links}</nav>", *(part for s in sections for part in _section(s))]
    return html_page(title, body, narrow=True)


def html_page(
    title: str,
    body: Iterable[str],
    *,
    figure: Mapping[str, Any] | None = None,
    replay: Replay | None = None,
    narrow: bool = False,
) -> str:
    """A whole page.

    Args:
        body: HTML elements below the heading.
        figure: Data and layout of a Plotly figure; drawn into `figure_place()`.
        replay: A shift in 3-D; played in `replay_place()`.
        narrow: For text; the default width is for figures over a shift.
    """
    parts = [*(_figure_parts(figure) if figure is not None else ()), *(_replay_parts(replay) if replay else ())]
    scripts = "\n".join(parts)
    if parts:
        start = "start().catch((error)=>{document.title+=' (incomplete)';console.error(error);});"
        code = [_source(name) for name in ("unpack.js", "figure.js", *(("cell.js", "replay.js") if replay else ()))]
        scripts += f"\n<script>{''.join(code)}\n{_start(figure is not None, replay)}\n{start}</script>\n"
    policy = f"script-src 'unsafe-inline'; {_POLICY}" if parts else _POLICY
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_source('page.css')}</style>\n</head>\n"
        f"<body class='{'narrow' if narrow else 'wide-figures'}'>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(body)
        + f"\n{scripts}</body>\n</html>\n"
    )


def _figure_parts(figure: Mapping[str, Any]) -> list[str]:
    from plotly.offline import get_plotlyjs

    return [_data("plotly", compressed([get_plotlyjs().encode()])), _data("drawn", _json(figure))]


def _replay_parts(replay: Replay) -> list[str]:
    return [
        _data("three", compressed([three_js().encode()])),
        _data("cell-model", _json(replay.model)),
        _data("playback", replay.playback),
    ]


def _start(figure: bool, replay: Replay | None) -> str:
    """The function that begins a page; the replay comes first, since a figure takes longer."""
    play = f'await runLibrary("three");const shift=await startReplay({replay.unit_s});' if replay else ""
    draw = f"const figure=await drawFigure({json.dumps(_PLOTLY_OPTIONS)});" if figure else ""
    join = "shift.attach(figure);" if replay and figure else ""
    return f'async function start(){{startFilters();{play}{draw}{join}document.body.dataset.ready="all";}}'


def _data(key: str, text: str) -> str:
    """An element that holds text for a script and is not run."""
    return f'<script type="text/plain" id="{key}">{text}</script>'


def _json(value: object) -> str:
    """JSON with "<" escaped, so that no name can end the element that holds it."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


@cache
def _source(name: str) -> str:
    """A file of `static`."""
    return files("scenarios.report").joinpath("static", name).read_text(encoding="utf-8")


def replay_place() -> str:
    """The element in which a shift is played."""
    speeds = "".join(f'<option value="{s}"{" selected" if s == 60 else ""}>{s} ×</option>' for s in (1, 10, 60, 240))
    return (
        '<section class="replay" aria-label="The shift in three dimensions"><div id="cell"></div>'
        '<pre id="now" aria-live="off"></pre><div class="controls">'
        '<button id="play" type="button" aria-label="play">▶</button>'
        '<input id="time" type="range" min="0" max="1" value="0" aria-label="time of the shift">'
        f'<output id="clock">0:00:00</output><select id="speed" aria-label="speed">{speeds}</select>'
        '<select id="arm" aria-label="arm to look at"><option value="-1">all arms</option></select>'
        "</div></section>"
    )


def figure_place() -> str:
    """The element that holds the page's Plotly figure."""
    notice = "The figure needs JavaScript; everything it needs is in this file."
    return f'<div id="figure"></div>\n<noscript>{paragraph(notice)}</noscript>'


@dataclass(frozen=True)
class Moment:
    """A time of the shift, and the arm to look at; a click on an element with a moment goes there in the replay."""

    time_s: float
    arm: str = ""

    @property
    def marks(self) -> str:
        """Attributes of the element."""
        return f' data-time="{self.time_s:g}" data-arm="{escape(self.arm)}"'


def paragraph(text: str, style: str = "", moment: Moment | None = None) -> str:
    """A paragraph of plain text; `style` is a class of the page's style sheet."""
    marks = (f' class="{style}"' if style else "") + (moment.marks if moment else "")
    return f"<p{marks}>{escape(text)}</p>"


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    caption: str = "",
    style: str = "",
    kinds: Sequence[str] = (),
    moments: Sequence[Moment] = (),
    key: str = "",
) -> str:
    """A table of plain text.

    Args:
        kinds: A class of the style sheet for each row; none by default.
        moments: Of each row.
        key: With one, a field above the table filters its rows.
    """
    lines = []
    for i, row in enumerate(rows):
        marks = f' class="{escape(kinds[i])}"' if kinds else ""
        if moments:
            marks += moments[i].marks
        lines.append(f"<tr{marks}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>")
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    if head:
        above += f"<thead><tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr></thead>"
    field = (
        f'<input class="filter" data-table="{key}" placeholder="filter: arm, job, …" aria-label="filter rows">'
        if key
        else ""
    )
    mark = f' id="{key}"' if key else ""
    return f'{field}<div class="wide"><table{mark} class="{style}">{above}<tbody>{"".join(lines)}</tbody></table></div>'


def escape(text: str) -> str:
    """Text as HTML that shows it unchanged."""
    return html.escape(visible(text, "\n"))


def _section(section: Section) -> list[str]:
    parts = [f'<section id="{escape(section.key)}">', f"<h2>{escape(section.title)}</h2>"]
    if section.failed:
        parts.append(paragraph(f"Not computed: {section.failed}", "status bad"))
    parts += map(paragraph, section.sentences)
    for picture in section.pictures:
        data = base64.b64encode(picture.png).decode("ascii")
        parts.append(f'<figure><img alt="{escape(picture.alt)}" src="data:image/png;base64,{data}"></figure>')
    parts += [table(t.head, t.rows, caption=t.caption, style="numbers") for t in section.tables]
    if section.how:
        parts.append(paragraph(f"Method: {section.how}", "faint"))
    return [*parts, "</section>"]
