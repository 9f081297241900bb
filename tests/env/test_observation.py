"""What arms know: one layout both ways, and every number where it belongs."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.channel import Channel
from fleet.bus.exchange import UNHEARD, Heard
from fleet.bus.memory import MemoryExchange
from fleet.difficulty import Difficulty, Risk
from fleet.env.allocation_v0 import parallel_env
from fleet.env.observation import FIELDS, LONG_S, Layout, Observation, observe, remaining_s, saturation, say
from fleet.motion import Plan
from fleet.sim.claims import board
from fleet.sim.kernel import step
from fleet.sim.state import initial
from fleet.telemetry import FAULTED, IDLE, WORKING


def heard(arms: int, slots: int, **told: np.ndarray) -> Heard:
    """Every peer heard just now, idle, scores unknown."""
    base = {
        "mode": np.zeros((arms, arms), int),
        "headroom_k": np.full((arms, arms), 30.0),
        "difficulty": np.full((arms, arms, slots), np.nan),
        "p_saturation": np.full((arms, arms, slots), np.nan),
        "age_s": np.zeros((arms, arms)),
    }
    return Heard(**(base | told))


def look(world, state, told: Heard, measured_c=None) -> Observation:
    """The observation of all arms of env 0, [1, arm, ...]."""
    now = board(world, state)
    measured = state.temp_c[..., :7] if measured_c is None else measured_c
    return observe(world, state, now.on_offer, now.mask, measured, told)


def test_fields_and_attributes_are_the_same_in_the_same_order() -> None:
    assert [f.name for f in FIELDS] == [f.name for f in fields(Observation) if f.name != "action_mask"]


@settings(max_examples=60, deadline=None)
@given(
    arms=st.integers(1, 6), slots=st.integers(1, 9), lead=st.sampled_from([(), (2,), (3, 2)]), seed=st.integers(0, 99)
)
def test_what_is_packed_is_read_again(arms, slots, lead, seed) -> None:
    layout, rng = Layout(arms, slots), np.random.default_rng(seed)
    named = {f.name: rng.uniform(f.low, f.high, (*lead, *layout.shape(f))).astype(np.float32) for f in FIELDS}
    mask = rng.integers(0, 2, (*lead, slots + 1)).astype(np.int8)
    vector = layout.pack(Observation(**named, action_mask=mask))
    assert vector.shape == (*lead, layout.size)
    assert vector.dtype == np.float32
    again = layout.read(vector, mask)
    for name, value in named.items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    assert again.action_mask is mask
    assert layout.size == sum(int(np.prod(layout.shape(f))) for f in FIELDS)


def test_what_is_out_of_range_is_clipped_to_its_field() -> None:
    layout = Layout(2, 3)
    named = {f.name: np.full(layout.shape(f), 1e9) for f in FIELDS}
    again = layout.read(layout.pack(Observation(**named, action_mask=np.ones(4, np.int8))), np.ones(4, np.int8))
    for f in FIELDS:
        assert (getattr(again, f.name) == np.float32(f.high)).all()


def test_a_vector_of_another_fleet_is_refused() -> None:
    layout = Layout(2, 3)
    with pytest.raises(
        ValueError, match=rf"An observation of 3 slots and 1 peer\(s\) has {layout.size} elements, got 5"
    ):
        layout.read(np.zeros(5, np.float32), np.ones(4, np.int8))


def test_peers_are_the_others_in_order(small) -> None:
    world, _ = small.shop([[small.job("a")]], arms=4, slots=2)
    receiver, sender = np.indices((4, 4))
    told = heard(
        4, 2,
        headroom_k=10.0 * receiver + sender,
        age_s=100.0 * receiver + sender,
        difficulty=np.stack([receiver + sender / 10, np.full((4, 4), np.nan)], axis=-1),
        mode=np.where(sender == 3, FAULTED, np.where(sender == 1, WORKING, IDLE)),
    )  # fmt: skip
    seen = look(world, initial(world), told)
    for me in range(4):
        others = [a for a in range(4) if a != me]
        assert seen.peer_headroom_k[0, me].tolist() == [10.0 * me + a for a in others]
        assert seen.peer_age_s[0, me].tolist() == [100.0 * me + a for a in others]
        assert seen.peer_difficulty[0, me, :, 0].tolist() == [me + a / 10 for a in others]
        assert seen.peer_known[0, me].tolist() == [[True, False]] * 3
        assert (seen.peer_difficulty[0, me, :, 1] == 0).all()
        assert seen.peer_working[0, me].tolist() == [a == 1 for a in others]
        assert seen.peer_faulted[0, me].tolist() == [a == 3 for a in others]
        assert seen.peer_heard[0, me].all()


def test_a_peer_never_heard_says_nothing(small) -> None:
    world, _ = small.shop([[small.job("a")]], arms=3, slots=2)
    silent = np.array([[0, 1, 0]] * 3, bool)
    told = heard(
        3, 2,
        mode=np.where(silent, UNHEARD, WORKING),
        headroom_k=np.where(silent, np.nan, 5.0),
        age_s=np.where(silent, np.inf, 7.0),
    )  # fmt: skip
    seen = look(world, initial(world), told)
    assert seen.peer_heard[0, 0].tolist() == [False, True]
    assert seen.peer_age_s[0, 0].tolist() == [LONG_S, 7.0]
    assert seen.peer_headroom_k[0, 0].tolist() == [0.0, 5.0]
    assert seen.peer_working[0, 0].tolist() == [False, True]
    assert seen.peer_faulted[0, 0].tolist() == [False, False]
    assert np.isfinite(Layout(3, 2).pack(seen)).all()


def test_slots_hold_this_arm_s_own_view_of_the_jobs(small) -> None:
    bench, rack = small.work("bench", 4.0), small.work("rack", 1.0)
    arms = [small.arm(0, [bench, rack]), small.arm(1, [bench], times=small.Times(1.0, 20.0, 4.0))]
    jobs = [
        small.job("a", bench, repetitions=5, due_s=100.0, value=3.0),
        small.job("b", rack, repetitions=2, release_s=15.0, due_s=50.0, value=2.0),
    ]
    world, plant = small.shop([jobs], arms=arms, slots=3)
    state = initial(world)
    for _ in range(2):
        state = step(world, state, np.zeros((1, 2), int), np.zeros((1, 2, 3)), plant).state
    seen = look(world, state, heard(2, 3))
    assert seen.offered[0].tolist() == [[1, 1, 0]] * 2
    assert seen.feasible[0].tolist() == [[True, True, False], [True, False, False]]
    assert seen.known[0].tolist() == [[True, True, False], [True, False, False]]
    # 3 + 5 · 10 + 2, 3 + 2 · 10 + 2, and 1 + 5 · 20 + 4 s; now is 20 s.
    assert seen.duration_s[0].tolist() == [[55.0, 25.0, 0.0], [105.0, 0.0, 0.0]]
    assert seen.slack_s[0].tolist() == [[25.0, 5.0, 0.0], [-25.0, 30.0, 0.0]]
    assert seen.age_s[0].tolist() == [[20.0, 5.0, 0.0]] * 2
    assert seen.payload_kg[0].tolist() == [[4.0, 1.0, 0.0]] * 2
    assert seen.value[0].tolist() == [[3.0, 2.0, 0.0]] * 2
    expected = arms[1].model.score(arms[1].plans[bench][0], 5)
    assert expected is not None
    assert seen.difficulty[0, 1].tolist() == pytest.approx([expected.total, 0.0, 0.0])
    assert seen.p_saturation[0, 1].tolist() == pytest.approx([expected.p_saturation, 0.5, 0.5])
    assert seen.clock[0].tolist() == [20.0 / world.horizon_s] * 2
    assert seen.action_mask[0].tolist() == [[1, 1, 1, 0], [1, 1, 0, 0]]


def test_busy_time_counts_down_to_home(small) -> None:
    world, plant = small.shop([[small.job("a")]], arms=2)
    state, left = initial(world), []
    for tick in range(5):
        state = step(world, state, np.array([[int(tick == 0), 0]]), np.zeros((1, 2, 4)), plant).state
        seen = look(world, state, heard(2, 4))
        left.append(float(seen.busy_s[0, 0]))
        assert seen.busy_s[0, 1] == 0.0
        assert (seen.working[0, 0], seen.idle[0, 1]) == (left[-1] > 0, True)
    assert left == [25.0, 15.0, 5.0, 0.0, 0.0]  # 3 + 3 · 10 + 2 s


def test_what_is_left_of_a_returned_job_takes_less_time(small) -> None:
    world, _ = small.shop([[small.job("a", repetitions=10)]], arms=1)
    state = initial(world)
    state.cycles[0, 0] = 7
    assert remaining_s(world, state, np.array([[0, -1]])).tolist() == [[[3.0 + 3 * 10.0 + 2.0, 0.0]]]


def test_an_arm_says_what_it_measures_and_thinks(small) -> None:
    world, _ = small.shop([[small.job("a"), small.job("b", release_s=99.0)]], arms=2, slots=3)
    state = initial(world)
    measured = np.arange(14.0).reshape(1, 2, 7) + 40.0
    words = say(world, state, board(world, state).on_offer, measured, ("x", "y"))
    assert words.jobs == ("a", "", "")
    assert words.headroom_k.tolist() == [60.0 - 46.0, 60.0 - 53.0]
    assert words.temp_c.tolist() == measured[0].tolist()
    np.testing.assert_array_equal(words.difficulty[:, 0], world.offers.difficulty[0, :, 0])
    assert np.isnan(words.difficulty[:, 1:]).all()
    assert np.isnan(words.p_saturation[:, 1:]).all()


class SecondJointDecides:
    """P passes one half where joint 2 is at 50 °C less half a kelvin for every repetition."""

    version = "second joint decides"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        risk = Risk(np.array([0.2 * (0.5 * repetitions - 50.0)]), 0.2 * np.eye(7)[1:2])
        return Difficulty(np.full(7, 0.1), risk=risk)


def test_the_probability_is_that_of_the_temperatures_now(small) -> None:
    bench, rack = small.work("bench"), small.work("rack")
    arms = [small.arm(0, [bench]), small.arm(1, [bench, rack], model=SecondJointDecides())]
    jobs = [
        [small.job("a", bench, repetitions=4), small.job("b", rack, repetitions=8)],
        [small.job("a", bench, repetitions=20)],
    ]
    world, _ = small.shop(jobs, arms=arms, slots=3)
    state, on_offer = initial(world), np.array([[1, 0, -1], [0, -1, -1]])
    measured = np.full((2, 2, 7), 25.0)
    measured[0, 1, 1], measured[1, 1, 1] = 46.0, 35.0
    p = saturation(world.offers, on_offer, measured)
    # Joint 2 at 46 and 35 °C; one half at 46 (8 repetitions), 48 (4) and 40 (20).
    assert p[0, 1] == pytest.approx([0.5, 1 / (1 + np.exp(0.4)), np.nan], nan_ok=True)
    assert p[1, 1] == pytest.approx([1 / (1 + np.exp(1.0)), np.nan, np.nan], nan_ok=True)
    # The other arm's model takes the start for granted, and cannot do the second job.
    fixed = arms[0].model.score(arms[0].plans[bench][0], 4)
    assert p[0, 0] == pytest.approx([np.nan, fixed.p_saturation, np.nan], nan_ok=True)
    assert (saturation(world.offers, on_offer, measured + 1.0)[:, 1] >= p[:, 1])[~np.isnan(p[:, 1])].all()

    seen = observe(world, state, on_offer, np.ones((2, 2, 4), bool), measured, vars(both_heard(2, 3)))
    np.testing.assert_array_equal(seen.p_saturation, np.where(np.isnan(p), 0.5, p))
    words = say(world, state, on_offer, measured, ("x", "y"))
    np.testing.assert_array_equal(words.p_saturation, p[0])


def both_heard(arms: int, slots: int) -> Heard:
    """What `heard` makes, for two envs."""
    return Heard(**{name: np.stack([values] * 2) for name, values in vars(heard(arms, slots)).items()})


def test_what_peers_told_is_what_they_know_themselves(small) -> None:
    env = parallel_env(small.Shifts(arms=3, jobs=10))
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    while env.agents:
        seen = env.knowledge()
        for me, arm in enumerate(env.possible_agents):
            peers = [p for p in range(3) if p != me]
            for row, peer in enumerate(peers):
                other = seen[env.possible_agents[peer]]
                assert seen[arm].peer_age_s[row] == 0.0
                assert seen[arm].peer_headroom_k[row] == other.headroom_k
                assert seen[arm].peer_working[row] == other.working
                assert seen[arm].peer_faulted[row] == other.faulted
                np.testing.assert_array_equal(seen[arm].peer_difficulty[row], other.difficulty)
                np.testing.assert_array_equal(seen[arm].peer_known[row], other.known)
        env.step({a: int(rng.choice(np.flatnonzero(o.action_mask))) for a, o in seen.items()})


def test_a_word_that_takes_its_time_is_as_old_as_it_took(small) -> None:
    exchange = MemoryExchange(("arm_0", "arm_1"), Channel(delay_s=20.0))
    env = parallel_env(small.Shifts(arms=2), exchange=exchange)
    env.reset(seed=1)
    ages = []
    for _ in range(5):
        seen = env.knowledge()["arm_0"]
        ages.append((float(seen.peer_heard[0]), float(seen.peer_age_s[0])))
        env.step({})
    assert ages == [(0.0, LONG_S), (0.0, LONG_S), (1.0, 20.0), (1.0, 20.0), (1.0, 20.0)]
    env.close()


def test_temperatures_are_read_with_the_noise_of_the_sensors(small) -> None:
    env = parallel_env(small.Shifts(arms=2, jobs=0, ticks=400))
    env.reset(seed=1)
    errors = []
    while env.agents:
        truth = env.truth.temp_c[0, :, :7]
        errors.append([env.knowledge()[arm].temp_c - truth[a] for a, arm in enumerate(env.possible_agents)])
        env.step({})
    found = np.array(errors).std(axis=0)
    # The standard deviation of n readings is off by 1/√(2n) of itself; four times that, for 14 sensors.
    assert found == pytest.approx(env.world.motors.sensor_noise_k, rel=4 / np.sqrt(800))
