"""Synthetic arms: smooth random joint motion under a gravity-like torque, and one small twin trained on it."""

from collections.abc import Callable

import numpy as np
import pytest

from fleet.job import Place, Work
from fleet.motion import RATE_HZ, Phase, Plan
from twin.logs.recording import Recording
from twin.vae.config import TwinConfig
from twin.vae.train import train
from twin.vae.twin import Twin

GRAVITY_NM = np.array([2.0, 20.0, 5.0, 10.0, 1.0, 3.0, 1.5])


def smooth_motion(rng: np.random.Generator, seconds: float, load: np.ndarray | float = 1.0) -> np.ndarray:
    """Profile [time, 3, joint]: sums of sines, tau = load·g·sin(q + 0.3) + ½·qdd + noise."""
    time = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    omega = 2 * np.pi * rng.uniform(0.05, 0.25, (3, 7))
    size, shift = rng.uniform(0.1, 0.5, (3, 7)), rng.uniform(0, 2 * np.pi, (3, 7))
    angle = omega * time[:, None, None] + shift
    q = (size * np.sin(angle)).sum(axis=1)
    qd = (size * omega * np.cos(angle)).sum(axis=1)
    qdd = -(size * omega**2 * np.sin(angle)).sum(axis=1)
    tau = load * GRAVITY_NM * np.sin(q + 0.3) + 0.5 * qdd + rng.normal(0, 0.1, q.shape)
    return np.stack([q, qd, tau], axis=1).astype(np.float32)


def plan_of(*profiles: np.ndarray) -> Plan:
    """A plan of three profiles: approach, cycle, retreat."""
    work = Work(kind="hold", places=(Place(name="bench", position_m=(0.4, 0.0, 0.3)),))
    approach, cycle, retreat = (Phase(p, np.zeros(len(p), np.float32)) for p in profiles)
    return Plan("arm", work, 0, 1.0, approach, cycle, retreat)


@pytest.fixture(scope="session")
def motion() -> Callable[..., np.ndarray]:
    return smooth_motion


@pytest.fixture(scope="session")
def make_plan() -> Callable[..., Plan]:
    return plan_of


@pytest.fixture
def plan(rng: np.random.Generator) -> Plan:
    return plan_of(*(smooth_motion(rng, seconds) for seconds in (3.0, 10.0, 2.5)))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def records() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [smooth_motion(rng, 12.0) for _ in range(60)]


@pytest.fixture(scope="session")
def small() -> TwinConfig:
    """A configuration that trains seven joints in about a second."""
    return TwinConfig(hidden=16, max_windows=384, epochs=25, batch=64, restarts=1)


@pytest.fixture(scope="session")
def twin(records: list[np.ndarray], small: TwinConfig) -> Twin:
    return train(records, small, np.random.SeedSequence(3), arm="arm_0")


@pytest.fixture(scope="session")
def recording_of() -> Callable[[float], Recording]:
    def make(seconds: float) -> Recording:
        q, qd, tau = smooth_motion(np.random.default_rng(3), seconds).astype(float).swapaxes(0, 1)
        return Recording(name="log", time_s=np.arange(len(q)) / RATE_HZ, q=q, qd=qd, tau=tau)

    return make
