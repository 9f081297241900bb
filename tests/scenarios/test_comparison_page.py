"""The page of a comparison: its verdict against values by hand, nothing loaded or unescaped; the command repeats."""

import base64
import gzip
import io
import json
import re
import shlex
from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
import pytest
import typer
from plotly.offline import get_plotlyjs
from rich.console import Console

from scenarios.cli import options
from scenarios.evaluate.comparison import comparisons, scores_over_all
from scenarios.evaluate.rollout import FIGURES, Outcome
from scenarios.evaluate.scores import Shift
from scenarios.evaluate.study import Case, Key, Row, Study
from scenarios.prepare.randomisation import Randomisation
from scenarios.show.comparison_page import Judged, comparison_page, points, spans, verdict
from scenarios.spec.load import load

REWARD = {"wspt": 10.0, "wsept": 14.0, "fifo": 6.0}


class Known:
    """What scores read of a reference: random 0, hindsight 20, bound 40."""

    random, hindsight, upper = 0.0, 20.0, 40.0

    def __init__(self, instance: str) -> None:
        self.instance = instance


@pytest.fixture
def study() -> Study:
    scenario = load("quickstart")
    case = Case(name=scenario.name, scenario=scenario, seeds=tuple(range(6)))
    return Study(policies=[*REWARD, "random"], cases=[case], difficulties=["blind"])


def rows_of(study: Study, error: str | None = None, failing: str = "random") -> list[Row]:
    """Rewards around those of `REWARD`; a policy fails in its last shift if there is an error."""
    blank, rng = Outcome(**dict.fromkeys(FIGURES, 0.0)), np.random.default_rng(0)
    rows: list[Row] = []
    for policy in study.policies:
        for seed in study.cases[0].seeds:
            key = Key(policy, study.cases[0].name, 0, 0, "blind", seed)
            reward = REWARD.get(policy, 0.0) + 0.5 * rng.normal()
            failed = error is not None and policy == failing and seed == 5
            rows.append(Row(key, None, 0, error, "line 3") if failed else Row(key, replace(blank, reward=reward), 2))
    return rows


def judged(study: Study, rows: list[Row], known: dict[Shift, Known]) -> Judged:
    return Judged(
        title="Comparison <here>",
        results=comparisons(study, rows, "wspt", references=known),  # pyright: ignore[reportArgumentType]  # a stand-in
        values=scores_over_all(study, rows, known),  # pyright: ignore[reportArgumentType]
        card=study.card,
        command="thermofleet compare quickstart",
    )


def test_randomised_shifts_have_no_normalised_scores(study: Study):
    known = {("quickstart", seed): Known(f"quickstart/{seed}") for seed in range(6)}
    warmer = replace(study, randomise=Randomisation(ambient_k=(0.0, 5.0)))
    plain, varied = (judged(each, rows_of(each), known) for each in (study, warmer))
    assert plain.results[0].scores is not None
    assert varied.results[0].scores is None
    assert varied.values is None
    assert "Randomisation: ambient temperature +0 to +5 K." in comparison_page(varied)
    assert "Randomisation: none." in comparison_page(plain)


def test_the_page_says_who_beats_whom_and_loads_nothing(study: Study):
    known = {("quickstart", seed): Known(f"quickstart/{seed}") for seed in range(6)}
    rows = rows_of(study, "Oops: <script>alert(1)</script>")
    about = judged(study, rows, known)
    first, second, failed = verdict(about)
    mean = np.mean([row.outcome.reward for row in rows[6:12] if row.outcome]) / 20
    better = mean - np.mean([row.outcome.reward for row in rows[:6] if row.outcome]) / 20
    assert first.startswith(f"wsept beats the baseline wspt by {better:.2f} [")
    assert "; it beats the next one, fifo by " in first
    assert second.startswith(f"Its mean score is {mean:.2f} [")
    assert failed.startswith("Failed: random;")
    page = comparison_page(about)
    assert page == comparison_page(about)
    packed, *drawn = re.findall(r'<script type="text/plain" id="\w+">([^<]*)</script>', page)
    assert gzip.decompress(base64.b64decode(packed)).decode() == get_plotlyjs()
    own = page.replace(packed, "")
    assert not re.search(r"https?://|src=", own)
    assert own.count("<script") == 1 + 1 + len(drawn)
    assert "Oops: &lt;script&gt;" in page
    assert "Illegal actions, which count as waits: wspt 12" in page
    assert page.count("data-drawn=") == len(drawn) == 3
    for figure in drawn:
        go.Figure(json.loads(figure))  # raises on any property or value that Plotly does not know


def test_a_baseline_that_failed_has_no_differences(study: Study):
    known = {("quickstart", seed): Known(f"quickstart/{seed}") for seed in range(6)}
    about = judged(study, rows_of(study, "Oops", failing="wspt"), known)
    without, failed = verdict(about)
    assert without.endswith("no differences, as the baseline wspt failed.")
    assert failed.startswith("Failed: wspt;")
    assert "Normalised score" not in comparison_page(about)


def test_the_best_of_several_must_be_significant_among_them(study: Study):
    about = judged(study, rows_of(study), {})
    (result,) = about.results
    for p, said in (
        (0.016, "more reward than wspt."),
        (0.02, "more reward than wspt, which is not significant."),
    ):  # of three
        reward = replace(result.figures["wsept"]["reward"], p=p)
        figures = result.figures | {"wsept": result.figures["wsept"] | {"reward": reward}}
        (only,) = verdict(replace(about, results=[replace(result, figures=figures)]))
        assert said in only


def test_without_references_the_verdict_is_of_rewards(study: Study):
    (only,) = verdict(judged(study, rows_of(study), {}))
    assert re.fullmatch(
        r"quickstart, 6 seeds, this fleet only: wsept has the most reward, 14\.\d; "
        r"[34]\.\d \[[234]\.\d, [45]\.\d\] more reward than wspt\.",
        only,
    )


def test_charts_place_points_by_value():
    chart = spans([("a", 0.0, -0.5, 0.5), ("b", 1.0, 0.9, 1.1), ("c", -9.0, -9.9, 2.0)], "score", least=-1.0)
    (dots,) = chart["data"]
    assert (dots["x"], dots["y"]) == ([0.0, 1.0], [0, 1])
    assert dots["error_x"]["array"] == pytest.approx([0.5, 0.1])
    assert dots["error_x"]["arrayminus"] == pytest.approx([0.5, 0.1])
    assert [note["text"] for note in chart["layout"]["annotations"]] == ["◂ -9.00"]
    unknown = float("nan")
    near = points([("a", (1.0, 0.5, 2.5), (2.0, unknown, unknown)), ("b", (1.0, 1.0, 1.0), (2.0, 2.0, 2.0))], "x", "y")
    (dots,) = near["data"]
    assert (dots["error_x"]["array"], dots["error_x"]["arrayminus"]) == ([1.5, 0.0], [0.5, 0.0])
    assert (dots["error_y"]["array"], dots["error_y"]["arrayminus"]) == ([0.0, 0.0], [0.0, 0.0])
    assert len(set(dots["textposition"])) == 2  # labels of points at one place are apart


def test_a_comparison_is_one_table_in_every_form(study: Study):
    (result,) = judged(study, rows_of(study), {}).results
    page = io.StringIO()
    Console(file=page, width=120).print(result.table)
    figure = result.figures["wsept"]["reward"]
    text, html, markdown, csv = page.getvalue(), result.table.html(), result.table.markdown(), result.table.csv()
    assert re.search(rf"^  wsept +{figure.mean:.1f} ", text, re.MULTILINE)
    assert f"<td>{figure.mean:.1f}</td>" in html
    assert f"| wsept | {figure.mean:.1f} |" in markdown
    assert f"reward,wsept,{figure.mean:.1f}," in csv
    assert result._repr_html_() == html


def test_the_command_line_has_what_is_no_default():
    told: list[str] = []
    app = typer.Typer()

    @app.command("compare")
    def _(
        ctx: typer.Context, names: list[str], seeds: int = 3, more: list[str] | None = None, fast: bool = False
    ) -> None:
        told.append(options.command_line(ctx))

    typer.main.get_command(app).main(
        ["a", "my b", "--seeds", "5", "--more", "1", "--more", "2", "--fast"], "compare", standalone_mode=False
    )
    typer.main.get_command(app).main(["a", "--seeds", "3"], "compare", standalone_mode=False)
    assert shlex.split(told[0]) == [
        "thermofleet",
        "compare",
        "a",
        "my b",
        *["--seeds", "5", "--more", "1", "--more", "2", "--fast"],
    ]
    assert told[1] == "thermofleet compare a"
