"""Single fields of the observation against numbers computed by hand; peers and sensors in an episode."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.memory import UNHEARD, MemoryExchange, PeerView
from fleet.difficulty import KNOWN, Difficulty, Forecast
from fleet.engine.batch import Engine, RewardWeights, shifts_of
from fleet.engine.shift import Episode, broadcast, write_peers
from fleet.engine.state import State, World, initial
from fleet.engine.tables import tables_of
from fleet.env.allocation_v1 import parallel_env
from fleet.env.vector import BatchEnv
from fleet.heat.motor import gen3_motors
from fleet.motion import Plan
from fleet.observation import LONG_S, Layout, Observation
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING

NO_NOISE = replace(gen3_motors(), sensor_noise_k=np.zeros(7))


def received(arms: int, slots: int, **changes: np.ndarray) -> PeerView:
    """Return a view in which a message of every peer has just arrived: idle, no difficulties."""
    base = {
        "mode": np.zeros((arms, arms), int),
        "headroom_k": np.full((arms, arms), 30.0),
        "busy_s": np.zeros((arms, arms)),
        "difficulty": np.full((arms, arms, slots), np.nan),
        "p_saturation": np.full((arms, arms, slots), np.nan),
        "age_s": np.zeros((arms, arms)),
    }
    return PeerView(**(base | changes))


def peers_of(layout: Layout, view: PeerView) -> Observation:
    """Return the peer fields of the vectors, leading axis [arm]."""
    vectors = np.zeros((layout.arms, layout.size), np.float32)
    write_peers(layout, view, vectors)
    return layout.read(vectors, np.ones((layout.arms, layout.slots + 1), np.int8))


def engine_at(world: World, state: State) -> tuple[Engine, np.ndarray]:
    """Return an engine in this state, and the vectors of its arms, [env, arm, size]."""
    tables, drawn = tables_of(world)
    layout, rows = Layout(len(world.arms), world.slots, plans=world.plans_per_job), np.arange(world.envs)
    engine = Engine(tables, world.envs, layout, RewardWeights(), jobs=state.status.shape[1], compiled=False)
    engine.reset(rows, shifts_of(drawn, [0] * world.envs))
    engine.load(state)
    vectors = np.empty((world.envs, layout.arms, layout.size), np.float32)
    engine.observe(rows, vectors)
    return engine, vectors


def observe(world: World, state: State) -> Observation:
    """Return the observations in a state, leading axes [env, arm]."""
    engine, vectors = engine_at(world, state)
    return engine.layout.read(vectors, engine.mask)


# Single fields


def test_peers_are_the_others_in_order() -> None:
    receiver, sender = np.indices((4, 4))
    view = received(
        4, 2,
        headroom_k=10.0 * receiver + sender,
        age_s=100.0 * receiver + sender,
        difficulty=np.stack([receiver + sender / 10, np.full((4, 4), np.nan)], axis=-1),
        mode=np.where(sender == 3, FAULTED, np.where(sender == 1, WORKING, IDLE)),
    )  # fmt: skip
    observed = peers_of(Layout(4, 2), view)
    for me in range(4):
        others = [a for a in range(4) if a != me]
        assert observed.peer_headroom_k[me].tolist() == [10.0 * me + a for a in others]
        assert observed.peer_age_s[me].tolist() == [100.0 * me + a for a in others]
        assert observed.peer_difficulty[me, :, 0].tolist() == pytest.approx([me + a / 10 for a in others])
        assert observed.peer_known[me].tolist() == [[1, 0]] * 3
        assert (observed.peer_difficulty[me, :, 1] == 0).all()
        assert observed.peer_working[me].tolist() == [a == 1 for a in others]
        assert observed.peer_faulted[me].tolist() == [a == 3 for a in others]
        assert observed.peer_heard[me].all()


def test_nearest_peers_are_in_the_order_of_the_layout() -> None:
    near = ((2, 1), (3, 0), (3, 1), (0, 2))
    _, sender = np.indices((4, 4))
    observed = peers_of(Layout(4, 2, near), received(4, 2, headroom_k=1.0 * sender))
    assert observed.peer_headroom_k.tolist() == [list(map(float, peers)) for peers in near]


def test_a_peer_whose_messages_never_arrived_is_unknown() -> None:
    silent = np.array([[0, 1, 0]] * 3, bool)
    view = received(
        3, 2,
        mode=np.where(silent, UNHEARD, WORKING),
        headroom_k=np.where(silent, np.nan, 5.0),
        age_s=np.where(silent, np.inf, 7.0),
    )  # fmt: skip
    observed = peers_of(Layout(3, 2), view)
    assert observed.peer_heard[0].tolist() == [0, 1]
    assert observed.peer_age_s[0].tolist() == [LONG_S, 7.0]
    assert observed.peer_headroom_k[0].tolist() == [0.0, 5.0]
    assert observed.peer_working[0].tolist() == [0, 1]
    assert observed.peer_faulted[0].tolist() == [0, 0]
    assert all(np.isfinite(values).all() for values in vars(observed).values())


def test_slots_hold_each_arm_s_own_view_of_the_jobs(small) -> None:
    bench, rack = small.work("bench", 4.0), small.work("rack", 1.0)
    arms = [small.arm(0, [bench, rack]), small.arm(1, [bench], times=small.Times(1.0, 20.0, 4.0))]
    jobs = [
        small.job("a", bench, repetitions=5, due_s=100.0, value=3.0),
        small.job("b", rack, repetitions=2, release_s=15.0, due_s=50.0, value=2.0),
    ]
    world, _ = small.shop([jobs], arms=arms, slots=3)
    state = initial(world)
    state.tick[:] = 2
    observed = observe(world, state)
    assert observed.offered[0].tolist() == [[1, 1, 0]] * 2
    assert observed.feasible[0].tolist() == [[1, 1, 0], [1, 0, 0]]
    assert observed.known[0].tolist() == [[1, 1, 0], [1, 0, 0]]
    # 3 + 5 · 10 + 2, 3 + 2 · 10 + 2, and 1 + 5 · 20 + 4 s; now is 20 s.
    assert observed.duration_s[0].tolist() == [[55.0, 25.0, 0.0], [105.0, 0.0, 0.0]]
    assert observed.slack_s[0].tolist() == [[25.0, 5.0, 0.0], [-25.0, 0.0, 0.0]]
    assert observed.age_s[0].tolist() == [[20.0, 5.0, 0.0]] * 2
    assert observed.payload_kg[0].tolist() == [[4.0, 1.0, 0.0]] * 2
    assert observed.value[0].tolist() == [[3.0, 2.0, 0.0]] * 2
    expected = arms[1].model.score(arms[1].plans[bench][0], 5)
    assert expected is not None
    assert observed.difficulty[0, 1].tolist() == pytest.approx([expected.total, 0.0, 0.0])
    assert observed.p_saturation[0, 1].tolist() == pytest.approx([expected.p_saturation, 0.5, 0.5])
    assert observed.clock[0].tolist() == pytest.approx([20.0 / world.horizon_s] * 2)
    assert observed.action_mask[0].tolist() == [[1, 1, 1, 0, 0], [1, 1, 0, 0, 0]]


def test_busy_time_counts_down_to_home(small) -> None:
    world, plant = small.shop([[small.job("a")]], arms=2)
    env, left = parallel_env(lambda seed: Episode(world, plant, ("t",) * 2, seed)), []
    env.reset(seed=0)
    for tick in range(4):
        terminated = env.step({"arm_0": int(tick == 0)})[2]["arm_0"]
        observed = env.knowledge()
        left.append(float(observed["arm_0"].busy_s))
        assert observed["arm_1"].busy_s == 0.0
        assert (observed["arm_0"].working, observed["arm_1"].idle) == (left[-1] > 0, True)
    assert left == [25.0, 15.0, 5.0, 0.0]  # 3 + 3 · 10 + 2 s
    assert terminated


def test_a_returned_job_takes_only_its_remaining_time(small) -> None:
    world, _ = small.shop([[small.job("a", repetitions=10)]], arms=1, slots=2)
    state = initial(world)
    state.cycles[0, 0] = 7
    assert observe(world, state).duration_s.tolist() == [[[3.0 + 3 * 10.0 + 2.0, 0.0]]]


def test_an_arm_broadcasts_what_it_measures_and_its_scores(small) -> None:
    content = small.work()
    arms = [small.arm(i, [content], motors=NO_NOISE) for i in range(2)]
    world, _ = small.shop([[small.job("a"), small.job("b", release_s=99.0)]], arms=arms, slots=3)
    state = initial(world)
    measured = np.arange(14.0).reshape(1, 2, 7) + 40.0
    state.temp_c[..., :7] = measured
    engine, vectors = engine_at(world, state)
    message = broadcast(engine, vectors[0], world.jobs.names[0], ("x", "y"))
    assert message.time_s == 0.0
    assert message.twin == ("x", "y")
    assert message.jobs == ("a", "", "")
    assert message.headroom_k.tolist() == [60.0 - 46.0, 60.0 - 53.0]
    assert message.temp_c.tolist() == measured[0].tolist()
    np.testing.assert_array_equal(message.difficulty[:, 0], world.offers.difficulty[0, :, 0, 0])
    assert message.p_saturation[:, 0] == pytest.approx(world.offers.p_saturation[0, :, 0, 0])
    assert np.isnan(message.difficulty[:, 1:]).all()
    assert np.isnan(message.p_saturation[:, 1:]).all()


def test_headrooms_are_to_both_limits_and_time_is_left_until_the_horizon(small) -> None:
    content = small.work()
    arms = [small.arm(i, [content], motors=NO_NOISE) for i in range(2)]
    near = ThermalLimits(warning_c=60.0, error_c=67.0)
    world, _ = small.shop([[small.job("a")]], arms=arms, ticks=50, limits=near)
    state = initial(world)
    state.temp_c[0, :, :7] = np.arange(14.0).reshape(2, 7) + 55.0  # hottest 61 and 68 °C
    state.tick[:] = 12
    observed = observe(world, state)
    assert observed.headroom_k[0].tolist() == [-1.0, -8.0]
    assert observed.error_headroom_k[0].tolist() == [6.0, -1.0]
    assert observed.left_s[0].tolist() == [380.0, 380.0]  # of 50 · 10 s
    late, _ = small.shop([[small.job("a")]], arms=arms, ticks=20_000, limits=near)
    assert observe(late, initial(late)).left_s[0].tolist() == [LONG_S, LONG_S]


def test_in_a_batch_the_time_left_falls_by_that_of_each_step(small) -> None:
    batch = BatchEnv(small.Shifts(ticks=60).library(), 3, seed=1, autoreset=False, decisions="events")
    obs, _ = batch.reset()
    spent_s, over = np.zeros(3), np.zeros(3, bool)
    while not over.any():
        seen = batch.layout.read(obs["observation"], obs["action_mask"])
        np.testing.assert_array_equal(seen.left_s, np.tile(600.0 - spent_s[:, None], batch.layout.arms))
        np.testing.assert_allclose(seen.error_headroom_k - seen.headroom_k, 75.0 - 60.0, rtol=1e-6)
        obs, _, terminated, truncated, info = batch.step(obs["action_mask"][..., 1:-1].argmax(axis=-1) + 1)
        spent_s += info["elapsed_s"]
        over = terminated | truncated
    assert len(set(spent_s.tolist())) > 1, "rows at different times"


class SecondJointDecides:
    """P is one half if joint 2 is at 50 °C minus 0.5 K per repetition."""

    version = "second joint decides"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        risk = Forecast(np.array([0.2 * (0.5 * repetitions - 50.0)]), 0.2 * np.eye(KNOWN)[1:2])
        return Difficulty(np.full(7, 0.1), risk=risk)


def test_p_saturation_follows_the_present_temperatures(small) -> None:
    bench, rack = small.work("bench"), small.work("rack")
    arms = [
        small.arm(0, [bench], motors=NO_NOISE),
        small.arm(1, [bench, rack], model=SecondJointDecides(), motors=NO_NOISE),
    ]
    jobs = [
        [small.job("a", bench, repetitions=4), small.job("b", rack, repetitions=8)],
        [small.job("a", bench, repetitions=20)],
    ]
    world, _ = small.shop(jobs, arms=arms, slots=3)
    state = initial(world)
    state.temp_c[..., :7] = 25.0
    state.temp_c[0, 1, 1], state.temp_c[1, 1, 1] = 46.0, 35.0
    p = observe(world, state).p_saturation
    # Joint 2 at 46 and 35 °C. P is 0.5 at 48 °C (4 repetitions), 46 °C (8) and 40 °C (20), and where it is unknown.
    assert p[0, 1] == pytest.approx([1 / (1 + np.exp(0.4)), 0.5, 0.5])
    assert p[1, 1] == pytest.approx([1 / (1 + np.exp(1.0)), 0.5, 0.5])
    # The model of the other arm ignores the temperatures, and it cannot do the second job.
    fixed = arms[0].model.score(arms[0].plans[bench][0], 4)
    assert fixed is not None
    assert p[0, 0] == pytest.approx([fixed.p_saturation, 0.5, 0.5])
    engine, vectors = engine_at(world, state)
    message = broadcast(engine, vectors[0], world.jobs.names[0], ("x", "y"))
    assert message.p_saturation[1] == pytest.approx([1 / (1 + np.exp(0.4)), 0.5, np.nan], nan_ok=True)
    assert message.p_saturation[0] == pytest.approx([fixed.p_saturation, np.nan, np.nan], nan_ok=True)
    state.temp_c[..., :7] += 1.0
    assert (observe(world, state).p_saturation[0, 1, :2] > p[0, 1, :2]).all()


# Peers and sensors in an episode


def test_peers_observe_what_the_arm_observes_of_itself(small) -> None:
    env = parallel_env(small.Shifts(arms=3, jobs=10))
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    while env.agents:
        observed = env.knowledge()
        for me, arm in enumerate(env.possible_agents):
            peers = [p for p in range(3) if p != me]
            for row, peer in enumerate(peers):
                other = observed[env.possible_agents[peer]]
                assert observed[arm].peer_age_s[row] == 0.0
                assert observed[arm].peer_headroom_k[row] == other.headroom_k
                assert observed[arm].peer_busy_s[row] == other.busy_s
                assert observed[arm].peer_working[row] == other.working
                assert observed[arm].peer_faulted[row] == other.faulted
                np.testing.assert_array_equal(observed[arm].peer_difficulty[row], other.difficulty)
                np.testing.assert_array_equal(observed[arm].peer_known[row], other.known)
        env.step({a: int(rng.choice(np.flatnonzero(o.action_mask))) for a, o in observed.items()})


def test_a_delayed_message_is_as_old_as_its_delay(small) -> None:
    exchange = MemoryExchange(("arm_0", "arm_1"), Channel(delay_s=20.0))
    env = parallel_env(small.Shifts(arms=2), exchange=exchange)
    env.reset(seed=1)
    ages = []
    for _ in range(5):
        observed = env.knowledge()["arm_0"]
        ages.append((float(observed.peer_heard[0]), float(observed.peer_age_s[0])))
        env.step({})
    assert ages == [(0.0, LONG_S), (0.0, LONG_S), (1.0, 20.0), (1.0, 20.0), (1.0, 20.0)]
    env.close()


def test_temperatures_are_measured_with_the_noise_of_the_sensors(small) -> None:
    env = parallel_env(small.Shifts(arms=2, jobs=0, ticks=400))
    env.reset(seed=1)
    errors = []
    while env.agents:
        truth = env.truth.temp_c[0, :, :7]
        errors.append([env.knowledge()[arm].temp_c - truth[a] for a, arm in enumerate(env.possible_agents)])
        env.step({})
    actual = np.array(errors).std(axis=0)
    # The relative error of a standard deviation from n readings is 1/√(2n); four times that, for 14 sensors.
    assert actual == pytest.approx(env.world.motors.sensor_noise_k, rel=4 / np.sqrt(800))
