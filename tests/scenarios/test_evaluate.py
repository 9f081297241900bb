"""Figures, scores and the oracle of a shift, against the shift run alone and integrated heat."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from agents.policy import WAIT
from agents.registry import RULES
from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.difficulty import KNOWN
from fleet.engine.shift import initial, step
from fleet.engine.world import warm_start
from fleet.errors import FleetError
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, drive_heat, gen3_network, node_heat, steady_state, thermal_model
from fleet.motion import Plan, drive
from fleet.robot import ThermalLimits
from fleet.seeding import shift_seeds
from scenarios.evaluate.rollout import FIGURES, Outcome, outcomes
from scenarios.evaluate.scores import Normalised, normalised, references_of, scores_of
from scenarios.evaluate.statistics import interval
from scenarios.evaluate.study import Case, Row, RowKey
from scenarios.policy_loader import PolicyFailed, policy_of
from scenarios.prepare.fleet import Fleet, prepare, with_surprises
from scenarios.prepare.oracle import Oracle, peaks
from scenarios.run.shift import run
from scenarios.spec.jobs import JobSampler, downtime_s, fault_price, weights_of
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import override, parse_scenario
from scenarios.spec.schema import Ambient, RewardSpec
from scenarios.suite.splits import manifest
from tests.scenarios.conftest import Known

SEEDS = (0, 3)
LATE = Channel(delay_s=25.0, loss=0.3)


class Restless:
    """A policy whose actions depend on how often it was asked."""

    scope = "central"

    def reset(self, rng) -> None:
        self.asked, self.rng = 0, rng

    def act(self, observations) -> dict[str, Any]:
        self.asked += 1
        arms = list(observations)[self.asked % 2 :]  # arms that are left out wait
        last = len(observations[arms[0]].action_mask) + 1
        return {arm: np.int64(self.rng.integers(-1, last)) if self.asked % 3 else WAIT for arm in arms}


class Stranger(Restless):
    def act(self, observations) -> dict[str, Any]:
        return {"arm_9": 1}


class Undecided(Restless):
    def act(self, observations) -> dict[str, Any]:
        return dict.fromkeys(observations, 0.5)


@pytest.fixture(scope="module", params=["hot", "in_turn"])
def fleet(request) -> Fleet:
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def hot(three_arms, job_streams) -> Fleet:
    """Three arms over their limits: they fault, and are late."""
    streams = job_streams(hold_until_s=400.0, sort_until_s=None, sort_due_s=40.0)
    given = {**three_arms, "name": "hot", "jobs": [streams["hold"], streams["sort"]]}
    return prepare(parse_scenario(given, Path("hot.toml")), difficulty="oracle")


@pytest.fixture(scope="module")
def in_turn(three_arms, job_streams) -> Fleet:
    """One job waits for another, and all finish before the end."""
    streams = job_streams(hold_until_s=0.0, sort_until_s=200.0, sort_due_s=30.0)
    given = {**three_arms, "name": "in_turn", "limits": {}, "jobs": [streams["sort"], streams["check"]]}
    return prepare(parse_scenario(given, Path("in_turn.toml")), difficulty="oracle")


def own(kind: type) -> str:
    return f"{__file__}:{kind.__name__}"


def one_by_one(fleet: Fleet, policy: str, seeds, channel: Channel = PERFECT) -> list[Outcome]:
    """The figures of each shift run alone, from its metrics."""
    found = []
    for seed in seeds:
        spec = RunSpec(policy=policy, seed=seed, bus="memory", channel=channel)
        result = run(fleet, spec, record=False)
        m = result.metrics
        found.append(
            Outcome(
                reward=result.reward, value=m.value, finished=m.finished, on_time=m.on_time, faults=m.faults,
                above_warning_min=m.above_warning_min, peak_c=max(m.peak_c.values()), availability=m.availability,
                insulation_ppb=max(m.insulation_ppb.values()), tool_drift_mm=max(m.tool_drift_mm.values()),
                hot_surface_min=m.hot_surface_min,
            )
        )  # fmt: skip
    return found


def check_equal(found: list[Outcome], other: list[Outcome]) -> None:
    assert len(found) == len(other)
    for one, two in zip(found, other, strict=True):
        assert asdict(one) == pytest.approx(asdict(two), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("policy", [*RULES, own(Restless)])
def test_the_batch_gives_the_figures_of_each_shift_run_alone(fleet, policy) -> None:
    check_equal(outcomes(fleet, policy, SEEDS), one_by_one(fleet, policy, SEEDS))


def test_no_figure_of_these_shifts_is_trivial(hot, in_turn) -> None:
    found = outcomes(hot, "round_robin", SEEDS)
    assert all(min(each.faults, each.above_warning_min, 1.0 - each.availability) > 0 for each in found)
    assert 0 < sum(each.on_time for each in found) < sum(each.finished for each in found)
    assert all(each.availability == 1 for each in outcomes(in_turn, "random", SEEDS))
    worked = run(in_turn, RunSpec(policy="random", seed=SEEDS[0], bus="memory"), record=False)
    assert worked.finished
    assert worked.time_s < in_turn.scenario.horizon_s  # all jobs are done


@pytest.mark.parametrize("channel", [PERFECT, LATE], ids=["perfect", "late"])
@pytest.mark.parametrize("policy", ["random", "consensus", own(Restless)])
def test_a_seed_gives_the_same_whatever_the_other_seeds_are(fleet, policy, channel) -> None:
    """To the last bit; also where some shifts end before others."""
    together = outcomes(fleet, policy, SEEDS, channel)
    assert [outcomes(fleet, policy, [seed], channel)[0] for seed in SEEDS] == together
    assert outcomes(fleet, policy, SEEDS[::-1], channel) == together[::-1]
    assert outcomes(fleet, policy, [0, 0], channel) == [together[0]] * 2
    assert len({each.reward for each in together}) > 1


def test_figures_with_late_messages_are_those_of_each_shift_run_alone(fleet) -> None:
    check_equal(outcomes(fleet, "consensus", SEEDS, LATE), one_by_one(fleet, "consensus", SEEDS, LATE))


def test_measured_heat_that_is_not_shared_at_once_is_not_known_to_policies_without_messages_either(hot) -> None:
    """With a load that is heavier than declared; as in each shift run alone."""
    heavier = {"kind": "payload", "jobs": "hold", "size": 1.5}
    fleet = with_surprises(replace(hot, scenario=override(hot.scenario, surprises=[heavier])))
    fleet = replace(fleet, arms=tuple(replace(arm, learns=True) for arm in fleet.arms))
    for policy in ("wsept_local", "wsept"):
        late, at_once = (outcomes(fleet, policy, range(12), channel) for channel in (LATE, PERFECT))
        differ = [seed for seed in range(12) if late[seed] != at_once[seed]][:2]
        assert differ
        check_equal([late[seed] for seed in differ], one_by_one(fleet, policy, differ, LATE))
        check_equal([at_once[seed] for seed in differ], one_by_one(fleet, policy, differ))


def test_a_channel_does_not_matter_to_a_policy_that_reads_no_peer(hot) -> None:
    star = Channel(topology="star")
    assert not star.perfect
    expected = outcomes(hot, "round_robin", SEEDS)
    check_equal(outcomes(hot, "round_robin", SEEDS, star), expected)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Stranger, r"No agent 'arm_9' in this fleet\. Agents: left, right, far\."),
        (Undecided, r"The action of 'left' must be one integer \(got 0\.5\)\."),
    ],
)
def test_actions_that_cannot_be_are_refused_with_the_same_message(hot, kind, said) -> None:
    for way in (outcomes, one_by_one):
        with pytest.raises(PolicyFailed, match=said):
            way(hot, own(kind), SEEDS)


def test_a_subclass_of_a_rule_is_asked_at_every_moment(hot, tmp_path) -> None:
    """It may have a memory that the rule has not."""
    file = tmp_path / "mine.py"
    file.write_text(
        "from agents.rules import RoundRobin\n"
        "class Slow(RoundRobin):\n"
        "    asked = 0\n"
        "    def act(self, seen):\n"
        "        self.asked += 1\n"
        "        return super().act(seen) if self.asked % 7 == 0 else dict.fromkeys(seen, 0)\n"
    )
    assert policy_of(f"{file}:Slow").only_choices  # pyright: ignore[reportAttributeAccessIssue]  # inherited
    found = outcomes(hot, f"{file}:Slow", SEEDS)
    check_equal(found, one_by_one(hot, f"{file}:Slow", SEEDS))
    assert replace(found[0], reward=0.0) != replace(outcomes(hot, "round_robin", SEEDS)[0], reward=0.0)


SHIFTS = [("test/0000", 7), ("test/0001", 8), ("test/0002", 9)]


REFERENCES = {
    SHIFTS[0]: Known("test/0000", 10.0, 20.0, 30.0),
    SHIFTS[1]: Known("test/0001", 0.0, 50.0, 50.0),
    SHIFTS[2]: Known("test/0002", 5.0, 5.0, 6.0),
}


def scored(by_policy: dict[str, list[Row]], known: dict[tuple[str, int], Known], **more: bool):
    return normalised(by_policy, known, **more)  # pyright: ignore[reportArgumentType]  # a stand-in


def rows_of(policy: str, rewards: dict[int, float | None], trainings: int = 1) -> list[Row]:
    """A row for each shift and training; training k has k more reward, None is a failure."""
    blank = Outcome(**dict.fromkeys(FIGURES, 0.0))
    return [
        Row(RowKey(policy, name, 0, k, "oracle", seed), replace(blank, reward=own + k) if own is not None else None)
        for (name, seed), own in zip(SHIFTS, rewards.values(), strict=True)
        for k in range(trainings)
    ]


def test_scores_are_shares_of_the_way_from_random_to_hindsight():
    by_policy = {"a": rows_of("a", {0: 15.0, 1: 50.0, 2: 5.0}), "b": rows_of("b", {0: 7.0, 1: 24.0, 2: 0.0}, 3)}
    values = scored(by_policy, REFERENCES)
    assert values is not None
    assert values.instances == ("test/0000", "test/0001", "test/0002")
    assert values.score["a"].tolist() == [pytest.approx([0.5, 1.0, 0.0])]
    assert values.score["b"].tolist() == [pytest.approx([-0.2, 0.5, -8.0])]  # means of trainings of twins: 8, 25, 1
    scores = scores_of(values, "b")
    assert scores.policies["a"].mean.mean == 0.5
    assert scores.policies["a"].difference.mean == pytest.approx(0.5 + 7.7 / 3)
    assert scores.policies["a"].optimality_gap.mean == 0.5
    assert scores.policies["a"].improvement.mean == 1.0


def test_where_heat_binds_has_a_mean_of_its_own():
    levels = {row.axes.heat: (row.name, row.seed) for row in manifest("test")}
    shifts = [levels["cool"], levels["warm"], levels["severe"]]
    known = {shift: Known(shift[0], 0.0, 10.0, 10.0) for shift in shifts}
    known[shifts[0]] = Known(shifts[0][0], 9.6, 10.0, 10.0)  # less than a tenth of 10 to gain
    blank = Outcome(**dict.fromkeys(FIGURES, 0.0))
    rows = [
        Row(RowKey("a", name, 0, 0, "oracle", seed), replace(blank, reward=reward))
        for (name, seed), reward in zip(shifts, (10.5, 6.0, 2.0), strict=True)
    ]
    values = scored({"a": rows}, known)
    assert values is not None
    (found,) = scores_of(values, "a").policies.values()
    assert found.hot is not None
    assert found.cool is not None
    assert (found.hot.mean, found.cool.mean) == pytest.approx((0.4, 0.9))
    assert values.reachable == "0.80 (1.00 where heat binds, 0.40 where it does not)"
    assert f"Mean score of the hindsight: {values.reachable}." in scores_of(values, "a").remarks[0]
    other = replace(values, instances=("quickstart/1", *values.instances[1:]))
    assert scores_of(other, "a").policies["a"].hot is None


def test_trainings_of_a_policy_are_a_sample_and_those_of_twins_are_not():
    rewards: dict[int, float | None] = {0: 15.0, 1: 40.0, 2: 5.0}
    by_policy = {"pairs-*": rows_of("pairs-*", rewards, 3), "a": rows_of("a", {0: 12.0, 1: 30.0, 2: 5.0})}
    values = scored(by_policy, REFERENCES)
    assert values is not None
    each = np.array([[0.5, 0.8, 0.0], [0.6, 0.82, 2.0], [0.7, 0.84, 4.0]])  # instances in columns
    assert values.score["pairs-*"].tolist() == [pytest.approx(row.tolist()) for row in each]
    learned = scores_of(values, "a").policies["pairs-*"]
    assert learned.mean == interval(values.score["pairs-*"][:, None])
    assert learned.mean.mean == pytest.approx(each.mean())
    # Three instances: with trainings as a sample the interval is wider than that of the means over trainings.
    given = interval(each.mean(axis=0))
    assert learned.mean.high - learned.mean.low > given.high - given.low
    assert scores_of(values, "a").remarks[0].startswith("Unit: 3 instances × 3 trainings of a policy.")


@pytest.mark.parametrize(
    ("cells", "unit"),
    [("ab", "2 instances, these 2 cells only"), ("aa", "2 instances, this cell only"), ("abc", "3 instances")],
)
def test_fewer_than_three_cells_are_no_sample(cells, unit):
    assert Normalised(tuple("xyz"[: len(cells)]), tuple(cells), {}, np.ones(len(cells))).unit == unit


def test_shifts_without_a_reference_are_counted_and_failures_can_count_as_random():
    rows = rows_of("a", {0: None, 1: 50.0, 2: 0.0})
    known = {shift: REFERENCES[shift] for shift in SHIFTS[:2]}
    values = scored({"a": rows}, known, failed_as_random=True)
    assert values is not None
    assert (values.missing, values.score["a"].tolist()) == (1, [[0.0, 1.0]])
    assert scored({"a": rows}, {}) is None
    with pytest.raises(ValueError, match="2 instances"):
        scores_of(replace(values, instances=("x",)), "a")


def test_a_file_of_references_counts_for_the_same_scenario_only():
    file = Path(__file__).parents[2] / "docs" / "results" / "bounds_library.jsonl"
    wave = load("heat_wave")
    case = Case(name="heat_wave", scenario=wave, seeds=(100, 104, 105))
    assert sorted(seed for _, seed in references_of([case], file)) == [100, 104]
    assert not references_of([replace(case, scenario=replace(wave, slots=wave.slots + 1))], file)


def test_of_several_references_of_a_shift_that_with_the_compared_predictions_counts(tmp_path):
    """In whatever order; their zeros differ. An older row of another scenario hides none."""
    file = Path(__file__).parents[2] / "docs" / "results" / "bounds_library.jsonl"
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    row = next(each for each in lines if each["instance"] == "heat_wave/100")
    blind = row | {"difficulty": "blind", "key": "blind", "random": row["random"] - 5.0}
    stale = row | {"scenario_hash": "0" * 16, "key": "stale", "random": 0.0}
    case = Case(name="heat_wave", scenario=load("heat_wave"), seeds=(100,))
    for order in ((row, blind, stale), (stale, blind, row)):
        (tmp_path / "rows").write_text("".join(json.dumps(each) + "\n" for each in order), encoding="utf-8")
        for source, random in ((row["difficulty"], row["random"]), ("blind", blind["random"])):
            (found,) = references_of([case], tmp_path / "rows", [source]).values()
            assert found.random == random
        for sources in ([], ["twin"], ["blind", row["difficulty"]]):
            with pytest.raises(FleetError, match=r"has references of heat_wave/100 with several --difficulty \("):
                references_of([case], tmp_path / "rows", sources)


def test_a_policy_that_declares_to_read_no_messages_cannot_read_them(scenario, plans, tmp_path):
    """Otherwise it would see all of them on a channel that loses most."""
    body = "    def reset(self, rng): pass\n    def choose(self, seen, arm_index): return int(seen.{} is None)\n"
    for name, field in (("fleet", "fleet_busy_s"), ("peer", "peer_working"), ("own", "busy_s")):
        text = f"class Deaf:\n    scope, reads_messages = 'arm', False\n{body.format(field)}"
        (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
    fleet = prepare(scenario, difficulty="blind", cache=plans)
    assert outcomes(fleet, f"{tmp_path / 'own.py'}:Deaf", [0], LATE)
    for name, field in (("fleet", "fleet_busy_s"), ("peer", "fleet_working")):
        policy = f"{tmp_path / name}.py:Deaf"
        said = f"declares reads_messages = False, but reads {field}, which its peers send"
        with pytest.raises(PolicyFailed, match=said):
            outcomes(fleet, policy, [0], LATE)
        with pytest.raises(PolicyFailed, match=said):
            run(fleet, RunSpec(policy=policy, difficulty="blind", channel=LATE, bus="memory"))


MOTORS, THERMAL = gen3_motors(), thermal_model(gen3_network())
FEARLESS = ThermalLimits(warning_c=900.0, error_c=1000.0)


def plan_of(small, payload_kg: float) -> Plan:
    content = small.work(payload_kg=payload_kg)
    return small.arm(0, [content]).plans[content][0]


def oracle(start_c=None) -> Oracle:
    start = np.full(14, 25.0) if start_c is None else start_c
    return Oracle(MOTORS, THERMAL, start, 25.0, 60.0)


@pytest.mark.parametrize(("payload_kg", "repetitions"), [(0.0, 30), (4.0, 90), (8.0, 40)])
def test_peaks_equal_those_of_a_shift(small, payload_kg, repetitions) -> None:
    content = small.work(payload_kg=payload_kg)
    arms = [small.arm(0, [content], times=small.Times(0.0, 10.0, 0.02))]
    jobs = [small.job("a", content, repetitions=repetitions)]
    world, plant = small.shop([jobs], arms=arms, ticks=repetitions, limits=FEARLESS)
    state = initial(world)
    for tick in range(repetitions):
        state = step(world, state, np.array([[int(tick == 0)]]), plant).state
    plan = arms[0].plans[content][0]
    start = np.full(14, 25.0)
    (actual,) = peaks([plan], [10.0 * repetitions], motors=MOTORS, thermal=THERMAL, start_c=start, ambient_c=25.0)
    assert actual == pytest.approx(state.temp_c[0, 0, WINDING], abs=5e-5)  # the engine has temperatures in float32
    assert actual.max() == pytest.approx(state.peak_c[0, 0], abs=5e-5)


@pytest.mark.parametrize("duration_s", [0.0, 12.0, 99.0])
def test_heating_time_is_the_duration_of_the_plan(small, duration_s) -> None:
    plan = plan_of(small, 6.0)
    start = np.full(14, 30.0)
    load = drive(plan.cycle.profile, MOTORS)

    def slope(_, temp_c):
        heat = drive_heat(temp_c, load.current_sq, load.friction_w, MOTORS)
        return (heat + THERMAL.to_ambient * 25.0 - THERMAL.laplacian @ temp_c) / THERMAL.capacity

    law = solve_ivp(slope, (0.0, duration_s), start, rtol=1e-9, atol=1e-9).y[WINDING]
    other = plan_of(small, 0.0)  # other plans in the same call have no effect
    actual = peaks([plan, other], [duration_s, 55.0], motors=MOTORS, thermal=THERMAL, start_c=start, ambient_c=25.0)
    assert actual[0, 1] == pytest.approx(law[1].max(), abs=0.01 + 0.02 * (law[1].max() - 30.0))


def test_no_plans_have_no_peaks() -> None:
    assert peaks([], [], motors=MOTORS, thermal=THERMAL, start_c=np.zeros(14), ambient_c=0.0).shape == (0, 7)


def test_more_payload_or_more_repetitions_is_never_easier(small) -> None:
    plans = [plan_of(small, kg) for kg in (0.0, 1.0, 2.0, 4.0, 8.0)]
    by_payload = [oracle().score(p, 60).total for p in plans]
    assert by_payload == sorted(by_payload)
    assert len(set(by_payload)) == len(plans)
    by_length = [oracle().score(plans[3], n).total for n in (1, 5, 50, 500)]
    assert by_length == sorted(by_length)
    risk = [oracle().score(p, 200).p_at(np.full(KNOWN, 25.0)) for p in plans]
    assert risk[0] == 0.0
    assert risk[-1] == 1.0


def test_p_is_that_of_the_true_motors_from_any_state(small) -> None:
    """Against the simulation of the same plan from random states that the arm knows exactly."""
    plan, rng = plan_of(small, 6.0), np.random.default_rng(0)
    score, sure = oracle().score(plan, 60), 0
    for _ in range(60):
        ambient_c = rng.uniform(15.0, 40.0)
        housing_c = ambient_c + rng.uniform(0.0, 22.0, 7)
        start_c = np.concatenate([housing_c + rng.uniform(0.0, 4.0, 7), housing_c])
        (peak,) = peaks(
            [plan], [plan.duration_s(60)], motors=MOTORS, thermal=THERMAL, start_c=start_c, ambient_c=ambient_c
        )
        known_c = np.append(start_c, ambient_c)
        if start_c[:7].max() < peak.max() < 80.0:
            assert score.peak_at(known_c) == pytest.approx(peak.max(), abs=0.6)
        if abs(peak.max() - 60.0) > 1.0:
            assert score.p_at(known_c) == float(peak.max() > 60.0)
            sure += 1
    assert sure > 30


def test_difficulty_follows_its_formula(small) -> None:
    plan = plan_of(small, 4.0)
    score = oracle().score(plan, 30)
    (peak,) = peaks(
        [plan], [plan.duration_s(30)], motors=MOTORS, thermal=THERMAL, start_c=np.full(14, 25.0), ambient_c=25.0
    )
    assert score.per_joint == pytest.approx([1.0 - math.exp(-(c - 25.0) / (60.0 - 25.0)) for c in peak])


def test_a_warm_start_is_the_steady_state_at_rest(small) -> None:
    arm = small.arm(0, [small.work()])
    rest = arm.rest_drive()
    assert warm_start(arm, 25.0) == pytest.approx(steady_state(THERMAL, rest.current_sq, rest.friction_w, MOTORS, 25.0))


@pytest.mark.parametrize(("power_off", "ambient_c"), [(True, 30.0), (False, 15.0)])
def test_the_downtime_is_the_integrated_cooling_of_a_long_loaded_arm(power_off, ambient_c) -> None:
    limits = ThermalLimits(power_off_on_fault=power_off, clear_s=45.0)
    model, idle_w = thermal_model(gen3_network()), node_heat(np.zeros(7), gen3_motors().idle_w)

    def rate(heat_w):
        return lambda _, temp_c: (heat_w + model.to_ambient * ambient_c - model.laplacian @ temp_c) / model.capacity

    def loaded_c(load_w: float) -> np.ndarray:
        heat_w = idle_w + load_w * np.eye(NODES)[1]
        return solve_ivp(rate(heat_w), (0.0, 1e5), np.full(NODES, ambient_c), method="LSODA", rtol=1e-8).y[:, -1]

    idle_c, by_watt_k = loaded_c(0.0), loaded_c(1.0) - loaded_c(0.0)
    start_c = idle_c + (limits.error_c - idle_c[1]) / by_watt_k[1] * by_watt_k

    def cool(_, temp_c):
        return temp_c[WINDING].max() - limits.restart_c

    after = np.zeros(NODES) if power_off else idle_w
    cooling = solve_ivp(rate(after), (0.0, 1e5), start_c, method="LSODA", rtol=1e-8, events=cool)
    assert downtime_s(limits, ambient_c, most_s=1e5) == pytest.approx(cooling.t_events[0][0] + 45.0, rel=1e-3)


def test_an_arm_that_never_cools_enough_is_lost_for_the_whole_shift() -> None:
    assert downtime_s(ThermalLimits(restart_c=30.0), 35.0, most_s=7200.0) == 7200.0


@pytest.mark.parametrize("name", ["quickstart", "active_waiting", "heat_wave"])
def test_the_value_rate_is_the_mean_of_drawn_shifts(name) -> None:
    scenario = load(name)
    sampler = JobSampler(scenario)
    drawn = [
        sum(job.value for job in sampler.jobs(shift_seeds(np.random.SeedSequence(seed))[0])) for seed in range(200)
    ]
    mean, error = np.mean(drawn), np.std(drawn) / np.sqrt(len(drawn))
    assert abs(fault_price(scenario).value_per_s * scenario.horizon_s - mean) < 4 * error


def test_a_scenario_without_a_weight_of_faults_takes_the_price() -> None:
    scenario = load("heat_wave")
    assert weights_of(scenario).faults == -fault_price(scenario).price
    assert weights_of(replace(scenario, reward=RewardSpec(faults=-3.0))).faults == -3.0
    hotter = replace(scenario, ambient=Ambient(points=((0.0, 36.0),)))
    assert weights_of(hotter).faults < weights_of(scenario).faults
