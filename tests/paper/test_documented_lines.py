"""Every line of docs/paper.md runs, with tiny sizes; what it measures with these is of no use."""

import re
from pathlib import Path

import pytest

from benchmarks.paper.__main__ import MODULES, STUDIES, main
from benchmarks.paper.harness import Experiment
from scenarios.json_rows import Rows

ROOT = Path(__file__).parents[2]
LOGS = ROOT / "../shared/data/gen3_logs"
PAGES = (
    *("paper.md", "twin.md", "twin_studies.md", "identification.md", "concepts/cooling.md"),
    *("results/paper.md", "results/twin.md"),
)
COMMAND = re.compile(r"python -m benchmarks\.paper ([\w-]+)((?: [^`#\n>]+)?)")
RESULTS = "docs/results/"
TINY = {
    "readings": "--scenarios quickstart --train 20 --exploration 6 --reference 125 --test 60 --novel 70",
    "forms": "--scenarios quickstart --arms 1 --trainings 1 --train 20 --exploration 6 --reference 20 --test 60 "
    "--novel 8",
    "sides": "--count 2 --train 20 --exploration 6 --reference 20 --test 60 --novel 2",
    "sweep": "--scenarios heat_wave --arms 0 --only ours --train 10 --test 60",
    "parsimony": "--scenarios heat_wave --arms 0 --train 6 --test 60",
    "surprises": "--sources oracle --cells 1",
    "questions": "--seeds 1 --epochs 4",
    "forecast": "",
    "amounts": "--arms 2",
    "transfer": "--seeds 1 --jobs 2 4 --source-jobs 6 --source-steps 4 --held-out 4 --test 9 "
    "--steps 4 --further-steps 2",
    "features": "--seeds 1 --labels 10 --train 4 --steps 4",
    "augmentation": "--seeds 1 --measured 4 --added 4 --held-out 4 --test 8 --steps 4",
    "drift": "--seeds 1 --days 24 --onset 8 --reference 4 --full 8 --jobs 3 --window 6 --period 6 --least 4 --train 8 "
    "--pool 8 --steps 4 --further-steps 2",
    "cooling": "--scenarios quickstart --seeds 2 --policies round_robin",
}
"""Options that make each study small."""
QUICK = ("sweep", "parsimony", "features", "augmentation")


def documented() -> list[tuple[str, str]]:
    """Study and options of every documented line."""
    text = "\n".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in PAGES)
    return [(name, options.split(">")[0]) for name, options in COMMAND.findall(text.replace("\\\n  ", ""))]


def test_every_study_has_a_documented_line():
    assert {name for name, _ in documented()} == set(MODULES)


def parsed(experiment: Experiment, words: list[str]):
    from argparse import ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    experiment.options(parser)
    parser.add_argument("--out")
    parser.add_argument("--show", action="store_true")
    return parser.parse_args(words)


@pytest.mark.parametrize(("name", "options"), documented())
def test_documented_options_exist_and_stored_rows_are_those_of_the_line(name, options):
    """Second method for "stored results are what the line computes": keys are hashes of all that they depend on."""
    given = parsed(STUDIES[name](), options.split())
    if given.out is None or not given.out.startswith(RESULTS) or "--log" in options:
        return
    stored = Rows(ROOT / given.out)
    assert [key for unit in STUDIES[name]().units(given) for key in unit.keys if key not in stored] == []


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in MODULES]
)
def test_a_tiny_run_writes_its_rows_and_prints_its_tables(name, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("benchmarks.paper.sweep.JOBS", (3,))
    monkeypatch.setattr("benchmarks.paper.sweep.STEPS", 10)
    words = [name, *TINY[name].split(), "--out", str(tmp_path / "rows.jsonl")]
    if "--log" in " ".join(options for each, options in documented() if each == name):
        if not LOGS.is_dir():
            pytest.skip("the Gen3 logs are not beside this checkout")
        words += ["--log", str(LOGS), "--skip-damaged"]
    main(words)
    printed = capsys.readouterr()
    assert len(printed.out.splitlines()) >= 2
    rows = Rows(tmp_path / "rows.jsonl").by_key
    assert len(rows) == printed.err.count(" rows, ") > 0
    main([*words, "--show"])
    assert capsys.readouterr().out == printed.out
