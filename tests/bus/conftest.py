"""Routers and keys for the tests of security."""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from fleet.bus.router import Router, open_client
from fleet.bus.security.access_control import of_arms
from fleet.bus.security.certificates import make
from fleet.bus.security.tls import Tls
from tests.waiting import PATIENCE_S

ARMS = ("arm_0", "arm_1", "arm 2+*@")
Connect = Callable[[str], zenoh.Session]


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
