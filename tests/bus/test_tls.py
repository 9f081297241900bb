"""Lines with TLS: who gets one, who gets none and why, and when it ends. All against a real router over loopback."""

import json
import queue
import re
import socket
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.router import Router, fleets_at, open_client
from fleet.bus.security.access_control import RosterEntry, of_arms
from fleet.bus.security.certificates import issue, make
from fleet.bus.security.tls import Tls, try_connection
from fleet.errors import BusError
from tests.waiting import PATIENCE_S, wait_until

ARMS = ("arm_0", "arm_1")
SHORT_S = 0.3


def rogue_folder(place: Path, true: Path, how: str) -> Path:
    """Keys that the router must refuse, though their owner knows the true authority's certificate."""
    make(place, of_arms("f", ARMS), days=30)
    if how == "wrong authority":
        (place / "ca.pem").write_bytes((true / "ca.pem").read_bytes())
        return place
    for name in ("ca.pem", "ca.key"):
        (place / name).write_bytes((true / name).read_bytes())
    role = RosterEntry("arm_0", "router" if how == "wrong end" else "arm")
    ago = timedelta(days=2) if how == "expired" else timedelta(days=-2) if how == "not yet" else timedelta()
    issue(place, role, days=1, now=datetime.now(UTC) - ago)
    return place


REFUSALS = {
    "wrong authority": "arm_0.pem' is not signed by the certificate authority",
    "expired": "/arm_0.pem' expired on 20",
    "not yet": "/arm_0.pem' is valid only from 20",
    "wrong end": "arm_0.pem' is the certificate of 'router:arm_0'; only the router",
}


@pytest.mark.parametrize("how", REFUSALS)
def test_a_certificate_that_is_not_good_is_refused_at_both_ends(open_stranger, guarded, folder, tmp_path, how):
    tls = Tls(rogue_folder(tmp_path / "k", folder, how), "arm_0")
    with pytest.raises(BusError, match=REFUSALS[how]):
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=tls)
    if how == "wrong end":  # it is valid for links of routers, but this one is not in the roster
        with open_stranger(guarded.endpoint, tls.link(serves=False)) as rogue:
            assert list(rogue.get(f"{keys.all_of_fleet('f')}", timeout=SHORT_S)) == []
        return
    with pytest.raises(zenoh.ZError), open_stranger(guarded.endpoint, tls.link(serves=False), timeout_s=SHORT_S):
        pass


def test_nobody_gets_in_without_a_certificate(open_stranger, guarded, folder):
    ca = {"root_ca_certificate": str(folder / "ca.pem")}
    with pytest.raises(zenoh.ZError), open_stranger(guarded.endpoint, ca, timeout_s=SHORT_S):
        pass
    with pytest.raises(BusError, match="needs a certificate"):
        open_client(guarded.endpoint, timeout_s=PATIENCE_S)
    with pytest.raises(BusError, match=r"There is no '.*nobody\.pem'"):
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "nobody"))


@pytest.mark.parametrize(
    ("participant", "reason"),
    [
        ("nodir/monitor", r"There is no '.*nodir/monitor\.pem'; thermofleet bus keys makes it\."),
        ("f/nobody", r"There is no '.*f/nobody\.pem'; thermofleet bus keys makes it\."),
        ("f/monitor.pem", r"There is no '.*f/monitor\.pem\.pem'; leave the ending out: '.*f/monitor'\."),
        ("f/arm_0.key", r"leave the ending out: '.*f/arm_0'\."),
        ("elsewhere/nobody", r"nobody\.pem'; copy it from the machine that has ca\.key, where thermofleet bus keys ma"),
        ("f", r"There is no '.*/f\.pem'; name a participant of the folder, as '.*/f/monitor'\."),
        ("f/", r"There is no '.*/f\.pem'; name a participant of the folder, as '.*/f/monitor'\."),
        ("f/..", r"names no participant\. Expected tls/127\.0\.0\.1:\d+#FOLDER/NAME\."),
    ],
)
def test_a_wrong_path_of_a_certificate_is_named_by_whoever_uses_the_endpoint(guarded, folder, participant, reason):
    (folder.parent / "elsewhere").mkdir(exist_ok=True)
    endpoint = f"{guarded.endpoint}#{folder.parent}/{participant}"
    for use in (fleets_at, lambda endpoint: BusClient(endpoint, "f").open()):
        with pytest.raises(BusError, match=reason):
            use(endpoint)


def test_plain_tcp_and_tls_do_not_meet(guarded, open_router, folder):
    plain = guarded.endpoint.replace("tls/", "tcp/")
    with pytest.raises(BusError, match=r"No router answered .*expects TLS"):
        open_client(plain, timeout_s=SHORT_S)
    secure = open_router.endpoint.replace("tcp/", "tls/")
    with pytest.raises(BusError, match=r"No router answered .*does not use TLS"):
        open_client(secure, timeout_s=SHORT_S, tls=Tls(folder, "arm_0"))
    with pytest.raises(BusError, match="Expected tls/"):
        open_client(open_router.endpoint, timeout_s=SHORT_S, tls=Tls(folder, "arm_0"))


def test_a_router_that_accepts_connections_and_is_suspended_is_not_taken_for_one_without_tls(folder):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        trial = try_connection("127.0.0.1", silent.getsockname()[1], Tls(folder, "arm_0"))
    assert trial.reason.startswith("no reply to the TLS handshake: the server is suspended")
    assert not trial.stays


def test_keys_of_another_fleet_open_no_line_and_the_reason_is_told(guarded, tmp_path):
    make(tmp_path / "other", of_arms("f", ARMS), days=30)
    with pytest.raises(BusError, match=r"the server's certificate is not valid: .*issuer"):
        open_client(guarded.endpoint, timeout_s=SHORT_S, tls=Tls(tmp_path / "other", "arm_0"))


def test_the_verdict_of_the_router_is_told(guarded, folder, tmp_path):
    """An authority of the same name whose router is trusted, and whose arms the router does not trust."""
    place = rogue_folder(tmp_path / "k", folder, "wrong authority")
    mixed = tmp_path / "mixed.pem"
    make(tmp_path / "rogue", of_arms("f", ARMS), days=30)
    for name in ("arm_0.pem", "arm_0.key"):
        (place / name).write_bytes((tmp_path / "rogue" / name).read_bytes())
    mixed.write_bytes((tmp_path / "rogue" / "ca.pem").read_bytes() + (folder / "ca.pem").read_bytes())
    (place / "ca.pem").write_bytes(mixed.read_bytes())
    with pytest.raises(BusError, match="the router refuses the certificate of 'arm_0': "):
        open_client(guarded.endpoint, timeout_s=SHORT_S, tls=Tls(place, "arm_0"))


def test_no_participant_can_play_the_router(folder):
    with pytest.raises(BusError, match="certificate of 'arm:arm_0'; a router needs that of a router"):
        Router(tls=Tls(folder, "arm_0")).open()
    own = Tls(folder, "arm_0").link(serves=False)
    tls = {key.replace("connect_", "listen_"): value for key, value in own.items()}
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    listening = {"mode": "router", "listen": {"endpoints": [f"tls/127.0.0.1:{port}"]}}
    quiet = {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}}
    config = {**listening, "scouting": quiet, "transport": {"link": {"tls": tls}}}
    with (
        zenoh.open(zenoh.Config.from_json5(json.dumps(config))),
        pytest.raises(BusError, match="the server's certificate is not valid"),
    ):
        open_client(f"tls/127.0.0.1:{port}", timeout_s=SHORT_S, tls=Tls(folder, "arm_1"))


def test_a_line_ends_with_its_certificate(folder, guarded, tmp_path):
    place = rogue_folder(tmp_path / "k", folder, "good")
    soon = datetime.now(UTC) + timedelta(seconds=2.0)
    issue(place, RosterEntry("arm_0", "arm"), days=1, now=soon - timedelta(days=1))
    seen: queue.Queue[zenoh.Sample] = queue.Queue()
    with open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "monitor")) as monitor:
        key = keys.of_arm("f", "arm_0", "alive")
        watch = monitor.liveliness().declare_subscriber(key, seen.put, history=True)
        with open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(place, "arm_0")) as arm:
            token = arm.liveliness().declare_token(key)
            assert seen.get(timeout=PATIENCE_S).kind == zenoh.SampleKind.PUT
            gone = seen.get(timeout=PATIENCE_S)
            while gone.kind == zenoh.SampleKind.PUT:  # a client may get a token twice
                gone = seen.get(timeout=PATIENCE_S)
            assert datetime.now(UTC) >= soon - timedelta(seconds=1)
            token.undeclare()
        watch.undeclare()


def test_a_client_reports_that_its_certificate_has_expired_and_was_renewed(folder, guarded, tmp_path, caplog):
    place = rogue_folder(tmp_path / "k", folder, "good")
    soon = datetime.now(UTC) + timedelta(seconds=2.0)
    issue(place, RosterEntry("arm_0", "arm"), days=1, now=soon - timedelta(days=1))
    with BusClient(Tls(place, "arm_0").endpoint(guarded.endpoint), "f") as arm:
        assert (arm.connected, arm.expiry) == (True, "")
        wait_until(lambda: arm.expiry)
        arm.serve()
        arm.serve()
        assert arm.expiry.startswith(f"The certificate of 'arm_0' expired on {soon:%Y-%m-%d %H:%M} UTC")
        assert [each.levelname for each in caplog.records if each.getMessage() == arm.expiry] == ["ERROR"]
        issue(place, RosterEntry("arm_0", "arm"), days=30)
        again = "The certificate of 'arm_0' was renewed, and it is connected again."
        wait_until(lambda: again in caplog.text, arm.serve)
        assert (arm.connected, arm.expiry) == (True, "")


def test_a_key_that_others_may_read_is_not_used(folder, tmp_path, guarded):
    place = rogue_folder(tmp_path / "k", folder, "good")
    (place / "arm_0.key").chmod(0o640)
    with pytest.raises(BusError, match="Others on this machine may read"):
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(place, "arm_0"))


def test_a_certificate_that_ends_soon_is_said(guarded, folder, tmp_path, caplog):
    place = rogue_folder(tmp_path / "k", folder, "good")
    open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(place, "arm_0")).close()
    assert "The certificate of 'arm:arm_0' ends on 20" in caplog.text


def test_a_router_with_tls_may_listen_elsewhere_and_without_it_not(folder):
    with Router(host="0.0.0.0", tls=Tls(folder, "router")) as router:
        assert router.endpoint.startswith("tls/127.0.0.1:")
        open_client(router.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "arm_0")).close()
    with pytest.raises(BusError, match="Plain TCP does not authenticate"):
        Router(host="0.0.0.0")
    with pytest.raises(BusError, match="no address to listen on"):
        Router(host="a b/c", tls=Tls(folder, "router"))


@pytest.mark.ci_slow
def test_rubbish_at_the_door_harms_no_line_that_is_open_and_delays_new_ones_alone(guarded, folder):
    """Zenoh waits 0.1 s after every handshake that fails."""
    host, port = guarded.endpoint.removeprefix("tls/").split(":")
    cache = keys.caches_of("thermofleet/v4/f/arm/nobody")
    with open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "arm_0")) as arm:

        def ask_beside_rubbish() -> float:
            for number in range(30):
                with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as line:
                    line.sendall(bytes(range(number, 200)))
            began_s = time.monotonic()
            assert list(arm.get(cache, timeout=PATIENCE_S)) == []
            return time.monotonic() - began_s

        # A busy machine delays one attempt, waiting for those at the door all of them.
        assert any(ask_beside_rubbish() < 2.9 for _ in range(5)), "an open line waits for those at the door"
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "arm_1")).close()


def test_the_documented_configuration_opens_a_line(guarded, folder):
    """For clients without our code: taken from the page as it stands."""
    page = (Path(__file__).parents[2] / "docs" / "security.md").read_text(encoding="utf-8")
    (block,) = re.findall("```json\n(.*?)```", page, flags=re.DOTALL)
    config = block.replace("ENDPOINT", guarded.endpoint).replace("DIR", str(folder)).replace("NAME", "monitor")
    with zenoh.open(zenoh.Config.from_json5(config)) as client:
        assert len(client.info.routers_zid()) == 1
        assert list(client.get(keys.caches_of("thermofleet/v4/f/arm/nobody"), timeout=PATIENCE_S)) == []
