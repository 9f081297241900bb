"""A twin report as one HTML page that opens offline: sections with pictures inside the file, tables and sentences."""

import base64
import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

PNG_HEAD = b"\x89PNG\r\n\x1a\n"
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; form-action 'none'; base-uri 'none'"
_STYLE = """
body { font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; color: #222; max-width: 1080px;
  margin: 24px auto; padding: 0 16px; }
h1 { font-size: 25px; margin: 0 0 6px; }
h2 { font-size: 19px; margin: 38px 0 6px; border-top: 1px solid #e2e2e2; padding-top: 18px; }
h3 { font-size: 15px; margin: 18px 0 4px; }
p, li { max-width: 88ch; overflow-wrap: anywhere; }
p { margin: 5px 0; }
.how { color: #5a5a5a; font-size: 13.5px; }
figure { margin: 14px 0; }
figure img { max-width: 100%; height: auto; border: 1px solid #eee; border-radius: 4px; }
figcaption { color: #444; font-size: 13.5px; max-width: 88ch; }
table { border-collapse: collapse; font-size: 13.5px; margin: 8px 0; }
caption { text-align: left; color: #444; padding: 4px 0; }
th, td { text-align: right; padding: 3px 14px 3px 0; border-bottom: 1px solid #eee; vertical-align: top;
  font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
th { color: #555; font-weight: 600; }
.missed { background: #fbe5e5; color: #8f1414; padding: 6px 12px; border-radius: 4px; }
.whole { background: #e8f3ea; color: #1c6b32; padding: 6px 12px; border-radius: 4px; }
nav a { margin-right: 14px; white-space: nowrap; }
.wide { overflow-x: auto; }
"""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One PNG of a section."""

    name: str
    """Of its file, without the ending."""
    png: bytes
    alt: str
    """What is to be seen, for those who do not see it."""
    caption: str = ""

    def __post_init__(self) -> None:
        if not self.png.startswith(PNG_HEAD):
            raise ValueError(f"Picture.png must be a PNG (got {self.png[:8]!r}).")
        if not self.alt:
            raise ValueError(f"Picture '{self.name}' needs an alt text.")


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of text, the first column names the row."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def __post_init__(self) -> None:
        odd = [row for row in self.rows if len(row) != len(self.head)]
        if odd:
            raise ValueError(f"Every row needs {len(self.head)} cells like the head (got {odd[0]}).")


@dataclass(frozen=True, kw_only=True)
class Section:
    """One question of the report and its answer."""

    key: str
    title: str
    sentences: tuple[str, ...] = ()
    """What was found."""
    how: str = ""
    """How it was computed."""
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)
    """Plain values for report.json."""
    failed: str | None = None
    """Why there is nothing to show; None where all went well."""


def page(title: str, lead: Sequence[str], sections: Sequence[Section]) -> str:
    """The report as HTML text; nothing in it is loaded from elsewhere, and the same input gives the same text."""
    failed = [section for section in sections if section.failed]
    links = "".join(f'<a href="#{_text(s.key)}">{_text(s.title)}</a> ' for s in sections)
    body = [f"<h1>{_text(title)}</h1>", *(f"<p>{_text(line)}</p>" for line in lead), _status(failed, len(sections))]
    body += [f"<nav>{links}</nav>", *(part for section in sections for part in _section(section))]
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{_text(title)}</title>",
            f"<style>{_STYLE}</style>",
            "</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )


def _status(failed: Sequence[Section], count: int) -> str:
    if not failed:
        return f'<p class="whole">All {count} sections were computed.</p>'
    names = ", ".join(section.title for section in failed)
    return f'<p class="missed">{len(failed)} of {count} sections could not be computed: {_text(names)}.</p>'


def _section(section: Section) -> list[str]:
    parts = [f'<section id="{_text(section.key)}">', f"<h2>{_text(section.title)}</h2>"]
    if section.failed:
        parts.append(f'<p class="missed">Not computed: {_text(section.failed)}</p>')
    parts += [f"<p>{_text(sentence)}</p>" for sentence in section.sentences]
    parts += [_figure(picture) for picture in section.pictures]
    parts += [_table(table) for table in section.tables]
    if section.how:
        parts.append(f'<p class="how">How it was computed: {_text(section.how)}</p>')
    return [*parts, "</section>"]


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.png).decode("ascii")
    caption = f"<figcaption>{_text(picture.caption)}</figcaption>" if picture.caption else ""
    return f'<figure><img alt="{_text(picture.alt)}" src="data:image/png;base64,{data}">{caption}</figure>'


def _table(table: Table) -> str:
    head = "".join(f"<th>{_text(cell)}</th>" for cell in table.head)
    rows = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    caption = f"<caption>{_text(table.caption)}</caption>" if table.caption else ""
    return f'<div class="wide"><table>{caption}<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'


def spread(values: Sequence[float], digits: int = 3) -> str:
    """Mean and standard deviation over the seeds as text, `0.941 ± 0.006`; one seed has no deviation."""
    known = [float(v) for v in values if math.isfinite(v)]
    if not known:
        return "–"
    mean = sum(known) / len(known)
    if len(known) == 1:
        return f"{mean:.{digits}f}"
    deviation = math.sqrt(sum((v - mean) ** 2 for v in known) / (len(known) - 1))
    return f"{mean:.{digits}f} ± {deviation:.{digits}f}"


def _text(words: str) -> str:
    return html.escape(words)
