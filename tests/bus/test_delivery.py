"""What a channel does to words: when they come, which do not, and what an arm then has."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.exchange.channel import Channel, Partition
from fleet.bus.exchange.memory import Delivery

ARMS = ("a", "b", "c")
DT_S = 10.0


def carry(delivery: Delivery, now_s: float, said_s: list[float]) -> np.ndarray:
    """The times at which the words that every arm now has were said, [receiver, sender]; −inf for none."""
    said_s.append(now_s)
    return np.array([*said_s, -np.inf])[delivery.carry(now_s)]


def shift(channel: Channel, ticks: int, seed: int = 0, arms: tuple[str, ...] = ARMS) -> tuple[Delivery, np.ndarray]:
    """A delivery after so many ticks, and the times of the words known after each, [tick, receiver, sender]."""
    delivery = Delivery(arms, channel, np.random.default_rng(seed))
    said_s: list[float] = []
    return delivery, np.array([carry(delivery, DT_S * tick, said_s) for tick in range(ticks)])


channels = st.builds(
    Channel,
    topology=st.sampled_from(["complete", "ring", "star", "line"]),
    delay_s=st.sampled_from([0.0, 3.0, 10.0, 25.0]),
    jitter_s=st.sampled_from([0.0, 4.0, 35.0]),
    loss=st.sampled_from([0.0, 0.3]),
    partitions=st.sampled_from([(), (Partition(30.0, 60.0, (("a",),)),)]),
)


@given(channels, st.integers(0, 100))
def test_what_is_known_never_grows_older_by_a_word_and_never_comes_before_its_time(channel, seed):
    delivery, known = shift(channel, 15, seed)
    now_s = DT_S * np.arange(15)[:, None, None]
    others = ~np.eye(3, dtype=bool)
    for earlier, later in pairwise(known):
        assert (later >= earlier).all()
    assert ((now_s - known)[:, others] >= channel.delay_s).all()
    assert (known[:, ~others] == now_s[:, 0]).all()  # one's own word is known at once
    assert np.isneginf(known[:, ~channel.links(ARMS) & others]).all()
    assert delivery.delivered + delivery.late <= 15 * channel.links(ARMS).sum()


@given(st.sampled_from([0.0, 3.0, 10.0, 25.0]), st.sampled_from([1.0, 10.0, 35.0]), st.integers(0, 100))
def test_without_loss_a_word_is_there_after_delay_and_jitter_at_the_latest(delay_s, jitter_s, seed):
    _, known = shift(Channel(delay_s=delay_s, jitter_s=jitter_s), 20, seed)
    for tick in range(20):
        surely = DT_S * np.arange(20)
        surely = surely[surely + delay_s + jitter_s <= DT_S * tick]
        if len(surely):
            assert (known[tick] >= surely[-1]).all()


def test_jitter_is_uniform():
    """A word that takes 0 to m ticks is there after n of them with probability n/m."""
    m, links = 20, 90
    delivery, _ = shift(Channel(jitter_s=m * DT_S), m // 2 + 1, arms=tuple("abcdefghij"))
    shares = [n / m for n in range(m // 2 + 1)]
    spread = np.sqrt(links * sum(p * (1 - p) for p in shares))
    assert abs(delivery.delivered - links * sum(shares)) < 5 * spread


def test_words_overtake_each_other_and_the_older_is_no_news():
    delivery, known = shift(Channel(jitter_s=60.0), 60)
    others = ~np.eye(3, dtype=bool)
    changes = int((known[1:] > known[:-1])[:, others].sum()) + int(np.isfinite(known[0][others]).sum())
    assert delivery.delivered > changes > 0
    assert delivery.late == 0


def test_more_loss_loses_the_same_words_and_more_and_jitter_loses_no_others():
    def heard(**changes) -> np.ndarray:
        _, known = shift(Channel(**changes), 100, seed=3)
        return known == DT_S * np.arange(100)[:, None, None]

    little, much = heard(loss=0.2), heard(loss=0.5)
    assert (much <= little).all()
    assert much.sum() < little.sum()
    few, _ = shift(Channel(loss=0.2), 100, seed=3)
    delayed, _ = shift(Channel(loss=0.2, jitter_s=5.0), 100, seed=3)
    assert few.late == delayed.late
    pairs = 100 * 6
    assert abs(few.late - 0.2 * pairs) < 5 * np.sqrt(0.2 * 0.8 * pairs)


def test_each_link_draws_for_itself():
    _, known = shift(Channel(loss=0.5), 40)
    came = known == DT_S * np.arange(40)[:, None, None]
    rows = [tuple(came[:, r, s]) for r in range(3) for s in range(3) if r != s]
    assert len(set(rows)) == 6


def test_a_partition_cuts_between_groups_for_its_time_and_no_longer():
    _, known = shift(Channel(partitions=(Partition(20.0, 50.0, (("a", "b"), ("c",))),)), 7)
    for tick in range(7):
        now_s = DT_S * tick
        across = 10.0 if 20.0 <= now_s < 50.0 else now_s
        np.testing.assert_array_equal(
            known[tick], [[now_s, now_s, across], [now_s, now_s, across], [across, across, now_s]]
        )


def test_a_word_under_way_when_the_link_is_cut_is_lost_and_one_said_just_before_it_heals_too():
    """Delay 20 s, cut from 30 to 50 s: what is said in [10, 50) would travel while it is cut."""
    delivery, known = shift(Channel(delay_s=20.0, partitions=(Partition(30.0, 50.0, (("a",),)),)), 9, arms=("a", "b"))
    assert known[:, 0, 1].tolist() == [-np.inf, -np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 50.0, 60.0]
    assert delivery.late == 2 * 4


def test_partitions_may_overlap():
    both = (Partition(0.0, 30.0, (("a",),)), Partition(20.0, 40.0, (("b",),)))
    _, known = shift(Channel(partitions=both), 6)
    assert known[3].tolist() == [[30.0, -np.inf, 30.0], [-np.inf, 30.0, 10.0], [30.0, 10.0, 30.0]]
    assert (known[4] == 40.0).all()


def test_a_new_episode_forgets_what_was_known_and_what_was_on_its_way():
    delivery = Delivery(ARMS, Channel(delay_s=20.0))
    for time_s in (-20.0, -10.0, 0.0):
        delivery.carry(time_s)
    delivery.begin()
    others, said_s = ~np.eye(3, dtype=bool), list[float]()
    for time_s in (0.0, 10.0):
        assert np.isneginf(carry(delivery, time_s, said_s)[others]).all()
    assert (carry(delivery, 20.0, said_s)[others] == 0.0).all()


def test_chance_must_be_given():
    with pytest.raises(ValueError, match="needs an rng"):
        Delivery(ARMS, Channel(jitter_s=1.0)).carry(0.0)
    Delivery(ARMS, Channel(delay_s=1.0)).carry(0.0)
