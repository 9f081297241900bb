"""Random kills of recorder, router and publisher: every result is recorded once, or a row says that it is missing."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from scenarios.live.recording import read_parts

CLI = "from scenarios.cli.main import main; main()"
PUBLISHER = """
import json, sys, time
from pathlib import Path
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobStatus, Result

def result(number, time_s):
    return Result("boss", number, time_s, JobStatus(f"job {number}", "finished", arm="a", award="x", finished_s=time_s))

endpoint, journal, start_s = sys.argv[1], Path(sys.argv[2]), float(sys.argv[3])
known = [json.loads(line) for line in journal.read_text().splitlines()] if journal.exists() else []
with BusClient(endpoint, "f", timeout_s=60.0) as link, journal.open("a") as file:
    say = link.publisher(keys.of_auction("f", "boss", "result"), Result)
    for number, time_s in known[-1024:]:  # as our auctioneer after a restart
        say(result(number, time_s))
    for number in range(len(known), 10**6):
        time_s = time.monotonic() - start_s
        file.write(json.dumps([number, time_s]) + "\\n")
        file.flush()
        say(result(number, time_s))
        link.serve(time.monotonic() + 0.05)
"""
KILLS, BETWEEN_S, SETTLE_S = 12, (2.0, 7.0), 30.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_kills_cost_no_result(tmp_path, seed):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    endpoint, start_s = f"tcp/127.0.0.1:{port}", str(time.monotonic())
    commands = {
        "router": (CLI, "bus", "router", "--port", str(port)),
        "record": (CLI, "bus", "record", "f", "--out", str(tmp_path / "rec"), "--endpoint", endpoint),
        "publisher": (PUBLISHER, endpoint, str(tmp_path / "journal"), start_s),
    }
    running = {}

    def serve(seconds):
        """Restart what has ended, for this long."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            for name, command in commands.items():
                if name not in running or running[name].poll() is not None:
                    with (tmp_path / f"{name}.log").open("a") as log:
                        argv = [sys.executable, "-c", *command]
                        running[name] = subprocess.Popen(argv, env=os.environ, stdout=log, stderr=log)
            try:
                running["router"].wait(0.2)
            except subprocess.TimeoutExpired:
                continue

    rng = np.random.default_rng(seed)
    try:
        serve(10.0)
        for _ in range(KILLS):
            running[rng.choice(list(commands))].kill()
            serve(rng.uniform(*BETWEEN_S))
        serve(SETTLE_S)
        running["publisher"].kill()
        del commands["publisher"]
        serve(3.0)
        running["record"].send_signal(signal.SIGTERM)
        running["record"].wait(30)
    finally:
        for process in running.values():
            process.kill()
            process.wait()
    sent = [json.loads(line)[0] for line in (tmp_path / "journal").read_text().splitlines()]
    recorded = read_parts(tmp_path / "rec", "results")["number"].to_pylist()
    gaps = read_parts(tmp_path / "rec", "gaps").to_pylist()
    missing = {number for gap in gaps for number in range(gap["first"], gap["last"] + 1)}
    assert len(set(recorded)) == len(recorded)
    assert set(recorded) | missing >= set(sent[:-1])  # its last one may never have left the publisher
    assert set(recorded).isdisjoint(missing)
    assert len(missing) <= len(sent) / 100
