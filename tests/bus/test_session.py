"""The exchange that is also on the bus: what it publishes, and the same knowledge as in memory."""

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

from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.memory import Exchange, MemoryExchange
from fleet.bus.exchange.zenoh import ZenohExchange
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, Info, State, check_name, decode, encode, encoding
from fleet.bus.router import Router, open_client
from fleet.errors import BusError
from tests.waiting import PATIENCE_S

ARMS = ("arm_0", "arm_1", "arm 2+*@")
ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("channel", [Channel(), Channel(topology="ring", delay_s=10.0, loss=0.5)], ids=["all", "some"])
def test_the_bus_carries_every_message_and_the_arms_know_what_the_memory_delivers(make_words, assert_same, channel):
    arms, rng, samples = tuple(f"arm {i}+*@" for i in range(12)), np.random.default_rng(2), queue.Queue()
    with ZenohExchange(arms, "same", channel=channel, timeout_s=PATIENCE_S) as bus:
        memory, said = MemoryExchange(arms, channel), []
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
            heard = [samples.get(timeout=PATIENCE_S) for _ in range(2 * 12 * 10)]
            for ear in ears:
                ear.undeclare()
        assert (bus.delivered, bus.late) == (memory.delivered, memory.late)
    for sample in heard:
        key = keys.parse(str(sample.key_expr))
        kind = State if key.topic == "state" else DifficultyScores
        message = check_name(decode(kind, sample.payload.to_bytes()), key.name, "arm")
        words, arm = said[message.tick], arms.index(key.name)
        assert message.time_s == words.time_s
        if isinstance(message, State):
            assert (message.headroom_k, message.busy_s) == (words.headroom_k[arm], words.busy_s[arm])
            assert message.temp_c == tuple(words.temp_c[arm])
        else:
            known = [job for job in words.jobs if job]
            columns = [words.jobs.index(job) for job in known]
            assert message.jobs == tuple(known)
            np.testing.assert_array_equal(np.array(message.difficulty, float), words.difficulty[arm, columns])
            np.testing.assert_array_equal(np.array(message.p_saturation, float), words.p_saturation[arm, columns])


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
        assert (exchange.delivered, exchange.late) == (6, 0)
        assert heard.mode.dtype.kind == "i"
        assert heard.difficulty.dtype == heard.p_saturation.dtype == heard.age_s.dtype == np.float64
    exchange.close()


def test_one_arm_alone_needs_nobody(make_words):
    with ZenohExchange(["solo"], "f") as bus:
        assert bus.share(make_words(np.random.default_rng(0), 1, 0.0)).age_s.tolist() == [[0.0]]


def test_an_arm_is_on_the_bus_once():
    with Router() as router, ZenohExchange(ARMS, "f", router.endpoint, timeout_s=PATIENCE_S):
        with pytest.raises(BusError, match="already has arm_1 "):
            ZenohExchange(["arm_1", "arm_9"], "f", router.endpoint, timeout_s=PATIENCE_S).open()
        ZenohExchange(["arm_9"], "f", router.endpoint, timeout_s=PATIENCE_S).open().close()


def test_what_a_stranger_says_is_never_believed(make_words, assert_same):
    rng = np.random.default_rng(3)
    with (
        ZenohExchange(ARMS, "f", timeout_s=PATIENCE_S) as bus,
        MemoryExchange(ARMS) as memory,
        open_client(bus.endpoint or "", timeout_s=PATIENCE_S) as stranger,
    ):
        for tick in range(3):
            words = make_words(rng, 3, 10.0 * tick)
            assert_same(bus.share(words), memory.share(words))
            foreign = encode(State("arm_0", 10**9, 1e9, "idle", (20.0,), 40.0))
            stranger.put(keys.of_arm("f", "arm_0", "state"), foreign, encoding=encoding(State))
            stranger.put(keys.of_arm("f", "arm_0", "difficulty"), b"garbage")
            barrier(stranger)


def barrier(session: zenoh.Session) -> None:
    """Wait until the router has taken all that the session said: it answers in order."""
    assert list(session.liveliness().get("thermofleet/v4/*/arm/*/alive", timeout=PATIENCE_S))


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
from fleet.bus.exchange.memory import Broadcast
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
