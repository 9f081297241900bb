"""The rolling horizon and model predictive control against every plan there is; neither sees the future."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from agents.planners import NONE, Mpc, RollingHorizon, Sequences, _Memory, pack
from agents.policy import WAIT, EveryArm, Local, PlanningPolicy
from agents.registry import RULES, make_policy
from agents.schedules import Schedules
from fleet.engine.batch import Engine, RewardWeights, empty_parts
from fleet.env.lookahead import CellSimulator, Lookahead
from fleet.errors import FleetError
from fleet.observation import Layout, Observation
from fleet.robot import ThermalLimits
from scenarios.evaluate.hindsight import ShiftSimulator
from scenarios.live.auctioneer import central_allocation
from scenarios.policy_loader import policy_of, without_simulator
from scenarios.spec.load import load
from tests.agents.observations import observation
from tests.exhaustive import optimum
from tests.profiles import examples
from tests.shifts import with_work

WARNING_C = 60.0


def seen(
    duration_s,
    value,
    peak_c: ArrayLike = 0.0,
    *,
    due_s: ArrayLike = 9e4,
    temp_c=40.0,
    station_free=1.0,
    busy_s=0.0,
    **fields,
):
    """What an arm knows that has one plan for each job."""
    d, idle = np.array(duration_s, dtype=float), busy_s == 0.0
    known = {
        "working": float(not idle),
        "busy_s": busy_s,
        "station_free": np.broadcast_to(station_free, d.shape),
        "duration_s": d,
        "value": np.array(value, dtype=float),
        "due_in_s": np.broadcast_to(due_s, d.shape),
        "peak_c": np.broadcast_to(peak_c, d.shape),
        "p_saturation": np.full(len(d), 0.001),
        "temp_c": np.full(7, temp_c),
        "ambient_c": 25.0,
        "headroom_k": WARNING_C - temp_c,
        "error_headroom_k": 75.0 - temp_c,
    }
    return observation(len(d), legal=(np.broadcast_to(station_free, d.shape) > 0) & idle, **{**known, **fields})


def act(*fleet: Observation) -> list[int]:
    return list(RollingHorizon().act({f"arm_{i}": each for i, each in enumerate(fleet)}).values())


@examples(40)
@given(st.integers(0, 2**32))
def test_the_program_finds_the_best_of_all_selections(seed) -> None:
    rng, arms, jobs = np.random.default_rng(seed), 3, 4
    rows = []
    for _ in range(arms):
        first = rng.integers(0, jobs, 4)
        second = np.where(rng.random(4) < 0.5, (first + rng.integers(1, jobs, 4)) % jobs, NONE)
        rows.append(Sequences(first, second, np.zeros(4, bool), rng.random(4) + 0.01))
    best = 0.0
    for choice in product(range(-1, 4), repeat=arms):
        taken = [job for row, i in zip(rows, choice, strict=True) if i >= 0 for job in (row.first[i], row.second[i])]
        taken = [job for job in taken if job != NONE]
        if len(set(taken)) == len(taken):
            best = max(best, sum(float(row.worth[i]) for row, i in zip(rows, choice, strict=True) if i >= 0))
    solution = pack(rows, jobs, 1, 5.0, 10**6)
    assert solution.worth == pytest.approx(best)
    assert solution.gap == pytest.approx(0.0, abs=1e-4)


def test_without_time_for_the_solver_the_sequences_are_still_compatible() -> None:
    row = Sequences(np.array([0, 0, 1]), np.array([NONE, 1, NONE]), np.zeros(3, bool), np.array([1.0, 1.5, 0.9]))
    solution = pack([row, row], 2, 1, 0.0, 10**6)
    jobs = [job for i in solution.chosen for job in (row.first[i % 3], row.second[i % 3]) if job != NONE]
    assert solution.chosen
    assert len(set(jobs)) == len(jobs)


def test_two_jobs_go_to_two_arms_and_the_dear_one_before_the_cheap_one() -> None:
    assert sorted(act(seen([600.0, 600.0], [1, 4]), seen([600.0, 600.0], [1, 4]))) == [1, 2]
    assert act(seen([600.0, 600.0], [1, 4])) == [2]
    assert act(seen([600.0, 600.0], [1, 1], due_s=[9e4, 700.0])) == [2]


def test_a_job_waits_for_the_arm_that_does_it_at_once_when_it_is_home_soon() -> None:
    """The free arm needs an hour for the job, the other five minutes from in a minute on."""
    slow, quick = seen([3600.0], [4]), seen([300.0], [4], busy_s=60.0)
    assert act(slow, quick) == [WAIT, WAIT]
    assert act(slow, seen([300.0], [4], busy_s=3500.0)) == [1, WAIT]


def test_a_sure_fault_is_no_plan_and_a_hot_job_leaves_no_second_one() -> None:
    assert act(seen([600.0], [4], [95.0])) == [WAIT]
    policy = RollingHorizon()
    cool, hot = (policy.sequences(seen([600.0, 600.0], [4, 4], peak), 0.0) for peak in (50.0, 72.0))
    assert (cool.second != NONE).sum() == 2
    assert (hot.second != NONE).sum() == 0


@examples(50)
@given(st.floats(60, 3000), st.floats(60, 3000), st.floats(40, 90), st.floats(40, 90), st.floats(20, 40))
def test_the_second_peak_is_that_of_a_network_with_one_time_constant(first_s, second_s, one_c, two_c, start_c) -> None:
    """dT/dt = (T∞ − T) / τ, T∞ of each job at least the start: peaks from the start, and one job after the other."""
    tau_s = RollingHorizon.tau_s

    def run(begin_c, steady_c, time_s):
        return steady_c + (begin_c - steady_c) * np.exp(-time_s / tau_s)

    predicted = np.array([run(start_c, one_c, first_s), run(start_c, two_c, second_s)])
    one = seen([first_s, second_s], [4, 4], predicted, temp_c=start_c)
    policy = RollingHorizon()
    after_c = run(start_c, one_c, first_s)
    _, peak_c = policy._earn(one, predicted, np.array([first_s]), np.array([after_c]), start_c, np.array([1]))
    assert peak_c[0] == pytest.approx(max(after_c, run(after_c, two_c, second_s)), abs=1e-3)


def test_an_award_costs_the_expected_loss_by_a_fault_discounted_until_its_start() -> None:
    """At 78 °C, 3 K above the limit, a fault is as likely as none: half of the value 4 and of the price 20."""
    fleet = {"arm_0": seen([600.0] * 2, [4, 4], [78.0, 40.0]), "arm_1": seen([600.0] * 2, [4, 4], [40.0, 40.0])}
    loss = Mpc().expected_loss(fleet)
    assert loss.ravel() == pytest.approx([12.0, 0.0, 0.0, 0.0], abs=1e-3)

    start_s = np.array([[100.0, 1900.0], [1900.0, np.inf], [50.0, 100.0]])  # before the present: not again; inf: never

    class Simulator:
        def run(self, schedules, discount) -> SimpleNamespace:
            return SimpleNamespace(reward=np.array([10.0, 10.0, 10.0]), start_s=start_s)

    arm = np.array([[0, 1], [0, 0], [0, 1]])
    three = Schedules(arm, np.zeros_like(arm), np.array([[1.0, 2.0], [2.0, 1.0], [1.0, np.inf]]), np.zeros(arm.shape))
    rewards, _ = _Memory(Simulator(), np.ones(9), 100.0, loss, 1800.0).run(three)
    assert rewards == pytest.approx([-2.0, 10.0 - 12.0 / np.e, 10.0], abs=1e-3)


HOT = ThermalLimits(warning_c=40.0, error_c=46.0, restart_c=36.0, clear_s=10.0, move_home_s=30.0)
WEIGHTS = RewardWeights(tardiness=-0.5, faults=-10.0)


def simulator_of(world, weights=WEIGHTS):
    tables = with_work(world, difficulty=np.nan).tables  # the arms share it
    return CellSimulator(tables, len(world.arms), world.slots, weights)


def begun(world):
    """An engine at the beginning of the shift of a world, and both parts of its observations."""
    layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job)
    engine = Engine(world.tables, 1, layout, WEIGHTS, jobs=world.jobs)
    parts = empty_parts(layout, 1)
    engine.reset(np.arange(1), world.shifts)
    engine.observe(np.arange(1), parts)
    return engine, parts


def seen_by(world, engine, parts):
    shared, own = parts
    return engine.layout.read_each(world.arms, shared[0], own[0], engine.mask[0])


def alone(name):
    return without_simulator(name, policy_of(name))


def played(world, policy, *, seed=0, weights=WEIGHTS):
    policy.reset(np.random.default_rng(seed))
    return ShiftSimulator(world, weights, 1, simulator=lambda: simulator_of(world, weights)).follow([policy])


@pytest.mark.ci_slow
@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), hot=st.booleans(), moment=st.sampled_from([50.0, 100.0]))
def test_no_job_before_its_release_changes_a_claim(small, seed, hot, moment):
    shifts = small.Shifts(arms=3, jobs=10, ticks=40, limits=HOT if hot else ThermalLimits(), crowding=0.3)
    jobs = sorted(shifts.drawn(np.random.SeedSequence(seed))[0], key=lambda job: job.release_s)
    jobs = [replace(job, after=()) for job in jobs]
    other = [
        job
        if job.release_s <= moment
        else replace(job, value=9.0, repetitions=7, work=small.work("bench", small.HOT), due_s=job.release_s + 5.0)
        for job in jobs
    ]
    both = [played(shifts.shop(some)[0], Mpc()).claims[0] for some in (jobs, other, other[:-1])]
    early = [[claim for claim in claims if claim[0] * 10.0 < moment] for claims in both]
    assert early[0] == early[1] == early[2]


@pytest.mark.ci_slow
@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (3, 4))])
def test_it_finds_the_proven_optimum_where_all_jobs_are_known(small, seed):
    """Without a price of time: the whole reward of the shift is before its eyes."""

    class Patient(Mpc):
        tau_s = 1e9
        evaluations = 640

    shifts = small.Shifts(arms=2, jobs=3, ticks=10)
    drawn = shifts.drawn(np.random.SeedSequence(seed))[0]
    jobs = [replace(job, repetitions=min(job.repetitions, 2), release_s=0.0, due_s=25.0, after=()) for job in drawn]
    world, _ = shifts.shop(jobs)
    assert played(world, Patient()).reward[0] == pytest.approx(optimum(world, WEIGHTS), abs=1e-9)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), ticks=st.integers(0, 20))
def test_the_simulator_goes_on_as_the_true_shift_does(small, seed, ticks):
    """From any moment of a shift, with all jobs on offer, a schedule gives the reward and the awards of the shift."""
    shifts = small.Shifts(arms=3, jobs=6, ticks=40, slots=6, crowding=0.3)
    jobs = [replace(j, release_s=0.0, after=()) for j in shifts.drawn(np.random.SeedSequence(seed))[0]]
    rng, (world, _) = np.random.default_rng(seed), shifts.shop(jobs)
    difficulty = rng.uniform(0.0, 3.0, world.tables.work.shape)
    world = with_work(world, difficulty=difficulty)
    schedule = Schedules(
        rng.integers(0, 3, (1, 6)), np.zeros((1, 6), int), rng.uniform(0, 1, (1, 6)), rng.uniform(0, 300, (1, 6))
    )
    engine, parts = begun(world)
    for _ in range(ticks):
        engine.step(np.array([[rng.choice(np.flatnonzero(m[:-1])) for m in engine.mask[0]]]), parts)
    cell = Lookahead(simulator_of(world), engine)
    present = cell.look(seen_by(world, engine, parts))
    assert present.now_s == cell.now_s == ticks * 10.0
    others = ~np.isin(np.arange(6), present.open)
    assert not present.can[:, others].any()
    assert not present.stations[others].any()
    ahead = cell.simulator.run(schedule, np.ones(world.ticks))
    truth = engine.play(schedule, np.ones(world.ticks))
    np.testing.assert_array_equal(ahead.start_s, truth.start_s)
    assert ahead.reward[0] == pytest.approx(truth.reward[0], abs=1e-3)


def test_a_later_reward_is_worth_less(small):
    world, _ = small.Shifts(arms=1, jobs=1).shop([small.job("a")])
    simulator = simulator_of(world, RewardWeights(tardiness=0.0, energy=0.0))
    engine, parts = begun(world)
    simulator.look(engine, 0, seen_by(world, engine, parts))
    discount = 0.5 ** np.arange(world.ticks)
    whole = Schedules(np.zeros((1, 1), int), np.zeros((1, 1), int), np.zeros((1, 1)), np.zeros((1, 1)))
    value, later = (float(simulator.run(whole, each).reward[0]) for each in (np.ones(world.ticks), discount))
    finished = int(np.log2(value / later))
    assert value == world.kinds[0].value
    assert later == value * 0.5**finished
    delayed = whole._replace(not_before_s=np.full((1, 1), 30.0))
    assert simulator.run(delayed, discount).reward[0] == later / 8


def test_a_simulator_has_no_jobs_and_precedence_of_the_shift_before(small):
    """Two jobs at once by two arms, simulated anew and after a look at a longer shift in which one awaits another."""
    shifts, content = small.Shifts(arms=2), [small.work(place) for place in ("bench", "press")]
    pair = [small.job("a", content[0]), small.job("b", content[1])]
    chain = [pair[0], replace(pair[1], after=("a",)), small.job("c", content[0])]
    kinds, _ = shifts.shop(chain)
    waiting, free = (
        replace(kinds, shifts=shifts.shop(jobs)[0].shifts) for jobs in (chain, pair)
    )  # of the same three kinds of jobs
    both = Schedules(np.array([[0, 1]]), np.zeros((1, 2), int), np.zeros((1, 2)), np.zeros((1, 2)))
    results = []
    for before in ([], [waiting]):
        simulator = simulator_of(kinds)
        for world in (*before, free):
            engine, parts = begun(world)
            simulator.look(engine, 0, seen_by(world, engine, parts))
        results.append(simulator.run(both, np.ones(kinds.ticks)))
    assert results[0].start_s.tolist() == results[1].start_s.tolist() == [[0.0, 0.0]]
    assert results[0].reward == results[1].reward


def test_where_there_is_no_simulator_an_error_says_so(small):
    assert [name for name, rule in RULES.items() if rule.plans] == ["mpc"]
    for name in ("mpc", "limited:mpc"):
        assert isinstance(policy_of(name), PlanningPolicy)
        for refused in (alone, lambda name: central_allocation(name, load("quickstart"), 0)):
            with pytest.raises(
                FleetError, match=f"'{name}' needs a simulator of its cell, which is not available here"
            ):
                refused(name)
    assert not isinstance(policy_of("limited:wsept"), PlanningPolicy)
    world, _ = small.Shifts().shop(small.Shifts().drawn(np.random.SeedSequence(1))[0])
    with pytest.raises(FleetError, match="Choose another"):
        ShiftSimulator(world, WEIGHTS, 1).follow([make_policy("mpc")])
    with pytest.raises(RuntimeError, match=r"call look\(\)"):
        simulator_of(world).run(Schedules(*(np.zeros((1, 8)) for _ in range(4))), np.ones(world.ticks))


def test_a_guard_stops_claims_of_a_planner(small):
    world, _ = small.Shifts(jobs=12, ambient_c=38.0).shop(small.Shifts(jobs=12).drawn(np.random.SeedSequence(3))[0])
    free, guarded = (played(world, policy_of(name)) for name in ("mpc", "shutdown:mpc"))
    assert np.isfinite(free.start_s).any()
    assert np.isfinite(guarded.start_s).sum() <= np.isfinite(free.start_s).sum()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s, d: (s.at([0] * 33), d), "at most 32 schedules and 8 jobs"),
        (lambda s, d: (Schedules(*(each[:, :7] for each in s)), d), "8 jobs"),
        (lambda s, d: (s._replace(order=s.order[:, :7]), d), "the same shape"),
        (lambda s, d: (s._replace(arm=s.arm - 1), d), "The arm of a schedule must be an integer from 0 to 2"),
        (lambda s, d: (s._replace(arm=s.arm + 3), d), "from 0 to 2"),
        (lambda s, d: (s._replace(option=s.option + 0.5), d), "option of a schedule must be an integer from 0 to 0"),
        (lambda s, d: (s, np.ones(len(d) + 1)), "one for each step"),
        (lambda s, d: (s, d * np.nan), "finite factors"),
    ],
)
def test_schedules_that_the_simulator_cannot_hold_are_refused(small, change, said):
    """Compiled code does not check indices."""
    world, _ = small.Shifts().shop(small.Shifts().drawn(np.random.SeedSequence(1))[0])
    simulator, (engine, parts) = simulator_of(world), begun(world)
    simulator.look(engine, 0, seen_by(world, engine, parts))
    none = np.zeros((1, 8), int)
    whole, discount = Schedules(none, none, np.zeros((1, 8)), np.zeros((1, 8))), np.ones(world.ticks)
    assert np.isfinite(simulator.run(whole, discount).reward).all()
    with pytest.raises(ValueError, match=said):
        simulator.run(*change(whole, discount))


def test_heat_costs_nothing_where_limits_are_out_of_reach(small):
    jobs = [small.job(f"job_{i}", small.work(payload_kg=small.HOT), repetitions=5, due_s=1e4) for i in range(4)]
    world, _ = small.Shifts(arms=1, jobs=4, ticks=120, ambient_c=40.0).shop(jobs)
    engine, parts = begun(world)
    none = np.zeros((1, 4), int)
    all_, rewards = Schedules(none, none, np.arange(4.0)[None], np.zeros((1, 4))), []
    for cell in (near := Lookahead(simulator_of(world), engine)), near.with_limits(1e6, 1e6):
        cell.look(seen_by(world, engine, parts))
        rewards.append(float(cell.simulator.run(all_, np.ones(world.ticks)).reward[0]))
    assert rewards[0] < rewards[1]


def test_only_a_central_policy_plans():
    with pytest.raises(FleetError, match=r"Alone has no central policy that an arm can have alone \(got .*Mpc"):
        type("Alone", (Local,), {"central": Mpc})()

    class Planning:
        def plan_in(self, cell):
            pass

    with pytest.raises(FleetError, match=r"Planning has plan_in\(\), but only scope central"):
        EveryArm(Planning)
