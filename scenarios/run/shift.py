"""One shift from beginning to end, recorded."""

import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from agents.policy import only_choices
from fleet.bus.exchange.channel import PERFECT
from fleet.engine.profile_plant import recorded_noise, telemetry_of
from fleet.engine.shift import StepRecord, stack_records
from fleet.env.allocation_v1 import VERSION, AllocationEnv, actions_of
from fleet.events import Event
from fleet.observation import Observation
from fleet.telemetry import Readings, Telemetry
from scenarios.policy_loader import OnBus, blaming, policy_at
from scenarios.prepare.fleet import Fleet, env_of, let_plan
from scenarios.progress import Progress, quiet
from scenarios.run.metrics import HeatUse, Metrics, metrics_of
from scenarios.run.provenance import code_hash, provenance
from scenarios.shift_records import JobRecord, Offer, job_records, offers_of
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import scenario_hash
from scenarios.spec.schema import Scenario

RUN_FORMAT = 6
"""Raised when run.json or the columns of the recordings change so that an earlier version cannot be read."""
AT_ONCE = 20_000
"""Readings of an arm that are computed at a time."""
_LIBRARIES = ("thermofleet", "numpy", "mujoco", "torch", "pettingzoo", "eclipse-zenoh", "pyarrow")


@dataclass(frozen=True, eq=False)
class RunResult:
    """Result of a shift."""

    spec: RunSpec
    scenario: Scenario
    metrics: Metrics
    telemetry: Telemetry | None
    """None if the shift was interrupted before its first step."""
    events: tuple[Event, ...]
    jobs: tuple[JobRecord, ...]
    offers: tuple[Offer, ...]
    """Of all arms, at every award."""
    twins: dict[str, dict[str, Any]]
    """`provenance` of each arm's difficulty model."""
    finished: bool
    """False if interrupted."""
    time_s: float
    """Simulated time at the end."""
    total_reward: float

    def _repr_html_(self) -> str:
        from scenarios.show.run_page import run_html

        return run_html(summary(self), self.events, self.offers)


def run(
    fleet: Fleet,
    spec: RunSpec,
    *,
    progress: Progress = quiet,
    stopped: Callable[[], bool] = lambda: False,
    record: bool = True,
    endpoint: str | None = None,
) -> RunResult:
    """Run one shift; once `stopped` returns True it ends early, between two steps.

    Args:
        record: Keep telemetry.
        endpoint: Zenoh router on loopback, for other listeners; by default the fleet has its own.

    Raises:
        PolicyFailed: the policy is one of one's own, and raised something or returned no action.
    """
    shift = f"{fleet.scenario.name}/{spec.seed}"
    with blaming(spec.policy, shift):
        policy = policy_at(spec.policy, spec.seed, OnBus(fleet=fleet.scenario.name))
    recorder = _Recorder(fleet.scenario, record)
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
    offers: list[Offer] = []
    try:
        recorder.env = env
        env.reset(seed=spec.seed)
        with blaming(spec.policy, shift):
            let_plan(policy, fleet, env, spec.seed)
        only_when_asked = only_choices(policy)
        while env.agents and not stopped():
            count, asked = len(env.events), env.may_claim or not only_when_asked
            seen = env.knowledge() if asked else {}
            with blaming(spec.policy, f"{shift}, at {env.tick * env.world.dt_s:g} s of the shift"):
                actions = policy.act(seen) if asked else {}
                actions_of(env.agents, actions)
            _, earned, _, _ = env.advance(actions)
            awards = [event for event in env.events[count:] if event.kind == "award"]
            for award in awards if record else ():
                offers += offers_of(award, seen, actions, env.world.plans_per_job)
            env.events[count:] = [_with_prediction(event, seen, actions) for event in env.events[count:]]
            reward += earned
            progress("working", env.tick / env.world.ticks)
        finished = not env.agents
    finally:
        env.close()
    state, world = env.truth, env.world
    events = tuple(sorted(env.events, key=lambda event: event.time_s))
    return RunResult(
        spec=spec,
        scenario=fleet.scenario,
        metrics=metrics_of(
            world,
            state,
            recorder.heat or HeatUse(world.start_c, fleet.scenario.people.burn_c),
            events,
            env.messages,
            finds_contacts=not env.episode.plant.follows_plans,
        ),
        telemetry=recorder.telemetry(),
        events=events,
        jobs=job_records(world, state),
        offers=tuple(offers),
        twins={arm.robot.name: provenance(arm.model) for arm in fleet.arms},
        finished=finished,
        time_s=float(state.tick[0] * world.dt_s),
        total_reward=reward,
    )


def _with_prediction(event: Event, seen: Mapping[str, Observation], actions: Mapping[str, int]) -> Event:
    """An award with the predicted peak and P(saturation) of its plan as reason; other events as they are."""
    if event.kind != "award":
        return event
    option = actions[event.arm] - 1
    peak_c, p = float(seen[event.arm].peak_c[option]), float(seen[event.arm].p_saturation[option])
    return replace(event, reason=f"predicted peak {peak_c:.1f} °C, P(saturation) {p:.2f}") if peak_c else event


class _Recorder:
    """Keeps the record of every step, and reads the sensors several times in each.

    Args:
        env: The environment of the shift; set before its reset.
        reads: Whether to read the sensors.
    """

    env: AllocationEnv
    heat: HeatUse | None = None
    """None before the first step."""

    def __init__(self, scenario: Scenario, reads: bool) -> None:
        every_s, dt_s = scenario.telemetry_interval_s, scenario.decision_interval_s
        self._dt_s, self._reads, self._burn_c = dt_s, reads, scenario.people.burn_c
        self._offsets_s = np.arange(1, int(np.floor(dt_s / every_s + 1e-9)) + 1) * every_s
        self._most_steps = max(1, AT_ONCE // (len(scenario.arms) * len(self._offsets_s)))
        self._records: list[StepRecord] = []
        self._kept = Readings(scenario.ticks * len(self._offsets_s))

    def __call__(self, record: StepRecord) -> None:
        self.heat = self.heat or HeatUse(record.start_c[0], self._burn_c)
        self.heat.add(record.end_c[0], self._dt_s)
        if not self._reads:
            return
        self._records.append(record)
        if len(self._records) >= min(self._most_steps, self.env.episode.plant.most_steps):
            self._read()

    def telemetry(self) -> Telemetry | None:
        """All readings; None before the first step, or without reading."""
        if self._records:
            self._read()
        return self._kept.telemetry()

    def _read(self) -> None:
        episode, record = self.env.episode, stack_records(self._records)
        world, offsets_s = episode.world, self._offsets_s
        motion = episode.plant.motion(world, record, offsets_s)
        noise = recorded_noise(episode.noise_key, record, offsets_s, world.dt_s, len(world.arms))
        self._kept.add(telemetry_of(world, record, offsets_s, motion, noise))
        self._records.clear()


def summary(result: RunResult) -> dict[str, Any]:
    """The content of run.json. It holds no clock time, so the same seed gives the same file."""
    return {
        "format": RUN_FORMAT,
        "environment": VERSION,
        "status": "finished" if result.finished else "interrupted",
        "time_s": result.time_s,
        "scenario": asdict(result.scenario),
        "scenario_hash": scenario_hash(result.scenario),
        **asdict(replace(result.spec, channel=PERFECT)),
        "channel": result.scenario.channel(result.spec.channel).described(),
        "twins": result.twins,
        "versions": {"python": platform.python_version()} | {name: version(name) for name in _LIBRARIES},
        "code_hash": code_hash(),
        "reward": result.total_reward,
        "metrics": asdict(result.metrics),
    }
