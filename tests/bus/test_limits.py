"""What is too big or too often is dropped at the router, and everything else goes on; with TLS and without."""

import queue
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from fleet.bus.protocol import keys
from fleet.bus.router import Router, assembled_bytes, limits, open_client
from fleet.bus.security.access_control import RosterEntry, of_arms
from fleet.bus.security.certificates import make
from fleet.bus.security.tls import Tls
from tests.waiting import PATIENCE_S

LIMIT = 65_536
STATE_HZ = 25.0
Connect = Callable[[str], zenoh.Session]


@pytest.fixture(scope="module", params=["tcp", "tls"])
def connect(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Connect]:
    """Sessions by name on a router that lets through 64 KiB, and 25 words of telemetry a second."""
    folder: Path = tmp_path_factory.mktemp("keys") / "f"
    secure = request.param == "tls"
    if secure:
        make(folder, of_arms("f", ["arm_0", "arm_1"]), days=1)
    with ExitStack() as stack:
        router = stack.enter_context(Router(tls=Tls(folder, "router") if secure else None, state_hz=STATE_HZ))
        sessions: dict[str, zenoh.Session] = {}

        def session(name: str) -> zenoh.Session:
            if name not in sessions:
                tls = Tls(folder, name) if secure else None
                sessions[name] = stack.enter_context(open_client(router.endpoint, timeout_s=PATIENCE_S, tls=tls))
            return sessions[name]

        yield session


def say(session: zenoh.Session, key: str, size: int, **more: object) -> None:
    """Without the sender's own right to drop what is big."""
    session.put(key, b"x" * size, congestion_control=zenoh.CongestionControl.BLOCK, **more)


def sizes(connect: Connect, key: str, say_all: Callable[[zenoh.Session], object]) -> list[int]:
    """Payload sizes that a listener hears, until one of 1 byte ends it."""
    heard: queue.Queue[int] = queue.Queue()
    listener = connect("monitor").declare_subscriber(key, lambda sample: heard.put(len(sample.payload)))
    arm = connect("arm_0")
    settled(connect("monitor"))
    say_all(arm)
    say(arm, keys.of_arm("f", "arm_0", "event"), 1)
    got = [heard.get(timeout=PATIENCE_S)]
    while got[-1] != 1:
        got.append(heard.get(timeout=PATIENCE_S))
    listener.undeclare()
    return got[:-1]


def settled(session: zenoh.Session) -> None:
    """Wait until the router has taken all that the session said or declared before."""
    assert list(session.get(keys.caches_of("thermofleet/v4/f/arm/nobody"), timeout=PATIENCE_S)) == []


EVENT = keys.of_arm("f", "arm_0", "event")


@pytest.mark.parametrize("size", [LIMIT + 1, 2 * LIMIT, 3 * LIMIT + 1, 5_000_000])
def test_a_word_that_is_too_big_is_dropped_and_the_next_are_not(connect, size):
    def say_all(arm: zenoh.Session) -> None:
        for one in (2, size, LIMIT, size, 3):
            say(arm, EVENT, one)

    assert sizes(connect, EVENT, say_all) == [2, LIMIT, 3]


def test_an_attachment_counts(connect):
    def say_all(arm: zenoh.Session) -> None:
        say(arm, EVENT, LIMIT - 10, attachment=b"y" * 10)
        say(arm, EVENT, LIMIT - 9, attachment=b"y" * 10)

    assert sizes(connect, EVENT, say_all) == [LIMIT - 10]


def test_what_caches_say_to_each_other_is_no_way_round(connect):
    heard: queue.Queue[int] = queue.Queue()
    key = f"{EVENT}/@adv/pub/1"
    listener = connect("monitor").declare_subscriber(key, lambda sample: heard.put(len(sample.payload)))
    settled(connect("monitor"))
    for size in (LIMIT + 1, LIMIT):
        say(connect("arm_0"), key, size)
    assert heard.get(timeout=PATIENCE_S) == LIMIT
    listener.undeclare()


def test_a_question_and_an_answer_that_are_too_big_are_dropped(connect):
    key = keys.of_arm("f", "arm_0", "quote")
    asked: list[int] = []

    def reply(query: zenoh.Query) -> None:
        with query:
            size = 0 if query.payload is None else len(query.payload)
            asked.append(size)
            for answer in (size + 1, 2):
                query.reply(key, b"z" * answer)

    queryable = connect("arm_0").declare_queryable(key, reply)
    settled(connect("arm_0"))

    def answers(size: int) -> list[int]:
        began_s = time.monotonic()
        replies = connect("auctioneer").get(
            key, payload=b"q" * size, consolidation=zenoh.ConsolidationMode.NONE, timeout=PATIENCE_S
        )
        got = [len(one.ok.payload) for one in replies if one.ok]
        assert time.monotonic() - began_s < PATIENCE_S / 2, "nobody waits for what was dropped"
        return got

    assert answers(LIMIT + 1) == []
    assert answers(LIMIT) == [2]
    assert answers(LIMIT - 1) == [LIMIT, 2]
    assert asked == [LIMIT, LIMIT - 1]
    queryable.undeclare()


@pytest.mark.parametrize("asked", [f"{EVENT}/@adv/pub/1", "thermofleet/v4/f/**/@adv/**"])
def test_a_question_to_a_cache_is_not_larger_than_others(connect, asked):
    sizes: queue.Queue[int] = queue.Queue()

    def reply(query: zenoh.Query) -> None:
        with query:
            sizes.put(0 if query.payload is None else len(query.payload))

    queryable = connect("arm_0").declare_queryable(f"{EVENT}/@adv/pub/1", reply)
    settled(connect("arm_0"))
    for size in (LIMIT + 1, 2 * LIMIT, LIMIT):
        assert list(connect("monitor").get(asked, payload=b"q" * size, timeout=PATIENCE_S)) == []
    assert sizes.get(timeout=PATIENCE_S) == LIMIT
    queryable.undeclare()


def test_without_a_policy_in_the_roster_no_request_may_be_large():
    """Only of parameters does the router not know the size: it does not assemble them."""
    without, policy = of_arms("f", ["arm_0"]), of_arms("f", ["arm_0"], [RosterEntry("mine", "policy")])
    largest = [
        (max(size["size_limit"] for size in limits(roster)["low_pass_filter"]), assembled_bytes(roster))
        for roster in (without, policy, None)
    ]
    assert largest == [(LIMIT, 3 * LIMIT), *2 * [(64 * LIMIT, 65 * LIMIT)]]


def test_a_flood_of_telemetry_is_thinned_and_takes_nothing_from_other_words_and_other_arms(connect):
    heard: queue.Queue[str] = queue.Queue()
    listener = connect("monitor").declare_subscriber(
        "thermofleet/v4/f/**", lambda sample: heard.put(str(sample.key_expr))
    )
    settled(connect("monitor"))
    settled(connect("arm_1"))
    flood, other = keys.of_arm("f", "arm_0", "state"), keys.of_arm("f", "arm_1", "state")
    difficulty, end = keys.of_arm("f", "arm_0", "difficulty"), keys.of_arm("f", "arm_0", "info")
    began_s = time.monotonic()
    for _ in range(50):
        for _ in range(20):
            connect("arm_0").put(flood, b"state")
        say(connect("arm_0"), difficulty, 100)
    connect("arm_1").put(other, b"state")
    settled(connect("arm_1"))
    say(connect("arm_0"), end, 1)
    got: list[str] = []
    while not got or got[-1] != end:
        got.append(heard.get(timeout=PATIENCE_S))
    assert got.count(difficulty) == 50
    assert got.count(other) == 1
    assert 1 <= got.count(flood) <= 1 + STATE_HZ * (time.monotonic() - began_s)
    listener.undeclare()


def test_without_a_rate_every_word_passes_and_a_rate_that_cannot_be_is_refused():
    """An exchange says in a second what a fleet says in an hour."""
    assert ["downsampling" in limits(state_hz=hz) for hz in (None, 1.0)] == [False, True]
    with pytest.raises(ValueError, match="state_hz must be > 0"):
        Router(state_hz=float("nan"))
