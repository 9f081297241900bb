"""Results for the leaderboard: whole ones are taken, forged and incomplete ones refused, and the table is right."""

import json
import re
from collections.abc import Callable
from dataclasses import astuple, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

from docs.tables import board_text
from fleet.errors import FleetError
from fleet.seeding import shift_seeds
from scenarios.evaluate import leaderboard
from scenarios.evaluate.leaderboard import (
    MOST_BYTES,
    BoardResult,
    Card,
    ResultLine,
    board_of,
    check,
    read,
    read_all,
    write,
)
from scenarios.evaluate.references import ShiftReference
from scenarios.evaluate.rollout import FIGURES, Outcome
from scenarios.evaluate.store import opened
from scenarios.evaluate.study import Row, Study, suite_of
from scenarios.policy_loader import policy_of, scope_of
from scenarios.spec.jobs import draw_jobs
from scenarios.suite.splits import instance_of, manifest

BLANK = Outcome(
    **dict.fromkeys(FIGURES, 0.0) | {"value": 691.19, "finished": 166.0, "peak_c": 50.0, "availability": 1.0}
)
"""As if all jobs of `test/0007` were finished."""


@cache
def blank(instance: str, reward: float) -> Outcome:
    """A shift without heat in which all jobs are finished."""
    (line,) = [each for each in manifest("test") if each.name == instance]
    value = sum(
        job.value for job in draw_jobs(instance_of(line).scenario, shift_seeds(np.random.SeedSequence(line.seed))[0])
    )
    return replace(BLANK, reward=reward, value=value, finished=float(line.count))


def reference(line) -> ShiftReference:
    """Random has 10, hindsight 30, the bound is 40."""
    return ShiftReference(
        instance=line.name, scenario_hash=line.scenario, seed=line.seed, difficulty="oracle", random=10.0,
        random_se=0.0, rule="wspt", best_rule=20.0, hindsight=30.0, upper=40.0, linear=40.0, evaluations=1, nodes=0,
        search_s=None, upper_s=None, seconds=None, code="", claims=(),
    )  # fmt: skip


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch):
    found = {(line.name, line.seed): reference(line) for line in manifest("test")}
    monkeypatch.setattr(leaderboard, "split_references", lambda split: found if split == "test" else {})
    return found


@pytest.fixture(scope="module")
def study() -> Study:
    return Study(policies=["wspt", "wsept"], cases=suite_of("test", 1), difficulties=["oracle"])


def finished(study: Study, out: Path, rewards: dict[str, float], failed: int = 0) -> Path:
    """The folder of a study without running it; wsept fails in the first shifts."""
    keys = [key for unit in study.units(set()) for key in unit.keys]
    rows = [Row(key, blank(key.instance, rewards[key.policy])) for key in keys]
    with opened(out, study.card) as store:
        for n, row in enumerate(row for row in rows if row.key.policy == "wsept"):
            if n < failed:
                rows[rows.index(row)] = Row(row.key, None, 0, "Oops: x", "line 1")
        store.add(rows)
    return out


def test_a_study_of_a_whole_split_becomes_a_file_for_each_policy_and_a_table(study, tmp_path, thermofleet):
    out = finished(study, tmp_path / "study", {"wspt": 15.0, "wsept": 30.0}, failed=50)
    sent = tmp_path / "sent"
    said = thermofleet("leaderboard", "--submit", out, "--author", "Ann", "--about", "rules", "--out", sent)
    assert (said.code, "50 failed shifts, which count as random" in said.err) == (0, True)
    assert sorted(path.name for path in sent.iterdir()) == ["test-wsept-oracle.jsonl", "test-wspt-oracle.jsonl"]
    assert all(path.stat().st_size < 200_000 for path in sent.iterdir())
    made = board_of("test", read_all(sent, "test"))
    assert made is not None
    assert made.order == ["test-wsept-oracle", "test-wspt-oracle"]
    scores = made.scores.policies
    assert scores["test-wspt-oracle"].mean.mean == pytest.approx(0.25)
    assert scores["test-wsept-oracle"].mean.mean == pytest.approx(0.75)  # 150 of 200 shifts at 1, the others at 0
    assert scores["test-wspt-oracle"].improvement.mean == 0.25
    assert "of 200 instances; differences to `wsept` (oracle)." in thermofleet("leaderboard", sent).out
    assert thermofleet("leaderboard", "--submit", out, "--author", "Bob", "--out", sent).refused("has a result of Ann")
    text = board_text(sent, "test")
    assert f"Highest mean score of scope {scope_of('wsept')} `wsept` (0.75 [" in text
    (first,) = re.findall(r"\| 1 \|.*", text)
    assert [cell.strip() for cell in first.split("|")][2:4] == ["`wsept`", scope_of("wsept")]
    assert "200 of 200 instances; differences to `wsept` (oracle)." in text
    for shown in (thermofleet("leaderboard", sent).out, text):
        assert "`wsept` (0.75 [" in shown
        assert "50 failed shifts, which count as random)" in " ".join(shown.split())
    *_, row = [line for line in thermofleet("leaderboard", sent).out.splitlines() if line.startswith("wsept")]
    assert row.split()[-2:] == ["0.00", "50"]
    in_json = json.loads(thermofleet("leaderboard", sent, "--json").out)["policies"]["test-wsept-oracle"]
    assert (in_json["faults"], in_json["failed"]) == (0.0, 50)
    assert board_text(sent, "validation") == "No results on the split validation."
    assert thermofleet("leaderboard", tmp_path / "absent").code == 2


def changed(index: int | None, **fields) -> Callable[[BoardResult], BoardResult]:
    """A change of the card, or of one row; figures are given by name."""

    def change(given: BoardResult) -> BoardResult:
        if index is None:
            return msgspec.structs.replace(given, card=msgspec.structs.replace(given.card, **fields))
        rows, row = list(given.rows), given.rows[index]
        own = dict(fields)
        for name in [name for name in own if name in FIGURES]:
            figures = list(own.get("figures", row.figures))
            figures[FIGURES.index(name)] = own.pop(name)
            own["figures"] = figures
        rows[index] = msgspec.structs.replace(row, **own)
        return msgspec.structs.replace(given, rows=tuple(rows))

    return change


def cut(first: int, last: int | None) -> Callable[[BoardResult], BoardResult]:
    return lambda given: msgspec.structs.replace(given, rows=given.rows[first:last])


FORGED = {
    "all is well": (changed(None), None),
    "a shift is missing": (cut(0, -1), "1 of 200 shifts are missing, the first test/0199, training 0"),
    "a shift is given twice": (
        lambda given: msgspec.structs.replace(given, rows=(*given.rows, given.rows[0])),
        "shifts given twice: 1",
    ),
    "a training is missing": (changed(None, trainings=2), "200 of 400 shifts are missing"),
    "a shift of another split": (changed(3, instance="train/0003"), "shifts not of the split test: 1,"),
    "another scenario": (changed(3, scenario="0" * 16), "test/0003 was another scenario"),
    "another seed": (changed(3, seed=1), "test/0003 has seed"),
    "another manifest": (changed(None, manifest="0" * 16), "manifest of the split test is another one"),
    "predictions of no source": (changed(None, difficulty="guesses"), "predictions are of no source 'guesses'"),
    "predictions of another source": (changed(None, difficulty="rc-nominal"), None),
    "no versions": (changed(None, versions={"python": "3.12"}), "versions of thermofleet, numpy, numba, scipy"),
    "more than the bound": (changed(7, reward=40.1), r"test/0007 has a reward of 40\.1, above the upper bound 40"),
    "more jobs than there are": (changed(7, finished=1e4), "test/0007 has 10000 finished jobs"),
    "the name of a rule": (changed(None, policy="wsept"), "must be built-in and have no hash"),
    "code of its author": (changed(None, policy="this:x", policy_hash=""), "must be built-in and have no hash"),
    "another process": (changed(None, policy="bus:mine", policy_hash="", scope="central"), None),
    "a built-in policy": (changed(None, policy="wspt", policy_hash="", scope="central"), None),
    "another scope": (changed(None, policy="wsept", policy_hash=""), "scope is central, as that of every `wsept`"),
    "the scope of another process": (
        changed(None, policy="bus:m", policy_hash=""),
        r"scope is central, .* \(got arm\)",
    ),
    "files of another process": (changed(None, policy="bus:mine"), r"\(bus:NAME has none\)"),
    "hardly more than the bound": (
        changed(7, reward=40.0 + 1e-4),
        r"test/0007 has a reward of 40\.0001, above the upper bound 40,",
    ),
    "more than the value": (
        changed(7, value=11.9, finished=3),
        r"test/0007 has a reward of 12, above 11\.9: the finished value 11\.9 less 0 for",
    ),
    "more value than its jobs have": (changed(7, value=1e6), r"of 1e\+06, but 166 of its jobs have at most 691\.2"),
    "more value than its finished jobs have": (
        changed(7, finished=1),
        r"has a finished value of 691\.2, but 1 of its jobs have at most 5\.09",
    ),
    "less value than its finished jobs have": (
        changed(7, value=0.0),
        r"has a finished value of 0, but 166 of its jobs have at least 691\.2",
    ),
    "faults without their price": (changed(7, faults=1e6), r"the finished value 691\.2 less .* for faults"),
    "minutes without their price": (changed(7, above_warning_min=1.5e4), r"value 691\.2 less 750 for faults"),
    "no fault, above the limit": (
        changed(7, peak_c=80.0),
        "test/0007 has 0 faults, which come at 59 °C, but a hottest motor of 80 °C",
    ),
    "faults below the limit": (
        changed(7, faults=2.0),
        "has 2 faults, which come at 59 °C, but a hottest motor of 50 °C",
    ),
    "faults hardly below the limit": (
        changed(7, faults=1.0, peak_c=58.98),
        r"has 1 fault, which come at 59 °C, but a hottest motor of 58\.98 °C",
    ),
    "a fault": (changed(7, faults=1.0, peak_c=59.0, above_warning_min=1.0, availability=0.9), None),
    "minutes above the warning limit, below it": (
        changed(7, above_warning_min=1.0),
        "has 1 min above the warning limit of 52 °C, but a hottest motor of 50 °C",
    ),
    "no minute above the warning limit, above it": (
        changed(7, peak_c=53.0),
        "has 0 min above the warning limit of 52 °C, but a hottest motor of 53 °C",
    ),
    "lost time without a fault": (changed(7, availability=0.927), r"has no faults, but an availability of 0\.927,"),
    "no number": (changed(7, value=float("nan")), "needs 11 figures of at most 1e\\+09"),
    "below 0": (changed(7, faults=-1.0), "a figure below 0"),
    "half a fault": (changed(7, faults=0.5), "counts that are no whole numbers"),
    "more minutes than the shift": (changed(7, above_warning_min=1e6), "more minutes above a limit"),
    "a motor cooler than the air": (changed(7, peak_c=1.0), "a hottest motor of 1 °C, not within"),
    "an endless loss": (changed(7, reward=-1e9), "a reward of -1e\\+09, below what the worst policy could lose"),
    "neither figures nor error": (changed(7, figures=None), "needs either figures or an error"),
}


@pytest.fixture(scope="module")
def good(study: Study) -> BoardResult:
    scenarios = study.card["instances"]
    assert isinstance(scenarios, dict)
    versions: dict[str, str | None] = {name: "1" for name in leaderboard.NEEDED}
    card = Card(
        format=1, policy="mine", difficulty="oracle", split="test", scope="arm", trainings=1, author="Ann", about="",
        manifest=leaderboard.manifest_hash("test"), code_hash="a" * 16, policy_hash="c" * 16, risk="rc",
        versions=versions,
    )  # fmt: skip
    rows = [
        ResultLine(instance=case.name, scenario=scenarios[case.name], seed=case.seeds[0], training=0,
               figures=[*astuple(blank(case.name, 12.0))], illegal=0)
        for case in study.cases
    ]  # fmt: skip
    return BoardResult(card=card, rows=tuple(rows))


@pytest.mark.parametrize(("change", "said"), FORGED.values(), ids=list(FORGED))
def test_forged_and_incomplete_results_are_refused(good: BoardResult, known, change, said):
    if said is None:
        check(change(good), known)
        return
    with pytest.raises(FleetError, match=said):
        check(change(good), known)


def test_a_file_is_read_as_it_was_written_and_nothing_else_is(good: BoardResult, tmp_path: Path):
    path = write(good, tmp_path)
    assert read(path) == good
    path.rename(tmp_path / "test-other-oracle.jsonl")
    with pytest.raises(FleetError, match="must have the name of its policy and split, test-mine-oracle"):
        read_all(tmp_path, "test")
    (tmp_path / "banana.jsonl").touch()
    with pytest.raises(FleetError, match=r"banana.jsonl' must have the name .* with SPLIT validation, test"):
        read_all(tmp_path, "test")
    (tmp_path / "study.json").touch()
    with pytest.raises(
        FleetError, match="is a folder of `thermofleet compare`; run `thermofleet leaderboard --submit`"
    ):
        read_all(tmp_path, "test")
    lines = (tmp_path / "test-other-oracle.jsonl").read_text(encoding="utf-8").splitlines()
    for bad in (
        "",
        "[1]",
        lines[1],
        *(
            json.dumps(json.loads(lines[0]) | forged)
            for forged in ({"split": "own"}, {"policy": "x` | <b>"}, {"risk": "?"})
        ),
    ):
        path.write_text("\n".join([bad, *lines[1:]]), encoding="utf-8")
        with pytest.raises(FleetError, match="is no result of `thermofleet leaderboard --submit`"):
            read(path)
    for bad, said in (
        (
            json.dumps(json.loads(lines[0]) | {"author": "a | b"}),
            "without control characters and | < > ` - at `$.author`",
        ),
        (json.dumps(json.loads(lines[0]) | {"code_hash": "?"}), "of 16 hexadecimal digits - at `$.code_hash`"),
        (lines[0].replace("[0", "[NaN").replace('"trainings":1', '"trainings":NaN'), ": NaN is no number of JSON"),
    ):
        path.write_text("\n".join([bad, *lines[1:]]), encoding="utf-8")
        with pytest.raises(FleetError, match=re.escape(said)):
            read(path)
    path.write_text("\n".join([*lines[:2], lines[2][:20], *lines[3:]]), encoding="utf-8")
    with pytest.raises(FleetError, match="line 3: "):
        read(path)
    path.write_text(lines[0] + "\n" + " " * MOST_BYTES, encoding="utf-8")
    with pytest.raises(FleetError, match=f"at most {MOST_BYTES} bytes"):
        read(path)


def test_studies_of_other_settings_are_refused(study: Study, tmp_path: Path):
    out = finished(study, tmp_path / "study", {"wspt": 15.0, "wsept": 30.0})
    card = json.loads((out / "study.json").read_text(encoding="utf-8"))
    for change, said in (
        ({"status": "interrupted"}, "not finished"),
        ({"randomise": {**card["randomise"], "ambient_k": [1, 2]}}, "no randomisation"),
        ({"channel": {**card["channel"], "loss": 0.5}}, "bus of each instance"),
        ({"instances": {"quickstart": "0" * 16}}, "no instance of a split"),
    ):
        with pytest.raises(FleetError, match=said):
            leaderboard.submissions_of(card | change, [], "Ann", "")


def test_the_policy_of_the_page_can_be_loaded(tmp_path: Path):
    page = (Path(__file__).parents[2] / "docs" / "leaderboard.md").read_text(encoding="utf-8")
    code = page.split("```python\n")[1].split("```")[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 10 + 1  # and the name of its file
    (tmp_path / "mine.py").write_text(code, encoding="utf-8")
    assert scope_of(f"{tmp_path / 'mine.py'}:FirstLegal") == "arm"
    assert policy_of(f"{tmp_path / 'mine.py'}:FirstLegal")
