"""`thermofleet bus ros2`: an arm to ROS 2 and back, and errors in one sentence."""

import os
import signal
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import State
from fleet.bus.router import Router
from scenarios.cli.main import main
from tests import commands
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
TEMP_C = (30.0, 31.0, 32.5, 33.0, 34.0, 35.0, 36.0)


def started(stack, *words):
    """A command that says it is ready."""
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    environment.pop("ROS_DOMAIN_ID", None)
    process = stack.enter_context(commands.start("bus", "ros2", *words, env=environment))
    stack.callback(process.kill)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("ready ")
    return process


def ended(process, number):
    process.send_signal(number)
    _, said = process.communicate(timeout=PATIENCE_S)
    return process.returncode, said


def test_an_arm_is_published_in_ros_and_followed_again():
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        link = stack.enter_context(BusClient(router.endpoint, "shop"))
        heard: list[State] = []
        link.subscribe(keys.of_arm("shop", "mirror", "state"), State, lambda _, word: heard.append(word))
        here = ["--endpoint", router.endpoint, "--fleet", "shop"]
        bridge = started(stack, "bridge", *here)
        listen = started(stack, "listen", "/shop/arm_0/joint_states", "--temperatures", "/diagnostics",
                         "--hardware", "shop/arm_0", "--arm", "mirror", *here)  # fmt: skip
        deadline_s = time.monotonic() + PATIENCE_S
        tick = 0
        while not heard:
            assert time.monotonic() < deadline_s, "waited in vain"
            tick += 1
            said = State("arm_0", tick, 0.1 * tick, "working", TEMP_C, 24.0, q=(0.1,) * 7, qd=(0.2,) * 7)
            link.publish(keys.of_arm("shop", "arm_0", "state"), said)
            link.serve(time.monotonic() + 0.1)
        assert (heard[0].temp_c, heard[0].q, heard[0].qd, heard[0].tau) == (TEMP_C, (0.1,) * 7, (0.2,) * 7, ())
        assert heard[0].mode == "working"
        assert ended(listen, signal.SIGTERM) == (0, "")
        assert ended(bridge, signal.SIGINT) == (130, "The bridge was interrupted.\n")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["listen", "/joint_states"], "has no motor temperatures"),
        (["listen", "/j", "--temperatures", "/d", "--joints", "a,a"], "different names"),
        (["listen", "/j", "--temperatures", "/d", "--rate-hz", "0"], "--rate-hz must be"),
        (["jobs"], "needs the Python module 'rclpy' of ROS 2"),
        (["bridge", "--domain", "233"], "--domain must be 0 to 232"),
        (["bridge", "--fleet", "f", "--warning-c", "80"], "--warning-c must be less than --error-c"),
        (["bridge", "--endpoint", "tls/127.0.0.1:7447#keys/arm_0"], "name the router of ROS 2 with --router"),
    ],
)
def test_an_error_of_the_ros2_command_is_one_sentence(words, sentence, capsys, monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    with pytest.raises(SystemExit) as end:
        main(["bus", "ros2", *words])
    assert end.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert told.startswith("Error: ")
    assert sentence in told


def test_a_missing_extra_is_named(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(SystemExit) as end:
        main(["bus", "ros2", "bridge", "--fleet", "f", "--domain", "0"])
    assert end.value.code == 2
    assert "pip install -e '.[ros2]'" in capsys.readouterr().err
