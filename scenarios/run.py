"""One shift from beginning to end, recorded."""

import hashlib
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any

import msgspec
import numpy as np

from fleet.bus.channel import PERFECT, Channel
from fleet.events import Event
from fleet.metrics import Metrics
from fleet.seeds import child
from fleet.sim.kernel import Step
from fleet.telemetry import Telemetry, join
from scenarios.build import BusName, DifficultyName, Fleet, PlantName, Progress, env_of, quiet
from scenarios.outcome import metrics_of
from scenarios.policies import policy_at
from scenarios.provenance import provenance
from scenarios.scenario import Scenario

RUN_FORMAT = 3
"""Raised when run.json or the columns of the recordings change."""
_LIBRARIES = ("thermofleet", "numpy", "mujoco", "torch", "pettingzoo", "eclipse-zenoh", "pyarrow")


@dataclass(frozen=True, kw_only=True)
class RunSpec:
    """What to run, apart from the fleet."""

    policy: str
    seed: int = 0
    plant: PlantName = "profile"
    bus: BusName = "zenoh"
    difficulty: DifficultyName = "twin"
    channel: Channel = PERFECT
    """What becomes of the arms' words on the way."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """What came out of a shift."""

    spec: RunSpec
    scenario: Scenario
    metrics: Metrics
    telemetry: Telemetry | None
    """None if the shift was interrupted before its first step."""
    events: tuple[Event, ...]
    twins: dict[str, dict[str, Any]]
    """`provenance` of each arm's difficulty model."""
    finished: bool
    """False if interrupted."""
    time_s: float
    """How far the shift got."""
    total_reward: float


def run(
    fleet: Fleet,
    spec: RunSpec,
    *,
    progress: Progress = quiet,
    stopped: Callable[[], bool] = lambda: False,
    record: bool = True,
    endpoint: str | None = None,
) -> RunResult:
    """Work the shift; `stopped` turning true ends it early, between two steps, with what there is.

    Args:
        record: Keep telemetry; sweeps do without.
        endpoint: Of a Zenoh router on loopback that others listen on too; by default the fleet has its own.
    """
    policy = policy_at(spec.policy, spec.seed)
    readings = child(np.random.SeedSequence([spec.seed, 1]), 1)  # the first child is the policy's
    recorder = _Recorder(fleet.scenario, np.random.default_rng(readings)) if record else None
    env = env_of(
        fleet,
        plant=spec.plant,
        bus=spec.bus,
        endpoint=endpoint,
        channel=spec.channel,
        keep_events=True,
        watch=recorder,
    )
    finished, reward = False, 0.0
    try:
        if recorder is not None:
            recorder.env = env
        env.reset(seed=spec.seed)
        while env.agents and not stopped():
            _, rewards, _, _, _ = env.step(policy.act(env.knowledge()))
            reward += next(iter(rewards.values()))
            progress("working", float(env.truth.tick[0] / env.world.ticks))
        finished = not env.agents
    finally:
        env.close()
    state, world = env.truth, env.world
    events = tuple(sorted(env.events, key=lambda event: event.time_s))
    return RunResult(
        spec=spec,
        scenario=fleet.scenario,
        metrics=metrics_of(world, state, events, env.messages),
        telemetry=join(recorder.parts) if recorder is not None and recorder.parts else None,
        events=events,
        twins={arm.robot.name: provenance(arm.model) for arm in fleet.arms},
        finished=finished,
        time_s=float(state.tick[0] * world.dt_s),
        total_reward=reward,
    )


class _Recorder:
    """Reads the sensors a few times in every step."""

    def __init__(self, scenario: Scenario, rng: np.random.Generator) -> None:
        self.parts: list[Telemetry] = []
        self.env: Any = None
        self._rng = rng
        every, dt = scenario.telemetry_interval_s, scenario.decision_interval_s
        self._offsets_s = np.arange(1, int(np.floor(dt / every + 1e-9)) + 1) * every

    def __call__(self, step: Step) -> None:
        episode = self.env.episode
        self.parts.append(episode.plant.readings(episode.world, step, self._offsets_s, self._rng))


def scenario_hash(scenario: Scenario) -> str:
    """Name of a scenario by its content."""
    return hashlib.sha256(msgspec.json.encode(scenario)).hexdigest()[:16]


def summary(result: RunResult) -> dict[str, Any]:
    """The content of run.json. Holds no clock time, so the same seed gives the same file."""
    return {
        "format": RUN_FORMAT,
        "status": "finished" if result.finished else "interrupted",
        "time_s": result.time_s,
        "scenario": msgspec.to_builtins(result.scenario),
        "scenario_hash": scenario_hash(result.scenario),
        **asdict(replace(result.spec, channel=PERFECT)),
        "channel": result.spec.channel.described(),
        "twins": result.twins,
        "versions": {"python": platform.python_version()} | {name: version(name) for name in _LIBRARIES},
        "reward": result.total_reward,
        "metrics": asdict(result.metrics),
    }
