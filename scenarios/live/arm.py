"""One arm of a live fleet as a process: simulated, or replayed from the log of a real arm."""

import logging
import os
import secrets
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fleet.breaks import breaks_of
from fleet.bus.client import BusClient, NoReply
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest
from fleet.bus.protocol.keys import STATE_HZ
from fleet.difficulty import Blind, DifficultyModel
from fleet.errors import BusError, FleetError, InfeasibleJob, LogError, Refused
from fleet.files import cache_folder
from fleet.job import Work
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardExecutor, ExecutorConfig
from fleet.live.arm.body import Body, ReplayBody, SensorLog
from fleet.live.arm.estimator import Estimator, NominalPeaks
from fleet.live.arm.node import ArmConfig, ArmNode, AuctioneerClient, WorkSource
from fleet.live.clock import FleetClock
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Membership
from fleet.live.journal import CompactingJournal, Journal, own_records
from fleet.live.records import BookRecord
from fleet.live.supervisor import return_memory
from fleet.motion import Plan
from scenarios.live.auctioneer import folder_of, live_fleet, refuse_other_way, scenario_jobs, summary
from scenarios.live.cell import cell_of
from scenarios.policy_loader import arm_policy_of, scope_of
from scenarios.progress import Progress
from scenarios.signals import StopRequest, until_stopped
from scenarios.spec.options import LiveModel, LiveSpec, RiskName
from scenarios.spec.schema import Scenario
from scenarios.terminal import echo, progress_bar

if TYPE_CHECKING:
    from twin.monitor import Monitor

log = logging.getLogger(__name__)

TURN_S, CLOCK_S, RETIRE_S = 0.25, 2.0, 1.0
"""Real seconds between two checks for a stop request, for the clock reply, and for the return of awards at the end."""
TOKEN_S, POLL_S = 4.0, 0.1
"""Real seconds that the token of an exited process may remain (lease of a session, with a margin), and between two
requests for tokens."""
FAREWELL_S = 2.0
"""Real seconds to serve after all jobs are settled, for peers that still request outcomes."""


def run_arm(
    scenario: Scenario,
    name: str,
    spec: LiveSpec,
    endpoint: str,
    *,
    alone: bool = False,
    file: Path | None = None,
    twin: Path | None = None,
    network: Path | None = None,
    speed: float | None = None,
    rate_hz: float = STATE_HZ,
    capacity: int = 1,
) -> None:
    """Run one arm of a fleet until Ctrl-C or SIGTERM; with `alone` also until the shift ends or all jobs are settled.

    Args:
        alone: Allocate jobs with the peers by the policy of `spec`, without an auctioneer.
        file: Log to replay instead of a simulated arm.
        twin: Folder of the twin that scores the motion of a replayed arm.
        network: Folder of the thermal network that yields its expected temperatures.
        speed: Fleet seconds per real second; None for that of the auctioneer.

    Raises:
        FleetError: options contradict each other or the journals.
    """
    if alone and scope_of(spec.policy) == "central":
        raise FleetError(
            f"'{spec.policy}' needs an auctioneer: start it with thermofleet bus auctioneer --policy {spec.policy}, "
            "and leave --policy out for the arms."
        )
    if alone and file is not None:
        raise FleetError("An arm that replays a log takes no jobs: leave --policy out.")
    if spec.new_epoch and not alone:
        raise FleetError("--new-epoch is for an arm with --policy, or for thermofleet bus auctioneer: leave it out.")
    fleet, folder = folder_of(spec.journal, spec.fleet, scenario)
    refuse_other_way(folder, (name,), alone=alone, new_epoch=spec.new_epoch)
    with progress_bar() as progress:
        simulated = partial(simulated_arm, scenario, name, spec.difficulty, spec.seed, progress, risk=spec.risk)
        arm = replayed_arm(name, file, twin, network) if file else simulated()
    with (
        until_stopped() as stop,
        BusClient(endpoint, fleet, stopped=stop.is_set) as link,
        Journal[ArmRecord](folder / f"{name}.journal", ArmRecord) as book,
        ExitStack() as resources,
    ):
        link.require("show the token", keys.of_arm(fleet, name, "alive"))
        wait_for_name(link, name)
        source = None
        if alone:
            refuse_auctioneer(link)
            membership = membership_of(scenario, name, spec.policy, jobs=spec.jobs, seed=spec.seed)
            grants = resources.enter_context(Journal[BookRecord](folder / f"{name}.grants", BookRecord))
            source = partial(ConsensusNode, membership=membership, journal=grants, new_epoch=spec.new_epoch)

        node = make_node(link, book, arm, scenario, speed=speed, rate_hz=rate_hz, capacity=capacity, work_source=source)
        return_memory()
        echo(f"ready {name} {endpoint} {os.getpid()}")
        if alone and serve_until_done(node, stop):
            node.retire(time.monotonic())
            return
        while not stop.is_set():
            node.serve(time.monotonic() + TURN_S)
        node.retire(time.monotonic() + RETIRE_S)
        stop.leave(f"Interrupted; the journal is {book.path}, and the same command continues.")


@dataclass(frozen=True, kw_only=True)
class PreparedArm:
    """An arm before it joins the bus."""

    name: str
    model: DifficultyModel
    plan: Callable[[Work], tuple[Plan, ...]]
    """Plans of a task type; raises InfeasibleJob."""
    body: Callable[[float, float], Body]
    """Makes the body of the arm from fleet time and step length, s."""
    ambient_c: Callable[[float], float] | None = None
    """Ambient temperature at the arm by fleet time, °C; None: that of the cell."""
    works: tuple[Work, ...] = ()
    """Task types with known plans."""
    takes_jobs: bool = True


def simulated_arm(
    scenario: Scenario,
    name: str,
    difficulty: LiveModel,
    seed: int,
    progress: Progress,
    cache: Path | None = None,
    *,
    risk: RiskName = "rc",
) -> PreparedArm:
    """Prepare an arm of a scenario, with the body, plans and twin that it has in `thermofleet run`.

    Raises:
        FleetError: the scenario has no such arm.
    """
    from fleet.live.arm.body import SimulatedBody
    from scenarios.prepare.arms import CellPlanner, air_offsets
    from scenarios.prepare.fleet import prepare_arm

    arm = prepare_arm(scenario, name, difficulty=difficulty, risk=risk, cache=cache, progress=progress)
    index = scenario.index_of(name)
    cell_c, offset_k = ambient_of(scenario), float(air_offsets(scenario)[index])

    def ambient_c(time_s: float) -> float:
        return cell_c(time_s) + offset_k

    @lru_cache
    def planner() -> CellPlanner:  # made for the first unplanned task type: it loads the physics
        return CellPlanner(arm.robot, scenario, cache or cache_folder())

    def plan(work: Work) -> tuple[Plan, ...]:
        return arm.plans[work] if work in arm.plans else planner().plan(work)

    def body(time_s: float, dt_s: float) -> Body:
        return SimulatedBody(
            arm,
            scenario.limits,
            ambient_c,
            dt_s=dt_s,
            max_dt_s=scenario.decision_interval_s,
            rng=np.random.default_rng(np.random.SeedSequence([seed, index])),
            time_s=time_s,
            warm=scenario.start == "idle_warm",
        )

    works = tuple(arm.plans)
    return PreparedArm(name=name, model=arm.model, plan=plan, body=body, ambient_c=ambient_c, works=works)


def ambient_of(scenario: Scenario) -> Callable[[float], float]:
    """Ambient temperature of the cell by fleet time, °C."""
    return lambda at_s: float(scenario.ambient.at(np.array(at_s)))


def monitor_of(twin: Path | None, network: Path | None) -> "Callable[[float], Monitor] | None":
    """Makes what compares motion with the twin and the thermal network of these folders; None without both.

    Its argument is the time between two scores, s.

    Raises:
        CheckpointError: a folder has none, or several twins.
    """
    if twin is None and network is None:
        return None
    from scenarios.prepare.twins import open_twin
    from twin.monitor import Monitor
    from twin.thermal.checkpoint import load

    models = None if twin is None else open_twin(twin), None if network is None else load(network)
    return lambda every_s: Monitor(*models, every_s=every_s)


def replayed_arm(name: str, file: Path, twin: Path | None = None, network: Path | None = None) -> PreparedArm:
    """Prepare an arm that replays a real arm's log and takes no jobs; see `monitor_of`.

    Raises:
        LogError: the file cannot be read, has no temperatures, or holds several arms and none of this name.
    """
    from twin.logs.reader import of_arm, read

    recordings = read(file, damaged="skip")
    (recording,) = of_arm(recordings, name if len(recordings) > 1 else None, file)
    if recording.temp_c is None:
        raise LogError(str(file), None, "has no motor temperatures; a live arm needs them.")
    sensors = SensorLog(
        recording.time_s, recording.temp_c, recording.q, recording.qd, recording.tau, recording.current_a
    )

    def refuse(work: Work) -> tuple[Plan, ...]:
        raise InfeasibleJob(name, work.places[0].name, f"this arm replays the log '{file.name}' and takes no jobs")

    monitor = monitor_of(twin, network)  # errors before the arm joins the bus

    def body(time_s: float, dt_s: float) -> Body:
        return ReplayBody(sensors, time_s=time_s, monitor=monitor and monitor(dt_s))

    model = Blind(version=monitor(1.0).version if monitor else f"log {file.name}")
    return PreparedArm(name=name, model=model, plan=refuse, body=body, takes_jobs=False)


def wait_for_name(link: BusClient, name: str, *, patience_s: float = TOKEN_S) -> None:
    """Wait until no arm of that name is online; two arms of one name would act as one.

    Raises:
        BusError: one is still online.
    """
    deadline_s = time.monotonic() + patience_s
    while link.tokens(keys.of_arm(link.fleet, name, "alive")):
        if time.monotonic() < deadline_s:
            time.sleep(POLL_S)
            continue
        raise BusError(
            f"Arm '{name}' of fleet '{link.fleet}' is already running. Stop it first, or give this one another name."
        )


def make_node(
    link: BusClient,
    book: Journal[ArmRecord],
    arm: PreparedArm,
    scenario: Scenario,
    *,
    speed: float | None = None,
    rate_hz: float = STATE_HZ,
    capacity: int = 1,
    work_source: Callable[..., WorkSource] | None = None,
) -> ArmNode:
    """Join the bus with an arm and the history of its journal; link and journal are open.

    Args:
        work_source: Makes the source of jobs from the arm and its boot number `boot`; by default auctioneers.
    """
    clock = fleet_clock(link, speed)
    history = restart_history(book, arm.name, clock.now_s(time.monotonic()))
    config = ExecutorConfig(capacity=capacity)
    kept = ArmHistory().replay(history.compact())
    keep = CompactingJournal(book, kept).append
    executor = AwardExecutor(arm.name, keep, history, nonce=secrets.token_hex(4), config=config)
    estimator = Estimator(arm.model, arm.plan, {place.name: place for place in scenario.places}, NominalPeaks())
    estimator.plan_ahead(arm.works)
    arm_config = ArmConfig(
        warning_c=scenario.limits.warning_c,
        rate_hz=rate_hz,
        boot=history.boot,
        ambient_c=arm.ambient_c or ambient_of(scenario),
        takes_jobs=arm.takes_jobs,
        breaks=breaks_of(scenario.breaks, arm.name),
    )
    body = arm.body(clock.now_s(time.monotonic()), clock.speed / rate_hz)
    auctioneers = partial(AuctioneerClient, history=kept)
    source = auctioneers if work_source is None else partial(work_source, boot=history.boot)
    return ArmNode(link, body, executor, estimator, clock, arm_config, source)


def restart_history(book: Journal[ArmRecord], name: str, time_s: float) -> ArmHistory:
    """History of the arm at this start, written to its journal."""
    before = ArmHistory().replay(own_records(book, name))
    for active in before.active.values():
        log.warning("'%s' was unfinished at the last exit of the arm: returned.", active.job)
    history = before.after_restart(name, time_s)
    book.rewrite(*history.compact())
    return history


def fleet_clock(link: BusClient, speed: float | None) -> FleetClock:
    """Fleet time, from the auctioneer if there is one."""
    asked_s = time.monotonic()
    try:
        reply = link.ask(keys.of_clock(link.fleet), ClockRequest(), Clock, timeout_s=CLOCK_S)
    except (NoReply, Refused):
        return FleetClock(speed or 1.0, time.monotonic())
    if speed is not None and speed != reply.speed:
        log.warning("The fleet's speed is %g, not %g.", reply.speed, speed)
    return FleetClock(reply.speed, epoch=reply.epoch).set_to(asked_s, time.monotonic(), reply.time_s)


def membership_of(scenario: Scenario, name: str, policy: str, *, jobs: str, seed: int) -> Membership:
    """Membership of an arm in the consensus of its fleet, by a policy of scope `arm`.

    Raises:
        FleetError: the scenario has no such arm, or there is no such policy.
    """
    place = scenario.index_of(name)
    chosen = arm_policy_of(policy)
    chosen.reset(np.random.default_rng(np.random.SeedSequence([seed, 1, place])))
    stream = jobs == "scenario"
    fleet = live_fleet(scenario, ends=stream)
    cell, space = cell_of(scenario, name)
    return Membership(
        fleet=fleet,
        choose=chosen.choose,
        slots=scenario.slots,
        places=frozenset(place.name for place in scenario.places),
        stream=tuple(scenario_jobs(scenario, seed)) if stream else (),
        horizon_s=fleet.horizon_s,
        excludes=space,
        cell=cell,
    )


def refuse_auctioneer(link: BusClient) -> None:
    """Check that the fleet has no auctioneer, which would award the jobs that the arms allocate.

    Raises:
        BusError: the fleet has one.
    """
    if present := link.tokens(keys.of_every_auction(link.fleet, "alive")):
        names = ", ".join(sorted(present))
        raise BusError(f"Fleet '{link.fleet}' has an auctioneer: '{names}'. Stop it first, or leave --policy out.")


def serve_until_done(node: ArmNode, stop: StopRequest) -> bool:
    """Serve until all jobs are settled, and print a summary; return False if stopped before that."""
    source = node.work_source
    assert isinstance(source, ConsensusNode)
    while not stop.is_set() and not source.over:
        node.serve(time.monotonic() + TURN_S)
    if stop.is_set():
        return False
    left = source.participant.book.left
    echo(summary(source.statuses(), node.clock.now_s(time.monotonic()), left))
    echo(f"This is the view of one arm, after {source.participant.rounds} rounds of allocation.")
    until_s = time.monotonic() + FAREWELL_S
    while not stop.is_set() and time.monotonic() < until_s:
        node.serve(min(until_s, time.monotonic() + TURN_S))
    return True
