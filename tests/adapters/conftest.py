"""A small world for trainers, watched: what reached the environment, whoever sent it."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from fleet.env.allocation_v0 import parallel_env
from fleet.env.vector import BatchEnv

PAGE = Path(__file__).parents[2] / "docs" / "trainers.md"

ELSEWHERE = """
import hashlib, importlib.util, sys
loaded = []
for name, path in zip(("small_worlds", "watched", "trainer"), sys.argv[1:]):
    spec = importlib.util.spec_from_file_location(name, path)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    loaded.append(module)
worlds, watched, trainer = loaded
told = hashlib.sha256()
for parameters in trainer.trained(watched.Workshop(worlds.Shifts(arms=3, jobs=8, ticks=15)), seed=0):
    for name in sorted(parameters):
        told.update(name.encode() + parameters[name].tobytes())
print("trained", told.hexdigest())
"""
"""Trains once in a process of its own and tells the parameters before and after, as a hash."""


@dataclass
class Log:
    """What reached the environments of a workshop."""

    steps: int = 0
    claims: int = 0
    illegal: int = 0
    orders: set[tuple[str, ...]] = field(default_factory=set)
    """In which order the actions of a step were given."""
    ends: list[tuple[bool, bool]] = field(default_factory=list)
    """Terminated and truncated of each finished episode."""


LOGS: dict[str, Log] = {}
"""By the name of the workshop: a pickled one, made anew in this process, writes where the other wrote."""


class Watched(BaseParallelWrapper[str, Any, Any]):
    """Notes every step in the log of its workshop."""

    def __init__(self, env: ParallelEnv[str, Any, Any], workshop: str) -> None:
        super().__init__(env)
        self.workshop = workshop
        self.legal: dict[str, Any] = {}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        seen, infos = super().reset(seed=seed, options=options)
        self.legal = {arm: each["action_mask"].copy() for arm, each in seen.items()}
        return seen, infos

    def step(self, actions: dict[str, Any]) -> Any:
        log = LOGS[self.workshop]
        log.steps += 1
        log.orders.add(tuple(actions))
        for arm, action in actions.items():
            log.claims += int(action) > 0
            log.illegal += not self.legal[arm][int(action)]
        seen, rewards, terminated, truncated, infos = super().step(actions)
        self.legal = {arm: each["action_mask"].copy() for arm, each in seen.items()}
        if not self.env.agents:
            log.ends.append((terminated["arm_0"], truncated["arm_0"]))
        return seen, rewards, terminated, truncated, infos


@dataclass(frozen=True)
class Workshop:
    """Makes watched environments."""

    shifts: Callable[[Any], Any]
    name: str = field(default_factory=lambda: f"workshop {len(LOGS)}")

    def __post_init__(self) -> None:
        LOGS.setdefault(self.name, Log())

    @property
    def log(self) -> Log:
        """What reached its environments."""
        return LOGS[self.name]

    def __call__(self, *_: Any, **__: Any) -> Watched:
        return Watched(parallel_env(self.shifts), self.name)


@pytest.fixture(scope="session", autouse=True)
def home(tmp_path_factory) -> Iterator[None]:
    """A home of its own: some trainers leave logs and tokens there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(tmp_path_factory.mktemp("home")))
        yield


@pytest.fixture(scope="session")
def small_workshop(small) -> Callable[..., Workshop]:
    """Makes workshops of shifts of three arms and 15 decisions, unless told otherwise."""
    return lambda **shift: Workshop(small.Shifts(**({"arms": 3, "jobs": 8, "ticks": 15} | shift)))


@pytest.fixture(scope="session")
def small_batch(small) -> Callable[..., BatchEnv]:
    """Makes batches of the same shifts, as `make_batch` does: scenario (any), number of envs, seed."""

    def make(
        scenario: str = "", num_envs: int = 4, seed: int | None = None, *, autoreset: bool = True, **shift: Any
    ) -> BatchEnv:
        known = {key: value for key, value in shift.items() if key not in ("difficulty", "horizon_s")}
        shifts = small.Shifts(**({"arms": 3, "jobs": 8, "ticks": 15} | known))
        return BatchEnv(shifts.library(), num_envs, seed=seed, autoreset=autoreset)

    return make


@pytest.fixture(scope="session")
def elsewhere(small) -> Callable[[str, int], str]:
    """Trains with the `trained` of a test file in a process with this hash seed; gives the digest."""

    def train(file: str, hash_seed: int) -> str:
        ran = subprocess.run(
            [sys.executable, "-c", ELSEWHERE, small.PATH, __file__, file],
            env=os.environ | {"PYTHONHASHSEED": str(hash_seed), "PYTHONPATH": ":".join(p for p in sys.path if p)},
            capture_output=True, text=True, timeout=600, check=False,
        )  # fmt: skip
        told = [line for line in ran.stdout.splitlines() if line.startswith("trained ")]
        assert len(told) == 1, ran.stderr[-2000:]
        return told[0]

    return train


@pytest.fixture
def example(small_workshop, small_batch, monkeypatch, tmp_path) -> Callable[[str], dict[str, Any]]:
    """Runs a trainer's example of docs/trainers.md on a small shift; gives its variables, and the `log`."""

    def run(trainer: str) -> dict[str, Any]:
        _, _, section = PAGE.read_text(encoding="utf-8").partition(f"## {trainer}\n")
        code = section.split("```python\n")[1].split("```")[0]
        workshop = small_workshop()
        monkeypatch.setattr("scenarios.make_env", workshop, raising=False)
        monkeypatch.setattr("scenarios.make_batch", small_batch, raising=False)
        monkeypatch.chdir(tmp_path)
        told: dict[str, Any] = {}
        exec(code, told)
        return told | {"log": workshop.log}

    return run
