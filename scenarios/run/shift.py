"""One shift from beginning to end, recorded."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.policy import only_choices, reads_messages
from fleet.engine.profile_plant import recorded_noise, telemetry_of
from fleet.engine.shift import StepRecord, stack_records
from fleet.engine.step import TOTAL
from fleet.env.allocation_v2 import AllocationEnv
from fleet.env.validation import actions_of
from fleet.errors import FleetError, nearest
from fleet.events import Event
from fleet.fields import check_value
from fleet.observation import Observation
from fleet.telemetry import Readings, Telemetry
from scenarios.policy_loader import OnBus, blaming, check_name, policy_at, scope_of
from scenarios.prepare.fleet import Fleet, env_of, let_plan, prepare
from scenarios.progress import Progress, check_progress, quiet
from scenarios.result_folder import argument_names, check_free, folder_at, new_folder
from scenarios.run.log import RUN, RunLog, card_of, provenance
from scenarios.run.metrics import HeatUse, metrics_of
from scenarios.run.records import Offer, job_records, offers_of
from scenarios.spec.load import keywords_of
from scenarios.spec.options import RunSpec
from scenarios.spec.schema import Scenario

AT_ONCE = 20_000
"""Number of readings of an arm computed at once."""


def run(
    fleet: Fleet | Scenario | str | Path,
    spec: RunSpec | None = None,
    *,
    progress: Progress = quiet,
    stopped: Callable[[], bool] = lambda: False,
    record: bool = True,
    endpoint: str | None = None,
    out: str | Path | None = None,
    **options: Any,  # one type per field
) -> RunLog:
    """Run one shift; it ends early, between two steps, once `stopped` returns True.

    Args:
        fleet: A prepared fleet, whose predictions are used, or a scenario (a library name, a .toml file, a `Scenario`),
            which is prepared first.
        spec: What to run; without it, `options` are its fields: policy, seed, plant, bus ("memory" here: nothing is
            published), difficulty, risk, channel; `thermofleet run --help` explains them.
        progress: Called with a stage and a share. The first run of a scenario prepares its arms for minutes.
        record: Keep telemetry.
        endpoint: Zenoh router on loopback that publishes the shift; by default a router in this process.
        out: Folder for the files of the run; it must not exist yet.

    Raises:
        FleetError: an option is not allowed, the fleet cannot be prepared, or the folder cannot be written.
        PolicyFailed: a user-defined policy raised an exception or returned no action.
    """
    spec = _spec_of(spec, options)
    check_progress(progress)
    if not callable(stopped):
        raise FleetError(f"stopped must be a function without arguments, as lambda: False (got {stopped!r}).")
    check_value("record", record, bool)
    if endpoint is not None and spec.bus == "memory":
        raise FleetError(f"endpoint needs bus='zenoh' (got endpoint={endpoint!r} and bus='memory').")
    target = None if out is None else folder_at("out", out)
    if target is not None:
        with argument_names():
            check_free(target, RUN, overwrite=False)
    check_name(spec.policy)
    with blaming(spec.policy, "loading"):  # before the fleet is prepared for minutes
        scope_of(spec.policy)
    if isinstance(fleet, Fleet):
        spec = _of_fleet(fleet, spec, options)
    else:
        fleet = prepare(fleet, difficulty=spec.difficulty, risk=spec.risk, progress=progress)
    if target is None:
        return _run_shift(fleet, spec, progress, stopped, record, endpoint)
    with argument_names(), new_folder(target, RUN) as folder:
        log = _run_shift(fleet, spec, progress, stopped, record, endpoint)
        log.write(folder)
    return log


def _run_shift(
    fleet: Fleet,
    spec: RunSpec,
    progress: Progress,
    stopped: Callable[[], bool],
    record: bool,
    endpoint: str | None,
) -> RunLog:
    """Run one shift of a prepared fleet."""
    shift = f"{fleet.scenario.name}/{spec.seed}"
    with blaming(spec.policy, shift):
        policy = policy_at(spec.policy, spec.seed, OnBus(fleet=fleet.scenario.name))
    recorder = _Recorder(fleet.scenario, record)
    progress("working", 0.0)  # the first shift of a machine waits for the compiler
    env = env_of(
        fleet,
        plant=spec.plant,
        bus=spec.bus,
        endpoint=endpoint,
        channel=spec.channel,
        keep_events=True,
        watch=recorder,
        scaled=False,
        ahead_s=np.inf,
        bids=reads_messages(policy),
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
                chosen = actions_of(env.agents, policy.act(seen) if asked else {})
            actions = dict(zip(env.agents, chosen.tolist(), strict=True))
            outcome, _, _ = env.advance(actions)
            awards = [event for event in env.events[count:] if event.kind == "award"]
            for award in awards if record else ():
                offers += offers_of(award, seen, actions, env.world.plans_per_job)
            env.events[count:] = [_with_prediction(event, seen, actions) for event in env.events[count:]]
            reward += float(outcome[TOTAL])
            progress("working", env.tick / env.world.ticks)
        finished = not env.agents
    finally:
        env.close()
    return _log_of(fleet, spec, recorder, offers, reward, finished=finished)


def _log_of(
    fleet: Fleet, spec: RunSpec, recorder: "_Recorder", offers: list[Offer], reward: float, *, finished: bool
) -> RunLog:
    """Return the log of a shift that has ended."""
    env = recorder.env
    state, world = env.truth, env.world
    events = tuple(sorted(env.events, key=lambda event: event.time_s))
    heat = recorder.heat or HeatUse(state.temp_c[0].astype(float), fleet.scenario.people.burn_c)
    finds_contacts = not env.episode.plant.follows_plans
    card = card_of(
        spec,
        fleet.scenario,
        metrics_of(world, state, heat, events, env.messages, finds_contacts=finds_contacts),
        {arm.robot.name: provenance(arm.model) for arm in fleet.arms},
        finished=finished,
        time_s=float(state.tick[0] * world.dt_s),
        reward=reward,
    )
    return RunLog(
        card=card,
        scenario=fleet.scenario,
        arms=tuple(arm.name for arm in fleet.scenario.arms),
        limits=fleet.scenario.limits,
        readings=recorder.readings(),
        events=events,
        jobs=job_records(world, state),
        offers=tuple(offers),
    )


def _spec_of(spec: RunSpec | None, options: Mapping[str, Any]) -> RunSpec:
    """Return the given spec, or that of the given options.

    Raises:
        FleetError: an option is not allowed, or both are given.
    """
    if not isinstance(spec, RunSpec | None):
        raise FleetError(f"Options are given by name, as policy='wspt' (got {spec!r}).")
    if spec is not None:
        if options:
            raise FleetError(f"Give either a RunSpec or single options, not both (got {', '.join(options)}).")
        return spec
    try:
        return RunSpec(**{"bus": "memory", **options})
    except TypeError as error:
        unknown = next((name for name in options if name not in RunSpec.__dataclass_fields__), "")
        allowed = [*RunSpec.__dataclass_fields__, *keywords_of(run)]
        raise FleetError(f"run() has no option '{unknown}'{nearest(unknown, allowed)}") from error
    except ValueError as error:
        raise FleetError(str(error).removeprefix("RunSpec.")) from error


def _of_fleet(fleet: Fleet, spec: RunSpec, options: Mapping[str, Any]) -> RunSpec:
    """The spec with the predictions of a prepared fleet.

    Args:
        options: Given options; a field of `spec` that differs from its default counts as given, too.

    Raises:
        FleetError: an option contradicts the fleet.
    """
    for name in ("difficulty", "risk"):
        given, prepared = getattr(spec, name), getattr(fleet, name)
        if given != prepared and (name in options or given != getattr(RunSpec, name)):
            raise FleetError(
                f"This fleet is prepared with {name}='{prepared}' (got {name}='{given}'); leave the option out, or "
                "prepare another fleet."
            )
        spec = replace(spec, **{name: prepared})
    return spec


def _with_prediction(event: Event, seen: Mapping[str, Observation], actions: Mapping[str, int]) -> Event:
    """The event; an award with the predicted peak and P(saturation) of its plan as reason."""
    if event.kind != "award":
        return event
    option = actions[event.arm] - 1
    peak_c, p = float(seen[event.arm].peak_c[option]), float(seen[event.arm].p_saturation[option])
    return replace(event, reason=f"predicted peak {peak_c:.1f} °C, P(saturation) {p:.2f}") if peak_c else event


class _Recorder:
    """Records every step, and reads the sensors several times in each.

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
        self._arms = len(scenario.arms)
        self._kept = Readings(scenario.ticks * len(self._offsets_s))

    def __call__(self, record: StepRecord) -> None:
        self.heat = self.heat or HeatUse(record.start_c[0], self._burn_c)
        self.heat.add(record.end_c, self._dt_s)
        if not self._reads:
            return
        self._records.append(record)
        if len(self._records) >= min(self._most_steps, self.env.episode.plant.most_steps):
            self._read()

    def readings(self) -> Telemetry:
        """All readings; no samples before the first step or without `reads`."""
        if self._records:
            self._read()
        return self._kept.telemetry() or Telemetry.empty(self._arms)

    def _read(self) -> None:
        episode, record = self.env.episode, stack_records(self._records)
        world, offsets_s = episode.world, self._offsets_s
        motion = episode.plant.motion(world, record, offsets_s)
        noise = recorded_noise(episode.noise_key, record, offsets_s, world.dt_s, len(world.arms))
        self._kept.add(telemetry_of(world, record, offsets_s, motion, noise))
        self._records.clear()
