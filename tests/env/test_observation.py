"""Observations and action masks: every field against a reference from `World` and `State`, or worked by hand."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree
from scipy.special import expit

from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.memory import UNHEARD, Exchange, PeerView
from fleet.engine.batch import Engine, RewardWeights, shifts_of
from fleet.engine.profile_plant import sensor_noise
from fleet.engine.shift import Episode, ShiftRunner, broadcast, initial, write_peers
from fleet.engine.state import State, World
from fleet.engine.tables import tables_of
from fleet.env.allocation_v2 import parallel_env
from fleet.errors import ScenarioError
from fleet.heat.motor import gen3_motors
from fleet.observation import FIELDS, LONG_S, Layout, Observation
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING
from scenarios.cell_layout import cell_of, near_of
from scenarios.prepare.batch import make_batch
from scenarios.prepare.fleet import make_env
from scenarios.spec.load import load
from tests.env.drafts import drafts, world_of
from tests.profiles import examples


def test_fields_and_attributes_are_the_same_in_the_same_order() -> None:
    assert [f.name for f in FIELDS] == [f.name for f in fields(Observation) if f.name != "action_mask"]


@examples(60)
@given(
    arms=st.integers(1, 6), slots=st.integers(1, 9), plans=st.integers(1, 3),
    lead=st.sampled_from([(), (2,), (3, 2)]), seed=st.integers(0, 99),
)  # fmt: skip
def test_a_packed_observation_is_read_back(arms, slots, plans, lead, seed) -> None:
    layout, rng = Layout(arms, slots, plans=plans), np.random.default_rng(seed)
    named = {f.name: rng.uniform(f.low, f.high, (*lead, *layout.shape(f))).astype(np.float32) for f in FIELDS}
    mask = rng.integers(0, 2, (*lead, layout.actions)).astype(np.int8)
    vector = layout.pack(Observation(**named, action_mask=mask))
    assert vector.shape == (*lead, layout.size)
    assert vector.dtype == np.float32
    again = layout.read(vector, mask)
    for name, value in named.items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    assert again.action_mask is mask
    assert layout.size == sum(int(np.prod(layout.shape(f))) for f in FIELDS)


def test_values_out_of_range_are_clipped() -> None:
    layout = Layout(2, 3)
    named = {f.name: np.full(layout.shape(f), 1e9) for f in FIELDS}
    again = layout.read(layout.pack(Observation(**named, action_mask=np.ones(4, np.int8))), np.ones(4, np.int8))
    for f in FIELDS:
        assert (getattr(again, f.name) == np.float32(f.high)).all()


def test_vectors_of_wrong_size_are_refused() -> None:
    layout = Layout(2, 3)
    with pytest.raises(
        ValueError, match=rf"An observation of 3 slots and 1 peer\(s\) has {layout.size} elements, got 5"
    ):
        layout.read(np.zeros(5, np.float32), np.ones(4, np.int8))


# The reference


def with_second_plans(world: World, rng: np.random.Generator) -> World:
    """Return the world in which arms have a second, slower plan for some jobs, with its own space and scores."""
    table, offers, count = world.plans, world.offers, len(world.plans.volume)
    twice = {name: np.concatenate([values, values]) for name, values in vars(table).items()}
    twice["times_s"][count:] *= 1.5
    twice["volume"][count:] += len(world.conflicts)
    new = np.triu(rng.random((2 * len(world.conflicts),) * 2) < 0.2)
    conflicts = np.tile(world.conflicts, (2, 2)) ^ (new | new.T)
    for own in np.moveaxis(offers.plan, 1, 0):  # an arm's plans never exclude each other
        volumes = twice["volume"][np.concatenate([own[own >= 0], own[own >= 0] + count])]
        conflicts[np.ix_(volumes, volumes)] = False
    second = (offers.plan >= 0) & (rng.random(offers.plan.shape) < 0.7)
    scored = second & (rng.random(offers.plan.shape) < 0.7)
    more = {
        "plan": np.where(second, offers.plan + count, -1),
        "difficulty": np.where(scored, rng.uniform(0.0, 2.0, offers.plan.shape), np.nan),
        "p_saturation": np.where(scored, rng.random(offers.plan.shape), np.nan),
        "risk": np.full(offers.plan.shape, -1),
        "peak": np.full(offers.plan.shape, -1),
    }
    both = {name: np.concatenate([getattr(offers, name), values], axis=-1) for name, values in more.items()}
    return replace(world, plans=replace(table, **twice), conflicts=conflicts, offers=replace(offers, **both))


def value_of(world: World, row: int, known_c: np.ndarray, left_s: float = np.inf) -> float:
    """Value of a forecast by its definition."""
    forecasts = world.offers.forecasts
    assert forecasts is not None
    counts = np.isfinite(forecasts.offset[row])
    if forecasts.time_s is not None:
        counts &= forecasts.time_s[row] <= left_s
    return max((forecasts.offset[row] + forecasts.weight[row] @ known_c)[counts], default=-np.inf)


def prediction(world: World, at: tuple[int, ...], known_c: np.ndarray, left_s: float = np.inf) -> tuple[float, float]:
    """P and the predicted peak of an option (env, arm, job, plan), 0.5 and 0 if unknown."""
    p, risk, peak = (getattr(world.offers, name)[at] for name in ("p_saturation", "risk", "peak"))
    if risk >= 0:
        forecasts = world.offers.forecasts
        assert forecasts is not None
        curve = np.zeros((0, 2)) if forecasts.curve is None else forecasts.curve[risk]
        curve = curve[np.isfinite(curve[:, 0])]
        score = value_of(world, risk, known_c, left_s)
        p = np.interp(score, *curve.T) if len(curve) else expit(score)
    peak_c = value_of(world, peak, known_c, left_s) if peak >= 0 else 0.0
    return 0.5 if np.isnan(p) else float(p), max(peak_c, -60.0)


def reference(world: World, state: State, slots: list[int], key: int) -> dict[str, np.ndarray]:
    """Compute the fields of all arms of env 0, [arm, ...], one by one; peers as of this moment."""
    arms, now_s, jobs, offers = len(world.arms), state.tick[0] * world.dt_s, world.jobs, world.offers
    measured_c = state.temp_c[0, :, :7] + world.motors.sensor_noise_k * sensor_noise(key, state.tick[0], arms, 7)
    ambient_c = world.ambient_c[min(int(state.tick[0]), world.ticks - 1)]
    volume, times_s, away = world.plans.volume, world.plans.times_s, state.plan[0]
    occupied = {s for j in state.job[0].tolist() if j >= 0 for s in jobs.stations[0, j].tolist() if s >= 0}
    own: list[dict[str, object]] = []
    for a in range(arms):
        mode, todo = state.mode[0, a], int(state.todo[0, a])
        known_c = np.concatenate([measured_c[a], state.housing_c[0, a], ambient_c[a : a + 1]])
        busy_s = times_s[away[a]] @ [1, todo, 1] - state.progress_s[0, a] if mode == WORKING else 0.0
        mine = {
            "clock": now_s / world.horizon_s, "left_s": world.horizon_s - now_s,
            "idle": mode == IDLE, "working": mode == WORKING, "faulted": mode == FAULTED,
            "last_award": state.last_award[0, a], "temp_c": measured_c[a],
            "busy_s": busy_s, "headroom_k": world.limits.warning_c - measured_c[a].max(),
            "error_headroom_k": world.limits.error_c - measured_c[a].max(),
            "housing_c": state.housing_c[0, a], "ambient_c": ambient_c[a],
            "job_value": 0.0, "job_cycles": 0.0, "job_peak_c": 0.0, "job_p": 0.0, "give_back": 0.0,
        }  # fmt: skip
        into_s = state.progress_s[0, a] - times_s[away[a], 0]
        if mode == WORKING and state.job[0, a] >= 0 and into_s < todo * times_s[away[a], 1] - 1e-6:
            j = int(state.job[0, a])
            n = offers.plan[0, a, j].tolist().index(away[a])
            p, peak_c = prediction(world, (0, a, j, n), known_c, busy_s)
            cycles = max(into_s, 0.0) / times_s[away[a], 1]
            mine |= {
                "job_value": jobs.value[0, j], "job_p": p,
                "job_peak_c": max(peak_c, measured_c[a].max()) if offers.peak[0, a, j, n] >= 0 else 0.0,
                "job_cycles": jobs.repetitions[0, j] - state.cycles[0, j] - int(cycles + 1e-9),
                "give_back": np.ceil(cycles - 1e-9) < todo,
            }  # fmt: skip
        rows, options, blocks = [], [], np.zeros((arms, len(slots)))
        for k, j in enumerate(slots):
            if j < 0:
                rows.append([0] * 8)
                options += [[0, 0, 0, 0, 0.5, 0, 0, 0]] * world.plans_per_job
                continue
            free = not occupied & set(jobs.stations[0, j].tolist())
            age_s = now_s - state.queued_s[0, j]
            rows.append(
                [1, free, age_s, jobs.payload_kg[0, j], jobs.value[0, j], state.returns[0, j], jobs.expires[0, j],
                 offers.too_heavy[0, a, j]]
            )  # fmt: skip
            for n, plan in enumerate(offers.plan[0, a, j].tolist()):
                if plan < 0:
                    options.append([0, 0, 0, 0, 0.5, 0, 0, 0])
                    continue
                closed = [
                    b for b in range(arms) if b != a and away[b] >= 0 and world.conflicts[volume[plan], volume[away[b]]]
                ]
                if n == 0:
                    blocks[closed, k] = 1.0
                left_s = times_s[plan] @ [1, jobs.repetitions[0, j] - state.cycles[0, j], 1]
                d = offers.difficulty[0, a, j, n]
                p, peak_c = prediction(world, (0, a, j, n), known_c)
                slack_s = jobs.due_s[0, j] - now_s - left_s
                options.append([1, not closed, not np.isnan(d), np.nan_to_num(d), p, peak_c, left_s, slack_s])
        names = ("offered", "station_free", "age_s", "payload_kg", "value", "returns", "expires", "too_heavy")
        mine |= dict(zip(names, np.array(rows, dtype=float).T, strict=True))
        names = ("feasible", "space_free", "known", "difficulty", "p_saturation", "peak_c", "duration_s", "slack_s")
        mine |= dict(zip(names, np.array(options, dtype=float).T, strict=True))
        own.append(mine | {"peer_blocks": np.delete(blocks, a, axis=0)})
    shared = []
    for mine in own:
        known, d = (np.reshape(mine[name], (len(slots), -1)) for name in ("known", "difficulty"))
        least = np.where(known > 0, d, np.inf).min(axis=1)
        shared.append({"known": known.any(axis=1), "difficulty": np.where(np.isinf(least), 0.0, least)})
    told = ("working", "faulted", "headroom_k", "busy_s", "known", "difficulty")
    for a, mine in enumerate(own):
        others = [{**own[b], **shared[b]} for b in range(arms) if b != a]
        mine |= {f"peer_{n}": [o[n] for o in others] for n in told}
        mine |= {"peer_heard": [1.0] * len(others), "peer_age_s": [0.0] * len(others)}
    return {name: np.array([each[name] for each in own], dtype=float) for name in own[0]}


def reference_mask(expected: dict[str, np.ndarray], plans: int) -> np.ndarray:
    """Legal actions by the fields: wait, every plan of an idle arm with free stations and space, and give back."""
    legal = expected["idle"][:, None] * expected["feasible"] * expected["space_free"]
    legal *= np.repeat(expected["station_free"], plans, axis=1)
    return np.concatenate([np.ones((len(legal), 1)), legal, expected["give_back"][:, None]], axis=1)


def compare_with_reference(play, episode: Episode, seed: int) -> tuple[State, int]:
    """Play a shift and compare every vector; return the last state, and the number of plans without free space."""
    world, rng = episode.world, np.random.default_rng(seed)
    runner, closed = ShiftRunner(episode, RewardWeights()), 0
    layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job)
    while True:
        slots = play.slots_of(world, runner.state)
        assert runner.slot_job.tolist() == slots
        actual = layout.read(runner.vectors, runner.mask)
        expected = reference(world, runner.state, slots, episode.noise_key)
        assert set(expected) - {"give_back"} == {field.name for field in FIELDS}
        for name in (field.name for field in FIELDS):
            values = expected[name]
            observed = getattr(actual, name)
            np.testing.assert_allclose(observed, values.reshape(observed.shape), rtol=1e-6, atol=2e-5, err_msg=name)
        np.testing.assert_array_equal(runner.mask, reference_mask(expected, layout.plans))
        closed += int((expected["feasible"] > expected["space_free"]).sum())
        if runner.tick == world.ticks:
            return runner.state.copy(), closed
        runner.step(play.chosen(runner.mask, rng.random((len(world.arms), 2))))


@pytest.mark.ci_slow
@examples(40)
@given(draft=drafts(), two_plans=st.booleans())
def test_vectors_equal_the_reference(small, play, draft, two_plans) -> None:
    world, plant = world_of(small, draft)
    if two_plans:
        world = with_second_plans(world, np.random.default_rng(draft.seed))
    episode = Episode(world, plant, ("t",) * len(world.arms), np.random.SeedSequence(draft.seed))
    compare_with_reference(play, episode, draft.seed)


def test_shifts_of_the_comparison_include_faults_returned_jobs_and_closed_space(small, play) -> None:
    limits = ThermalLimits(warning_c=56.0, error_c=60.0, restart_c=54.0, clear_s=25.0)
    make = small.Shifts(arms=3, jobs=9, ticks=80, ambient_c=45.0, limits=limits, crowding=0.3)
    played = [compare_with_reference(play, make(np.random.SeedSequence(seed)), seed) for seed in range(4)]
    last = [state for state, _ in played]
    assert sum(closed for _, closed in played) > 0
    assert sum(int(state.faults.sum()) for state in last) > 0
    assert sum(int(state.returns.sum()) for state in last) > 0
    assert sum(int(((state.faults > 0) & (state.mode != FAULTED)).sum()) for state in last) > 0


@pytest.mark.parametrize(("pieces", "curve"), [(1, False), (3, False), (2, True)])
def test_risks_equal_the_reference(small, play, pieces, curve) -> None:
    content = [small.work(place, payload) for place in ("a", "b") for payload in (small.LIGHT, small.HOT)]
    arms = [
        small.arm(0, content, model=play.Learned(pieces, curve=curve)),
        small.arm(1, content[:2], model=play.Learned(1, curve=False)),
        small.arm(2, content),
    ]
    jobs = [small.job(f"j{i}", content[i % 4], release_s=50.0 * (i % 3)) for i in range(6)]
    world, plant = small.shop([jobs], arms=arms, ticks=60)
    compare_with_reference(play, Episode(world, plant, ("t",) * 3, np.random.SeedSequence(1)), 3)


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


# Peers and sensors in an episode


def test_a_delayed_message_is_as_old_as_its_delay(small) -> None:
    exchange = Exchange(("arm_0", "arm_1"), Channel(delay_s=20.0))
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


@pytest.mark.parametrize("name", ["quickstart", "heat_wave"])
@pytest.mark.parametrize("peers", [1, 2])
def test_the_peers_are_the_nearest_in_space(name, peers) -> None:
    scenario = load(name)
    mounts_m = np.array(cell_of(scenario).mounts_m)
    far_m, _ = KDTree(mounts_m).query(mounts_m, k=peers + 1)
    near = near_of(scenario, peers)
    assert near is not None
    for a, own in enumerate(near):
        assert a not in own
        assert len(set(own)) == peers
        np.testing.assert_allclose(np.linalg.norm(mounts_m[list(own)] - mounts_m[a], axis=1), far_m[a, 1:])


@pytest.mark.ci_slow
def test_fields_of_the_nearest_peers_equal_those_of_all_peers(plans) -> None:
    options = {"difficulty": "blind", "cache": plans, "horizon_s": 600}
    all_, few = (make_batch("quickstart", 3, seed=5, peers=n, **options) for n in (None, 2))
    single = make_env("quickstart", peers=2, **options)
    all_.reset(), few.reset()
    alone, _ = single.reset(seed=5)
    near = near_of(load("quickstart"), 2)
    assert near is not None
    assert few.layout.size == all_.layout.size - (6 + 3 * few.layout.slots)
    rng = np.random.default_rng(0)
    for _ in range(40):
        whole, part = all_.knowledge(), few.knowledge()
        for name, values in vars(whole).items():
            if name.startswith("peer_"):
                place = [[b - (b > a) for b in own] for a, own in enumerate(near)]
                values = values[:, np.arange(len(near))[:, None], place]
            np.testing.assert_array_equal(getattr(part, name), values, err_msg=name)
        mask = whole.action_mask
        actions = (rng.random(mask.shape) * mask).argmax(-1)
        _, (obs, *_) = all_.step(actions), few.step(actions)
        alone, *_ = single.step(dict(zip(single.agents, actions[0], strict=True)))
        np.testing.assert_array_equal(alone["arm_2"]["observation"], obs["observation"][0, 2])


@pytest.mark.parametrize("peers", [-1, 4, 1.5, True, "all"])
def test_invalid_numbers_of_peers_are_refused(peers) -> None:
    for make in (lambda **more: make_batch("quickstart", 2, **more), lambda **more: make_env("quickstart", **more)):
        with pytest.raises(ScenarioError, match=r"peers must be None or an integer from 0 to 3 \(got "):
            make(difficulty="blind", peers=peers)
