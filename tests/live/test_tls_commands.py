"""Commands over TLS: an operator's certificate works, any other is refused in one sentence."""

import http.client
import json
import shutil
import signal
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from fleet.bus.protocol.operator import Cancel, Change, ClearRequest, Pause, ResetRequest, Resume, Settle
from fleet.bus.router import Router
from fleet.bus.security.access_control import RosterEntry, of_arms
from fleet.bus.security.certificates import issue, make
from fleet.bus.security.tls import Tls
from fleet.errors import BusError, FleetError
from fleet.live import job_client
from scenarios.cli import jobs
from scenarios.cli.main import app
from scenarios.live import requests
from tests import commands
from tests.live.gateway.moving_fleet import MovingFleet
from tests.waiting import PATIENCE_S

ARM = "arm 1+b"
EXTRA = [RosterEntry("gateway", "submitter"), RosterEntry("b", "arm")]
TOKEN = "a token of this test"
COMMANDS = {
    "watch": ["bus", "watch", "--json"],
    "doctor": ["bus", "doctor", "--seconds", "1"],
    "gateway": ["bus", "gateway", "--port", "0", "--token", TOKEN],
}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A router with TLS, one arm and an auctioneer, each with its own certificate; `received` has all requests."""
    place = tmp_path_factory.mktemp("keys") / "f"
    make(place, of_arms("f", [ARM], EXTRA), days=30)
    with Router(tls=Tls(place, "router")) as router:

        def endpoint(name):
            return Tls(place, name).endpoint(router.endpoint)

        moving = MovingFleet(endpoint(ARM), (ARM,), fleet="f", auctioneer=endpoint("auctioneer"))
        moving.paused["*"] = "ann"
        with moving:
            moving.post(lambda: moving.set("j", state="waiting", repetitions=1, cycles=0))
            yield SimpleNamespace(address=router.endpoint, endpoint=endpoint, keys=place, received=moving.requests)


def run(command, endpoint):
    return CliRunner().invoke(app, [*COMMANDS[command], "--endpoint", endpoint])


def test_a_monitor_can_watch(fleet):
    done = run("watch", fleet.endpoint("monitor"))
    assert done.exit_code == 0, done.exception
    now = json.loads(done.stdout)
    assert [(arm["arm"], arm["present"]) for arm in now["arms"]] == [(ARM, True)]
    assert now["auctioneers"][0]["auctioneer"] == "auctioneer"
    assert "j" in {job["job"] for job in now["jobs"]}


@contextmanager
def gateway(fleet, name):
    """The address of a gateway with the certificate of this one."""
    started = commands.start(*COMMANDS["gateway"], "--endpoint", fleet.endpoint(name))
    try:
        ready = started.stdout.readline()
        assert ready.startswith("ready gateway http://127.0.0.1:"), ready + started.stderr.read()
        yield int(ready.split(":")[2].split("/")[0])
    finally:
        started.kill()
        started.communicate(timeout=PATIENCE_S)


def asked(port, method, path, body=None):
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    try:
        headers = {"Content-Type": "application/json", "Authorization": f"Bearer {TOKEN}"}
        line.request(method, path, json.dumps(body), headers)
        answer = line.getresponse()
        return answer.status, json.loads(answer.read())
    finally:
        line.close()


JOBS = {"jobs": [{"name": "crate", "kind": "hold", "places": ["rack"]}]}


def test_the_gateway_submits_with_the_certificate_of_a_submitter(fleet):
    with gateway(fleet, "gateway") as port:
        code, told = asked(port, "POST", "/v4/jobs", JOBS)
        assert (code, told["jobs"][0]["accepted"]) == (200, True), told
        code, told = asked(port, "POST", "/v4/ask", JOBS)
        assert (code, [quote["arm"] for quote in told["quotes"]]) == (200, [ARM]), told
        code, told = asked(port, "GET", "/v4/fleet")
        assert (code, [arm["arm"] for arm in told["arms"]]) == (200, [ARM])


def test_a_gateway_with_the_certificate_of_a_monitor_has_requests_of_a_monitor_only(fleet, tmp_path):
    with gateway(fleet, "monitor") as port:
        assert asked(port, "GET", "/")[1]["role"] == "monitor"
        assert asked(port, "GET", "/v4/jobs?job=j")[0] == 200
        for path in ("/v4/jobs", "/v4/ask"):
            code, told = asked(port, "POST", path, JOBS)
            assert code == 403
            assert told["detail"] == "This token has the role monitor; this request needs submitter."
    tokens = tmp_path / "tokens"
    tokens.touch(0o600)
    tokens.write_text("operator another-token-of-this-test")
    done = CliRunner().invoke(
        app, ["bus", "gateway", "--endpoint", fleet.endpoint("monitor"), "--port", "0", "--tokens", str(tokens)]
    )
    with pytest.raises(
        FleetError, match=r"'monitor:monitor' does not permit .* Use a certificate of the role operator"
    ):
        raise done.exception


def test_an_error_of_tls_is_one_sentence(fleet):
    done = run("doctor", f"{fleet.address}#{fleet.keys}/nobody")
    assert isinstance(done.exception, BusError)
    with pytest.raises(BusError, match=r"^There is no '\S+/nobody\.pem'; thermofleet bus keys makes it\.$"):
        raise done.exception


@pytest.mark.parametrize("command", ["bus watch", "bus watch --json", "bus doctor", "job list"])
def test_without_a_roster_the_fleet_has_to_be_named(fleet, tmp_path, command):
    for file in ("ca.pem", "monitor.pem", "monitor.key"):
        shutil.copy(fleet.keys / file, tmp_path)
    done = CliRunner().invoke(app, [*command.split(), "--endpoint", f"{fleet.address}#{tmp_path}/monitor"])
    assert isinstance(done.exception, FleetError)
    with pytest.raises(FleetError, match=r"^With TLS nobody may list the fleets .* name the fleet with --fleet\.$"):
        raise done.exception


def test_a_router_reports_its_links(fleet):
    own = ("bus", "router", "--port", 0, "--tls", fleet.keys, "--connect")
    with commands.ready(*own, fleet.address, "--connect", "tls/127.0.0.1:1") as (process, _):
        assert process.stderr is not None
        assert process.stderr.readline() == f"Linked to the router at {fleet.address}.\n"
        assert "tls/127.0.0.1:1 (Connection refused)" in process.stderr.readline()
        assert commands.end(process, signal.SIGTERM) == (0, "")


def test_a_recorder_whose_certificate_expires_ends_with_an_error(fleet, tmp_path, monkeypatch):
    record = ["bus", "record", "f", "--out", str(tmp_path / "r"), "--endpoint", fleet.endpoint("recorder")]
    monkeypatch.setattr("fleet.bus.client.is_past", lambda _: True)
    done = CliRunner().invoke(app, record)
    assert isinstance(done.exception, BusError)
    assert "messages in" in done.stdout
    with pytest.raises(BusError, match=r"^Nothing has been recorded since .*'recorder' expired on 20\d\d-.* UTC"):
        raise done.exception


def issue_later(fleet, place, entry):
    """Endpoint with a certificate that was issued after the router has read its roster."""
    make(place, of_arms("f", [ARM], [entry]), days=30)
    for name in ("ca.pem", "ca.key"):
        (place / name).write_bytes((fleet.keys / name).read_bytes())
    issue(place, entry, days=20)
    return f"{fleet.address}#{place}/{entry.name}"


def test_the_doctor_mentions_a_certificate_unknown_to_the_router(fleet, tmp_path):
    done = run("doctor", issue_later(fleet, tmp_path / "k", RosterEntry("spy", "monitor")))
    assert done.exit_code == 1
    assert "the router does not know this certificate" in " ".join(done.stdout.split())


@pytest.mark.parametrize(
    "command",
    [
        *(("arm", *words, "--by", "ann") for words in (("pause",), ("clear", ARM), ("reset", ARM))),
        ("job", "list"),
        *(("job", "submit", "--kind", "hold", "--place", "rack", *words) for words in ((), ("--quote",))),
    ],
    ids=" ".join,
)
def test_a_request_without_a_reply_mentions_the_roster(fleet, tmp_path, monkeypatch, command):
    for module, seconds in ((requests, "REPLY_S"), (job_client, "REPLY_S"), (jobs, "LISTEN_S")):
        monkeypatch.setattr(module, seconds, 0.5)
    endpoint = issue_later(fleet, tmp_path / "k", RosterEntry("ann", "operator"))
    done = CliRunner().invoke(app, [*command, "--endpoint", endpoint, "--fleet", "f"])
    assert isinstance(done.exception, FleetError)
    assert "it reads its roster when it starts" in str(done.exception)


STEERING = {
    ("job", "cancel", "j"): Cancel("j"),
    ("job", "settle", "j", "redo"): Settle("j", "redo"),
    ("job", "change", "j", "--value", "2"): Change("j", value=2.0),
    ("arm", "pause"): Pause("*"),
    ("arm", "pause", ARM): Pause(ARM),
    ("arm", "pause", "--end"): Resume("*"),
    ("arm", "clear", ARM): ClearRequest(ARM, "ann"),
    ("arm", "reset", ARM): ResetRequest("ann"),
}

OTHERS = ("monitor", "submitter", "recorder", "b")


@pytest.mark.parametrize("command", STEERING, ids=" ".join)
def test_an_operator_may(fleet, command):
    fleet.received.clear()
    done = CliRunner().invoke(app, [*command, "--by", "ann", "--endpoint", fleet.endpoint("operator")])
    assert done.exit_code == 0, done.exception
    (request,) = fleet.received
    assert request.by == "ann"
    assert STEERING[command] in (request, getattr(request, "action", None))


@pytest.mark.parametrize("who", OTHERS)
@pytest.mark.parametrize("command", [("arm", "pause"), ("arm", "clear", ARM), ("arm", "reset", ARM)], ids=" ".join)
def test_nobody_else_may(fleet, command, who):
    fleet.received.clear()
    done = CliRunner().invoke(app, [*command, "--by", "ann", "--endpoint", fleet.endpoint(who)])
    assert isinstance(done.exception, BusError)
    assert "may not query" in str(done.exception)
    assert "a certificate of the role" in str(done.exception)
    assert "operator" in str(done.exception)
    assert fleet.received == []
