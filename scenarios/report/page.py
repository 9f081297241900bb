"""HTML pages that open offline: one file with style, tables and figures inside, and nothing loaded from elsewhere."""

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any  # values of JSON

from fleet.errors import visible

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
_STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 1320px; padding: 20px 28px 48px; color: #222; background: #fff;
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
body.narrow { max-width: 1080px; font-size: 15px; }
h1 { font-size: 23px; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 17px; margin: 28px 0 8px; }
section h2 { margin-top: 38px; border-top: 1px solid #e2e2e2; padding-top: 18px; }
p { margin: 4px 0; max-width: 90ch; overflow-wrap: anywhere; }
.faint { color: #666; font-size: 13px; }
.status { display: inline-block; margin: 8px 0; padding: 2px 10px; border-radius: 4px; font-weight: 600; }
.good { background: #e8f3ea; color: #1c6b32; }
.bad { background: #fbe5e5; color: #a31515; }
.figures { display: grid; grid-template-columns: repeat(6, 1fr); gap: 8px; margin: 18px 0 10px; }
@media (max-width: 900px) { .figures { grid-template-columns: repeat(3, 1fr); } }
.figures div { border: 1px solid #e2e2e2; border-radius: 6px; padding: 7px 10px; }
.figures div.bad { background: none; }
.figures dt { color: #666; font-size: 12px; }
.figures dd { margin: 0; font-size: 18px; font-weight: 600; font-variant-numeric: tabular-nums; }
.figures small { font-size: 12px; font-weight: 400; color: #666; }
figure { margin: 14px 0; }
figure img { max-width: 100%; height: auto; border: 1px solid #eee; border-radius: 4px; }
table { border-collapse: collapse; font-size: 13px; margin: 8px 0; }
caption { text-align: left; color: #444; padding: 4px 0; }
th, td { text-align: left; padding: 3px 14px 3px 0; border-bottom: 1px solid #eee; vertical-align: top;
  overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }
table.numbers th:not(:first-child), table.numbers td:not(:first-child) { text-align: right; }
table.events { width: 100%; }
th { color: #555; font-weight: 600; }
#lost:not(:checked) ~ div tr.lost { display: none; }
tr.fault td, tr.contact td { color: #b51d1d; font-weight: 600; }
tr.warning td { color: #8a5600; }
.wide { overflow-x: auto; }
nav a { margin-right: 14px; white-space: nowrap; }
details { margin: 8px 0; }
summary { cursor: pointer; color: #444; }
"""


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


def html_page(title: str, body: Iterable[str], *, figure: Mapping[str, Any] | None = None, narrow: bool = False) -> str:
    """A whole page.

    Args:
        body: HTML elements below the heading.
        figure: Data and layout of a Plotly figure; drawn into `figure_place()`.
        narrow: For text; the default width is for figures over a shift.
    """
    policy, head, end = _POLICY, "", ""
    if figure is not None:
        from plotly.offline import get_plotlyjs

        policy = f"script-src 'unsafe-inline'; {_POLICY}"
        # "<" escaped, so that no name can end the script element.
        values = json.dumps(figure, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
        options = json.dumps(_PLOTLY_OPTIONS, separators=(",", ":"))
        head = f"<script>{get_plotlyjs()}</script>\n"
        end = f'<script>const drawn={values};Plotly.newPlot("figure",drawn.data,drawn.layout,{options});</script>\n'
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n{head}</head>\n"
        f"<body class='{'narrow' if narrow else 'wide-figures'}'>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(body)
        + f"\n{end}</body>\n</html>\n"
    )


def figure_place() -> str:
    """The element that holds the page's Plotly figure."""
    notice = "The figure needs JavaScript; everything it needs is in this file."
    return f'<div id="figure"></div>\n<noscript>{paragraph(notice)}</noscript>'


def paragraph(text: str, style: str = "") -> str:
    """A paragraph of plain text; `style` is a class of the page's style sheet."""
    return f'<p class="{style}">{escape(text)}</p>' if style else f"<p>{escape(text)}</p>"


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str = "", style: str = "", kinds: Sequence[str] = ()
) -> str:
    """A table of plain text.

    Args:
        kinds: A class of the style sheet for each row; none by default.
    """
    classes = [f' class="{escape(kind)}"' for kind in kinds]
    lines = [
        f"<tr{classes[i] if classes else ''}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>"
        for i, row in enumerate(rows)
    ]
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    if head:
        above += f"<thead><tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr></thead>"
    return f'<div class="wide"><table class="{style}">{above}<tbody>{"".join(lines)}</tbody></table></div>'


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
