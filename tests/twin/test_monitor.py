"""The motion of a live arm that replays a log: d of its windows, and the temperatures of its network."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import Info, State
from fleet.bus.router import Router
from fleet.live.arm.body import ReplayBody, SensorLog
from fleet.live.monitor.snapshot import ArmSnapshot
from scenarios.live.arm import replayed_arm
from scenarios.show.watch import format_work
from tests.commands import start
from tests.twin.test_follow import csv_of, log_of
from tests.twin.test_identify import AIR_C, working
from tests.waiting import serve_until
from twin.log_windows import log_windows
from twin.logs.recording import Recording
from twin.monitor import Monitor
from twin.thermal.checkpoint import save as save_network
from twin.thermal.identify import identify
from twin.thermal.thermal_twin import RcTwin
from twin.vae.twin import save


def replayed(log: Recording, monitor: Monitor, every_s: float) -> list[tuple[float | None, tuple[float, ...]]]:
    """The scores of each state of an arm that replays a log."""
    assert log.temp_c is not None
    body = ReplayBody(SensorLog(log.time_s, log.temp_c, log.q, log.qd, log.tau, log.current_a), monitor=monitor)
    scores = []
    for time_s in np.arange(0.0, log.duration_s + 1e-6, every_s):
        body.advance(float(time_s))
        reading = body.read_sensors()
        scores.append((reading.motion_difficulty, reading.expected_c))
    return scores


def test_d_of_the_motion_is_that_of_its_last_window(twin, recording_of):
    log = replace(recording_of(10.0), temp_c=np.full((500, 7), 30.0))
    scores = replayed(log, Monitor(twin, None, every_s=0.96), 0.02)
    ((_, _, features),) = log_windows(twin, log)
    assert scores[0] == (None, ())
    seen = list(dict.fromkeys(d for d, _ in scores if d is not None))
    np.testing.assert_allclose(seen, (features.difficulty @ twin.joint_weight)[: len(seen)], rtol=1e-3)
    assert len(seen) >= len(features.packed) - 1


def test_the_network_of_the_arm_yields_its_temperatures():
    """The network is identified from this log; the monitor does not know the housings at its start."""
    arm = RcTwin.nominal()
    log, nodes = working(arm, 60.0, np.random.default_rng(1))
    scores = replayed(log, Monitor(None, identify([log], arm="own", ambient_c=AIR_C)), 30.0)
    warmed_k = np.ptp(nodes[:, 1])
    np.testing.assert_allclose(scores[-1][1], nodes[-1, :7], atol=max(0.5, 0.05 * warmed_k))
    assert warmed_k > 10.0


def test_impossible_readings_give_no_scores_and_are_forgotten(twin):
    log, _ = working(RcTwin.nominal(), 20.0, np.random.default_rng(1))
    wrong = log.tau.copy()
    wrong[40:60] = 1e200
    monitor = Monitor(twin, identify([log], arm="own", ambient_c=AIR_C), every_s=0.96)
    with np.errstate(all="ignore"):
        scores = replayed(replace(log, tau=wrong, current_a=None), monitor, 10.0)
    assert () in [expected_c for _, expected_c in scores[5:]]
    np.testing.assert_allclose(scores[-1][1], scores[-1][1])
    assert len(scores[-1][1]) == 7
    for d, expected_c in scores:
        assert all(-100 < each < 500 for each in expected_c)
        assert d is None or 0 <= d <= 7


def test_a_replayed_arm_reads_its_models_once(twin, motion, tmp_path, monkeypatch):
    save(twin, tmp_path / "twin")
    (tmp_path / "log.csv").write_text(csv_of(log_of(motion, seconds=60.0)))
    opened = list[Path]()
    monkeypatch.setattr("scenarios.prepare.twins.open_twin", lambda folder: opened.append(folder) or twin)
    arm = replayed_arm("museum", tmp_path / "log.csv", tmp_path / "twin")
    assert arm.body(0.0, 0.5).read_sensors().motion_difficulty is None
    assert (arm.model.version, opened) == (f"d:{twin.version}", [tmp_path / "twin"])


def test_a_replayed_arm_publishes_d_and_expected_temperatures(twin, motion, tmp_path):
    save(twin, tmp_path / "twin")
    log, _ = working(RcTwin.nominal(), 20.0, np.random.default_rng(1))
    network = identify([log], arm="own", ambient_c=AIR_C)
    save_network(network, tmp_path / "rc")
    (tmp_path / "log.csv").write_text(csv_of(log_of(motion, seconds=120.0)))
    words = ("arm", "run", "quickstart", "museum", tmp_path / "log.csv", "--source", "log", "--speed", 20)
    models = ("--twin", tmp_path / "twin", "--network", tmp_path / "rc")
    states, infos = list[State](), list[Info]()
    with Router() as router, BusClient(router.endpoint, "quickstart") as link:
        link.subscribe(keys.of_every_arm("quickstart", "state"), State, lambda _, state: states.append(state))
        link.subscribe(keys.of_every_arm("quickstart", "info"), Info, lambda _, info: infos.append(info), history=True)
        env = {**os.environ, "THERMOFLEET_CACHE": str(tmp_path / "cache")}
        with start(*words, *models, "--endpoint", router.endpoint, cwd=tmp_path, env=env) as process:
            try:
                serve_until(lambda: states and states[-1].motion_difficulty is not None and states[-1].expected_c, link)
            finally:
                process.send_signal(signal.SIGTERM)
                process.communicate(timeout=300)
    assert infos[-1].twin == f"d:{twin.version}+temperatures:{network.version}"
    assert 0 < (states[-1].motion_difficulty or 0) < 7
    shown = ArmSnapshot("a", True, True, joint=2, motion_difficulty=1.25, expected_c=(30.0, 41.5))
    assert "motion d 1.25, joint 2 expected 41.5 °C" in format_work(shown)
