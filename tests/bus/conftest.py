"""Broadcasts for the tests of exchanges; routers and keys for those of security."""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import zenoh

from fleet.bus.exchange.memory import Broadcast, PeerView
from fleet.bus.router import Router, open_client
from fleet.bus.security.access_control import of_arms
from fleet.bus.security.certificates import make
from fleet.bus.security.tls import Tls
from fleet.offered_plans import PLANS
from tests.waiting import PATIENCE_S

ARMS = ("arm_0", "arm_1", "arm 2+*@")
Connect = Callable[[str], zenoh.Session]


def random_words(rng: np.random.Generator, arms: int, time_s: float, slots: int = 4) -> Broadcast:
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


def assert_equal(one: PeerView, other: PeerView) -> None:
    """The same arrays to the last bit; NaN equals NaN."""
    for name in (field.name for field in fields(PeerView)):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name, strict=True)


@pytest.fixture
def make_words() -> Callable[..., Broadcast]:
    return random_words


@pytest.fixture
def assert_same() -> Callable[[PeerView, PeerView], None]:
    return assert_equal


def stranger(
    endpoint: str, tls: Mapping[str, object] | None = None, mode: str = "client", *, timeout_s: float = PATIENCE_S
) -> zenoh.Session:
    """A session as somebody opens it who has none of our checks."""
    config = {
        "mode": mode,
        "connect": {"endpoints": [endpoint], "timeout_ms": round(1000 * timeout_s), "exit_on_failure": True},
        "listen": {"endpoints": []},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"tls": tls or {}}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


@pytest.fixture
def open_stranger() -> Callable[..., zenoh.Session]:
    return stranger


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The keys of the fleet f."""
    place = tmp_path_factory.mktemp("keys") / "f"
    make(place, of_arms("f", ARMS), days=30)
    return place


@pytest.fixture(scope="module")
def guarded(folder: Path) -> Iterator[Router]:
    with Router(tls=Tls(folder, "router")) as router:
        yield router


@pytest.fixture(scope="module")
def open_router() -> Iterator[Router]:
    with Router() as router:
        yield router


@pytest.fixture(params=["guarded", "open"])
def side(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def router(side: str, guarded: Router, open_router: Router) -> Router:
    return guarded if side == "guarded" else open_router


@pytest.fixture
def connect(router: Router, side: str, folder: Path) -> Iterator[Connect]:
    """Sessions of participants by name, on the guarded and on the open router."""
    with ExitStack() as stack:

        def session(name: str) -> zenoh.Session:
            tls = Tls(folder, name) if side == "guarded" else None
            return stack.enter_context(open_client(router.endpoint, timeout_s=PATIENCE_S, tls=tls))

        yield session


@pytest.fixture
def inside() -> Callable[[Router], zenoh.Session]:
    """The router's own session, which receives everything that the router accepts, whatever its key."""

    def session(router: Router) -> zenoh.Session:
        assert router._session is not None
        return router._session

    return session
