"""Studies: the same rows on any number of processes and after any interruption; failures are told, the rest goes on."""

import subprocess
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from agents.pairs import PARAMETERS, save_pairs
from fleet.errors import FleetError
from scenarios.evaluate import runner, sources
from scenarios.evaluate.comparison import comparison_of, comparisons
from scenarios.evaluate.rollout import FIGURES, outcomes
from scenarios.evaluate.store import RESULTS, UNFINISHED, opened, read_rows
from scenarios.evaluate.study import CARD, Case, RowKey, Study, Unit, policy_hash, seeds_of_instance
from scenarios.policy_loader import label
from scenarios.prepare import fleet as preparing
from scenarios.prepare.arms import plan_arms
from scenarios.prepare.fleet import prepare
from scenarios.processes import Queue
from scenarios.show.comparison_page import Judged, verdict
from scenarios.spec.parse import override
from scenarios.spec.schema import Scenario
from tests.own_policies import IDLE


def study_of(scenario: Scenario, *policies: str, seeds: int = 3, **more) -> Study:
    case = Case(name=scenario.name, scenario=scenario, seeds=tuple(range(seeds)))
    how = {"policies": policies or ("random", "round_robin"), "cases": [case], "difficulties": ["blind"]}
    return Study(**(how | more))


@pytest.mark.ci_slow
def test_rows_do_not_depend_on_processes_folders_and_blocks(scenario, plans, tmp_path, monkeypatch):
    study = study_of(scenario, seeds=5, fleets=2)
    alone = runner.run_study(study, cache_dir=plans, workers=1)
    assert [row.key for row in alone] == [
        RowKey(policy, "heat", fleet, 0, "blind", seed)
        for fleet in range(2)
        for policy in ("random", "round_robin")
        for seed in range(5)
    ]
    fleet = prepare(replace(scenario, spread=replace(scenario.spread, seed=1)), difficulty="blind", cache=plans)
    assert [row.outcome for row in alone[10:15]] == outcomes(fleet, "random", range(5))
    assert alone[0].outcome != alone[10].outcome
    assert runner.run_study(study, out=tmp_path / "one", cache_dir=plans, workers=1) == alone
    monkeypatch.setattr("scenarios.evaluate.study.TOGETHER", 2)
    monkeypatch.setattr(runner, "HERE_S", 0.0)
    assert runner.run_study(study, out=tmp_path / "two", cache_dir=plans, workers=2) == alone
    one, two = ((tmp_path / name / RESULTS).read_bytes() for name in ("one", "two"))
    assert one == two
    columns = ["policy", "instance", "fleet", "training", "difficulty", "seed", *FIGURES, "illegal", "error", "trace"]
    assert pq.read_table(tmp_path / "two" / RESULTS).column_names == columns


def test_an_interrupted_study_goes_on_where_it_was(scenario, plans, tmp_path, monkeypatch):
    monkeypatch.setattr("scenarios.evaluate.study.TOGETHER", 2)
    study = study_of(scenario, seeds=5)
    whole = runner.run_study(study, out=tmp_path / "whole", cache_dir=plans, workers=1)
    out, ran, run_unit = tmp_path / "out", [], runner.run_unit

    def stop_at(count: int):
        def run(unit, settings):
            if len(ran) == count:
                raise KeyboardInterrupt
            ran.append(unit)
            return run_unit(unit, settings)

        return run

    for most in (1, 1, 4, 5, 6):
        monkeypatch.setattr(runner, "run_unit", stop_at(most))
        if most < 6:
            with pytest.raises(KeyboardInterrupt):
                runner.run_study(study, out=out, cache_dir=plans, workers=1)
            with (out / UNFINISHED).open("a") as file:
                file.write('{"key": "ran')  # as a killed process may leave
            assert len(read_rows(out)) == sum(len(unit.case.seeds) for unit in ran)
        else:
            assert runner.run_study(study, out=out, cache_dir=plans, workers=1) == whole
    assert len(ran) == 6
    assert (out / RESULTS).read_bytes() == (tmp_path / "whole" / RESULTS).read_bytes()
    assert runner.run_study(study, out=out, cache_dir=plans, workers=1) == whole  # nothing runs: it would stop
    more = study_of(scenario, "random", "wspt", seeds=5)
    monkeypatch.setattr(runner, "run_unit", run_unit)
    added = runner.run_study(more, out=out, cache_dir=plans, workers=1)
    assert added == runner.run_study(more, cache_dir=plans, workers=1)
    assert {row.key.policy for row in read_rows(out)} == {"random", "round_robin", "wspt"}


@pytest.mark.ci_slow
def test_a_folder_of_something_else_is_refused(scenario, plans, tmp_path, bad):
    out = tmp_path / "out"
    own = f"{bad}:Idle"
    study = study_of(scenario, own, "random")
    runner.run_study(study, out=out, cache_dir=plans, workers=1)
    hot = override(scenario, horizon_s=120.0)
    cases = [
        (study_of(hot, own, "random"), "holds a study in which instance 'heat' was another one"),
        (replace(study, decision_limit_s=5.0), r"holds a study with decision_limit_s 60\.0, not 5\.0; give another"),
    ]
    for other, said in cases:
        with pytest.raises(FleetError, match=said):
            runner.run_study(other, out=out, cache_dir=plans, workers=1)
    bad.write_text(bad.read_text() + "\n", encoding="utf-8")
    study = replace(study)  # begun now
    with pytest.raises(FleetError, match=f"in which policy '{own}' was another one"):
        runner.run_study(study, out=out, cache_dir=plans, workers=1)
    with opened(tmp_path / "busy", study.card), pytest.raises(FleetError, match="Another process writes to"):
        runner.run_study(study, out=tmp_path / "busy", cache_dir=plans, workers=1)
    with pytest.raises(FleetError, match="holds other files"):
        runner.run_study(study, out=tmp_path, cache_dir=plans, workers=1)


def test_a_damaged_or_missing_card_is_named(scenario, tmp_path):
    study, out = study_of(scenario), tmp_path / "out"
    with opened(out, study.card):
        pass
    (out / CARD).write_text("{", encoding="utf-8")
    with (
        pytest.raises(FleetError, match=r"has a damaged study\.json; --out needs a new folder"),
        opened(out, study.card),
    ):
        pass
    (out / CARD).unlink()
    with pytest.raises(FleetError, match=r"has results\.parquet, but no study\.json"), opened(out, study.card):
        pass


@pytest.mark.ci_slow
def test_policies_that_fail_are_told_and_the_others_go_on(scenario, plans, bad, tmp_path):
    names = {name: f"{bad}:{name}" for name in ("Raises", "Nonsense", "Stuck", "Illegal", "Idle")}
    study = study_of(scenario, "round_robin", *names.values(), seeds=2, decision_limit_s=2.5)
    rows = runner.run_study(study, out=tmp_path / "out", cache_dir=plans, workers=1)
    by_policy = {policy: [row for row in rows if row.key.policy == policy] for policy in study.policies}
    alone = runner.run_study(study_of(scenario, "round_robin", seeds=2), cache_dir=plans, workers=1)
    assert by_policy["round_robin"] == alone
    said = {
        "Raises": ("KeyError: 'nobody' (at 30 s of the shift)", 'return seen["nobody"]'),
        "Nonsense": ("ValueError: The action of 'left' must be one integer (got 'wait').", "validation.py"),
        "Stuck": ("TooSlow: a decision took longer than 2.5 s", "while True: pass"),
    }
    for name, (error, trace) in said.items():
        for seed, row in enumerate(by_policy[names[name]]):
            assert row.key.seed == seed
            assert row.outcome is None
            assert error in (row.error or "")
            assert trace in (row.trace or "")
    idle, illegal = (by_policy[names[name]] for name in ("Idle", "Illegal"))
    assert [row.outcome for row in idle] == [row.outcome for row in illegal]  # what is illegal is a wait
    assert [row.illegal for row in idle] == [0, 0]
    assert [row.illegal for row in illegal] == [36, 36]  # two arms, 18 decisions
    assert read_rows(tmp_path / "out") == sorted(rows, key=lambda row: row.key)

    result = comparison_of(study, rows, "round_robin")
    assert set(result.figures) == {"round_robin", names["Illegal"], names["Idle"]}
    assert {(each.policy, each.seed) for each in result.failures} == {(names[n], s) for n in said for s in (0, 1)}
    (again,) = comparisons(study, rows, names["Raises"])  # which failed: the first that did not takes its place
    assert (again.baseline, again.failed_baseline) == ("round_robin", names["Raises"])
    assert replace(again, failed_baseline="") == result
    told = verdict(Judged(title="", results=[again], values=None, card=study.card, command=""))
    assert f"The baseline {label(names['Raises'])} failed: differences are to round_robin." in told


def test_failed_shifts_are_run_again_and_no_others(scenario, plans, tmp_path):
    """The cause may have been outside of the policy."""
    policy = tmp_path / "needs.py"
    policy.write_text(
        "class Needs:\n    scope = 'central'\n    def reset(self, rng): pass\n"
        f"    def act(self, seen):\n        open({str(tmp_path / 'file')!r}).close()\n        return {{}}\n",
        encoding="utf-8",
    )
    study, told = study_of(scenario, "random", f"{policy}:Needs", seeds=2), list[str]()

    def failed():
        rows = runner.run_study(study, out=tmp_path / "out", cache_dir=plans, workers=1, tell=told.append)
        return [row.error is not None for row in rows]

    assert failed() == [False, False, True, True]
    (tmp_path / "file").touch()
    assert failed() == [False] * 4
    assert failed() == [False] * 4
    assert told == ["Running again what failed before: 2 shifts."]
    assert not any(row.error for row in read_rows(tmp_path / "out"))


def test_an_interruption_of_a_policy_is_its_failure_and_ctrl_c_is_none(thermofleet, small_toml, tmp_path):
    policy = tmp_path / "stops.py"
    policy.write_text(
        "import os, signal, threading\n"
        "class Raises:\n    scope = 'central'\n    def reset(self, rng): pass\n"
        "    def act(self, seen): raise KeyboardInterrupt\n"
        "class Pressed(Raises):\n    def act(self, seen):\n"
        "        for process in (os.getpid(), os.getppid()): os.kill(process, signal.SIGINT)\n"
        "        threading.Event().wait()\n",
        encoding="utf-8",
    )
    how = (small_toml, "--difficulty", "blind", "--seeds", 2, "--workers", 1, "--policies")
    told = thermofleet("compare", *how, f"{policy}:Raises").succeeded().out
    assert (
        "Raises failed in 2 shifts, first in heat, fleet 0, training 0, seed 0: KeyboardInterrupt (at 0 s"
        in " ".join(told.split())
    )
    pressed = thermofleet("compare", *how, f"{policy}:Pressed")
    assert (pressed.code, pressed.err.partition(":")[0]) == (130, "Interrupted while comparing")


@pytest.mark.parametrize("is_package", [False, True])
def test_a_policy_is_another_one_when_what_it_imports_has_changed(tmp_path, monkeypatch, is_package):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    name = f"pol_{is_package}"
    folder = tmp_path / name if is_package else tmp_path
    folder.mkdir(exist_ok=True)
    (folder / "helper.py").write_text("import numpy\nfrom agents.policy import WAIT\n", encoding="utf-8")
    (folder / "other.py").write_text("", encoding="utf-8")
    if is_package:
        (folder / "__init__.py").write_text("from .impl import Mine\n", encoding="utf-8")
        (folder / "impl.py").write_text("from . import helper\nclass Mine: pass\n", encoding="utf-8")
    else:
        (folder / f"{name}.py").write_text("import helper\nclass Mine: pass\n", encoding="utf-8")
    policy = f"{name}:Mine" if is_package else f"{name}.py:Mine"
    hashes = [policy_hash(policy)]
    for changed in ("other.py", "helper.py"):
        with (folder / changed).open("a", encoding="utf-8") as file:
            file.write("x = 1\n")
        hashes.append(policy_hash(policy))
    assert hashes[0] == hashes[1] != hashes[2]
    if not is_package:
        (folder / "helper.py").write_text("def (", encoding="utf-8")
        assert policy_hash(policy)  # what cannot be loaded is told elsewhere


def test_a_worker_gives_every_policy_the_modules_beside_it(scenario, plans, tmp_path):
    """Of two policies of one worker process, whose helpers have one name, one waits and the other one works."""
    for folder, base in (("idle", "Idle"), ("busy", "Fifo")):
        (tmp_path / folder).mkdir()
        text = IDLE if base == "Idle" else "from agents.rules import Fifo\n"
        (tmp_path / folder / "helper.py").write_text(text, encoding="utf-8")
        (tmp_path / folder / "own.py").write_text(f"from helper import {base} as {base}Own\n", encoding="utf-8")
    own = [f"{tmp_path / 'idle' / 'own.py'}:IdleOwn", f"{tmp_path / 'busy' / 'own.py'}:FifoOwn"]
    rows = runner.run_study(study_of(scenario, *own, "fifo", seeds=1), cache_dir=plans, workers=1)
    idle, busy, fifo = (row.outcome for row in rows)
    assert idle is not None
    assert idle.finished == 0
    assert busy == fifo
    hashes = [policy_hash(each) for each in own]
    (tmp_path / "busy" / "helper.py").write_text("from agents.rules import Edd as Fifo\n", encoding="utf-8")
    assert [policy_hash(each) == before for each, before in zip(own, hashes, strict=True)] == [True, False]


@pytest.mark.ci_slow
def test_a_policy_that_catches_every_alarm_ends_with_its_process():
    code = """
from scenarios.evaluate import rollout as decision_limit
decision_limit.AGAIN_S, limit = 0.05, decision_limit.DecisionLimit(0.05)
def turn():
    while True: pass
def again(function):
    while True:
        try: function()
        except BaseException: pass
with limit.watching(), limit.decision():
    again(lambda: again(turn))  # one more level, for an alarm that comes while the one before is caught
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 1
    assert "longer than 0.05 s, and the policy catches what should end it" in ended.stderr


@pytest.mark.slow
def test_shifts_of_a_process_that_dies_are_run_again(scenario, plans, bad, monkeypatch):
    monkeypatch.setattr(runner, "HERE_S", 0.0)
    told: list[str] = []
    study = study_of(scenario, f"{bad}:DiesOnce", f"{bad}:DiesInOne", f"{bad}:Idle")
    rows = runner.run_study(study, cache_dir=plans, workers=2, tell=told.append)
    once, one, idle = ([row.outcome for row in rows[i : i + 3]] for i in (0, 3, 6))
    assert once == idle
    assert one == [idle[0], None, idle[2]]
    assert rows[4].error == "The process that ran it died 3 times."
    assert len(told) == 4
    assert sum(sentence.endswith("seed 1: given up.") for sentence in told) == 1


def test_instances_of_one_cell_share_a_prepared_fleet(scenario, plans, monkeypatch):
    """And have the outcomes of fleets that are prepared for each; what is warmer alone shares the plans."""
    hold, sort = scenario.jobs
    scenarios = [
        scenario,
        replace(scenario, name="late", jobs=(replace(hold, due_s=30.0), replace(sort, value=3.0, repetitions=(2, 4)))),
        replace(scenario, name="paid", reward=replace(scenario.reward, tardiness=-0.1), slots=3),
        replace(scenario, name="wide", clearance_m=0.03),
        replace(scenario, name="warm", ambient=replace(scenario.ambient, points=((0.0, 45.0),))),
    ]
    made: list[str] = []
    planned: list[str] = []

    def counted(scenario, **more):
        made.append(scenario.name)
        return preparing.prepare(scenario, **more)

    def plans_counted(scenario, *rest):
        planned.append(scenario.name)
        return plan_arms(scenario, *rest)

    monkeypatch.setattr(sources, "prepare", counted)
    monkeypatch.setattr(runner, "fleets", sources.Fleets())
    cases = [Case(name=each.name, scenario=each, seeds=(7,)) for each in scenarios]
    for difficulty in ("blind", "oracle"):
        made.clear()
        planned.clear()
        study = Study(policies=["round_robin"], cases=cases, difficulties=[difficulty])
        with monkeypatch.context() as patched:
            patched.setattr(preparing, "plan_arms", plans_counted)
            rows = runner.run_study(study, cache_dir=plans, workers=1)
        assert made == ["heat", "wide", "warm"]
        assert planned == ["heat", "wide"]
        assert [row.key.instance for row in rows] == ["heat", "late", "paid", "warm", "wide"]
        for each in scenarios:
            (row,) = [row for row in rows if row.key.instance == each.name]
            alone = prepare(each, difficulty=difficulty, cache=plans)
            assert row.outcome == outcomes(alone, "round_robin", [7])[0]


def test_several_instances_are_told_apart_or_together(scenario, plans):
    warm = replace(scenario, name="warm", ambient=replace(scenario.ambient, points=((0.0, 45.0),)))
    cases = [Case(name=each.name, scenario=each, seeds=(0, 1)) for each in (scenario, warm)]
    study = Study(policies=["random", "round_robin"], cases=cases, difficulties=["blind", "oracle"])
    rows = runner.run_study(study, cache_dir=plans, workers=1)
    apart = comparisons(study, rows, "random@oracle")
    assert [each.scenario for each in apart] == ["heat", "warm"]
    (together,) = comparisons(study, rows, "random@oracle", "both")
    names = ["random@blind", "round_robin@blind", "random@oracle", "round_robin@oracle"]
    assert list(together.figures) == names
    for name in names:
        means = [each.figures[name]["peak_c"].mean for each in apart]
        assert together.figures[name]["peak_c"].mean == pytest.approx(np.mean(means))
    with pytest.raises(FleetError, match="'random' is not among the policies compared: random@blind, "):
        comparisons(study, rows, "random")


@pytest.mark.ci_slow
def test_folders_of_trainings_are_one_policy(scenario, plans, tmp_path):
    for k in (0, 1, 10):
        save_pairs(np.eye(1, PARAMETERS)[0] * -9.0 * min(k, 2), tmp_path / f"pairs-{k}")  # refuses warm jobs, then all
    every = str(tmp_path / "pairs-*")
    rows = runner.run_study(study_of(scenario, "wsept", every), cache_dir=plans, workers=1)
    assert [(row.key.policy, row.key.training) for row in rows[::3]] == [("wsept", 0), *((every, k) for k in range(3))]
    apart = study_of(scenario, *(str(tmp_path / f"pairs-{k}") for k in (0, 1, 10)))
    alone = runner.run_study(apart, cache_dir=plans, workers=1)
    assert [row.outcome for row in rows[3:]] == [row.outcome for row in alone]
    assert rows[3].outcome != rows[6].outcome
    assert len({policy_hash(each) for each in (every, *apart.policies)}) == 4
    for given, said in (
        ({"trainings": 2, "difficulties": ["twin"]}, "has 3 trainings: then --trainings and"),
        ({"fleets": 2}, "then --trainings and --fleets must be 1"),
        ({"policies": [every, str(tmp_path / "pairs-1*")]}, "has 2 trainings, another policy 3: give as many"),
        ({"policies": [str(tmp_path / "none-*")]}, "There is no folder"),
        ({"policies": [str(tmp_path / "none-?")]}, "There is no folder"),
    ):
        with pytest.raises(FleetError, match=said):
            study_of(scenario, **({"policies": ["wsept", every]} | given))


def test_trainings_of_one_pattern_differ_in_their_seed_alone(scenario, tmp_path):
    recipe = {"suite": "train", "config": {"learning_rate": 0.02, "seed": 0}, "prepared": 48}
    for k, changed in enumerate(
        ({}, {"config": {"learning_rate": 0.02, "seed": 1}, "validation": 0.5, "iterations": 7}, {"prepared": 12})
    ):
        save_pairs(np.zeros(PARAMETERS), tmp_path / f"pairs-{k}", **(recipe | changed))
    assert study_of(scenario, str(tmp_path / "pairs-[01]*")).most_trainings == 2
    every = f"limited:{tmp_path / 'pairs-?'}"
    with pytest.raises(FleetError, match=r"pairs-0' has --instances = 48, '.*pairs-2' 12\. Give a pattern for each"):
        study_of(scenario, every)
    save_pairs(np.zeros(PARAMETERS), tmp_path / "pairs-2", **(recipe | {"config": {"learning_rate": 0.1, "seed": 2}}))
    with pytest.raises(FleetError, match=r"differ in more than their seed: .* has learning_rate = 0\.02, '.*-2' 0\.1"):
        study_of(scenario, every)
    save_pairs(np.zeros(PARAMETERS), tmp_path / "pairs-2", **recipe)
    assert study_of(scenario, every).most_trainings == 3


def test_seeds_of_instances_are_their_own():
    drawn = [seed for instance in range(50) for seed in seeds_of_instance(instance, 20)]
    assert len(set(drawn)) == 1000
    assert seeds_of_instance(7, 3)[0] == 7
    assert seeds_of_instance(7, 3) == seeds_of_instance(7, 20)[:3]


def test_a_worker_stays_with_its_group_and_helps_others_at_the_end(scenario):
    settings = runner.Settings.of(study_of(scenario), None)

    def works(name: str, count: int) -> list[runner.UnitWork]:
        case = Case(name=name, scenario=scenario, seeds=(0,))
        return [runner.UnitWork(Unit(str(i), case, 0, 0, "blind"), settings) for i in range(count)]

    queue = Queue([*works("a", 4), *works("b", 2)])
    first, second = queue.take(), queue.take()
    assert (first.unit.case.name, second.unit.case.name) == ("a", "b")
    assert queue.take(second.group).group == second.group
    assert queue.take(second.group).group == first.group
    unit = replace(first.unit, case=replace(first.unit.case, seeds=(5, 6)))
    queue.put_back(replace(first, unit=unit).after_death())
    left = [queue.take(first.group) for _ in range(4)]
    assert [(work.unit.case.seeds, work.deaths) for work in left] == [((5,), 1), ((6,), 1), ((0,), 0), ((0,), 0)]
    assert not queue


@pytest.mark.ci_slow
def test_the_command_tells_every_scenario_and_goes_on_in_its_folder(thermofleet, small_toml, bad, tmp_path):
    out = tmp_path / "study"
    how = ("--difficulty", "blind", "--seeds", "2", "--workers", "1", "--out", out)
    said = thermofleet("compare", small_toml, "--policies", f"round_robin,{bad}:Raises,{bad}:Illegal", *how).succeeded()
    told = " ".join(said.out.split())
    assert "Raises failed in 2 shifts, first in" in told
    assert "KeyError: 'nobody' (at 30 s of the shift)" in told
    assert "Illegal actions, which count as waits: Illegal 72." in said.out
    assert len(read_rows(out)) == 6
    page = (out / "index.html").read_text(encoding="utf-8")
    assert f"thermofleet compare {small_toml} --policies round_robin,{bad}:Raises" in page
    assert "KeyError: &#39;nobody&#39; (at 30 s of the shift)" in page
    told = thermofleet("compare", "--suite", small_toml, "--policies", "wspt,random", *how, "--fleets", "2", "--json")
    assert msgspec.json.decode(told.out)["scenario"] == str(small_toml)
    assert len(read_rows(out)) == 14
    for wrong, sentence in (
        ((), "Give either scenarios or --suite."),
        ((small_toml, "--workers", "2", "--ray", "auto"), "Give either --workers or --ray."),
        ((small_toml, "--references", "none.jsonl"), "There is no file of references 'none.jsonl'"),
    ):
        said = thermofleet("compare", *wrong)
        assert said.code != 0
        assert sentence in said.err
