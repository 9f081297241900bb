"""`thermofleet arm run`: the arm of a run as its own process, and a replayed log."""

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleet.arm.model import ArmModel
from fleet.arm.plan_cache import rest_torque
from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobSpec, Quote, QuoteRequest
from fleet.bus.protocol.messages import Info, State
from fleet.bus.router import Router
from fleet.errors import BusError, FleetError, LogError
from scenarios.live.arm import ambient_of, replayed_arm, simulated_arm, wait_for_name
from scenarios.prepare.fleet import prepare, prepare_arm
from scenarios.progress import quiet
from scenarios.spec.load import load
from scenarios.spec.schema import Ambient
from tests import commands
from tests.waiting import PATIENCE_S
from twin.logs.reader import read
from twin.logs.recording import READINGS

LOGS = Path(__file__).parents[2] / "../shared/data/gen3_logs"
TIME_S = np.arange(0.0, 4.0, 0.1)


@pytest.fixture
def log(tmp_path):
    """A plain log in which every channel of joint k rises by k a second from its own start."""
    starts = dict(zip(READINGS, (0.0, 1.0, 2.0, 3.0, 30.0), strict=True))
    rise = TIME_S[:, None] * np.arange(1, 8) / 100
    columns = np.hstack([TIME_S[:, None] + 50.0, *(start + rise for start in starts.values())])
    header = ",".join(["time_s", *(f"{channel}_{k}" for channel in READINGS for k in range(1, 8))])
    path = tmp_path / "real.csv"
    np.savetxt(path, columns, delimiter=",", header=header, comments="", fmt="%.12g")
    return path


class Process:
    """`thermofleet arm …` until the end of the block."""

    def __init__(self, *args, cache, cwd):
        self.process = commands.start("arm", "run", *args, cwd=cwd, env={**os.environ, "THERMOFLEET_CACHE": str(cache)})
        self.killer = threading.Timer(PATIENCE_S, self.process.kill)
        self.killer.start()
        self.ready = self.process.stdout.readline()

    def end(self, number):
        self.process.send_signal(number)
        _, said = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, said

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.killer.cancel()
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()


def heard_from(link, fleet, enough):
    """State words and the info of an arm, once there are enough."""
    states, infos = [], []
    link.subscribe(keys.of_every_arm(fleet, "state"), State, lambda _, word: states.append(word))
    link.subscribe(keys.of_every_arm(fleet, "info"), Info, lambda _, word: infos.append(word), history=True)
    deadline_s = time.monotonic() + PATIENCE_S
    while not (infos and enough(states)):
        assert time.monotonic() < deadline_s, "waited in vain"
        link.serve(time.monotonic() + 0.1)
    return states, infos[-1]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["ghost"], "No arm 'ghost'"),
        (["left", "--source", "log"], "log with a FILE"),
        (["left", "some.csv"], "log with a FILE"),
        (["left", "--source", "video"], "'video' is not one of 'sim', 'log'"),
        (["left", "--difficulty", "oracle"], "No difficulty 'oracle'. Allowed: blind, twin."),
        (["left", "--speed", "0"], "--speed must be 0.001 to 10000"),
        (["left", "--rate-hz", "1000"], "--rate-hz must be > 0 and at most 100 (got 1000)."),
        (["left", "--capacity", "0"], "--capacity must be 1 to 256 (got 0)."),
        (["left", "--seed", "-1"], "--seed must be 0 to 4294967295 (got -1)."),
        (["left", "--speed", "inf"], "--speed must be 0.001 to 10000 (got inf)."),
        (["left", "none.csv", "--source", "log"], "none.csv"),
        (["left", "--difficulty", "blind", "--endpoint", "udp/127.0.0.1:1"], "is no endpoint of this bus"),
    ],
)
def test_an_error_of_the_arm_command_is_one_sentence(
    thermofleet, small_toml, tmp_path, monkeypatch, options, complaint
):
    monkeypatch.chdir(tmp_path)
    said = thermofleet("arm", "run", small_toml, *options)
    assert said.code == 2
    assert complaint in said.err.replace("\n", " ")


def test_a_single_arm_equals_the_arm_of_the_fleet(small_toml, plans):
    scenario = load(small_toml)
    fleet = prepare(scenario, difficulty="blind", cache=plans)
    alone, same = prepare_arm(scenario, "right", difficulty="blind", cache=plans), fleet.arms[1]
    assert alone.robot == same.robot
    for name in ("motors", "thermal"):
        for one, other in zip(vars(getattr(alone, name)).values(), vars(getattr(same, name)).values(), strict=True):
            np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(alone.rest_tau, same.rest_tau)
    assert alone.plans.keys() == same.plans.keys()
    for work, variants in alone.plans.items():
        for one, other in zip(variants, same.plans[work], strict=True):
            np.testing.assert_array_equal(one.cycle.profile, other.cycle.profile)


@pytest.mark.slow
def test_a_single_arm_has_the_twin_of_the_arm_of_the_fleet(small_toml, tmp_path):
    text = small_toml.read_text(encoding="utf-8") + '\n[twin]\nsize = "quick"\nexploration = 0\n'
    small_toml.write_text(text, encoding="utf-8")
    scenario = load(small_toml)
    alone = prepare_arm(scenario, "right", cache=tmp_path / "one")
    assert alone.model.version == prepare(scenario, cache=tmp_path / "all").arms[1].model.version


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_an_arm_runs_as_a_process_and_exits_on_a_signal(small_toml, plans, tmp_path, number, code):
    with Router() as router, BusClient(router.endpoint, "heat") as link:
        options = ["--endpoint", router.endpoint, "--difficulty", "blind", "--rate-hz", 20]
        with Process(small_toml, "left", *options, cache=plans, cwd=tmp_path) as arm:
            assert arm.ready.split() == ["ready", "left", router.endpoint, str(arm.process.pid)]
            states, info = heard_from(link, "heat", lambda states: len(states) > 5)
            assert "torch" not in Path(f"/proc/{arm.process.pid}/maps").read_text()
            returned, said = arm.end(number)
    assert returned == code, said
    assert (info.twin, states[-1].mode) == ("blind", "idle")
    assert (tmp_path / "runs/live-heat/left.journal").is_file()
    if number == signal.SIGINT:
        assert "the same command continues" in said.replace("\n", " ")


def test_a_log_is_replayed_as_an_arm(small_toml, plans, log, tmp_path):
    with Router() as router, BusClient(router.endpoint, "heat") as link:
        options = ["--source", "log", "--endpoint", router.endpoint, "--speed", 4, "--rate-hz", 20]
        with Process(small_toml, "museum", log, *options, cache=plans, cwd=tmp_path) as arm:
            assert arm.ready.startswith("ready museum")
            states, info = heard_from(link, "heat", lambda states: states and states[-1].mode == "idle")
            job = JobSpec(name="j", kind="hold", places=("bench",))
            answers = link.query_and_wait(
                keys.of_every_arm("heat", "quote"), QuoteRequest("q", (job,), dry_run=True), Quote, timeout_s=PATIENCE_S
            )
            assert arm.end(signal.SIGTERM)[0] == 0
    assert info.twin == "log real.csv"
    (quote,) = answers.messages.values()
    assert "replays the log 'real.csv'" in quote.estimates[0].reason
    rise = np.arange(1, 8) / 100
    for state in states:
        into_s = (state.temp_c[0] - 30.0) * 100  # what the first joint says of the time, the others must say too
        np.testing.assert_allclose(state.temp_c, 30.0 + into_s * rise, atol=1e-9)
        np.testing.assert_allclose(state.q, into_s * rise, atol=1e-9)
        np.testing.assert_allclose(state.tau, 2.0 + into_s * rise, atol=1e-9)
        np.testing.assert_allclose(state.current_a, 3.0 + into_s * rise, atol=1e-9)
    seen = [round((state.temp_c[0] - 30.0) * 100, 6) for state in states]
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(TIME_S[-1])
    began_s = states[0].time_s - seen[0]
    for state, into_s in zip(states, seen, strict=True):
        if state.mode == "working":
            assert state.time_s - began_s == pytest.approx(into_s, abs=0.1 + 1e-6)


def test_no_second_arm_of_a_name_starts(token_reaches):
    with Router(0) as router, BusClient(router.endpoint, "f") as first, BusClient(router.endpoint, "f") as second:
        first.declare_token(keys.of_arm("f", "a", "alive"))
        token_reaches(second, keys.of_arm("f", "a", "alive"))
        wait_for_name(second, "b", patience_s=PATIENCE_S)
        with pytest.raises(BusError, match="Arm 'a' of fleet 'f' is already running"):
            wait_for_name(second, "a", patience_s=0.3)


def test_an_arm_waits_until_the_token_of_its_last_process_expires(token_reaches):
    with Router(0) as router, BusClient(router.endpoint, "f") as second:
        with BusClient(router.endpoint, "f") as first:
            first.declare_token(keys.of_arm("f", "a", "alive"))
            token_reaches(second, keys.of_arm("f", "a", "alive"))
            leaves = threading.Timer(0.3, first.close)
            leaves.start()
            wait_for_name(second, "a", patience_s=PATIENCE_S)
            leaves.join()
        assert not second.tokens(keys.of_arm("f", "a", "alive"), timeout_s=PATIENCE_S)


def test_a_log_without_temperatures_is_refused(log, tmp_path):
    bare = tmp_path / "bare.csv"
    lines = log.read_text().splitlines()
    bare.write_text("\n".join(",".join(line.split(",")[:22]) for line in lines))
    with pytest.raises(LogError, match="no motor temperatures"):
        replayed_arm("arm", bare)


def test_an_arm_that_the_scenario_lacks_is_refused(small_toml, plans):
    with pytest.raises(FleetError, match="No arm 'museum'"):
        simulated_arm(load(small_toml), "museum", "blind", 0, quiet, plans)


@pytest.mark.skipif(not LOGS.is_dir(), reason="the real logs are not here")
def test_a_real_arm_is_replayed_as_it_was_logged():
    file = sorted(LOGS.glob("*.csv.gz"))[0]
    (recording,) = read(file, damaged="skip")
    body = replayed_arm("kinova", file).body(1000.0, 0.1)
    for row in np.linspace(0, len(recording.time_s) - 2, 50).astype(int).tolist():
        body.advance(1000.0 + recording.time_s[row] - recording.time_s[0] + 1e-6)
        reading = body.read_sensors()
        np.testing.assert_array_equal(reading.temp_c, recording.temp_c[row])
        np.testing.assert_array_equal(reading.q, recording.q[row])
        np.testing.assert_array_equal(reading.current_a, recording.current_a[row])


@pytest.mark.parametrize("points", [((0.0, 28.0),), ((0.0, 28.0), (600.0, 28.0)), ((0.0, 20.0), (600.0, 40.0))])
def test_the_ambient_temperature_is_that_of_the_scenario(points):
    scenario = replace(load("quickstart"), ambient=Ambient(points=points))
    for time_s in (-1.0, 0.0, 150.0, 600.0, 1e6):
        assert ambient_of(scenario)(time_s) == np.interp(time_s, *zip(*points, strict=True))


def test_a_blind_arm_whose_plans_are_known_loads_no_physics(tmp_path):
    """64 of them on one machine would each take 50 MB more."""
    prepare(load("quickstart"), difficulty="blind", cache=tmp_path)
    program = f"""
import sys
from pathlib import Path
from scenarios.progress import quiet
from scenarios.live.arm import simulated_arm
from scenarios.spec.load import load
made = simulated_arm(load("quickstart"), "arm_0", "blind", 0, quiet, Path({str(tmp_path)!r}))
made.body(0.0, 0.1).advance(1.0)
print(*sys.modules)
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    heavy = {"mujoco", "mink", "ruckig", "scipy", "torch", "pettingzoo", "gymnasium", "numba", "pyarrow", "plotly"}
    assert set(said.stdout.split()) & heavy == set()


def test_the_torque_at_home_is_the_same_from_the_cache(tmp_path):
    fresh, kept = (prepare_arm(load("quickstart"), "arm_2", difficulty="blind", cache=tmp_path) for _ in range(2))
    assert fresh.rest_tau.tolist() == kept.rest_tau.tolist()
    assert fresh.rest_tau.tolist() == ArmModel(fresh.robot).gravity_torque(fresh.robot.home_q()).tolist()
    tilted = replace(fresh.robot, mount=replace(fresh.robot.mount, tilt_deg=(30.0, 0.0, 0.0)))
    heavier = replace(fresh.robot, tool_kg=fresh.robot.tool_kg + 1.0)
    for other in (tilted, heavier):
        assert rest_torque(other, tmp_path / "plans").tolist() != fresh.rest_tau.tolist()
