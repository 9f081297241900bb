"""Play environments through, and compare what they returned."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleet.difficulty import KNOWN, Difficulty, Forecast
from fleet.engine.state import DONE, WAITING, State
from fleet.engine.world import World
from fleet.env.allocation_v2 import AllocationEnv, parallel_env
from fleet.env.vector import BatchEnv
from fleet.observation import FIELDS, Observation
from fleet.robot import JOINTS
from scenarios.spec.parse import parse_scenario
from scenarios.spec.schema import Scenario

Trace = list[tuple[Any, ...]]


def wild(env: AllocationEnv, rng: np.random.Generator) -> dict[str, int]:
    """Mostly legal actions, some not."""
    actions = {}
    for arm, seen in env.knowledge().items():
        legal = np.flatnonzero(seen.action_mask[:-1] if rng.random() < 0.95 else seen.action_mask)
        actions[arm] = int(rng.choice(legal)) if rng.random() < 0.9 else int(rng.integers(env.layout.actions))
    return actions


def go_on(env: AllocationEnv, rng: np.random.Generator, steps: int = 10_000) -> Trace:
    """Everything the env returns until the end of the episode, or for a number of steps."""
    trace: Trace = []
    while env.agents and len(trace) < steps:
        trace.append(env.step(wild(env, rng)))
    return trace


def chosen(mask: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Mostly legal actions, some not, [...], of a mask [..., action]; by numbers from 0 to 1, [..., 2].

    Arms seldom give their jobs back, so that motors get hot.
    """
    actions, mask = mask.shape[-1], mask.copy()
    mask[..., -1] *= numbers[..., 1] < 0.05
    rank = np.floor(numbers[..., 0] * mask.sum(axis=-1)).astype(int)
    legal = np.argmax(np.cumsum(mask, axis=-1) > rank[..., None], axis=-1)
    return np.where(numbers[..., 1] < 0.9, legal, np.floor(numbers[..., 0] * actions).astype(int))


def slots_of(world: World, state: State) -> list[int]:
    """Jobs in the slots of env 0 by the rule: released, waiting, nothing to wait for; oldest first; −1 for none.

    Jobs that were passed over come last, and have a quarter of the slots at least.
    """
    shift, status = world.shifts[0], state.status[0]
    ready = [
        j
        for j in np.flatnonzero(status[: len(shift.kind)] == WAITING).tolist()
        if shift.release_s[j] <= state.tick[0] * world.dt_s
        and all(status[before] == DONE for before in shift.after[j].tolist() if before >= 0)
    ]
    ready.sort(key=lambda j: (state.queued_s[0, j], j))
    passed = [j for j in ready if state.jobs["passes"][0, j] < 0]
    others = [j for j in ready if j not in passed]
    ready = others[: world.slots - min(len(passed), world.slots // 4)] + passed
    return (ready + [-1] * world.slots)[: world.slots]


def plain(trace: Any) -> Any:
    """The same in lists and numbers, so that two can be compared with ==."""
    if isinstance(trace, dict):
        return {key: plain(value) for key, value in trace.items()}
    if isinstance(trace, list | tuple):
        return [plain(value) for value in trace]
    return trace.tolist() if isinstance(trace, np.ndarray) else trace


def named(observed: Observation) -> dict[str, Any]:
    return {name: getattr(observed, name) for name in (*(field.name for field in FIELDS), "peers", "action_mask")}


def rows(given: Any, which: Any) -> dict[str, Any]:
    """Some rows of what a batch returned at a step or a reset, by name; `which` are env numbers."""
    obs, info = given[0], given[-1]
    which = np.atleast_1d(np.asarray(which, dtype=int))
    out = {name: values[which] for name, values in obs.items()}
    out |= {name: values[which] for name, values in zip(RETURNED, given[1:-1], strict=False)}
    out |= {name: values[which] for name, values in info.items() if not name.startswith("final_")}
    ended = info["final_envs"].tolist()
    out["ended"] = np.array([e in ended for e in which.tolist()])
    place = [ended.index(e) for e in which.tolist() if e in ended]
    return out | {f"final_{name}": values[place] for name, values in info["final_obs"].items()}


def single(env: AllocationEnv, given: Any) -> dict[str, Any]:
    """What a single env returned at a step or a reset, as the only row of a batch."""
    arms, cut = env.possible_agents, env.layout.shared
    seen, infos = given[0], given[-1]
    vectors, masks = (np.stack([seen[arm][name] for arm in arms])[None] for name in ("observation", "action_mask"))
    assert (vectors[..., :cut] == vectors[:, :1, :cut]).all()  # all arms alike
    out = {"shared": vectors[:, 0, :cut], "own": vectors[..., cut:], "action_mask": masks}
    for name, each in zip(RETURNED, given[1:-1], strict=False):
        assert len(set(each.values())) == 1  # all arms alike
        out[name] = np.array([each[arms[0]]])
    for name in infos[arms[0]]:
        per_arm = np.array([infos[arm][name] for arm in arms])
        out[name] = per_arm[None] if name in PER_ARM else per_arm[:1]
    return out


def same(one: dict[str, Any], other: dict[str, Any]) -> None:
    """Assert that two are equal to the last bit."""
    assert list(one) == list(other)
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


RETURNED = ("reward", "terminated", "truncated")
PER_ARM = ("faults", "illegal", "peak_c", "above_warning_s")


def digest(*given: Any) -> str:
    """A hash of everything in dictionaries, tuples and arrays, in the order it comes in."""
    return hashlib.sha256(repr(plain(given)).encode()).hexdigest()


class Learned:
    """A risk that depends on the temperatures: logistic of some pieces, or by a curve."""

    version = "learned"

    def __init__(self, pieces: int, *, curve: bool) -> None:
        self._pieces, self._curve = pieces, curve

    def score(self, plan, repetitions: int) -> Difficulty:
        slope = np.linspace(0.01, 0.05, self._pieces)[:, None] * np.arange(1, KNOWN + 1) / 2.0
        curve = np.array([[-3.0, 0.1], [0.0, 0.4], [0.0, 0.5], [4.0, 0.9]]) if self._curve else None
        peak = Forecast(np.linspace(20.0, 30.0, 3), np.full((3, KNOWN), 0.1), time_s=np.array([0.0, 30.0, 90.0]))
        risk = Forecast(-np.linspace(4.0, 7.0, self._pieces) - plan.work.payload_kg, slope, curve)
        return Difficulty(np.full(JOINTS, 0.1 + 0.05 * plan.work.payload_kg), risk=risk, peak=peak)


@pytest.fixture(scope="session")
def play() -> SimpleNamespace:
    """Play environments through, and compare what they returned."""
    return SimpleNamespace(
        wild=wild, go_on=go_on, chosen=chosen, slots_of=slots_of, plain=plain, named=named, rows=rows, same=same,
        single=single, Learned=Learned,
    )  # fmt: skip


@pytest.fixture
def make(small) -> Callable[..., AllocationEnv]:
    """Makes a small environment; `shift` are the options of its shifts."""

    def make_env(shift: dict[str, Any] | None = None, **options: Any) -> AllocationEnv:
        return parallel_env(small.Shifts(**(shift or {})), **options)

    return make_env


@pytest.fixture
def batch(small) -> Callable[..., BatchEnv]:
    """Makes a small batch; `shift` are the options of its shifts."""

    def make_batch(num_envs: int, shift: dict[str, Any] | None = None, **options: Any) -> BatchEnv:
        return BatchEnv(small.Shifts(**(shift or {})).library(), num_envs, **options)

    return make_batch


@pytest.fixture(scope="session")
def cell(three_arms: dict[str, Any], job_streams) -> Scenario:
    """A cell of three arms, planned in a second, hot enough to fault."""
    streams = job_streams(hold_until_s=240.0, sort_until_s=200.0, sort_due_s=100.0)
    own = {"name": "cell", "horizon_s": 600.0, "ambient": {"points": [[0.0, 30.0], [600.0, 32.0]]}}
    return parse_scenario({**three_arms, **own, "jobs": list(streams.values())}, Path("cell.toml"))
