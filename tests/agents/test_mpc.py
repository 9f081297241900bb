"""Model predictive control: it sees no future, finds proven optima, and its simulator agrees with the true one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.planners import Mpc
from agents.policy import EveryArm, Local, Planner
from agents.registry import RULES, make_policy
from agents.schedules import Schedules
from fleet.engine.batch import Engine, RewardWeights, shifts_of
from fleet.engine.tables import tables_of
from fleet.env.lookahead import CellSimulator, Lookahead
from fleet.errors import FleetError
from fleet.observation import Layout
from fleet.robot import ThermalLimits
from scenarios.evaluate.hindsight import ShiftSimulator
from scenarios.live.auctioneer import central_allocation
from scenarios.policy_loader import policy_of, without_simulator
from scenarios.spec.load import load
from tests.exhaustive import optimum

HOT = ThermalLimits(warning_c=40.0, error_c=46.0, restart_c=36.0, clear_s=10.0, move_home_s=30.0)
WEIGHTS = RewardWeights(tardiness=-0.5, faults=-10.0)


def simulator_of(world, weights=WEIGHTS):
    tables, _ = tables_of(world)
    tables.work["difficulty"] = np.nan  # the arms share it
    return CellSimulator(tables, len(world.arms), world.slots, weights)


def begun(world):
    """An engine at the beginning of the shift of a world, and the vectors of its arms."""
    tables, drawn = tables_of(world)
    layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job)
    engine = Engine(tables, 1, layout, WEIGHTS, jobs=len(world.jobs.names[0]))
    vectors = np.zeros((1, len(world.arms), layout.size), np.float32)
    engine.reset(np.arange(1), shifts_of(drawn, [0]))
    engine.observe(np.arange(1), vectors)
    return engine, vectors


def seen_by(world, engine, vectors):
    return engine.layout.read_each(world.arms, vectors[0], engine.mask[0])


def alone(name):
    return without_simulator(name, policy_of(name))


def played(world, policy, *, seed=0, weights=WEIGHTS):
    policy.reset(np.random.default_rng(seed))
    return ShiftSimulator(world, weights, 1, simulator=lambda: simulator_of(world, weights)).follow([policy])


@settings(max_examples=15)
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


@pytest.mark.parametrize("seed", range(5))
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
    difficulty = rng.uniform(0.0, 3.0, world.offers.difficulty.shape)
    world = replace(world, offers=replace(world.offers, difficulty=difficulty))
    schedule = Schedules(
        rng.integers(0, 3, (1, 6)), np.zeros((1, 6), int), rng.uniform(0, 1, (1, 6)), rng.uniform(0, 300, (1, 6))
    )
    engine, vectors = begun(world)
    for _ in range(ticks):
        engine.step(np.array([[rng.choice(np.flatnonzero(m[:-1])) for m in engine.mask[0]]]), vectors)
    cell = Lookahead(simulator_of(world), engine)
    present = cell.look(seen_by(world, engine, vectors))
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
    engine, vectors = begun(world)
    simulator.look(engine, 0, seen_by(world, engine, vectors))
    discount = 0.5 ** np.arange(world.ticks)
    whole = Schedules(np.zeros((1, 1), int), np.zeros((1, 1), int), np.zeros((1, 1)), np.zeros((1, 1)))
    value, later = (float(simulator.run(whole, each).reward[0]) for each in (np.ones(world.ticks), discount))
    finished = int(np.log2(value / later))
    assert value == world.jobs.value[0, 0]
    assert later == value * 0.5**finished
    delayed = whole._replace(not_before_s=np.full((1, 1), 30.0))
    assert simulator.run(delayed, discount).reward[0] == later / 8


def test_where_there_is_no_simulator_an_error_says_so(small):
    assert [name for name, rule in RULES.items() if rule.plans] == ["mpc"]
    for name in ("mpc", "limited:mpc"):
        assert isinstance(policy_of(name), Planner)
        for refused in (alone, lambda name: central_allocation(name, load("quickstart"), 0)):
            with pytest.raises(FleetError, match=f"'{name}' plans in a simulator of its cell, and there is none here"):
                refused(name)
    assert not isinstance(policy_of("limited:wsept"), Planner)
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
        (
            lambda s, d: (s._replace(option=s.option + 0.5), d),
            "option of a schedule must be an integer from 0 to 0",
        ),
        (lambda s, d: (s, d[1:]), "one for each step"),
        (lambda s, d: (s, d * np.nan), "finite factors"),
    ],
)
def test_schedules_that_the_simulator_cannot_hold_are_refused(small, change, said):
    """Compiled code does not check indices."""
    world, _ = small.Shifts().shop(small.Shifts().drawn(np.random.SeedSequence(1))[0])
    simulator, (engine, vectors) = simulator_of(world), begun(world)
    simulator.look(engine, 0, seen_by(world, engine, vectors))
    none = np.zeros((1, 8), int)
    whole, discount = Schedules(none, none, np.zeros((1, 8)), np.zeros((1, 8))), np.ones(world.ticks)
    assert np.isfinite(simulator.run(whole, discount).reward).all()
    with pytest.raises(ValueError, match=said):
        simulator.run(*change(whole, discount))


def test_heat_costs_nothing_where_limits_are_out_of_reach(small):
    jobs = [small.job(f"job_{i}", small.work(payload_kg=small.HOT), repetitions=5, due_s=1e4) for i in range(4)]
    world, _ = small.Shifts(arms=1, jobs=4, ticks=120, ambient_c=40.0).shop(jobs)
    engine, vectors = begun(world)
    none = np.zeros((1, 4), int)
    all_, rewards = Schedules(none, none, np.arange(4.0)[None], np.zeros((1, 4))), []
    for cell in (near := Lookahead(simulator_of(world), engine)), near.with_limits(1e6, 1e6):
        cell.look(seen_by(world, engine, vectors))
        rewards.append(float(cell.simulator.run(all_, np.ones(world.ticks)).reward[0]))
    assert rewards[0] < rewards[1]


def test_only_a_central_policy_plans():
    with pytest.raises(TypeError, match="Alone: Mpc plans in a simulator of its cell, which an arm alone"):
        type("Alone", (Local,), {"central": Mpc})

    class Planning:
        def plan_in(self, cell):
            pass

    with pytest.raises(FleetError, match=r"Planning has plan_in\(\), but only scope central"):
        EveryArm(Planning)
