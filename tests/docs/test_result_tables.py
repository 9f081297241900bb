"""Tables of figures on the pages are made from files by `docs/tables.py`, or stand in a list with the reason."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MADE = re.compile(r"<!-- made by [^:>]+: \w+ -->.*?<!-- end -->", re.DOTALL)
FIGURE = re.compile(r"^\W*\d|\d\.\d")
"""In a cell: it begins with a number (after a sign, `**` and the like), or has a decimal one."""
SHARE = 1 / 6
"""Least share of figures among the cells of a table of figures, without the first column."""

BY_HAND = {
    ("docs/concepts/cooling.md", "°C"): "published limits",
    ("docs/concepts/cooling.md", "contact"): "published limits",
    ("docs/faults.md", "fault"): "`make chaos` prints it: half an hour of real processes",
    ("docs/identification.md", "question"): "`benchmarks.paper` prints it, from logs that are not in the repository",
    (
        "docs/performance.md",
        "env steps per CPU-second, unless a unit is given",
    ): "times of one machine; `make bench-env`",
    ("docs/performance.md", ""): "times of one machine; the commands beside the tables print them",
    ("docs/performance.md", "what"): "times of one machine; the commands in the table print them",
    ("docs/performance.md", "arms"): "times of one machine; `benchmarks/bench_exchange.py` prints them",
    (
        "docs/results/twin.md",
        "scenario",
    ): "`benchmarks.paper reliability` prints it: an hour",
    ("docs/results/twin.md", "question"): "hours; the commands are beside it",
    ("docs/ros2.md", "ROS 2"): "settings",
    ("docs/scaling.md", ""): "to be made from files",
    ("docs/scaling.md", "arms, sites"): "to be made from files",
    ("docs/scaling.md", "what fails first"): "calculated from the table above it",
    ("docs/scaling.md", "asked"): "to be made from files",
    ("docs/security.md", ""): "times of one machine; `benchmarks/bench_tls.py` prints them",
    ("docs/several_machines.md", "fault"): "`make mesh` prints it: 256 arms",
    ("docs/suite.md", "split"): "the definition of the suite",
    ("docs/suite.md", "axis of a cell"): "the definition of the suite",
    ("docs/trainers.md", "trainer"): "versions",
}
"""Tables that are kept by hand, by page and first heading, and why."""


def tables_of_figures(text: str) -> list[str]:
    """First headings of the tables of figures that no command makes."""
    found = list[str]()
    for block in re.findall(r"(?:^ *\|.*\n?)+", MADE.sub("", text), re.MULTILINE):
        rows = [
            [cell.strip() for cell in line.strip().split("|")[1:-1]] for line in block.replace("\\|", "").splitlines()
        ]
        cells = [cell for row in rows[2:] for cell in row[1:]]
        if sum(FIGURE.search(cell) is not None for cell in cells) >= SHARE * len(cells):
            found.append(rows[0][0])
    return found


def test_figures_come_from_files() -> None:
    by_hand = {
        (page.relative_to(ROOT).as_posix(), head)
        for page in PAGES
        for head in tables_of_figures(page.read_text(encoding="utf-8"))
    }
    assert not by_hand - BY_HAND.keys(), "Make the table from a file (docs/tables.py)."
    assert not BY_HAND.keys() - by_hand, "The list has tables that the pages no longer have by hand."


def test_a_table_of_figures_without_a_mark_is_found() -> None:
    figures = "| policy | value |\n|---|---|\n| `wspt` | **+3.1 (+2.0 … +4.2)** |\n"
    words = "| option | meaning |\n|---|---|\n| `--seeds` | number of seeds, 20 by default |\n"
    marked = f"<!-- made by docs/tables.py: ladder -->\n\n{figures}\n<!-- end -->\n"
    assert tables_of_figures(f"{words}\n{marked}\n{figures}") == ["policy"]
