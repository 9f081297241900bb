"""Bounds of the reward: no play exceeds the upper one, the search is between its start and the proven optimum."""

import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.registry import RULES
from fleet.engine.batch import RewardWeights
from fleet.env.random_actions import random_legal
from fleet.errors import FleetError
from fleet.robot import ThermalLimits
from scenarios.evaluate import references as stored
from scenarios.evaluate.hindsight import ScheduleReplay, Schedules, ShiftSimulator, hindsight, without_scores
from scenarios.evaluate.references import load_references, reference, reference_table, references
from scenarios.evaluate.rollout import outcomes
from scenarios.evaluate.scores import split_file
from scenarios.evaluate.upper_bound import HeatBudget, Relaxation, upper_bound
from scenarios.policy_loader import policy_at
from scenarios.prepare.fleet import Fleet, ShiftFactory, env_of, prepare
from scenarios.spec.jobs import weights_of
from scenarios.spec.options import Budget
from scenarios.spec.parse import parse_scenario
from scenarios.spec.schema import SPLITS
from scenarios.suite.splits import Instance, instance, manifest
from tests.exhaustive import optimum

HOT = ThermalLimits(warning_c=40.0, error_c=46.0, restart_c=36.0, clear_s=10.0, move_home_s=30.0)
DEAR = RewardWeights(tardiness=-0.5, above_warning=-2.0, faults=-1.5, energy=-0.05)
PLAYERS = ("wspt", "round_robin", "coolest_first", "random")


class Restless:
    """Every arm takes any legal action, waiting and giving back included."""

    scope = "central"

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def reset(self, rng) -> None:
        pass

    def act(self, observations):
        masks = np.stack([seen.action_mask for seen in observations.values()])
        return dict(zip(observations, random_legal(masks, self._rng).tolist(), strict=True))


def played(world, weights, seed):
    policies = [*(policy_at(name, seed) for name in PLAYERS), *map(Restless, range(seed, seed + 4))]
    return ShiftSimulator(world, weights, len(policies)).follow(policies)


@settings(max_examples=12)
@given(seed=st.integers(0, 10_000), crowding=st.sampled_from([0.0, 0.5]), hot=st.booleans(), period_s=st.just(30.0))
def test_no_play_exceeds_the_upper_bound(small, seed, crowding, hot, period_s):
    limits = HOT if hot else ThermalLimits()
    shifts = small.Shifts(arms=3, jobs=8, ticks=50, limits=limits, crowding=crowding, hard_due=0.3)
    world, _ = shifts.shop(shifts.drawn(np.random.SeedSequence(seed))[0])
    bound = upper_bound(Relaxation(world, DEAR, period_s))
    assert played(world, DEAR, seed).reward.max() <= bound.reward <= bound.linear + 1e-4
    assert upper_bound(Relaxation(world, DEAR, 1e9), heat=False).reward >= bound.reward - 1e-3


TINY = ((0, 3), (0, 4), (6, 3), (7, 3))
"""Seeds and numbers of jobs of shifts with at most 100 000 states."""


@pytest.mark.parametrize(("seed", "jobs"), TINY)
def test_search_finds_the_proven_optimum_of_tiny_shifts(small, seed, jobs):
    shifts = small.Shifts(arms=2, jobs=jobs, ticks=10)
    drawn = [
        replace(job, repetitions=min(job.repetitions, 3), due_s=job.release_s + 15.0)
        for job in shifts.drawn(np.random.SeedSequence(seed))[0]
    ]
    world, _ = shifts.shop(drawn)
    weights = RewardWeights(tardiness=-0.5, faults=-10.0)
    best = optimum(world, weights)
    starts = played(world, weights, seed)
    found = hindsight(
        ShiftSimulator(world, weights, 16), starts, np.random.SeedSequence(seed), Budget(evaluations=1500)
    )
    assert starts.reward.max() <= found.reward <= best + 1e-9
    assert found.reward == pytest.approx(best, abs=1e-9)
    assert best <= upper_bound(Relaxation(world, weights, 10.0)).reward


def test_time_to_compile_is_no_part_of_the_search(small, monkeypatch):
    clock_s = 0.0
    monkeypatch.setattr(time, "process_time", lambda: clock_s)

    class Compiling(ShiftSimulator):
        """Takes a minute for its first simulation and a second for each other one."""

        def run(self, schedules):
            nonlocal clock_s
            clock_s += 1.0 if clock_s else 60.0
            return super().run(schedules)

    world, _ = small.Shifts().shop(small.Shifts().drawn(np.random.SeedSequence(1))[0])
    starts = played(world, DEAR, 1)
    simulator, budget = Compiling(world, DEAR, 8), Budget(seconds=10.0)
    found = hindsight(simulator, starts, np.random.SeedSequence(0), budget)
    assert found.seconds == 10.0
    assert found.evaluations >= 10 * 8
    assert clock_s == 70.0


def test_a_schedule_runs_the_same_compiled_and_not(small):
    shifts = small.Shifts(arms=2, jobs=4, ticks=12, limits=HOT)
    world, _ = shifts.shop(shifts.drawn(np.random.SeedSequence(1))[0])
    rng = np.random.default_rng(0)
    shape = (6, 4)
    schedules = Schedules(
        rng.integers(2, size=shape), np.zeros(shape, int), rng.random(shape), 10.0 * rng.integers(4, size=shape)
    )
    both = [ShiftSimulator(world, DEAR, 6, compiled=compiled).run(schedules) for compiled in (True, False)]
    assert both[0].claims == both[1].claims
    np.testing.assert_allclose(both[0].reward, both[1].reward, rtol=1e-12)


def test_the_effect_of_heat_on_a_motor_is_that_of_a_simulated_joule(small):
    shifts = small.Shifts(arms=1, jobs=3, ticks=120)
    world, _ = shifts.shop(shifts.drawn(np.random.SeedSequence(3))[0])
    relaxation = Relaxation(world, DEAR, 60.0)
    budget = HeatBudget(relaxation)
    low, high = budget._effect(0, 1, 600.0, 1200.0)
    for node, tick in ((1, 12), (8, 40), (1, 70), (9, 95)):
        heat_w = np.repeat(relaxation.base_w[:, None], world.ticks, axis=1)
        heat_w[0, tick, node] += 1000.0 / world.dt_s
        change = budget._integral(heat_w) - budget.base_integral
        true = change[0, 60:120, 1].sum() / 1000.0
        period = tick // 6
        assert low[period, node] <= true <= high[period, node]
        assert true == pytest.approx((low[period, node] + high[period, node]) / 2, rel=0.5)


def test_heat_budgets_lower_the_bound_where_heat_is_dear(small):
    """One arm, and holds that bring it past the warning limit in minutes, which costs more than they earn."""
    hold = small.work("bench", small.HOT)
    jobs = [small.job(f"job_{i}", hold, repetitions=12, release_s=0.0, value=1.0) for i in range(12)]
    world, _ = small.shop([jobs], arms=1, ticks=200, limits=ThermalLimits())
    weights = RewardWeights(above_warning=-5.0, faults=-50.0)
    relaxation = Relaxation(world, weights, 100.0)
    cool = upper_bound(relaxation)
    assert cool.budgets > 0
    assert cool.reward < 0.8 * upper_bound(relaxation, heat=False).reward
    assert played(world, weights, 0).reward.max() <= cool.reward


def test_a_shift_without_jobs_has_bounds(small):
    world, _ = small.shop([[]], arms=[small.arm(0, (small.work(),))])
    starts = played(world, DEAR, 0)
    found = hindsight(ShiftSimulator(world, DEAR, 4), starts, np.random.SeedSequence(0), Budget(evaluations=10))
    assert starts.reward.max() == found.reward <= upper_bound(Relaxation(world, DEAR)).reward


def test_weights_with_other_signs_are_refused(small):
    world, _ = small.shop([[small.job("a")]])
    with pytest.raises(ValueError, match=r"energy = 0\.1"):
        Relaxation(world, RewardWeights(energy=0.1))


@pytest.fixture(scope="module")
def fleet(three_arms, job_streams, plans: Path) -> Fleet:
    streams = list(job_streams(300.0, None, 200.0).values())
    scenario = parse_scenario(three_arms | {"name": "three", "jobs": streams, "horizon_s": 600.0}, Path("three.toml"))
    return prepare(scenario, difficulty="blind", cache=plans)


def test_a_reference_is_between_its_parts_and_its_schedule_can_be_replayed(fleet: Fleet):
    task = Instance("three/4", fleet.scenario, 4)
    found = reference(fleet, task, Budget(evaluations=64, nodes=20), difficulty="blind")
    shipped = {name: outcomes(fleet, name, [4])[0].reward for name in RULES if name != "random"}
    assert found.best_rule == pytest.approx(max(shipped.values()), abs=1e-9)
    assert shipped[found.rule] == pytest.approx(found.best_rule, abs=1e-9)
    assert found.best_rule <= found.hindsight <= found.upper <= found.linear + 1e-3
    assert (found.normalised(found.random), found.normalised(found.hindsight)) == (0.0, 1.0)
    env, policy, reward = env_of(fleet, bus="memory"), ScheduleReplay(found.claims), 0.0
    env.reset(seed=4)
    while env.agents:
        reward += next(iter(env.step(policy.act(env.knowledge()))[1].values()))
    assert reward == pytest.approx(found.hindsight, abs=1e-6)


def test_a_search_starts_from_a_known_schedule(fleet: Fleet):
    task = Instance("three/1", fleet.scenario, 1)
    found = reference(fleet, task, Budget(evaluations=200), difficulty="blind", bound=False)
    again = reference(fleet, task, Budget(evaluations=1), difficulty="blind", bound=False, known=found.claims)
    assert again.hindsight >= found.hindsight - 1e-9 > found.best_rule
    assert (again.rule, again.best_rule) == (found.rule, found.best_rule)
    alone = reference(fleet, task, Budget(evaluations=1), difficulty="blind", bound=False, policies=("fifo",))
    assert alone.rule == "fifo"
    assert alone.best_rule < found.best_rule


def test_finished_rows_are_kept_and_a_larger_budget_searches_again(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    calls: list[tuple[str, int]] = []
    one = reference(
        fleet, Instance("three/1", fleet.scenario, 1), Budget(evaluations=1), difficulty="blind", bound=False
    )

    def counted(fleet, task, budget, *, known, **options):
        calls.append((task.name, len(known)))
        found = replace(one, instance=task.name, seed=task.seed, search_s=budget.seconds, nodes=budget.nodes)
        return replace(found, upper=100.0 - budget.seconds - budget.nodes / 1e6)

    monkeypatch.setattr(stored, "reference", counted)
    monkeypatch.setattr(stored, "_fleet_of", lambda *_: fleet)
    tasks = [Instance(f"three/{seed}", fleet.scenario, seed) for seed in (1, 2)]
    path = tmp_path / "bounds.jsonl"
    short = references(tasks, path, Budget(seconds=1.0), difficulty="blind")
    assert references(tasks, path, Budget(seconds=1.0), difficulty="blind") == short
    assert calls == [("three/1", 0), ("three/2", 0)]
    longer = references(tasks, path, Budget(seconds=5.0), difficulty="blind")
    assert calls[2:] == [("three/1", len(one.claims)), ("three/2", len(one.claims))]
    assert [asdict(each) for each in load_references(path)] == [asdict(each) for each in longer]
    proved = references(tasks, path, Budget(seconds=1.0, nodes=9000), difficulty="blind")  # more nodes, a lower bound
    assert [each.nodes for each in proved] == [9000, 9000]
    assert [each.upper for each in proved] == [each.upper for each in longer]
    path.write_text(path.read_text().replace('"claims": [[', '"claims": [["x", '), encoding="utf-8")
    with pytest.raises(FleetError, match=r"A row of '.*bounds.jsonl' has a missing or odd value .* remove the row"):
        references(tasks, path, Budget(seconds=1.0), difficulty="blind")


@pytest.mark.ci_slow
def test_a_budget_of_evaluations_gives_the_same_file_in_any_order(fleet: Fleet, tmp_path: Path):
    tasks = [Instance(f"three/{seed}", fleet.scenario, seed) for seed in (2, 10)]
    budget, plans = Budget(seconds=np.inf, evaluations=16, nodes=2), tmp_path / "plans"
    once = references(tasks, tmp_path / "once.jsonl", budget, difficulty="blind", cache=plans)
    for task in reversed(tasks):  # as of a run that was stopped
        references([task], tmp_path / "twice.jsonl", budget, difficulty="blind", cache=plans)
    assert (tmp_path / "once.jsonl").read_bytes() == (tmp_path / "twice.jsonl").read_bytes()
    assert [each.instance for each in once] == ["three/2", "three/10"]
    assert "CPU s" not in reference_table(once).headings  # times would depend on other load, so they are unknown
    assert "CPU s" in reference_table([replace(once[0], seconds=1.0)]).headings


def test_rewards_do_not_depend_on_predictions_that_only_policies_read(small):
    shifts = small.Shifts(arms=3, jobs=8, ticks=40, crowding=0.3)
    world, _ = shifts.shop(shifts.drawn(np.random.SeedSequence(5))[0])
    policies = [policy_at(name, 5) for name in PLAYERS]
    scored = ShiftSimulator(world, DEAR, 4).follow(policies)
    again = ShiftSimulator(without_scores(world), DEAR, 4).follow([ScheduleReplay(claims) for claims in scored.claims])
    np.testing.assert_allclose(scored.reward, again.reward, rtol=1e-12)


def test_references_of_the_splits_are_of_their_instances():
    for split in SPLITS:
        lines = {line.name: line for line in manifest(split)}
        path = split_file(split)
        rows = load_references(path) if path.is_file() else []
        assert [each.instance for each in rows] == sorted({each.instance for each in rows})
        for each in rows:
            line = lines[each.instance]
            assert (each.scenario_hash, each.seed, each.search_s) == (line.scenario, line.seed, None)
            assert each.best_rule <= each.hindsight <= each.upper <= each.linear + 1e-3
            assert each.random < each.hindsight


@pytest.mark.slow
def test_stored_schedules_still_have_their_rewards():
    """Those of the files are of an engine in float64."""
    for each in load_references(split_file("test"))[:3]:
        own = instance(each.instance)
        fleet = prepare(own.scenario, difficulty="blind")
        world = ShiftFactory(fleet)(np.random.SeedSequence(own.seed)).world
        simulator = ShiftSimulator(without_scores(world), weights_of(fleet.scenario), 1)
        assert simulator.follow([ScheduleReplay(each.claims)]).reward[0] == pytest.approx(each.hindsight, rel=1e-6)


def test_an_instance_has_one_seed_and_a_scenario_as_many_as_given():
    assert [task.name for task in stored.tasks_of("test/0013,quickstart", 2, 0)] == [
        "test/0013",
        "quickstart/0",
        "quickstart/1",
    ]
    assert len(stored.tasks_of("quickstart", None, 0)) == 5
    assert [task.seed for task in stored.tasks_of("test/0013,test/0014", None, 0)] == [
        instance("test/0013").seed,
        instance("test/0014").seed,
    ]
    with pytest.raises(FleetError, match="leave --seeds 2 out"):
        stored.tasks_of("test/0013", 2, 0)
