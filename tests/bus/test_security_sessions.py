"""Certificates in sessions of other modes, of strangers, and of new participants."""

import queue
import time
from contextlib import suppress

import pytest
import zenoh

from fleet.bus.protocol import keys
from fleet.bus.router import Router, open_client
from fleet.bus.security.access_control import Participant, of_arms
from fleet.bus.security.certificates import add, issue, make
from fleet.bus.security.tls import Tls
from tests.waiting import PATIENCE_S

ARMS = ("arm_0", "arm_1", "arm 2+*@")
HERE = "thermofleet/v4/f"


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
def test_a_certificate_gives_no_more_rights_in_another_mode(open_stranger, guarded, folder, mode, inside):
    heard: queue.Queue[str] = queue.Queue()
    with (
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "monitor")) as monitor,
        open_stranger(guarded.endpoint, Tls(folder, "arm_1").link(serves=False), mode) as rogue,
    ):
        ears = [
            session.declare_subscriber(f"{HERE}/**", lambda sample: heard.put(str(sample.key_expr)))
            for session in (monitor, inside(guarded))
        ]
        got: list[str] = []
        end_s = time.monotonic() + PATIENCE_S
        # A peer or a router sends nothing before it has learnt who listens.
        while len(got) < 2 and time.monotonic() < end_s:
            rogue.put(keys.of_arm("f", "arm_0", "state"), b"not mine")
            rogue.put(keys.of_arm("f", "arm_1", "state"), b"mine")
            with suppress(queue.Empty):
                got.append(heard.get(timeout=0.1))
        assert got == [keys.of_arm("f", "arm_1", "state")] * 2
        for ear in ears:
            ear.undeclare()


def test_somebody_whom_the_authority_knows_and_the_roster_does_not_may_do_nothing(guarded, folder, tmp_path, inside):
    """Such as one that was added after the router started."""
    stranger = tmp_path / "copy"
    stranger.mkdir()
    for name in ("ca.pem", "ca.key"):
        (stranger / name).write_bytes((folder / name).read_bytes())
    issue(stranger, Participant("arm_9", "arm"), days=1)
    heard: queue.Queue[str] = queue.Queue()
    ear = inside(guarded).declare_subscriber("**", lambda sample: heard.put(str(sample.key_expr)))
    with (
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(stranger, "arm_9")) as rogue,
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "arm_0")) as arm,
    ):
        deaf: list[zenoh.Sample] = []
        subscriber = rogue.declare_subscriber(f"{HERE}/**", deaf.append, allowed_origin=zenoh.Locality.REMOTE)
        rogue.put(keys.of_arm("f", "arm_9", "state"), b"not in the roster")
        assert list(rogue.get(f"{HERE}/**", timeout=PATIENCE_S)) == []
        arm.put(keys.of_arm("f", "arm_0", "state"), b"mine")
        assert heard.get(timeout=PATIENCE_S) == keys.of_arm("f", "arm_0", "state")
        assert list(rogue.get(f"{HERE}/**", timeout=PATIENCE_S)) == []
        assert deaf == []
        subscriber.undeclare()
    ear.undeclare()


def test_one_that_is_added_may_speak_when_the_router_starts_again(tmp_path, inside):
    place = tmp_path / "k"
    make(place, of_arms("f", ["arm_0"]), days=30)
    new, key = Participant("arm_7", "arm"), keys.of_arm("f", "arm_7", "state")
    add(place, new, days=30)
    heard: queue.Queue[str] = queue.Queue()
    for _ in range(2):  # the second time with a new certificate of the same authority
        with (
            Router(tls=Tls(place, "router")) as router,
            open_client(router.endpoint, timeout_s=PATIENCE_S, tls=Tls(place, "arm_7")) as arm,
        ):
            ear = inside(router).declare_subscriber("**", lambda sample: heard.put(str(sample.key_expr)))
            arm.put(key, b"mine")
            assert heard.get(timeout=PATIENCE_S) == key
            ear.undeclare()
        add(place, new, days=60, overwrite=True)
