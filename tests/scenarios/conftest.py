"""A small cell whose plans are made once for all tests here, and the command line called in place."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from agents.registry import make_policy
from fleet.arm.random_motions import random_jobs
from fleet.bus.router import Router
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import ThermalSpread, gen3_network, spread_motors, thermal_model
from fleet.robot import Robot
from scenarios.motion.generate import Verification, bare_arm
from scenarios.policy_loader import policy_at
from scenarios.prepare.twins import cold_peaks, records
from scenarios.spec.load import load
from scenarios.spec.schema import Scenario
from tests.own_policies import BAD
from twin.vae.config import TwinConfig
from twin.vae.train import train

SMALL = """
description = "Two arms hold and sort for three minutes."
horizon_s = 180

[[arms]]
name = "left"
position_m = [-0.45, 0.0, 0.0]
home = "retract"

[[arms]]
name = "right"
position_m = [0.45, 0.0, 0.0]
tilt_deg = [0, 0, 180]
home = "retract"

[[places]]
name = "bench"
position_m = [0.0, 0.2, 0.25]

[[places]]
name = "shelf"
position_m = [0.0, -0.2, 0.25]

[[jobs]]
name = "hold"
kind = "hold"
places = ["bench"]
payload_kg = [2.0]
repetitions = [1, 2]
dwell_s = 10
arrivals = { kind = "batch", count = 2 }

[[jobs]]
name = "sort"
kind = "sort"
places = ["shelf", "bench"]
payload_kg = [0.2, 0.5]
repetitions = [1, 3]
arrivals = { kind = "poisson", every_s = 30 }

[planning]
elbows = 1
speeds = [1.0]
"""


QUICK = ("--difficulty", "blind", "--bus", "memory", "--policy", "round_robin")
"""Options of a run that takes little time."""


def run_json(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


class Known:
    """A reference as `scenarios.evaluate.references` stores it, with what scores read."""

    def __init__(self, instance: str, random: float, hindsight: float, upper: float) -> None:
        self.instance, self.random, self.hindsight, self.upper = instance, random, hindsight, upper
        self.unit = max(hindsight - random, 0.1 * hindsight)


@pytest.fixture(scope="session")
def subject() -> SimpleNamespace:
    """An arm with its own deviation from a Gen3, light jobs that stay cool, and a small twin trained on them."""
    draw = np.random.default_rng(np.random.SeedSequence(8))
    robot, spread = Robot(name="arm", tool_kg=0.9), ThermalSpread.gen3(0.5)
    motors = spread_motors(gen3_motors(), spread, draw)
    thermal = thermal_model(gen3_network(spread=spread, rng=draw))
    sampled = random_jobs(robot, 40, draw, payload_kg=(0.0, 1.5))
    peak_c = cold_peaks(sampled, motors, thermal, ambient_c=23.0, horizon_s=1800.0).max(axis=1)
    jobs = tuple(job for job, highest in zip(sampled, peak_c, strict=True) if highest < 40.0)
    config = TwinConfig(hidden=16, max_windows=384, epochs=40, batch=64, restarts=1)
    twin = train(records(jobs), config, np.random.SeedSequence(3), arm=robot.name)
    return SimpleNamespace(arm=bare_arm(robot, motors, thermal), jobs=jobs, twin=twin)


@pytest.fixture
def small_toml(tmp_path: Path) -> Path:
    """The small scenario as a file."""
    path = tmp_path / "heat.toml"
    path.write_text(SMALL, encoding="utf-8")
    return path


@pytest.fixture
def scenario(small_toml: Path) -> Scenario:
    return load(small_toml)


@pytest.fixture(scope="module")
def asked(subject: SimpleNamespace) -> Verification:
    """What a motion of the subject is verified with."""
    return Verification.nominal(subject.arm.robot, 23.0)


@pytest.fixture
def bad(tmp_path: Path) -> Path:
    """A file of policies that fail."""
    path = tmp_path / "bad.py"
    path.write_text(BAD.replace("DRAWN", "0.0"), encoding="utf-8")
    drawn = policy_at(f"{path}:Idle", 1).drawn  # pyright: ignore[reportAttributeAccessIssue]  # of the file
    path.write_text(BAD.replace("DRAWN", repr(drawn)), encoding="utf-8")
    return path


@pytest.fixture
def endpoint() -> Iterator[str]:
    with Router() as router:
        yield router.endpoint


class PressingCtrlC:
    """Round robin that sends SIGINT to its own process at a certain step."""

    def __init__(self, step: int, times: int) -> None:
        self._policy, self._left, self._times = make_policy("round_robin"), step, times

    def reset(self, rng):
        self._policy.reset(rng)

    def act(self, observations):
        self._left -= 1
        if self._left == 0:
            for _ in range(self._times):
                os.kill(os.getpid(), signal.SIGINT)
        return self._policy.act(observations)


@pytest.fixture
def press_ctrl_c() -> Callable[..., AbstractContextManager[object]]:
    """A function that interrupts the shifts within a block at their fourth step."""

    def press(times: int = 1) -> AbstractContextManager[object]:
        return patch("scenarios.policy_loader.policy_of", lambda *name: PressingCtrlC(step=4, times=times))

    return press
