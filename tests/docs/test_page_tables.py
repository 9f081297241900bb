"""Tables and figures of the pages are made from files and current, and the site needs no network."""

import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import observed_bytes, step_figures
from benchmarks.paper.cooling import cooling_tables
from benchmarks.paper.features import INPUTS, feature_tables
from benchmarks.result_tables import difference, env_table, steps_table
from docs.tables import share_of_gain
from scenarios.evaluate.scores import Normalised


def cells(text: str) -> list[list[str]]:
    """The rows of a Markdown table without its headings."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]]


def test_a_difference_is_bold_if_its_interval_excludes_zero() -> None:
    assert difference(-6.04, -10.36, -2.5) == "**−6.0 (−10.4 … −2.5)**"
    assert difference(0.5, -1.0, 2.0, 2) == "+0.50 (−1.00 … +2.00)"
    assert difference(0.0, math.nan, math.nan) == "+0.0"
    assert difference(1.0, None, None) == "+1.0"


def test_the_share_of_a_gain_has_fiellers_interval() -> None:
    """Second method: the roots of Fieller's quadratic with Student's t, for instances without cells and no skewness."""
    blind, whole = np.zeros(40), 2.0 + 0.4 * np.tile([-1.0, 1.0], 20)
    gain = 1.0 + 0.4 * np.repeat([-1.0, 1.0], 20)
    names = tuple(f"{n}" for n in range(40))
    score = {"blind": blind[None], "rc": gain[None], "oracle": whole[None]}
    found = share_of_gain(Normalised(names, names, score, np.ones(40)), "rc")
    t2 = 2.0227**2 / 40  # t of 39 degrees of freedom at .975
    (a, b), (_, c) = np.cov(gain, whole)
    p = np.array([2.0**2 - t2 * c, -2.0 * (1.0 * 2.0 - t2 * b), 1.0**2 - t2 * a])
    low, high = sorted(np.roots(p).tolist())
    best, ends = found.split(" ", 1)
    assert best == "0.50"
    assert json.loads(ends) == pytest.approx([low, high], abs=0.006)
    assert share_of_gain(Normalised(names, names, score, np.ones(40)), "oracle") == "1"
    assert share_of_gain(Normalised(names, names, score, np.ones(40)), "blind") == "0"


def test_an_interval_of_r2_ends_at_one() -> None:
    rows = [
        {"estimates": [{"target": "t", "labels": 5, "inputs": each, "r2": r2} for each in INPUTS]}
        for r2 in (0.5, 0.9, 0.95)
    ]
    assert all(cell.endswith(", 1.00]") for cell in cells(feature_tables(rows)["features_r2"].markdown())[0][1:])


def test_cooling_has_differences_of_value_to_the_first_way() -> None:
    def row(cooling: str, mean: float, change: float) -> dict[str, object]:
        value = {"mean": mean, "difference": change, "difference_low": change - 1, "difference_high": change + 1}
        return {
            "cooling": cooling,
            "policy": "p",
            "figures": {"value": value, "faults": {"mean": 0.25}, "above_warning_min": {"mean": 12.4}},
        }

    fleet = [row("still_air", 10.0, 0.0), row("liquid", 12.0, 2.0)]
    table = cooling_tables([{"scenario": "hall", "fleet": fleet}])["cooling_hall"]
    assert cells(table.markdown()) == [
        ["`still_air`", "10.0", "0.25", "12"],
        ["`liquid`", "12.0; **+2.0 (+1.0 … +3.0)**", "0.25", "12"],
    ]


def test_steps_are_ranges_over_policies() -> None:
    def row(policy: str, events: int, choices: int) -> dict[str, object]:
        every = {"env": 100, "env_choices": 10, "arm": 400, "arm_choices": 4}
        some = {"env": events, "env_choices": choices, "arm": 4 * events, "arm_choices": events}
        return {"scenario": "hall", "policy": policy, "interval": every, "events": some}

    text = steps_table({"rows": [row("a", 20, 10), row("b", 50, 50)]})
    assert cells(text) == [["`hall`", "100", "20–50", "2–5", "10.0 %", "50–100 %", "1.0 %", "25 %"]]


def test_observed_bytes_are_those_of_all_arrays_and_repeated_axes_count_once() -> None:
    own, shared = np.zeros((5, 4, 3), np.float32), np.broadcast_to(np.zeros((5, 1, 2), np.float32), (5, 4, 2))
    assert observed_bytes({"own": own, "shared": shared, "mask": [np.zeros(7, np.int8)]}) == 240 + 40 + 7


def test_the_speed_of_an_env_stands_beside_a_copy_of_its_observations() -> None:
    def window() -> tuple[int, np.ndarray]:
        np.ones(1_000_000).sum()
        return 10, np.zeros((8, 25), np.float32)

    figures = step_figures(window, envs=8, agents=2)
    assert figures["observed_bytes"] == 100
    assert figures["ns_per_agent_step"] == pytest.approx(5e8 / figures["steps_per_s"])
    assert 0 < figures["observed_gb_per_s"] < figures["copied_gb_per_s"]
    half = {"observed_gb_per_s": 2.0, "copied_gb_per_s": 4.0, "steps_per_s": 2e7, "ns_per_agent_step": 25.0}
    rows = [{"what": "ours", **figures, **half}, {"what": "theirs", "missing": "not installed"}]
    assert cells(env_table({"rows": rows})) == [
        ["ours", "20,000,000", "25", "100", "2", "50"],
        ["theirs", "not installed", "", "", "", ""],
    ]


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
    ("docs/logs.md", "finding"): "limits in `fleet/readings.py`",
    ("docs/performance.md", ""): "times of one machine; the commands beside the tables print them",
    ("docs/performance.md", "what"): "times of one machine; the commands in the table print them",
    ("docs/ros2.md", "ROS 2"): "settings",
    ("docs/scaling.md", ""): "to be made from files",
    ("docs/scaling.md", "what fails first"): "calculated from the table above it",
    ("docs/several_machines.md", "fault"): "`make mesh` prints it: 256 arms",
    ("docs/suite.md", "split"): "the definition of the suite",
    ("docs/suite.md", "control"): "the definition of the suite",
    ("docs/suite.md", "axis of an instance"): "the definition of the suite",
    ("docs/trainers.md", "trainer"): "versions",
}
"""Hand-made tables by page and first heading, with the reason."""


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


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow  # CI builds the pages by `make docs`
def test_pages_are_made_from_readme_docstrings_and_notebooks(site: Path) -> None:
    for page, content in (
        ("index.html", "Two commands"),
        ("api/scenarios.html", "scenarios.evaluate.comparison.Comparison"),
        ("notebooks/quick_look.html", "data:image/png"),
        ("examples/own_policy.html", "HEADROOM_K"),
        ("cli.html", "thermofleet twin train"),
    ):
        assert content in (site / page).read_text(encoding="utf-8"), page


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_search_works_from_a_folder_without_network(site: Path) -> None:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": 1280, "height": 900})
        outside, errors = list[str](), list[str]()
        view.on("request", lambda request: request.url.startswith("http") and outside.append(request.url))
        view.on("pageerror", lambda error: errors.append(str(error)))
        view.goto((site / "index.html").as_uri())
        view.click(".md-search__input")
        view.keyboard.type("clearance")
        found = view.locator(".md-search-result__link").first
        found.wait_for(timeout=120_000)
        found.click()
        view.wait_for_selector("article:has-text('clearance')", timeout=120_000)
        for page in ("index", "cli", "bus/messages", "tutorials/judge_a_policy", "notebooks/evaluate_policies"):
            view.set_viewport_size({"width": 390, "height": 844})
            view.goto((site / f"{page}.html").as_uri())
            width = view.evaluate("document.documentElement.scrollWidth")
            assert width <= 390, f"{page} is {width} px wide"
        browser.close()
    assert outside == []
    assert errors == []


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SHOWN = {
    "quick_look": r"arm_1 stopped.*jobs finished",
    "evaluate_policies": r">round_robin</td>.*>wsept</td>",
    "twin_on_own_logs": r"arm_2: 3600 samples",
}
"""What the HTML or text outputs of each notebook contain."""


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=getattr(pytest.mark, "ci_slow" if path.stem == "quick_look" else "slow"), id=path.stem)
        for path in NOTEBOOKS
    ],
)
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location("notebooks", ROOT / "docs" / "notebooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    done = module.execute(path, tmp_path)
    outputs = [output for cell in done.cells for output in cell.get("outputs", ())]
    text = "".join(str(output.get("data", {}).get("text/html", output.get("text", ""))) for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert re.search(SHOWN[path.stem], text, re.DOTALL), text
