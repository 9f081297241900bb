"""`thermofleet arm`: one arm of a fleet as a process of its own, simulated, or replayed from a real arm's log."""

import logging
import os
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fleet.errors import BusError, FleetError, InfeasibleJob
from fleet.job import Work
from fleet.motion import Plan
from scenarios.live_options import ENDPOINT, EndpointOption
from scenarios.load import load
from scenarios.scenario import Scenario

if TYPE_CHECKING:
    from fleet.bus.link import Link
    from fleet.difficulty import DifficultyModel
    from fleet.live.arm_node import ArmNode
    from fleet.live.body import Body
    from fleet.live.clock import FleetClock
    from fleet.live.journal import Journal
    from fleet.live.orders import Orders, Worker
    from fleet.live.promises import Memory, Promise
    from scenarios.build import Progress

log = logging.getLogger(__name__)

TURN_S, CLOCK_S, FAREWELL_S = 0.25, 2.0, 1.0
"""Real seconds: between two looks at whether to stop; that the auctioneer has to tell the time at the start; to give
back what is in hand at the end."""
NAMESAKE_S = 4.0
"""Real seconds that the token of one that has just died may still be there: its session's lease, and some more."""


def arm_command(
    scenario: Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")],
    name: Annotated[str, typer.Argument(help="Of the arm in the scenario; with --source log any name.")],
    file: Annotated[Path | None, typer.Argument(help="--source log: a Gen3 log, a plain log, or a recording.")] = None,
    source: Annotated[str, typer.Option(help="sim (the scenario's arm), or log FILE.")] = "sim",
    difficulty: Annotated[str, typer.Option(help="What scores the plans: twin or blind.")] = "twin",
    speed: Annotated[
        float | None, typer.Option(help="Fleet seconds per real second; default: the auctioneer's, else 1.")
    ] = None,
    rate_hz: Annotated[float, typer.Option(help="State words per real second.")] = 10.0,
    capacity: Annotated[int, typer.Option(help="Jobs that it takes in hand at a time.")] = 1,
    journal: Annotated[
        Path | None, typer.Option(help="Folder of its journal; the same one again goes on where it stopped.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Draws the noise of its sensors, and with --policy the jobs.")] = 0,
    policy: Annotated[
        str, typer.Option(help="consensus: share the jobs out with the other arms; else an auctioneer awards them.")
    ] = "",
    jobs: Annotated[str, typer.Option(help="With --policy: scenario (its own stream, the same for all), or none.")] = (
        "scenario"
    ),
    endpoint: EndpointOption = ENDPOINT,
    fleet: Annotated[str, typer.Option(help="Name of the fleet; default: the scenario's name.")] = "",
) -> None:
    """Live as one arm of a fleet: say how it is, offer, work, and report, until Ctrl-C or SIGTERM."""
    from fleet.bus.link import Link
    from fleet.live.journal import Journal
    from fleet.live.promises import Promise
    from scenarios import live_council
    from scenarios.stopping import until_stopped
    from scenarios.terminal import progress_bar

    chosen = load(scenario)
    _check(source, difficulty, file, speed, rate_hz, capacity, seed)
    _check_policy(policy, jobs, file)
    fleet = fleet or chosen.name
    folder = journal or Path("runs") / f"live-{fleet}"
    live_council.refuse_other_way(folder, (name,), alone=bool(policy))
    with progress_bar() as progress:
        made = replayed(name, file) if file else simulated(chosen, name, difficulty, seed, progress)
    with (
        until_stopped() as stop,
        Link(endpoint, fleet) as link,
        Journal[Promise](folder / f"{name}.journal", Promise) as book,
        ExitStack() as more,
    ):
        refuse_namesake(link, name)
        orders = None
        if policy:
            live_council.refuse_auctioneer(link)
            membership = live_council.membership_of(chosen, policy, jobs=jobs, seed=seed)
            orders = more.enter_context(live_council.seat(folder / f"{name}.grants", membership))
        node = node_of(link, book, made, chosen, speed=speed, rate_hz=rate_hz, capacity=capacity, orders=orders)
        typer.echo(f"ready {name} {endpoint} {os.getpid()}")
        while not stop.is_set():
            if policy and live_council.work(node, stop):
                return
            node.serve(time.monotonic() + TURN_S)
        node.retire(time.monotonic() + FAREWELL_S)
        stop.leave(f"Interrupted; the journal is {book.path}, and the same command goes on.")


@dataclass(frozen=True, kw_only=True)
class MadeArm:
    """What an arm is, before it is on a bus."""

    name: str
    model: "DifficultyModel"
    plan: Callable[[Work], tuple[Plan, ...]]
    """Variants of a work; raises InfeasibleJob."""
    body: "Callable[[float, float], Body]"
    """Its body by the fleet's time at its birth and the length of its steps, s."""
    works: tuple[Work, ...] = ()
    """Whose plans are at hand."""
    takes_work: bool = True


def simulated(
    scenario: Scenario, name: str, difficulty: str, seed: int, progress: "Progress", cache: Path | None = None
) -> MadeArm:
    """The scenario's arm: its body, plans and twin are those of the same arm in `thermofleet run`.

    Raises:
        FleetError: the scenario has no such arm.
    """
    import numpy as np

    from fleet.live.body import SimulatedBody
    from scenarios.build import air_offsets, cache_folder, planner_of, prepare_arm

    how: Any = difficulty
    arm = prepare_arm(scenario, name, difficulty=how, cache=cache, progress=progress)
    index = scenario.index_of(name)
    air_c, offset_k = air_of(scenario), float(air_offsets(scenario)[index])
    planners: list[Any] = []

    def plan(work: Work) -> tuple[Plan, ...]:
        if work in arm.plans:
            return arm.plans[work]
        if not planners:
            planners.append(planner_of(arm.robot, scenario, cache or cache_folder()))
        return planners[0].plan(work)

    def body(time_s: float, dt_s: float) -> "Body":
        return SimulatedBody(
            arm,
            scenario.limits,
            lambda at_s: air_c(at_s) + offset_k,
            dt_s=dt_s,
            longest_s=scenario.decision_interval_s,
            rng=np.random.default_rng(np.random.SeedSequence([seed, index])),
            time_s=time_s,
            warm=scenario.start == "idle_warm",
        )

    return MadeArm(name=name, model=arm.model, plan=plan, body=body, works=tuple(arm.plans))


def air_of(scenario: Scenario) -> Callable[[float], float]:
    """Air of the cell at a time of the fleet, °C: asked ten times a second, so what never changes is not worked out."""
    import numpy as np

    if len({temp_c for _, temp_c in scenario.ambient.points}) == 1:
        steady_c = float(scenario.ambient.points[0][1])
        return lambda at_s: steady_c
    return lambda at_s: float(scenario.ambient.at(np.array(at_s)))


def replayed(name: str, file: Path) -> MadeArm:
    """A real arm's log as an arm that takes no work.

    Raises:
        LogError: the file cannot be read, or tells no temperatures.
        FleetError: the file holds several arms, and none is called so.
    """
    from fleet.difficulty import Blind
    from fleet.errors import LogError
    from fleet.live.log_body import LogBody, Readings
    from twin.logs import read

    recordings = {each.name.rpartition("/")[2]: each for each in read(file, damaged="skip")}
    if len(recordings) > 1 and name not in recordings:
        raise FleetError(f"{file} holds several arms: {', '.join(recordings)}. Call the arm by one of these names.")
    recording = recordings[name] if len(recordings) > 1 else next(iter(recordings.values()))
    if recording.temp_c is None:
        raise LogError(str(file), None, "tells no motor temperatures; a live arm needs them.")
    readings = Readings(
        time_s=recording.time_s,
        temp_c=recording.temp_c,
        q=recording.q,
        qd=recording.qd,
        tau=recording.tau,
        current_a=recording.current_a,
    )

    def refuse(work: Work) -> tuple[Plan, ...]:
        raise InfeasibleJob(name, work.places[0].name, f"this arm replays the log '{file.name}' and takes no work")

    model, body = Blind(version=f"log {file.name}"), lambda time_s, dt_s: LogBody(readings, time_s=time_s)
    return MadeArm(name=name, model=model, plan=refuse, body=body, takes_work=False)


def refuse_namesake(link: "Link", name: str, *, patience_s: float = NAMESAKE_S) -> None:
    """Wait until no arm of that name is there: two would speak, and take work, with one voice.

    Raises:
        BusError: one is there still.
    """
    from fleet.bus import keys

    gone = threading.Event()

    def heard(_: str, there: bool) -> None:
        (gone.clear if there else gone.set)()

    key = keys.of_arm(link.fleet, name, "alive")
    if not link.there(key, timeout_s=patience_s):
        return
    link.watch(key, heard)
    deadline_s = time.monotonic() + patience_s
    while not gone.is_set() and time.monotonic() < deadline_s:
        link.serve(deadline_s)
    if not gone.is_set():
        raise BusError(
            f"Fleet '{link.fleet}' has an arm '{name}' already: its token is there. Stop that one first, or give this "
            "one another name."
        )


def node_of(
    link: "Link",
    book: "Journal[Promise]",
    made: MadeArm,
    scenario: Scenario,
    *,
    speed: float | None = None,
    rate_hz: float = 10.0,
    capacity: int = 1,
    nonce: str | None = None,
    orders: "Callable[[Worker, int], Orders] | None" = None,
) -> "ArmNode":
    """The arm on an open line, with what its open journal remembers.

    Args:
        nonce: Never the same for two lives; drawn unless given.
        orders: Where its work comes from, for the arm and the number of its life; auctioneers unless given.
    """
    from fleet.live.arm_node import ArmNode, Nature
    from fleet.live.contractor import Contractor, Terms
    from fleet.live.estimate import Estimator, NominalHeat
    from fleet.live.orders import FromAuctioneers

    clock = clock_of(link, speed)
    memory = remembered(book, made.name, clock.now_s(time.monotonic()))
    contractor = Contractor(
        made.name, book.append, memory, nonce=nonce or secrets.token_hex(4), terms=Terms(capacity=capacity)
    )
    places = {place.name: place for place in scenario.places}
    estimator = Estimator(made.model, made.plan, places, NominalHeat())
    estimator.know(made.works)
    nature = Nature(
        warning_c=scenario.limits.warning_c,
        rate_hz=rate_hz,
        life=memory.boot,
        air_c=air_of(scenario),
        works=made.takes_work,
    )
    body = made.body(clock.now_s(time.monotonic()), clock.speed / rate_hz)
    given = FromAuctioneers if orders is None else lambda worker: orders(worker, memory.boot)
    return ArmNode(link, body, contractor, estimator, clock, nature, given)


def remembered(book: "Journal[Promise]", name: str, time_s: float) -> "Memory":
    """What the arm knows at its start, written down anew."""
    from fleet.live.promises import recall, restarted, retold

    before = recall(book.replay())
    for held in before.held.values():
        log.warning("'%s' was in hand when the arm went down; it is given back.", held.award.job.name)
    memory = restarted(before, name, time_s)
    book.rewrite(*retold(memory))
    return memory


def clock_of(link: "Link", speed: float | None) -> "FleetClock":
    """The fleet's time, from the auctioneer if there is one."""
    from fleet.bus import keys
    from fleet.bus.trade import Clock, ClockRequest
    from fleet.live.clock import FleetClock

    asked_s = time.monotonic()
    answers = link.ask_and_wait(keys.of_clock(link.fleet), ClockRequest(), Clock, timeout_s=CLOCK_S)
    answered_s = time.monotonic()
    for said in answers.words.values():
        if speed is not None and speed != said.speed:
            log.warning("The fleet's speed is %g, not %g.", said.speed, speed)
        return FleetClock(said.speed).set_by(asked_s, answered_s, said.time_s)
    return FleetClock(speed or 1.0, answered_s)


def _check(
    source: str, difficulty: str, file: Path | None, speed: float | None, rate_hz: float, capacity: int, seed: int
) -> None:
    if source not in ("sim", "log") or (source == "log") != (file is not None):
        given = f"{source} {file or ''}".strip()
        raise FleetError(f"--source must be sim, or log with a FILE after the arm's name (got {given}).")
    if difficulty not in ("twin", "blind"):
        raise FleetError(f"--difficulty must be twin or blind (got {difficulty}).")
    if speed is not None and not 0 < speed < float("inf"):
        raise FleetError(f"--speed must be > 0 (got {speed:g}).")
    if not 0 < rate_hz <= 100:
        raise FleetError(f"--rate-hz must be > 0 and at most 100 (got {rate_hz:g}).")
    if not 1 <= capacity <= 256:
        raise FleetError(f"--capacity must be 1 to 256 (got {capacity}).")
    if seed < 0:
        raise FleetError(f"--seed must be 0 or more (got {seed}).")


def _check_policy(policy: str, jobs: str, file: Path | None) -> None:
    from scenarios.live_council import among_arms

    if policy and not among_arms(policy):
        raise FleetError(f"'{policy}' takes an auctioneer: thermofleet auction --policy {policy}; arms then need none.")
    if policy and file is not None:
        raise FleetError("An arm that replays a log takes no jobs, so it shares none out: leave --policy out.")
    if jobs not in ("scenario", "none"):
        raise FleetError(f"--jobs must be scenario or none (got {jobs}).")
