"""The exchange in memory and on the bus: who hears whom through which channel, when, and what is then known."""

import copy
import json
import os
import pickle
import queue
import subprocess
import sys
import threading
import warnings
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.exchange.channel import PERFECT, Channel, Partition
from fleet.bus.exchange.memory import UNHEARD, Broadcast, Exchange, PeerView
from fleet.bus.exchange.zenoh import ZenohExchange, messages_of
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, State, decode, encode
from fleet.bus.router import Router, open_client
from fleet.errors import BusError
from fleet.offered_plans import PLANS
from tests.profiles import examples
from tests.waiting import PATIENCE_S

FIVE = ("a", "b", "c", "d", "e")


def named(count: int) -> tuple[str, ...]:
    return tuple(f"arm_{i}" for i in range(count))


@pytest.mark.parametrize("count", [1, 2, 3, 6])
@pytest.mark.parametrize(
    ("topology", "same"),
    [
        ("complete", nx.complete_graph),
        ("star", lambda n: nx.star_graph(n - 1)),
        ("ring", nx.cycle_graph),
        ("line", nx.path_graph),
    ],
)
def test_a_topology_by_name_is_that_of_networkx(topology, same, count):
    expected = nx.to_numpy_array(same(count), dtype=bool)
    np.fill_diagonal(expected, False)  # networkx's ring of one is a loop
    np.testing.assert_array_equal(Channel(topology=topology).links(named(count)), expected)


@given(st.floats(0, 1.5), st.floats(0, 1.5), st.integers(0, 1000))
def test_whoever_reaches_farther_hears_all_the_same_and_more(one, other, seed):
    near, far = (
        Channel(topology="random_geometric", radius=radius, topology_seed=seed).links(FIVE)
        for radius in sorted((one, other))
    )
    assert (near <= far).all()
    np.testing.assert_array_equal(far, far.T)
    assert not far.diagonal().any()


def test_random_places_are_uniform_in_the_unit_square():
    """Two points of the unit square are not farther apart than r < 1 with πr² − 8r³/3 + r⁴/2 (square line picking)."""
    r, arms = 0.4, named(2)
    hits = [Channel(topology="random_geometric", radius=r, topology_seed=s).links(arms)[0, 1] for s in range(3000)]
    expected = np.pi * r**2 - 8 / 3 * r**3 + r**4 / 2
    assert abs(np.mean(hits) - expected) < 4 * np.sqrt(expected * (1 - expected) / 3000)


def test_a_partition_cuts_what_lies_between_groups_and_those_of_no_group_keep_together():
    cut = Partition(0.0, 1.0, (("a", "b"), ("c",))).cuts(FIVE)
    together = [{"a", "b"}, {"c"}, {"d", "e"}]
    for r, receiver in enumerate(FIVE):
        for s, sender in enumerate(FIVE):
            assert cut[r, s] == (not any({receiver, sender} <= group for group in together))


def test_only_the_default_is_perfect():
    assert Channel() == PERFECT
    partitions = (Partition(0.0, 1.0, (("a",),)),)
    others = ({"topology": "ring"}, {"delay_s": 1.0}, {"jitter_s": 1.0}, {"loss": 0.1}, {"partitions": partitions})
    assert [Channel(**changes).perfect for changes in ({}, *others)] == [True] + 5 * [False]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"topology": "rign"}, "No topology 'rign'; did you mean 'ring'"),
        ({"delay_s": np.nan}, "delay_s must be 0 to 86400"),
        ({"jitter_s": -0.1}, "jitter_s must be 0 to 86400"),
        ({"loss": np.nan}, "loss must be 0 to 1"),
        ({"radius": -1.0}, "radius must be 0 to 2"),
        ({"radius": 0.3}, r"radius is for the topology random_geometric \(got 0.3 and complete\): give this topology"),
        ({"topology": "ring", "topology_seed": 3}, r"topology_seed is for the topology random_geometric \(got 3 and"),
        ({"topology_seed": -1}, "topology_seed must be 0 to 4294967295"),
    ],
)
def test_a_channel_that_cannot_be_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        Channel(**arguments)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((5.0, 5.0, (("a",),)), "must end after it begins"),
        ((np.nan, 5.0, (("a",),)), "must end after it begins"),
        ((0.0, 5.0, (("a",), ())), "needs groups"),
        ((0.0, 5.0, (("a", "b"), ("a",))), "names 'a' twice"),
    ],
)
def test_a_partition_that_cannot_be_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        Partition(*arguments)


def test_a_channel_is_told_in_plain_values_and_travels_to_other_processes():
    partition = Partition(600.0, 1200.0, (("a", "b"), ("c",)))
    channel = Channel(topology="random_geometric", radius=0.3, topology_seed=4, loss=0.1, partitions=(partition,))
    assert json.loads(json.dumps(channel.described())) == {
        "topology": "random_geometric",
        "radius": 0.3,
        "topology_seed": 4,
        "delay_s": 0.0,
        "jitter_s": 0.0,
        "loss": 0.1,
        "partitions": [{"from_s": 600.0, "to_s": 1200.0, "groups": [["a", "b"], ["c"]]}],
    }
    assert pickle.loads(pickle.dumps(channel)) == channel


THREE = ("a", "b", "c")
DT_S = 10.0


def carry(exchange: Exchange, now_s: float, said_s: list[float]) -> np.ndarray:
    """The times at which the words that every arm now has were said, [receiver, sender]; −inf for none."""
    said_s.append(now_s)
    return np.array([*said_s, -np.inf])[exchange._carry(now_s)]


def shift(channel: Channel, ticks: int, seed: int = 0, arms: tuple[str, ...] = THREE) -> tuple[Exchange, np.ndarray]:
    """An exchange after so many ticks, and the times of the messages received after each, [tick, receiver, sender]."""
    exchange = Exchange(arms, channel)
    exchange.begin(np.random.default_rng(seed))
    said_s: list[float] = []
    return exchange, np.array([carry(exchange, DT_S * tick, said_s) for tick in range(ticks)])


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
    exchange, known = shift(channel, 15, seed)
    now_s = DT_S * np.arange(15)[:, None, None]
    others = ~np.eye(3, dtype=bool)
    for earlier, later in pairwise(known):
        assert (later >= earlier).all()
    assert ((now_s - known)[:, others] >= channel.delay_s).all()
    assert (known[:, ~others] == now_s[:, 0]).all()  # one's own word is known at once
    assert np.isneginf(known[:, ~channel.links(THREE) & others]).all()
    assert exchange.delivered + exchange.late <= 15 * channel.links(THREE).sum()


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
    exchange, _ = shift(Channel(jitter_s=m * DT_S), m // 2 + 1, arms=tuple("abcdefghij"))
    shares = [n / m for n in range(m // 2 + 1)]
    spread = np.sqrt(links * sum(p * (1 - p) for p in shares))
    assert abs(exchange.delivered - links * sum(shares)) < 5 * spread


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


def test_partitions_cut_for_their_time_and_may_overlap():
    _, known = shift(Channel(partitions=(Partition(20.0, 50.0, (("a", "b"), ("c",))),)), 7)
    for tick in range(7):
        now_s = DT_S * tick
        across = 10.0 if 20.0 <= now_s < 50.0 else now_s
        np.testing.assert_array_equal(
            known[tick], [[now_s, now_s, across], [now_s, now_s, across], [across, across, now_s]]
        )
    both = (Partition(0.0, 30.0, (("a",),)), Partition(20.0, 40.0, (("b",),)))
    _, known = shift(Channel(partitions=both), 6)
    assert known[3].tolist() == [[30.0, -np.inf, 30.0], [-np.inf, 30.0, 10.0], [30.0, 10.0, 30.0]]
    assert (known[4] == 40.0).all()


def test_a_word_under_way_when_the_link_is_cut_is_lost_and_one_said_just_before_it_heals_too():
    """Delay 20 s, cut from 30 to 50 s: what is said in [10, 50) would travel while it is cut."""
    exchange, known = shift(Channel(delay_s=20.0, partitions=(Partition(30.0, 50.0, (("a",),)),)), 9, arms=("a", "b"))
    assert known[:, 0, 1].tolist() == [-np.inf, -np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 50.0, 60.0]
    assert exchange.late == 2 * 4


def test_a_new_episode_forgets_what_was_known_and_what_was_on_its_way():
    exchange = Exchange(THREE, Channel(delay_s=20.0))
    for time_s in (-20.0, -10.0, 0.0):
        exchange._carry(time_s)
    exchange.begin()
    others, said_s = ~np.eye(3, dtype=bool), list[float]()
    for time_s in (0.0, 10.0):
        assert np.isneginf(carry(exchange, time_s, said_s)[others]).all()
    assert (carry(exchange, 20.0, said_s)[others] == 0.0).all()


def make_words(rng: np.random.Generator, arms: int, time_s: float, slots: int = 4) -> Broadcast:
    """Broadcasts with awkward floats, unknown scores, empty slots, and jobs that come and go between ticks."""
    jobs = [f"job {number}" for number in rng.choice(8, size=slots, replace=False)]
    empty = rng.random(slots) < 0.25
    for slot in np.flatnonzero(empty):
        jobs[slot] = ""
    difficulty = rng.random((arms, slots)) * 10.0 ** rng.integers(-300, 1, (arms, slots))
    duration_s, peak_c, p_saturation = rng.random((3, arms, slots, PLANS)) * np.reshape(
        [900.0, 80.0, 1.0], (3, 1, 1, 1)
    )
    for values in (difficulty, duration_s, peak_c, p_saturation):
        values[rng.random(values.shape) < 0.3] = np.nan
        values[:, empty] = np.nan
    return Broadcast(
        time_s=time_s,
        mode=rng.integers(0, 3, arms),
        temp_c=rng.normal(40.0, 10.0, (arms, 7)),
        headroom_k=rng.normal(10.0, 20.0, arms),
        busy_s=rng.uniform(0.0, 900.0, arms),
        jobs=tuple(jobs),
        difficulty=difficulty,
        duration_s=duration_s,
        peak_c=peak_c,
        p_saturation=p_saturation,
        twin=tuple(f"twin-{number}" for number in rng.integers(0, 2, arms)),
    )


def assert_same(one: PeerView, other: PeerView) -> None:
    """The same arrays to the last bit; NaN equals NaN."""
    for name in (field.name for field in fields(PeerView)):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name, strict=True)


FOUR = ("a", "b", "c", "d")
BIDS = ("duration_s", "peak_c", "p_saturation")


@examples(40)
@given(ticks=st.integers(0, 4), dt_s=st.sampled_from([0.1, 1.0, 10.0]), seed=st.integers(0, 99))
def test_a_delayed_word_is_the_word_of_then_under_the_names_of_now(ticks, dt_s, seed):
    """Against a second method: look the word of t − delay up by hand."""
    rng = np.random.default_rng(seed)
    exchange = Exchange(FOUR, Channel(delay_s=ticks * dt_s))
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
                    assert heard.mode[receiver, sender] == UNHEARD
                    assert np.isnan(heard.headroom_k[receiver, sender])
                    assert np.isnan(heard.difficulty[receiver, sender]).all()
                    continue
                old = said[then]
                assert heard.age_s[receiver, sender] == words.time_s - old.time_s
                assert heard.mode[receiver, sender] == old.mode[sender]
                assert heard.headroom_k[receiver, sender] == old.headroom_k[sender]
                for slot, job in enumerate(words.jobs):
                    was_open = bool(job) and job in old.jobs
                    for name in ("difficulty", *BIDS):
                        expected = getattr(old, name)[sender, old.jobs.index(job)] if was_open else np.nan
                        actual = getattr(heard, name)[receiver, sender, slot]
                        np.testing.assert_array_equal(actual, np.broadcast_to(expected, np.shape(actual)))


def test_a_delay_is_not_a_tick_longer_for_a_rounding():
    """0.1 + 0.2 > 0.3 in binary."""
    exchange = Exchange(FOUR, Channel(delay_s=0.2))
    rng = np.random.default_rng(0)
    exchange.share(make_words(rng, 4, 0.1))
    assert np.isfinite(exchange.share(make_words(rng, 4, 0.3)).age_s).all()


def test_an_exchange_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"A partition names an unknown arm 'z'.*Allowed: a, b, c, d"):
        Exchange(FOUR, Channel(partitions=(Partition(0.0, 1.0, (("z",),)),)))
    with pytest.raises(ValueError, match="names"):
        Exchange(["a", "a"])
    with pytest.raises(ValueError, match="needs an rng"):
        Exchange(FOUR, Channel(loss=0.5)).share(make_words(np.random.default_rng(0), 4, 0.0))


def test_an_exchange_over_zenoh_stays_in_its_process():
    """Its sessions have threads, which a copy, a pickle or a forked process does not have."""
    exchange = ZenohExchange(ARMS, "stays")
    for copied in (copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="neither copied nor pickled"):
            copied(exchange)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # this process has threads
        child = os.fork()
    if not child:
        try:
            exchange.share(make_words(np.random.default_rng(0), len(ARMS), 0.0))
        except BusError as error:
            os._exit("belongs to process" not in str(error))
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


ARMS = ("arm_0", "arm_1", "arm 2+*@")
ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("channel", [Channel(), Channel(topology="ring", delay_s=10.0, loss=0.5)], ids=["all", "some"])
def test_the_bus_carries_every_message_and_the_arms_know_what_the_memory_delivers(channel):
    arms, rng, samples = tuple(f"arm {i}+*@" for i in range(12)), np.random.default_rng(2), queue.Queue()
    with ZenohExchange(arms, "same", channel=channel, timeout_s=PATIENCE_S) as bus:
        memory, said, heard = Exchange(arms, channel), [], []
        with open_client(bus.endpoint or "", timeout_s=PATIENCE_S) as observer:
            ears = [
                observer.declare_subscriber(keys.of_every_arm("same", topic), samples.put)
                for topic in ("state", "difficulty")
            ]
            barrier(observer)
            for exchange in (bus, memory):
                exchange.begin(np.random.default_rng(7))
            for tick in range(10):
                words = make_words(rng, 12, 10.0 * tick, slots=3 + tick % 3)
                said.append(words)
                assert_same(bus.share(words), memory.share(words))
                # Step by step: a router drops these messages when an observer lags by more than its buffers.
                heard += [samples.get(timeout=PATIENCE_S) for _ in range(2 * 12)]
            for ear in ears:
                ear.undeclare()
        assert (bus.delivered, bus.late) == (memory.delivered, memory.late)
    for sample in heard:
        key = keys.parse(str(sample.key_expr))
        kind = State if key.topic == "state" else DifficultyScores
        message = decode(kind, sample.payload.to_bytes())
        assert message.arm == key.name
        words, arm = said[message.tick], arms.index(key.name)
        assert message.time_s == words.time_s
        if isinstance(message, State):
            assert (message.headroom_k, message.busy_s) == (words.headroom_k[arm], words.busy_s[arm])
            assert message.temp_c == tuple(words.temp_c[arm])
        else:
            known = [job for job in words.jobs if job]
            columns = [words.jobs.index(job) for job in known]
            assert message.jobs == tuple(known)
            least = np.fmin.reduce(words.p_saturation[arm, columns], axis=-1)
            np.testing.assert_allclose(np.array(message.difficulty, float), words.difficulty[arm, columns], atol=5e-5)
            np.testing.assert_allclose(np.array(message.p_saturation, float), least, atol=5e-4)
            for name, atol in {"duration_s": 0.05, "peak_c": 0.05, "p_saturation": 5e-4}.items():
                values = getattr(message, f"bid_{name}")
                if name == "p_saturation" and not values:
                    assert not (np.isfinite(words.duration_s[arm]) & np.isnan(words.peak_c[arm])).any()
                    continue
                sent = np.array(values, float).reshape(len(columns), -1)
                np.testing.assert_allclose(sent, getattr(words, name)[arm, columns], atol=atol + 1e-9)


def test_scores_and_bids_for_sixteen_jobs_fit_into_a_kilobyte() -> None:
    """With two plans a job, names of 15 characters, and figures of any length."""
    rng, arms = np.random.default_rng(3), ("arm_0", "arm_1")
    duration_s, peak_c, p_saturation = rng.random((3, 2, 16, 2)) * np.reshape([1000, 100, 1], (3, 1, 1, 1))
    broadcast = Broadcast(
        time_s=28_790.0,
        mode=np.zeros(2, int),
        temp_c=np.zeros((2, 7)),
        headroom_k=np.zeros(2),
        busy_s=np.zeros(2),
        jobs=tuple(f"inspection_{i:04d}" for i in range(16)),
        difficulty=rng.random((2, 16)),
        duration_s=duration_s,
        peak_c=peak_c,
        p_saturation=p_saturation,
        twin=("lstm-vae-3f9a", "lstm-vae-3f9a"),
    )
    for _, scores in messages_of(broadcast, arms, 2879):
        assert len(scores.bid_duration_s) == len(scores.bid_peak_c) == 32
        assert len(encode(scores)) <= 1024


def test_an_exchange_takes_broadcasts_in_order_until_it_is_closed():
    with Exchange(ARMS) as exchange:
        exchange.begin(np.random.default_rng(0))
        exchange.share(make_words(np.random.default_rng(0), 3, 0.0))
        with pytest.raises(ValueError, match=r"-1 s after that of 0 s; begin\(\)"):
            exchange.share(make_words(np.random.default_rng(0), 3, -1.0))
        assert (exchange.delivered, exchange.late) == (6, 0)
    exchange.close()
    with pytest.raises(BusError, match="closed"):
        exchange.share(make_words(np.random.default_rng(0), 3, 0.0))


def test_an_arm_is_on_the_bus_once():
    with Router() as router, ZenohExchange(ARMS, "f", router.endpoint, timeout_s=PATIENCE_S):
        with pytest.raises(BusError, match="already has arm_1 "):
            ZenohExchange(["arm_1", "arm_9"], "f", router.endpoint, timeout_s=PATIENCE_S).open()
        ZenohExchange(["arm_9"], "f", router.endpoint, timeout_s=PATIENCE_S).open().close()


def barrier(session: zenoh.Session) -> None:
    """Wait until the router has taken all that the session said: it answers in order."""
    assert list(session.liveliness().get("thermofleet/v4/*/arm/*/alive", timeout=PATIENCE_S))


def test_closing_leaves_no_thread_and_no_port():
    threads = set(threading.enumerate())
    bus = ZenohExchange(ARMS, "f", timeout_s=PATIENCE_S).open()
    endpoint = bus.endpoint or ""
    bus.share(make_words(np.random.default_rng(0), 3, 0.0))
    bus.close()
    bus.close()
    assert set(threading.enumerate()) <= threads
    with Router(int(endpoint.rsplit(":", 1)[1])):
        pass
    with pytest.raises(BusError, match="closed"):
        bus.share(make_words(np.random.default_rng(0), 3, 0.0))
    with pytest.raises(BusError, match="closed"):
        bus.open()


@pytest.mark.parametrize("ending", ["pass", "del bus", "raise SystemExit(0)"])
def test_a_process_ends_however_it_leaves_the_exchange(ending):
    """A Zenoh session that is not closed keeps a process from ending."""
    program = f"""
import numpy as np
from fleet.bus.exchange.memory import UNHEARD, Broadcast, Exchange, PeerView
from fleet.bus.exchange.zenoh import ZenohExchange
bus = ZenohExchange(["a", "b"], "f", timeout_s=120.0)
one, plan = np.ones((2, 1)), np.ones((2, 1, 1))
heard = bus.share(Broadcast(0.0, np.zeros(2, int), one, one[:, 0], one[:, 0], ("j",), one, plan, plan, plan, ("", "")))
print(heard.difficulty.sum(), flush=True)
{ending}
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "4.0", "")


def test_what_cannot_be_is_refused():
    with pytest.raises(BusError, match="not on loopback"):
        ZenohExchange(ARMS, "f", "tcp/0.0.0.0:7447")
    with pytest.raises(ValueError, match="timeout_s"):
        ZenohExchange(ARMS, "f", timeout_s=0.0)
    with pytest.raises(ValueError, match="name"):
        ZenohExchange(ARMS, "")
    with pytest.raises(ValueError, match="names"):
        ZenohExchange(["a", "a"], "f")
