"""Commands that steer a fleet, over TLS: an operator may, nobody else can, and then nothing reaches the fleet."""

import threading
import time
from contextlib import ExitStack
from types import SimpleNamespace

import pytest
from msgspec.structs import replace
from typer.testing import CliRunner

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobStatus
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.contract import EXAMPLES
from fleet.bus.protocol.messages import encode, encoding
from fleet.bus.protocol.operator import (
    Cancel,
    Change,
    Cleared,
    ClearRequest,
    Controlled,
    ControlRequest,
    Pause,
    ResetReply,
    ResetRequest,
    Resume,
    Settle,
)
from fleet.bus.router import Router, open_client
from fleet.bus.security.access_control import Participant, of_arms
from fleet.bus.security.certificates import make
from fleet.bus.security.tls import Tls
from fleet.errors import BusError
from scenarios.cli.main import app
from tests.waiting import PATIENCE_S

COMMANDS = {
    ("job", "cancel", "j"): Cancel("j"),
    ("job", "settle", "j", "redo"): Settle("j", "redo"),
    ("job", "change", "j", "--value", "2"): Change("j", value=2.0),
    ("arm", "pause"): Pause("*"),
    ("arm", "pause", "a"): Pause("a"),
    ("arm", "pause", "--end"): Resume("*"),
    ("arm", "clear", "a"): ClearRequest("a", "ann"),
    ("arm", "reset", "a"): ResetRequest("ann"),
}
OTHERS = ("monitor", "submitter", "recorder", "b")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A router with TLS, and an arm and an auctioneer that keep every request."""
    place, stop, received = tmp_path_factory.mktemp("keys") / "f", threading.Event(), []
    make(place, of_arms("f", ["a"], [Participant("b", "arm")]), days=30)

    def keep(reply):
        return lambda request: (received.append(request), reply(request))[1]

    def controlled(request):
        return Controlled("auctioneer", request.request, True, "", JobStatus("j", "waiting"), {})

    with ExitStack() as stack:
        router = stack.enter_context(Router(tls=Tls(place, "router")))
        arm, auctioneer = (
            stack.enter_context(BusClient(Tls(place, name).endpoint(router.endpoint), "f"))
            for name in ("a", "auctioneer")
        )
        arm.reply_to(keys.of_arm("f", "a", "reset"), ResetRequest, keep(lambda _: ResetReply("a", True)))
        auctioneer.reply_to(keys.of_jobs("f", "control"), ControlRequest, keep(controlled))
        auctioneer.reply_to(keys.of_jobs("f", "clear"), ClearRequest, keep(lambda _: Cleared("auctioneer", "a")))
        cell = replace(EXAMPLES[Cell], auctioneer="auctioneer")
        auctioneer.reply_to(keys.of_jobs("f", "cell"), CellRequest, keep(lambda _: cell))

        def serve():
            while not stop.is_set():
                for each in (arm, auctioneer):
                    each.serve(time.monotonic() + 0.02)

        thread = threading.Thread(target=serve)
        thread.start()
        yield SimpleNamespace(received=received, endpoint=lambda who: Tls(place, who).endpoint(router.endpoint))
        stop.set()
        thread.join(PATIENCE_S)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_an_operator_may(fleet, command):
    fleet.received.clear()
    done = CliRunner().invoke(app, [*command, "--by", "ann", "--endpoint", fleet.endpoint("operator")])
    assert done.exit_code == 0, done.exception
    (request,) = fleet.received
    assert request.by == "ann"
    assert COMMANDS[command] in (request, getattr(request, "action", None))


@pytest.mark.parametrize("who", OTHERS)
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_nobody_else_may(fleet, command, who):
    fleet.received.clear()
    done = CliRunner().invoke(app, [*command, "--by", "ann", "--endpoint", fleet.endpoint(who)])
    assert isinstance(done.exception, BusError)
    assert "may not query" in str(done.exception)
    assert "a certificate of the role" in str(done.exception)
    assert "operator" in str(done.exception)
    assert fleet.received == []


@pytest.mark.parametrize("who", OTHERS)
def test_the_router_drops_what_a_client_sends_against_its_role(fleet, who):
    """Without our client's own check."""
    fleet.received.clear()
    messages = [
        *((keys.of_jobs("f", "control"), ControlRequest(str(i), a)) for i, a in enumerate([Cancel("j"), Pause("*")])),
        (keys.of_jobs("f", "clear"), ClearRequest("a", "ann")),
        (keys.of_arm("f", "a", "reset"), ResetRequest("ann")),
    ]
    session = open_client(fleet.endpoint(who), timeout_s=PATIENCE_S)
    try:
        for key, message in messages:
            replies = session.get(key, payload=encode(message), encoding=encoding(type(message)), timeout=0.5)
            assert [reply for reply in replies if reply.ok is not None] == []
    finally:
        session.close()
    test_an_operator_may(
        fleet,
        (
            "arm",
            "pause",
        ),
    )  # whatever came before would have been served by now
    assert len(fleet.received) == 1


@pytest.mark.parametrize(("who", "may"), [("operator", True), ("submitter", True), ("b", False)])
def test_the_cell_is_described_to_those_who_submit(fleet, who, may):
    fleet.received.clear()
    with BusClient(fleet.endpoint(who), "f") as link:
        if may:
            replies = link.query_and_wait(keys.of_jobs("f", "cell"), CellRequest(), Cell, timeout_s=PATIENCE_S)
            assert [cell.scenario for cell in replies.messages.values()] == [EXAMPLES[Cell].scenario]
        else:
            with pytest.raises(BusError, match="may not query"):
                link.query_and_wait(keys.of_jobs("f", "cell"), CellRequest(), Cell, timeout_s=PATIENCE_S)
    assert len(fleet.received) == may
