"""The exchange in memory: who hears whom, when, and what is then known."""

from dataclasses import fields, replace

import networkx as nx
import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st

from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.memory import UNHEARD, MemoryExchange, PeerView
from fleet.errors import BusError
from tests.profiles import examples

ARMS = ("a", "b", "c", "d")


def test_everybody_hears_everybody_at_once(make_words):
    words = replace(make_words(np.random.default_rng(0), 4, 5.0), jobs=("w", "x", "y", "z"))
    heard = MemoryExchange(ARMS).share(words)
    for receiver in range(4):
        np.testing.assert_array_equal(heard.mode[receiver], words.mode)
        np.testing.assert_array_equal(heard.headroom_k[receiver], words.headroom_k)
        np.testing.assert_array_equal(heard.difficulty[receiver], words.difficulty)
        np.testing.assert_array_equal(heard.p_saturation[receiver], words.p_saturation)
    np.testing.assert_array_equal(heard.age_s, np.zeros((4, 4)))


def test_nothing_is_known_of_an_empty_slot(make_words):
    words = replace(make_words(np.random.default_rng(0), 4, 0.0), jobs=("w", "", "y", ""), difficulty=np.ones((4, 4)))
    heard = MemoryExchange(ARMS).share(words)
    assert np.isnan(heard.difficulty[:, :, [1, 3]]).all()
    assert (heard.difficulty[:, :, [0, 2]] == 1.0).all()


def test_scores_go_to_the_slot_of_their_job(make_words):
    exchange = MemoryExchange(("s", "t"), Channel(delay_s=10.0))
    words = replace(
        make_words(np.random.default_rng(0), 2, 0.0, slots=3),
        jobs=("a", "b", "c"),
        difficulty=np.array([[1.0, 2.0, 3.0]] * 2),
        p_saturation=np.array([[0.1, 0.2, 0.3]] * 2),
    )
    exchange.share(words)
    later = make_words(np.random.default_rng(1), 2, 10.0, slots=4)
    heard = exchange.share(replace(later, jobs=("c", "", "x", "a")))
    np.testing.assert_array_equal(heard.difficulty[0, 1], [3.0, np.nan, np.nan, 1.0])
    np.testing.assert_array_equal(heard.p_saturation[0, 1], [0.3, np.nan, np.nan, 0.1])


def test_on_a_ring_only_neighbours_are_heard(make_words):
    exchange = MemoryExchange(ARMS, Channel(topology=nx.cycle_graph(ARMS)))
    rng = np.random.default_rng(1)
    heard = [exchange.share(make_words(rng, 4, 10.0 * tick)) for tick in range(3)][-1]
    across = np.array([[(r - s) % 4 == 2 for s in range(4)] for r in range(4)])
    assert np.isinf(heard.age_s[across]).all()
    assert (heard.mode[across] == UNHEARD).all()
    assert np.isnan(heard.headroom_k[across]).all()
    assert np.isnan(heard.difficulty[across]).all()
    assert (heard.age_s[~across] == 0.0).all()
    assert exchange.delivered == 3 * 8


def test_a_directed_edge_carries_one_way(make_words):
    exchange = MemoryExchange(("a", "b"), Channel(topology=nx.DiGraph([("a", "b")])))
    age_s = exchange.share(make_words(np.random.default_rng(0), 2, 0.0)).age_s
    np.testing.assert_array_equal(age_s, [[0.0, np.inf], [0.0, 0.0]])


@examples(40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(ticks=st.integers(0, 4), dt_s=st.sampled_from([0.1, 1.0, 10.0]), seed=st.integers(0, 99))
def test_a_delayed_word_is_the_word_of_then_under_the_names_of_now(make_words, ticks, dt_s, seed):
    """Against a second method: look the word of t − delay up by hand."""
    rng = np.random.default_rng(seed)
    exchange = MemoryExchange(ARMS, Channel(delay_s=ticks * dt_s))
    said = []
    for tick in range(8):
        words = make_words(rng, 4, tick * dt_s)
        said.append(words)
        heard = exchange.share(words)
        for receiver in range(4):
            for sender in range(4):
                then = tick if receiver == sender else tick - ticks
                if then < 0:
                    assert heard.age_s[receiver, sender] == np.inf
                    assert np.isnan(heard.difficulty[receiver, sender]).all()
                    continue
                old = said[then]
                assert heard.age_s[receiver, sender] == words.time_s - old.time_s
                assert heard.mode[receiver, sender] == old.mode[sender]
                assert heard.headroom_k[receiver, sender] == old.headroom_k[sender]
                for slot, job in enumerate(words.jobs):
                    expected = old.difficulty[sender, old.jobs.index(job)] if job and job in old.jobs else np.nan
                    np.testing.assert_equal(heard.difficulty[receiver, sender, slot], expected)


def test_lost_words_leave_the_last_known_and_its_age(make_words):
    exchange = MemoryExchange(ARMS, Channel(loss=0.5), rng=np.random.default_rng(3))
    rng, age_s = np.random.default_rng(4), np.full((4, 4), np.inf)
    np.fill_diagonal(age_s, 0.0)
    grown = 0
    for tick in range(30):
        heard = exchange.share(make_words(rng, 4, 10.0 * tick))
        older = heard.age_s == age_s + 10.0
        assert (older | (heard.age_s == 0.0) | np.isinf(heard.age_s)).all()
        grown += int(older[np.isfinite(age_s)].sum())
        age_s = heard.age_s
    assert grown > 0
    assert exchange.late > 0
    assert exchange.delivered + exchange.late == 30 * 12
    # Binomial(360, 1/2): five standard deviations either side.
    assert abs(exchange.late - 180) < 5 * np.sqrt(360 / 4)


def test_all_is_lost_with_loss_one(make_words):
    exchange = MemoryExchange(ARMS, Channel(loss=1.0), rng=np.random.default_rng(0))
    age_s = exchange.share(make_words(np.random.default_rng(0), 4, 0.0)).age_s
    np.testing.assert_array_equal(np.isinf(age_s), ~np.eye(4, dtype=bool))


def test_the_same_seed_loses_the_same_words(make_words, assert_same):
    def episode(seed: int) -> list[PeerView]:
        rng = np.random.default_rng(0)
        exchange = MemoryExchange(ARMS, Channel(loss=0.3), rng=np.random.default_rng(seed))
        return [exchange.share(make_words(rng, 4, 10.0 * tick)) for tick in range(10)]

    for one, other in zip(episode(7), episode(7), strict=True):
        assert_same(one, other)
    assert any((a.age_s != b.age_s).any() for a, b in zip(episode(7), episode(8), strict=True))


def test_relabelling_the_arms_relabels_what_is_heard(make_words, assert_same):
    order = [2, 0, 3, 1]
    rng = np.random.default_rng(5)
    channel = Channel(topology=nx.path_graph(ARMS), delay_s=10.0)
    plain, turned = MemoryExchange(ARMS, channel), MemoryExchange([ARMS[i] for i in order], channel)
    for tick in range(5):
        words = make_words(rng, 4, 10.0 * tick)
        per_arm = ("mode", "temp_c", "headroom_k", "busy_s", "difficulty", "p_saturation")
        moved = replace(
            words, **{f: getattr(words, f)[order] for f in per_arm}, twin=tuple(words.twin[i] for i in order)
        )
        one, other = plain.share(words), turned.share(moved)
        assert_same(PeerView(**{f.name: getattr(one, f.name)[np.ix_(order, order)] for f in fields(PeerView)}), other)


def test_a_new_episode_knows_nothing_of_the_last(make_words):
    exchange = MemoryExchange(ARMS, Channel(delay_s=10.0))
    rng = np.random.default_rng(0)
    heard = [exchange.share(make_words(rng, 4, 10.0 * tick)) for tick in range(3)][-1]
    assert np.isfinite(heard.age_s).all()
    exchange.begin()
    heard = exchange.share(make_words(rng, 4, 0.0))
    np.testing.assert_array_equal(np.isinf(heard.age_s), ~np.eye(4, dtype=bool))


def test_a_new_episode_may_bring_its_own_chance(make_words, assert_same):
    exchange = MemoryExchange(ARMS, Channel(loss=0.5), rng=np.random.default_rng(0))

    def episode() -> list[PeerView]:
        exchange.begin(np.random.default_rng(3))
        rng = np.random.default_rng(1)
        return [exchange.share(make_words(rng, 4, 10.0 * tick)) for tick in range(10)]

    for one, other in zip(episode(), episode(), strict=True):
        assert_same(one, other)


def test_what_was_said_does_not_change_with_the_callers_arrays(make_words):
    exchange = MemoryExchange(ARMS, Channel(delay_s=10.0))
    rng = np.random.default_rng(0)
    words = replace(make_words(rng, 4, 0.0), jobs=("w", "x", "y", "z"), difficulty=np.full((4, 4), 0.5))
    exchange.share(words)
    words.difficulty[:] = 9.0
    heard = exchange.share(replace(words, time_s=10.0))
    assert heard.difficulty[0, 1, 0] == 0.5
    assert heard.difficulty[0, 0, 0] == 9.0


def test_a_delay_is_not_a_tick_longer_for_a_rounding(make_words):
    """0.1 + 0.2 > 0.3 in binary."""
    exchange = MemoryExchange(ARMS, Channel(delay_s=0.2))
    rng = np.random.default_rng(0)
    exchange.share(make_words(rng, 4, 0.1))
    assert np.isfinite(exchange.share(make_words(rng, 4, 0.3)).age_s).all()


def test_one_arm_alone_knows_itself(make_words):
    heard = MemoryExchange(["solo"]).share(make_words(np.random.default_rng(0), 1, 0.0))
    assert heard.difficulty.shape == (1, 1, 4)
    assert heard.age_s.tolist() == [[0.0]]


def test_no_slot_is_fine(make_words):
    heard = MemoryExchange(ARMS).share(make_words(np.random.default_rng(0), 4, 0.0, slots=0))
    assert heard.difficulty.shape == (4, 4, 0)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"time_s": np.nan}, "time_s"),
        ({"mode": np.array([0, 1, 3, 0])}, "mode"),
        ({"mode": np.zeros(3, dtype=int)}, "mode"),
        ({"headroom_k": np.array([1.0, np.nan, 1.0, 1.0])}, "headroom_k"),
        ({"temp_c": np.full((4, 7), np.inf)}, "temp_c"),
        ({"temp_c": np.zeros(4)}, "temp_c"),
        ({"difficulty": np.full((4, 4), np.inf)}, "difficulty"),
        ({"p_saturation": np.zeros((4, 5))}, "p_saturation"),
        ({"jobs": ("x", "x", "", "y")}, "jobs"),
        ({"twin": ("v1",)}, "twin"),
    ],
)
def test_words_that_cannot_be_said_are_refused(make_words, changes, named):
    exchange = MemoryExchange(ARMS)
    with pytest.raises(ValueError, match=f"Broadcast.{named}"):
        exchange.share(replace(make_words(np.random.default_rng(0), 4, 0.0), **changes))


def test_an_exchange_that_cannot_be_is_refused(make_words):
    with pytest.raises(ValueError, match="unknown arm 'z'"):
        MemoryExchange(ARMS, Channel(topology=nx.path_graph(["a", "z"])))
    with pytest.raises(ValueError, match="names"):
        MemoryExchange(["a", "a"])
    with pytest.raises(ValueError, match="needs an rng"):
        MemoryExchange(ARMS, Channel(loss=0.5)).share(make_words(np.random.default_rng(0), 4, 0.0))


def test_a_closed_exchange_says_so(make_words):
    with MemoryExchange(ARMS) as exchange:
        pass
    exchange.close()
    with pytest.raises(BusError, match="closed"):
        exchange.share(make_words(np.random.default_rng(0), 4, 0.0))
