"""Make every picture of README and docs anew: python docs/make_pictures.py.

The film needs OpenGL without a display (EGL), the screenshots need Chromium. `$CHROMIUM` names another executable.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import sync_playwright

from scenarios.train.pairs import PairLearner
from scenarios.train.training import draw_curves

ROOT = Path(__file__).parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))
PICTURES = ROOT / "docs" / "pictures"
FILM_RUN = ("quickstart", "--policy", "round_robin", "--difficulty", "oracle", "--seed", "5")
FILM = ("--size", "640x360", "--speed", "240", "--fps", "8", "--overwrite")
REPORT_RUN = ("active_waiting", "--policy", "round_robin", "--difficulty", "oracle", "--seed", "1")
OFFERS_RUN, OFFERS = ("quickstart", "--policy", "wsept", "--seed", "5"), "Why each arm got its job"
"""With the twins of the package, and the heading of the table of offers in its report."""
COMPARISON = (
    *("quickstart", "--difficulty", "oracle", "--policies", "round_robin,wspt,wsept"),
    *("--baseline", "round_robin", "--seeds", "10"),
)
"""As in the tutorial."""
CELLS = (
    *("quickstart", "active_waiting", "heat_wave", "people_near"),
    *("machine_tending", "assembly", "palletising_line"),
)
"""Scenarios whose cells are drawn; others have the cell of one of them, or too many arms for a picture."""
GRAPHICS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def thermofleet(*words: str) -> None:
    """Run a command of thermofleet.

    Raises:
        CalledProcessError: it fails.
    """
    subprocess.run([sys.executable, "-m", "scenarios", *words], check=True, cwd=ROOT)


def screenshot(page: Path, picture: Path, *, heading: str = "", height: int = 1500) -> None:
    """A picture of a page: its first screen, or from a heading on, with what is folded below it."""
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit(
            "There is no Chromium here, which makes the screenshots. Install it, or name one: CHROMIUM=/path/to/it"
        )
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(GRAPHICS))
        view = browser.new_page(viewport={"width": 1280, "height": height})
        view.goto(page.as_uri())
        view.wait_for_selector("body[data-ready]")
        if heading:
            found = view.get_by_role("heading", name=heading)
            found.evaluate("it => { for (const one of it.parentElement.querySelectorAll('details')) one.open = true; }")
            found.evaluate("it => it.scrollIntoView()")
        view.screenshot(path=picture)
        browser.close()


def draw_knowledge(picture: Path) -> None:
    """Scores of the best rule by what its arms know, where heat binds: from nothing to the true state."""
    from matplotlib.figure import Figure

    from docs.tables import KNOWLEDGE, known_scores

    found, values = known_scores(ROOT / "docs" / "results" / "leaderboard")
    some = values if values.hot is None else values.only(values.hot)
    names = [name for name in KNOWLEDGE if name in found][::-1]
    scores = [some.interval(some.score[name]) for name in names]
    figure = Figure(figsize=(8.0, 2.9), layout="constrained")
    axes = figure.subplots()
    reach = [[each.mean - each.low for each in scores], [each.high - each.mean for each in scores]]
    labels = [KNOWLEDGE[name] for name in names]
    axes.barh(labels, [each.mean for each in scores], xerr=reach, color="#3b7dd8", ecolor="#444444", capsize=3)
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.set(xlabel="normalised score where heat binds")
    axes.grid(axis="x", alpha=0.3)
    figure.savefig(picture, dpi=130)


def draw_amounts(picture: Path) -> None:
    """Error of an identified network by the length of the arm's own logs, beside that of a nominal one."""
    from matplotlib.figure import Figure

    from benchmarks.paper.harness import mean_by_group
    from scenarios.json_rows import Rows

    rows = [*Rows(ROOT / "docs" / "results" / "paper" / "amounts.jsonl").by_key.values()]
    errors = {
        float(minutes): mean_by_group([(str(i), row["error_k"][minutes]) for i, row in enumerate(rows)], least=0.0)
        for minutes in rows[0]["error_k"]
    }
    nominal, own = errors.pop(0.0), [*errors.values()]
    figure = Figure(figsize=(6.0, 2.7), layout="constrained")
    axes = figure.subplots()
    axes.axhline(nominal.mean, color="#888888", linestyle="--", label="nominal network")
    axes.axhspan(nominal.low, nominal.high, color="#888888", alpha=0.15)
    reach = [[each.mean - each.low for each in own], [each.high - each.mean for each in own]]
    axes.errorbar([*errors], [each.mean for each in own], yerr=reach, marker="o", capsize=3, label="identified network")
    axes.set(xscale="log", xlabel="own logs, min", ylabel="error of the peak, K", ylim=(0.0, None))
    axes.set_xticks([*errors], [f"{minutes:g}" for minutes in errors])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(picture, dpi=130)


def main() -> None:
    """Make the pictures; prints the size of each."""
    with TemporaryDirectory() as folder:
        film, report = str(Path(folder) / "film"), str(Path(folder) / "report")
        thermofleet("run", *FILM_RUN, "--out", film)
        thermofleet("view", film, "--out", str(PICTURES / "shift.gif"), *FILM)
        thermofleet("run", *REPORT_RUN, "--out", report)
        screenshot(Path(report) / "report.html", PICTURES / "report.png")
        offers = str(Path(folder) / "offers")
        thermofleet("run", *OFFERS_RUN, "--out", offers)
        screenshot(Path(offers) / "report.html", PICTURES / "offers.png", heading=OFFERS, height=420)
        comparison = str(Path(folder) / "comparison")
        thermofleet("compare", *COMPARISON, "--out", comparison)
        screenshot(Path(comparison) / "index.html", PICTURES / "comparison.png", height=1000)
    for scenario in CELLS:
        thermofleet("layout", scenario, "--out", str(PICTURES / "library" / f"{scenario}.png"), "--overwrite")
    trainings = sorted((ROOT / "docs" / "results" / "learned").glob("train-pairs-*"))
    curve = PICTURES / "learning_pairs.png"
    draw_curves(trainings, curve, PairLearner.unit, teacher_name=PairLearner.teacher_name)
    draw_knowledge(PICTURES / "knowledge.png")
    draw_amounts(PICTURES / "amounts.png")
    for picture in sorted(PICTURES.rglob("*.*")):
        print(f"{picture.relative_to(ROOT)}: {picture.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
