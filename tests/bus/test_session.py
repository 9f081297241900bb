"""The exchange over Zenoh: the same knowledge as in memory, whatever else is said on the bus."""

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zenoh

from fleet.bus.client.router import Router, open_client
from fleet.bus.exchange.memory import MemoryExchange
from fleet.bus.exchange.protocol import Exchange
from fleet.bus.exchange.zenoh import MOST_OWN_SESSIONS, ZenohExchange
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, Info, State, check_name, decode, encode, encoding
from fleet.errors import BusError
from tests.waiting import PATIENCE_S

ARMS = ("arm_0", "arm_1", "arm 2+*@")
ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("sessions", [1, 2, 8])
def test_the_bus_and_the_memory_know_the_same(make_words, assert_same, sessions):
    rng = np.random.default_rng(0)
    with ZenohExchange(ARMS, "same", timeout_s=PATIENCE_S, sessions=sessions) as bus, MemoryExchange(ARMS) as memory:
        for tick in range(20):
            words = make_words(rng, 3, 10.0 * tick, slots=3 + tick % 3)
            assert_same(bus.share(words), memory.share(words))
        assert (bus.delivered, bus.late, bus.malformed) == (memory.delivered, 0, 0) == (120, 0, 0)


def test_a_large_fleet_shares_two_sessions_and_knows_the_same(make_words, assert_same):
    arms = tuple(f"arm_{i}" for i in range(40))
    rng = np.random.default_rng(2)
    with ZenohExchange(arms, "large", timeout_s=PATIENCE_S) as bus, MemoryExchange(arms) as memory:
        with open_client(
            bus.endpoint, timeout_s=PATIENCE_S
        ) as session:  # everything that is said goes over the router, too
            heard = [
                session.declare_subscriber(keys.of_every_arm("large", "difficulty"), zenoh.handlers.FifoChannel(99))
            ]
            assert list(session.get("@/*/router", timeout=PATIENCE_S))
            for tick in range(3):
                words = make_words(rng, 40, 10.0 * tick)
                assert_same(bus.share(words), memory.share(words))
            said = [heard[0].recv() for _ in range(2 * 40)]
        assert len({str(sample.key_expr) for sample in said}) == 40
        assert (bus.delivered, bus.late, bus.malformed) == (3 * 40 * 39, 0, 0)
        assert len(bus._groups) == 1
    with ZenohExchange(arms[:MOST_OWN_SESSIONS], "small", timeout_s=PATIENCE_S) as bus:
        assert len(bus._groups) == MOST_OWN_SESSIONS


def test_arms_that_share_a_session_are_waited_for_alike(make_words, caplog):
    """One whose words do not come is missed by all others, and by nobody twice."""
    rng = np.random.default_rng(3)
    with ZenohExchange(ARMS, "miss", timeout_s=0.2, sessions=2) as bus:
        bus.share(make_words(rng, 3, 0.0))
        voice = bus._groups[1]._publishers[0]  # of the second arm, alone at its seat
        voice.publish = lambda state, difficulty: None
        heard = bus.share(make_words(rng, 3, 10.0))
        assert heard.age_s[:, 1].tolist() == [10.0, 0.0, 10.0]
        assert bus.late == 2
    with ZenohExchange(ARMS, "miss", timeout_s=0.2, sessions=1) as bus:
        bus.share(make_words(rng, 3, 0.0))
        bus._groups[0]._publishers[1].publish = lambda state, difficulty: None
        heard = bus.share(make_words(rng, 3, 10.0))
        assert heard.age_s[[0, 2], 1].tolist() == [10.0, 10.0]
        assert bus.late == 2


def test_a_new_episode_knows_nothing_of_the_last_but_what_is_said_anew(make_words, assert_same):
    rng = np.random.default_rng(1)
    with ZenohExchange(ARMS, "again", timeout_s=PATIENCE_S) as bus, MemoryExchange(ARMS) as memory:
        for time_s in (0.0, 10.0, 20.0, 0.0, 10.0, 0.0):
            if time_s == 0.0:
                bus.begin()
                memory.begin()
            words = make_words(rng, 3, time_s)
            assert_same(bus.share(words), memory.share(words))


@pytest.mark.parametrize("make", [lambda: MemoryExchange(ARMS), lambda: ZenohExchange(ARMS, "f")])
def test_an_exchange_is_an_exchange(make: Callable[[], Exchange], make_words):
    """The contract that the environment relies on, for both."""
    with make() as exchange:
        exchange.begin(np.random.default_rng(0))
        heard = exchange.share(make_words(np.random.default_rng(0), 3, 0.0))
        with pytest.raises(ValueError, match=r"-1 s after that of 0 s; begin\(\)"):
            exchange.share(make_words(np.random.default_rng(0), 3, -1.0))
        assert exchange.arms == ARMS
        assert (exchange.delivered, exchange.malformed, exchange.late) == (6, 0, 0)
        assert heard.mode.dtype.kind == "i"
        assert heard.difficulty.dtype == heard.p_saturation.dtype == heard.age_s.dtype == np.float64
    exchange.close()


def test_one_arm_alone_needs_nobody(make_words):
    with ZenohExchange(["solo"], "f") as bus:
        assert bus.share(make_words(np.random.default_rng(0), 1, 0.0)).age_s.tolist() == [[0.0]]


def test_fleets_on_one_router_and_fleets_on_two_do_not_mix(make_words, assert_same):
    rng = np.random.default_rng(2)
    with (
        Router() as router,
        ZenohExchange(ARMS, "east", router.endpoint, timeout_s=PATIENCE_S) as east,
        ZenohExchange(ARMS, "west", router.endpoint, timeout_s=PATIENCE_S) as west,
        ZenohExchange(ARMS, "east", timeout_s=PATIENCE_S) as far,
    ):
        for tick in range(5):
            for bus in (east, west, far):
                words = make_words(rng, 3, 10.0 * tick)
                assert_same(bus.share(words), MemoryExchange(ARMS).share(words))
        assert [bus.malformed + bus.late for bus in (east, west, far)] == [0, 0, 0]


def test_an_arm_is_on_the_bus_once():
    with Router() as router, ZenohExchange(ARMS, "f", router.endpoint, timeout_s=PATIENCE_S):
        with pytest.raises(BusError, match="already has arm_1 "):
            ZenohExchange(["arm_1", "arm_9"], "f", router.endpoint, timeout_s=PATIENCE_S).open()
        ZenohExchange(["arm_9"], "f", router.endpoint, timeout_s=PATIENCE_S).open().close()


def state_json(**changes) -> bytes:
    fields = json.loads(encode(State("arm_0", 0, 0.0, "idle", (20.0,), 40.0)))
    return json.dumps(fields | changes).encode()


UNEVEN = b'{"arm":"arm_0","tick":1,"time_s":1,"twin":"","jobs":["a"],"difficulty":[],"p_saturation":[]}'
FOREIGN: list[tuple[str, keys.ArmTopic, bytes, str]] = [
    ("arm_0", "state", b"\x00\xff garbage", encoding(State)),
    ("arm_0", "state", b"", encoding(State)),
    ("arm_0", "state", state_json(headroom_k=None), encoding(State)),
    ("arm_0", "state", state_json(arm="arm_1"), encoding(State)),
    ("arm_0", "state", state_json(tick=10**9), encoding(State)),
    ("arm_0", "state", state_json(time_s=1e9), encoding(State)),
    ("arm_0", "state", state_json(), "application/json;thermofleet.State.v1"),
    ("arm_0", "state", state_json(), "zenoh/bytes"),
    ("arm_0", "difficulty", b"[]", encoding(DifficultyScores)),
    ("arm_0", "difficulty", UNEVEN, encoding(DifficultyScores)),
]


def test_what_a_stranger_says_is_counted_and_never_believed(make_words, assert_same, caplog):
    """Each malformed word reaches the two or three arms that listen to the key; sharing goes on as if it were not."""
    rng = np.random.default_rng(3)
    with (
        ZenohExchange(ARMS, "f", timeout_s=PATIENCE_S) as bus,
        MemoryExchange(ARMS) as memory,
        open_client(bus.endpoint or "", timeout_s=PATIENCE_S) as stranger,
    ):
        words = make_words(rng, 3, 0.0)
        assert_same(bus.share(words), memory.share(words))
        for arm, topic, payload, said in FOREIGN:
            stranger.put(keys.of_arm("f", arm, topic), payload, encoding=said)
        stranger.put(keys.of_every_arm("f", "state"), state_json(), encoding=encoding(State))
        stranger.delete(keys.of_arm("f", "arm_1", "difficulty"))
        stranger.put(keys.of_arm("f", "another arm", "state"), b"no state", encoding=encoding(State))
        other = state_json(arm="another arm")
        stranger.put(keys.of_arm("f", "another arm", "state"), other, encoding=encoding(State))
        barrier(stranger)
        for tick in range(1, 4):
            words = make_words(rng, 3, 10.0 * tick)
            assert_same(bus.share(words), memory.share(words))
        assert bus.malformed == 3 * (len(FOREIGN) + 2)  # a DELETE is no message
        assert bus.late == 0
    assert "Dropped invalid message" in caplog.text


def barrier(stranger: zenoh.Session) -> None:
    """Wait until the router has taken all that the stranger said: it answers in order."""
    assert list(stranger.liveliness().get("thermofleet/v4/f/arm/*/alive", timeout=PATIENCE_S))


def test_a_flood_passes_and_leaves_no_trace(make_words, assert_same):
    rng = np.random.default_rng(4)
    with (
        ZenohExchange(ARMS, "f", timeout_s=0.2) as bus,
        open_client(bus.endpoint or "", timeout_s=PATIENCE_S) as stranger,
    ):
        topics: tuple[keys.ArmTopic, ...] = ("state", "difficulty")
        for topic in topics:
            flood = stranger.declare_publisher(
                keys.of_arm("f", "arm_0", topic), congestion_control=zenoh.CongestionControl.BLOCK
            )
            for _ in range(5000):
                flood.put(b"x" * 100)
        barrier(stranger)
        for tick in range(100):
            words = make_words(rng, 3, 10.0 * tick)
            late = bus.late
            heard = bus.share(words)
            if bus.malformed and bus.late == late:
                assert_same(heard, MemoryExchange(ARMS).share(words))
                return
    pytest.fail("The flood never ended.")


def test_a_late_joiner_gets_the_last_word_and_who_said_it(make_words):
    """With nothing but Zenoh: the caches answer a subscriber that was not there."""
    samples: queue.Queue[zenoh.Sample] = queue.Queue()
    with ZenohExchange(ARMS, "f", timeout_s=PATIENCE_S) as bus:
        words = make_words(np.random.default_rng(5), 3, 0.0)
        bus.share(words)
        with open_client(bus.endpoint or "", timeout_s=PATIENCE_S) as joiner:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            for topic in ("info", "difficulty"):
                zenoh.ext.declare_advanced_subscriber(
                    joiner, keys.of_every_arm("f", topic), samples.put, history=history
                )
            tokens = joiner.liveliness().get(keys.of_every_arm("f", "alive"), timeout=PATIENCE_S)
            present = {keys.parse(str(reply.ok.key_expr)).name for reply in tokens if reply.ok}
            said = [samples.get(timeout=PATIENCE_S) for _ in range(6)]
    assert present == set(ARMS)
    for sample in said:
        key = keys.parse(str(sample.key_expr))
        index = ARMS.index(key.name)
        kind = Info if key.topic == "info" else DifficultyScores
        assert str(sample.encoding) == encoding(kind)
        word = check_name(decode(kind, sample.payload.to_bytes()), key.name, "arm")
        assert word.twin == words.twin[index]
        if isinstance(word, Info):
            assert word.joints == 7
        else:
            assert word.jobs == tuple(job for job in words.jobs if job)
    assert len({str(sample.key_expr) for sample in said}) == 6


def test_closing_leaves_no_thread_and_no_port(make_words):
    threads = set(threading.enumerate())
    bus = ZenohExchange(ARMS, "f", timeout_s=PATIENCE_S).open()
    endpoint = bus.endpoint or ""
    bus.share(make_words(np.random.default_rng(0), 3, 0.0))
    bus.close()
    bus.close()
    assert set(threading.enumerate()) == threads
    with Router(int(endpoint.rsplit(":", 1)[1])):
        pass
    with pytest.raises(BusError, match="closed"):
        bus.share(make_words(np.random.default_rng(0), 3, 0.0))
    with pytest.raises(BusError, match="closed"):
        bus.open()


def test_an_error_inside_the_block_is_the_one_that_is_seen():
    with pytest.raises(ZeroDivisionError), ZenohExchange(ARMS, "f"):
        _ = 1 / 0


@pytest.mark.parametrize("ending", ["bus.close()", "pass", "del bus", "raise SystemExit(0)"])
def test_a_process_ends_however_it_leaves_the_exchange(ending):
    """A Zenoh session that is not closed keeps a process from ending."""
    program = f"""
import numpy as np
from fleet.bus.exchange.protocol import Broadcast
from fleet.bus.exchange.zenoh import ZenohExchange
bus = ZenohExchange(["a", "b"], "f", timeout_s=30.0)
one = np.ones((2, 1))
heard = bus.share(Broadcast(0.0, np.zeros(2, int), one, one[:, 0], one[:, 0], ("j",), one, one, ("", "")))
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


@pytest.mark.parametrize("endpoint", ["tcp/10.0.0.1:7447", "tcp/0.0.0.0:7447"])
def test_an_arm_connects_to_this_machine_alone(endpoint):
    with pytest.raises(BusError, match="not on loopback"):
        ZenohExchange(ARMS, "f", endpoint)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="timeout_s"):
        ZenohExchange(ARMS, "f", timeout_s=0.0)
    with pytest.raises(ValueError, match="name"):
        ZenohExchange(ARMS, "")
    with pytest.raises(ValueError, match="names"):
        ZenohExchange(["a", "a"], "f")


def test_no_router_is_an_error_and_leaves_nothing_open():
    with Router() as router:
        endpoint = router.endpoint
    threads = set(threading.enumerate())
    with pytest.raises(BusError, match="No router answered"):
        ZenohExchange(ARMS, "f", endpoint, timeout_s=0.2).open()
    assert set(threading.enumerate()) == threads


def test_words_that_cannot_be_said_open_nothing(make_words):
    bus = ZenohExchange(ARMS, "f")
    with pytest.raises(ValueError, match=r"Broadcast\.mode"):
        bus.share(make_words(np.random.default_rng(0), 2, 0.0))
    assert bus.endpoint is None
