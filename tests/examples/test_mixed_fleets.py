"""Fleets of the examples alone, and of examples and thermofleet's own processes."""

import re
import signal
import subprocess
import time
from contextlib import ExitStack

import pytest

from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Result, Status, StatusRequest
from fleet.bus.protocol.messages import State
from tests import commands
from tests.examples.programs import killed_afterwards, program, running, started, submit_jobs
from tests.waiting import PATIENCE_S, serve_until


@pytest.mark.ci_slow
def test_the_examples_alone_make_a_fleet(bus):
    port, link = bus
    watcher, statuses = link(), []
    watcher.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, result: statuses.append(result.status))
    watcher.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: None)
    with started(program("monitor", port)) as monitor:
        assert monitor.stdout.readline().startswith("waiting")
        with (
            running("own_allocator", port, "f"),
            running("own_arm", port, "f", "a"),
            running("own_arm", port, "f", "b"),
        ):
            submit_jobs(port)
            serve_until(lambda: sum(status.state == "finished" for status in statuses) >= 3, watcher)
        output, _ = monitor.communicate(timeout=PATIENCE_S)
    assert re.search(r"own +outside 1 is finished [ab]\n", output)
    assert re.search(r" [ab] +difficulty outside 1 0\.10", output)
    finished = [status.job for status in statuses if status.state == "finished"]
    assert sorted(finished) == ["outside 1", "outside 2", "outside 3"]
    assert finished.index("outside 1") < finished.index("outside 3")
    assert watcher.malformed == 0


@pytest.mark.ci_slow
def test_own_arm_and_the_submitter_work_with_the_real_auctioneer(bus, tmp_path):
    """The auctioneer, an arm and a submitter written from docs/bus alone."""
    port, link = bus
    watcher, statuses = link(), []
    watcher.subscribe(
        keys.of_every_auction("f", "result"), Result, lambda _, result: statuses.append(result.status), history=True
    )
    last = {}
    watcher.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: last.update({state.arm: state}))
    at = ("--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}")
    started_auction = commands.start(
        "bus", "auctioneer", "quickstart", "--jobs", "none", *at, "--journal", tmp_path / "j"
    )
    with killed_afterwards(started_auction) as auction:
        assert auction.stdout.readline().startswith("ready")
        for arm in range(4):  # they are offline, so their positions are unknown until then
            cleared = commands.run("arm", "clear", f"arm_{arm}", *at)
            assert cleared.stdout == f"arm_{arm}: its space is free until the arm reports its space again.\n"
        with running("own_arm", port, "f", "a") as first, running("own_arm", port, "f", "b") as second:
            submit_jobs(port)
            # They leave in order, one of them in the middle of a job: it goes back, and no space stays closed.
            one = commands.run("job", "submit", "--kind", "hold", "--place", "belt", "--repetitions", "900", *at)
            assert one.returncode == 0, one.stderr
            serve_until(lambda: any(status.arm and status.job == "hold" for status in statuses), watcher)
            holder = next(status.arm for status in statuses if status.arm and status.job == "hold")
            with started(program("own_arm", port, "f", "a"), stderr=subprocess.PIPE) as again:
                assert again.communicate(timeout=PATIENCE_S)[1].startswith("Arm 'a' is already running.")
            arms = (first, second) if holder == "a" else (second, first)  # the other may get it meanwhile
            for arm, number in zip(arms, (signal.SIGTERM, signal.SIGINT), strict=True):
                arm.send_signal(number)
                assert arm.wait(PATIENCE_S) == 130
            serve_until(lambda: all(last[arm].leaving and not last[arm].job for arm in ("a", "b")), watcher)
            asked = keys.of_jobs("f", "status"), StatusRequest(), Status
            for _ in range(40):  # the auctioneer may still handle the last quotes and leases
                (reply,) = watcher.query_and_wait(*asked, timeout_s=PATIENCE_S).messages.values()
                if not {"a", "b"} & reply.space.keys():
                    break
                watcher.serve(time.monotonic() + 0.5)
            assert not {"a", "b"} & reply.space.keys()
            assert [status.state for status in reply.jobs if status.job == "hold"] == ["waiting"]
        auction.terminate()
        output = auction.communicate(timeout=PATIENCE_S)[1]
        assert auction.returncode == 0
        assert "Dropped invalid message" not in output  # no message of the examples was malformed
        serve_until(lambda: sum(status.state == "finished" for status in statuses) == 3, watcher)
        finished = sorted(status.job for status in statuses if status.state == "finished")
        assert finished == ["outside 1", "outside 2", "outside 3"]


@pytest.mark.slow
def test_own_allocator_has_real_arms_do_the_jobs(bus, tmp_path):
    """An arm that plans and simulates, under an allocator written from docs/bus alone."""
    port, link = bus
    watcher, statuses = link(), []
    watcher.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, result: statuses.append(result.status))
    watcher.subscribe(keys.of_every_arm("f", "state"), State, lambda _, state: None)
    with running("own_allocator", port, "f") as allocator, ExitStack() as stack:
        for name in ("arm_2", "arm_3"):
            options = ["--difficulty", "blind", "--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}"]
            command = commands.start(
                "arm", "run", "quickstart", name, *options, "--journal", tmp_path / name, stderr=subprocess.DEVNULL
            )
            arm = stack.enter_context(killed_afterwards(command))
            assert arm.stdout.readline().startswith("ready")
        submit_jobs(port, timeout_s=150.0)
        assert allocator.poll() is None
    serve_until(lambda: sum(status.state == "finished" for status in statuses) == 3, watcher)
    assert watcher.malformed == 0
