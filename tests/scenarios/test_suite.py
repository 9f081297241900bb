"""The suite: its splits never change; and stored results are those of its code."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from fleet.errors import ScenarioError
from scenarios.evaluate.leaderboard import read_all
from scenarios.evaluate.runner import run_study
from scenarios.evaluate.study import Study, suite_of
from scenarios.prepare.fleet import prepare
from scenarios.prepare.load_factor import load_factor
from scenarios.spec.jobs import all_works
from scenarios.spec.load import load
from scenarios.spec.parse import scenario_content
from scenarios.spec.schema import SPLITS, BusSpec, Scenario
from scenarios.suite.instances import BUSES, CELLS, DUE, Axes, layout, scenario_of
from scenarios.suite.splits import cell_of_instance, drawn_rows, instance, manifest, split

PLAIN = Axes(
    heat="warm", due="usual", arrivals="poisson", precedence="none", air="warm", faults="attended", bus="perfect"
)


@pytest.mark.parametrize("name", SPLITS)
def test_a_split_never_changes(name) -> None:
    """Draw every instance anew; the manifest has the hashes of its scenario and of its jobs."""
    frozen = manifest(name)
    assert len(frozen) >= (48 if name == "sizes" else 200)
    assert frozen == tuple(drawn_rows(name))


def test_splits_share_no_cell_and_no_seed() -> None:
    cells = [{row.cell for row in manifest(name)} for name in SPLITS]
    assert sum(map(len, cells)) == len(set.union(*cells)) == len(CELLS)
    seeds = [row.seed for name in SPLITS for row in manifest(name)]
    assert len(seeds) == len(set(seeds))
    assert len({(cell.seed, layout(cell)) for cell in CELLS}) == len(CELLS)


def test_instances_of_a_cell_share_what_is_prepared() -> None:
    """Plans depend on arms and works, twins besides on the air of past jobs, repetitions and limits of two kinds."""
    for row in manifest("validation")[:12]:
        scenario, plain = instance(row.name).scenario, scenario_of("plain", cell_of_instance(row), PLAIN, 0)
        arms = [replace(arm, sensor_noise_k=None) for arm in scenario.arms]
        assert (arms, scenario.places, scenario.twin) == (list(plain.arms), plain.places, plain.twin)
        assert (all_works(scenario), scenario.spread) == (all_works(plain), plain.spread)
        assert {stream.repetitions for stream in scenario.jobs} == {stream.repetitions for stream in plain.jobs}


def test_axes_are_honoured() -> None:
    cell = next(cell for cell in CELLS if cell.name == "bench_4_assembly")

    def at(**values) -> Scenario:
        return scenario_of("x", cell, replace(PLAIN, **values), 3)

    plain = at()
    counts = {kind: sum(s.arrivals.expected(7200.0) for s in at(arrivals=kind).jobs) for kind in ("batch", "rush")}
    expected = sum(stream.arrivals.expected(7200.0) for stream in plain.jobs)
    assert counts["rush"] == pytest.approx(expected, rel=1e-3)
    assert counts["batch"] == pytest.approx(expected, rel=0.25)
    traced = [sum(s.arrivals.expected(7200.0) for s in scenario_of("x", cell, replace(PLAIN, arrivals="trace"), n).jobs)
              for n in range(20)]  # fmt: skip
    assert np.mean(traced) == pytest.approx(expected, abs=4 * np.sqrt(expected / 20))
    assert [s.due_s for s in at(due="tight").jobs] == [DUE["tight"] * s.due_s for s in plain.jobs]
    assert {s.due for s in at(due="hard").jobs} == {"hard"}
    chained = at(precedence="chain", arrivals="rush").jobs
    assert {s.name: s.after for s in chained}["rush_join_00"] == ("rush_hold_part_00",)
    assert at(faults="unattended").limits.clear_s > 10 * plain.limits.clear_s
    assert [arm.sensor_noise_k for arm in at(faults="noisy").arms] == [None, 2.0] * 2
    assert at(bus="late").bus == BUSES["late"] != BusSpec()
    (cut,) = at(bus="cut").bus.partitions
    assert cut.cuts([arm.name for arm in plain.arms]).sum() == 8
    assert [c for _, c in at(air="rising").ambient.points] == [22.0, 31.0]


def test_heat_severity_raises_the_thermal_load(plans) -> None:
    cell = next(cell for cell in CELLS if cell.arms == 2)
    scenario = scenario_of("x", cell, PLAIN, 0)
    fleet = prepare(scenario, difficulty="blind", cache=plans)
    assert {len([arm for arm in fleet.arms if work in arm.plans]) for work in all_works(scenario)} == {2}
    from scenarios.prepare.fleet import ShiftFactory

    loads = []
    for heat in ("mild", "severe"):
        hotter = replace(fleet, scenario=scenario_of("x", cell, replace(PLAIN, heat=heat), 0))
        worlds = [ShiftFactory(hotter)(np.random.SeedSequence(seed)).world for seed in range(4)]
        loads.append(np.mean([load_factor(world).thermal for world in worlds]))
    assert loads[1] > 1.3 * loads[0]


def test_a_default_changes_no_hash() -> None:
    scenario = load("quickstart")
    assert "bus" not in scenario_content(scenario)
    assert scenario_content(replace(scenario, bus=BusSpec(loss=0.5)))["bus"] == {"loss": 0.5}


def test_an_instance_is_loaded_by_name() -> None:
    first = split("test")[0]
    assert load("test/0000") == first.scenario == instance("test/0000").scenario
    with pytest.raises(ScenarioError, match=r"No instance 'test/9999' in the suite; they are test/0000 to test/0"):
        load("test/9999")
    with pytest.raises(ScenarioError, match="split"):
        split("exam")


@pytest.mark.slow
@pytest.mark.parametrize("cell", [cell for cell in CELLS if cell.arms <= 8], ids=lambda cell: cell.name)
def test_three_quarters_of_the_arms_of_a_cell_can_work_at_once(cell) -> None:
    from scenarios.show.layout import layout_report

    report = layout_report(scenario_of("x", cell, PLAIN, 0))
    assert report.problems == ()
    assert len(report.at_once) >= 0.75 * cell.arms


OTHERWISE = {
    **dict.fromkeys(("ssi", "matching", "matching_ahead", "wsept_learned"), "predictions from noisy sensors"),
    "quickest_matching": "two assignments that take equally long",
    "mpc": "no schedule is simulated twice, and rewards of less than a hundredth do not count",
}
"""Policies that claim other jobs than in the stored shift, and why: it had another stream of sensor noise, and float64.

Results that are made anew need no exceptions.
"""

RESULTS = Path(__file__).parents[2] / "docs" / "results" / "leaderboard"


@pytest.mark.ci_slow
def test_stored_results_of_built_in_policies_repeat():
    """One shift of each, with the present code: a change of a policy needs new results."""
    found = [each for each in read_all(RESULTS, "test") if not each.card.policy_hash]
    for difficulty in {each.card.difficulty for each in found}:
        stored = {each.card.policy: each for each in found if each.card.difficulty == difficulty}
        study = Study(policies=list(stored), cases=suite_of("test/0000", 1), difficulties=[difficulty])
        for row in run_study(study, workers=1):
            (before,) = [own.figures for own in stored[row.key.policy].rows if own.instance == "test/0000"]
            assert row.outcome is not None
            if row.key.policy in OTHERWISE:
                assert row.outcome.reward == pytest.approx(before[0], rel=0.03), row.key
            else:  # times above a limit that is passed slowly, in float32
                assert list(asdict(row.outcome).values()) == pytest.approx(before, rel=1e-3, abs=1e-6), row.key
