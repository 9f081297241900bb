"""A small world for trainers, watched: what reached the environment, whoever sent it."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from fleet.env.allocation_v2 import parallel_env
from fleet.env.validation import Decisions
from fleet.env.vector import BatchEnv
from fleet.files import user_cache_folder

PAGE = Path(__file__).parents[2] / "docs" / "trainers.md"
ELSEWHERE = """
import hashlib, importlib, sys
from tests.adapters.conftest import Workshop
from tests.conftest import Shifts
told, trainer = hashlib.sha256(), importlib.import_module(f"tests.adapters.{sys.argv[1]}")
for parameters in trainer.trained(Workshop(Shifts(arms=3, jobs=8, ticks=15)), seed=0):
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


@dataclass(frozen=True)
class Ending:
    shift: dict[str, Any]
    """Its options."""
    finished: bool
    """All jobs are done, or else it is cut at its horizon of six decisions."""


CUT = Ending({"ticks": 6}, finished=False)
FINISHED = Ending({"jobs": 1, "ticks": 400, "ambient_c": 20.0}, finished=True)


@dataclass(frozen=True)
class Turn:
    before: dict[str, Any]
    """What the arms knew."""
    claims: dict[str, int]
    seen: dict[str, Any]
    """What they know after it."""
    rewards: dict[str, float]
    terminated: dict[str, bool]
    truncated: dict[str, bool]
    infos: dict[str, dict[str, Any]]
    last: bool

    @property
    def ends(self) -> tuple[bool, bool]:
        """Terminated and truncated, which are the same of all arms."""
        ((terminated,), (truncated,)) = set(self.terminated.values()), set(self.truncated.values())
        return terminated, truncated


def turns(
    env: ParallelEnv[str, Any, Any], seen: dict[str, Any], choose: Callable[[dict[str, Any]], dict[str, int]]
) -> Iterator[Turn]:
    """The second way: an episode by hand, from what the arms know at its beginning to its end.

    Args:
        choose: The claims of the arms, of what they know.
    """
    while env.agents:
        claims = choose(seen)
        before, (seen, rewards, terminated, truncated, infos) = seen, env.step(claims)
        yield Turn(before, claims, seen, rewards, terminated, truncated, infos, last=not env.agents)


def claim_by_chance(seed: int) -> Callable[[dict[str, Any]], dict[str, int]]:
    rng = np.random.default_rng(seed)
    return lambda seen: {arm: int(rng.choice(np.flatnonzero(each["action_mask"]))) for arm, each in seen.items()}


@pytest.fixture(params=[CUT, FINISHED], ids=["cut", "finished"])
def ending(request) -> Ending:
    return request.param


@pytest.fixture(scope="session")
def by_hand() -> SimpleNamespace:
    """How an environment is stepped without a trainer."""
    return SimpleNamespace(turns=turns, claim_by_chance=claim_by_chance)


@pytest.fixture(scope="package", autouse=True)
def home(tmp_path_factory) -> Iterator[None]:
    """A home of its own for these tests, as some trainers leave logs and tokens there; the compiled engine stays."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(user_cache_folder().parent))
        patch.setenv("THERMOFLEET_CACHE", str(tmp_path_factory.mktemp("plans")))
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
        scenario: str = "", num_envs: int = 4, seed: int | None = None, *,
        autoreset: bool = True, decisions: Decisions = "interval", **shift: Any,
    ) -> BatchEnv:  # fmt: skip
        known = {key: value for key, value in shift.items() if key not in ("difficulty", "horizon_s")}
        shifts = small.Shifts(**({"arms": 3, "jobs": 8, "ticks": 15} | known))
        return BatchEnv(shifts.library(), num_envs, seed=seed, autoreset=autoreset, decisions=decisions)

    return make


@pytest.fixture(scope="session")
def elsewhere() -> Callable[[str, int], str]:
    """Trains with the `trained` of a test file in a process with this hash seed; gives the digest."""

    def train(file: str, hash_seed: int) -> str:
        ran = subprocess.run(
            [sys.executable, "-c", ELSEWHERE, Path(file).stem],
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
        monkeypatch.setattr("thermofleet.make_env", workshop, raising=False)
        monkeypatch.setattr("thermofleet.make_batch", small_batch, raising=False)
        monkeypatch.chdir(tmp_path)
        told: dict[str, Any] = {}
        exec(code, told)
        return told | {"log": workshop.log}

    return run
