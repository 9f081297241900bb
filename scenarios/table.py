"""One table for the terminal, pages, notebooks and documents.

HTML from the templates of this folder: every text is escaped, and control characters are shown.
"""

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import TYPE_CHECKING

from markupsafe import Markup

from fleet.errors import visible

if TYPE_CHECKING:
    from jinja2 import Environment
    from rich.console import Console, ConsoleOptions, Group, RenderResult


MOST_LABEL, LONGEST_NAME, LONGEST_WORD, LEAST_TEXT = 40, 24, 12, 24
"""Characters on the terminal: of a row's label, so that a long name leaves room for the figures; of a label, and of a
word of another column, up to which they are not broken; and of a text that is shortened to fit into a line."""


TABLE_FILES = (".csv", ".xlsx")
"""Endings of files of tables for spreadsheets."""
NUMBER = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]?\d+)?")
FORMULA = re.compile(r"\s*[=+@-](?![\d.,]+(e[+-]?\d+)? ?%?$)")
"""Begin of a text that a spreadsheet would compute; numbers and percentages are none."""


@dataclass(frozen=True)
class Moment:
    """A time of the shift, and the arm to look at; a click on an element with a moment goes there in the replay."""

    time_s: float
    arm: str = ""


@dataclass(frozen=True)
class Column:
    """Heading of a column."""

    name: str
    unit: str = ""
    words: bool = False
    """Whether its cells are words, aligned to the left, in a table of figures."""

    def __str__(self) -> str:
        return f"{self.name}, {self.unit}" if self.unit else self.name


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of text under headings; the first column names the row.

    Raises:
        ValueError: a row has another number of cells than the head.
    """

    head: tuple[str | Column, ...]
    rows: tuple[tuple[str, ...], ...]
    groups: Mapping[int, str] = field(default_factory=dict)
    """Headings within the table, each by the index of the row below it."""
    caption: str = ""
    """Above the table."""
    notes: tuple[str, ...] = ()
    """Sentences below the table."""
    numbers: bool = True
    """Whether all columns but the first hold figures and are aligned to the right; otherwise all hold words."""

    def __post_init__(self) -> None:
        odd = [row for row in self.rows if len(row) != len(self.head)]
        if odd:
            raise ValueError(f"Every row needs {len(self.head)} cells like the head (got {odd[0]}).")

    @classmethod
    def grouped(
        cls,
        head: Sequence[str | Column],
        groups: Mapping[str, Sequence[tuple[str, ...]]],
        *,
        caption: str = "",
        notes: Sequence[str] = (),
    ) -> "Table":
        """A table of figures from the rows of each group by its heading."""
        rows, begins = list[tuple[str, ...]](), dict[int, str]()
        for heading, own in groups.items():
            begins[len(rows)] = heading
            rows += own
        return cls(head=tuple(head), rows=tuple(rows), groups=begins, caption=caption, notes=tuple(notes))

    @property
    def headings(self) -> tuple[str, ...]:
        """Texts of the head."""
        return tuple(map(str, self.head))

    @property
    def words(self) -> tuple[bool, ...]:
        """Whether each column holds words: the first one, all of a table without numbers, and those that say so."""
        named = (isinstance(column, Column) and column.words for column in self.head)
        return tuple(words or not (self.numbers and number) for number, words in enumerate(named))

    def select(self, *columns: int) -> "Table":
        """Some of the columns, by index."""

        def of(cells: Sequence[str]) -> tuple[str, ...]:
            return tuple(cells[column] for column in columns)

        return replace(self, head=tuple(self.head[column] for column in columns), rows=tuple(map(of, self.rows)))

    @property
    def width(self) -> int:
        """Characters of its longest line on a terminal that is wide enough."""
        return sum(self._widths) + 2 * (len(self.head) - 1)

    @property
    def _widths(self) -> list[int]:
        """Of each column, characters."""
        from rich.cells import cell_len

        columns = zip(self.headings, *self.rows, strict=True)
        return [max(cell_len(visible(cell)) for cell in column) for column in columns]

    def _fitted(self, room: int) -> list[int]:
        """Of each column on the terminal, characters; wide ones are narrowed first, down to names or words."""
        from rich.cells import cell_len

        labels = [f"{'  ' * bool(self.groups)}{row[0]}" for row in self.rows]
        first, *others = zip(self.headings, *self.rows, strict=True)
        columns = [(first[0], *labels, *self.groups.values()), *others]
        lines = [[line for cell in column for line in visible(cell, "\n").split("\n")] for column in columns]
        widths = [max(map(cell_len, column)) for column in lines]
        words = [max(map(cell_len, " ".join(column).split()), default=0) for column in lines]
        least = [min(longest, LONGEST_WORD) for longest in words]
        if self.numbers:
            widths[0] = min(widths[0], MOST_LABEL)
            names = max((cell_len(visible(label)) for label in labels), default=0)
            least[0] = max(least[0], min(names, LONGEST_NAME, room - sum(least[1:])))
        while sum(widths) > room and (wide := [i for i, own in enumerate(widths) if own > least[i]]):
            widths[max(wide, key=lambda i: widths[i])] -= 1
        return widths

    def in_lines(self, width: int, leave_out: Sequence[str]) -> "Table":
        """The table with one line for each row on a terminal.

        The last column is shortened, then columns are left out, then the first one is shortened.

        Args:
            width: Of the terminal.
            leave_out: Headings of the columns that may be left out, the first one first.
        """
        table, left_out = self, list(leave_out)
        while left_out and table.width - max(0, table._widths[-1] - LEAST_TEXT) > width:
            gone = left_out.pop(0)
            table = table.select(*(i for i, name in enumerate(table.headings) if name != gone))
        for column in (-1, 0):
            most = max(table._widths[column] - max(0, table.width - width), LEAST_TEXT)
            rows = (list(map(visible, row)) for row in table.rows)
            table = replace(table, rows=tuple(_with_shorter(row, column, most) for row in rows))
        return table

    def split(self) -> Iterator[tuple[str, "Table"]]:
        """Yield each group as a heading and a table without caption and notes."""
        begins = sorted(self.groups)
        for begin, end in zip(begins, [*begins[1:], len(self.rows)], strict=True):
            part = replace(self, rows=self.rows[begin:end], groups={}, caption="", notes=())
            yield self.groups[begin], part

    def rich(self, width: int) -> "Group":
        """For a console of rich of this width, without lines."""
        from rich.console import Group
        from rich.table import Table as RichTable
        from rich.text import Text

        def text(cell: str, style: str = "") -> Text:
            return Text(visible(cell, "\n"), style=style)  # before rich measures its width

        table = RichTable(box=None, pad_edge=False, show_header=any(self.headings))
        widths = self._fitted(width - 2 * (len(self.head) - 1))
        for number, (heading, words) in enumerate(zip(self.headings, self.words, strict=True)):
            style = "bold" if not number and not table.show_header else None
            how = {"overflow": "fold", "width": widths[number], "style": style}
            table.add_column(text(heading), justify="left" if words else "right", **how)
        for index, row in enumerate(self.rows):
            if index in self.groups:
                table.add_row(text(self.groups[index], "bold"))
            label = f"  {row[0]}" if self.groups else row[0]
            table.add_row(text(label), *map(text, row[1:]))
        above = [text(self.caption)] if self.caption else []
        body = [table] if self.rows or table.show_header else []
        return Group(*above, *body, *map(text, self.notes))

    def __str__(self) -> str:
        from rich.console import Console

        text = io.StringIO()
        Console(file=text, width=120).print(self)
        return text.getvalue().rstrip("\n")

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> "RenderResult":
        yield self.rich(options.max_width)

    def html(
        self, *, style: str = "", kinds: Sequence[str] = (), moments: Sequence[Moment] = (), key: str = ""
    ) -> "Markup":
        """For a page.

        Args:
            style: Classes of the page's style sheet; figures are aligned by the class `numbers`, which this adds.
            kinds: A class for each row; none by default.
            moments: Of each row.
            key: With one, a field above the table filters its rows.
        """

        classes = " ".join([*(["numbers"] if self.numbers else []), *style.split()])
        return render("table.html", table=self, style=classes, kinds=kinds, moments=moments, key=key)

    def _repr_html_(self) -> str:
        return str(self.html())

    def markdown(self) -> str:
        """For a document, without caption and notes; cells are Markdown."""
        lines = [self.headings, ("---",) * len(self.head)]
        for index, row in enumerate(self.rows):
            if index in self.groups:
                lines.append((f"**{self.groups[index]}**", *[""] * (len(self.head) - 1)))
            lines.append(row)
        return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)

    def csv(self) -> str:
        """As comma-separated values, with the group of a row, if any, as its first column.

        A text that a spreadsheet would take for a formula has an apostrophe before it.
        """
        text = io.StringIO()
        lines = (["'" * bool(FORMULA.match(cell)) + cell for cell in cells] for cells in self._lines())
        csv.writer(text, lineterminator="\n").writerows(lines)
        return text.getvalue()

    def xlsx(self) -> bytes:
        """As a workbook of one sheet, with the columns of `csv`; figures are numbers, and no text is a formula.

        Raises:
            MissingExtra: openpyxl is not installed.
        """
        from scenarios.extras import require_extra

        require_extra("xlsx")
        book = import_module("openpyxl").Workbook()
        for row, cells in enumerate(self._lines(), start=1):
            for column, text in enumerate(cells, start=1):
                is_number = NUMBER.fullmatch(text) and row > 1
                cell = book.active.cell(row, column, float(text) if is_number else visible(text, "\n"))
                cell.data_type, cell.quotePrefix = "n" if is_number else "s", bool(FORMULA.match(text))
        file = io.BytesIO()
        book.save(file)
        return file.getvalue()

    def content(self, ending: str) -> bytes:
        """Content of a file with one of the endings `TABLE_FILES`; raises as `xlsx`."""
        return self.xlsx() if ending == ".xlsx" else self.csv().encode()

    def _lines(self) -> Iterator[tuple[str, ...]]:
        """Yield the headings, then the rows, each after its group if there are groups."""
        yield (*(["group"] if self.groups else []), *self.headings)
        group: list[str] = []
        for index, row in enumerate(self.rows):
            group = [self.groups[index]] if index in self.groups else group
            yield (*group, *row)


def _with_shorter(row: list[str], column: int, most: int) -> tuple[str, ...]:
    """A row with at most `most` characters in one column."""
    from rich.cells import cell_len, set_cell_size

    if cell_len(row[column]) > most:
        row[column] = f"{set_cell_size(row[column], most - 1).rstrip()}…"
    return tuple(row)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of texts in Markdown."""
    return Table(head=tuple(head), rows=tuple(map(tuple, rows))).markdown()


def render(template: str, **values: object) -> Markup:
    """The text of a template; the same values give the same text."""
    return Markup(_environment().get_template(template).render(values))


@cache
def static(name: str) -> str:
    """A file of `static`."""
    return files("scenarios.show").joinpath("static", name).read_text(encoding="utf-8")


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("scenarios.show"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: visible(value, "\n") if type(value) is str else value,  # not of Markup
    )
