"""Layout of a cell (reach, tasks that exclude each other, arms at work at once), and a scenario in words and tables."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from itertools import combinations
from typing import TypeVar

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array

from fleet.arm.kinematics import REACH_M, SHOULDER_M
from fleet.arm.space import SpaceTable
from fleet.engine.world import warm_start
from fleet.files import cache_folder
from fleet.heat.thermal import WINDING
from fleet.job import Place, Work
from fleet.motion import Plan
from fleet.robot import Robot
from scenarios.prepare.arms import PlannedArm, air_offsets, plan_arms
from scenarios.prepare.fleet import Fleet, ShiftFactory, cell_problems, prepare, space_of
from scenarios.prepare.load_factor import LoadFactor, load_factor
from scenarios.progress import Progress, quiet
from scenarios.show.words import clock, duration, names_text
from scenarios.spec.calendar import begin_of, date_at, moment_text
from scenarios.spec.jobs import all_works, alternatives_of, fault_price, works_of
from scenarios.spec.schema import ArmSpec, JobStream, Scenario
from scenarios.table import Table

Array = np.ndarray
T = TypeVar("T")
SEARCH_S = 20.0
"""Time limit of the search for the most arms at work at once."""
MOST_ROWS = 12
"""Rows that a table shows, and sentences of one kind."""


@dataclass(frozen=True, kw_only=True)
class Reach:
    """What one arm can do at one place."""

    arm: str
    place: str
    payload_kg: float | None
    """Heaviest payload of the scenario's jobs at this place that the arm can carry; None if it can do none."""
    lacks_m: float | None
    """Distance of the place beyond the outstretched arm; 0 within it. None if the arm can do no job there though the
    place is within it, for example because its wrist would be too far away; see `reason`."""
    reason: str = ""
    """Why it cannot do some of them."""


@dataclass(frozen=True, kw_only=True)
class Exclusion:
    """How much the jobs of two streams exclude each other when two arms do them."""

    jobs: tuple[str, str]
    """Names of the streams."""
    arms: tuple[str, str]
    share: float
    """Share of the pairs of plans that come too close to each other."""
    same_place: bool
    """Whether both need one station, which one arm at a time may use."""


@dataclass(frozen=True, kw_only=True)
class ArmTask:
    """The task of one arm in a set of tasks that can be done at the same time."""

    arm: str
    job: str
    places: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class LayoutReport:
    """What `thermofleet layout` shows."""

    scenario: str
    clearance_m: float
    reach: tuple[Reach, ...]
    exclusions: tuple[Exclusion, ...]
    excluded_share: float
    """Share of the pairs of plans of two arms that exclude each other."""
    at_once: tuple[ArmTask, ...]
    """A largest set of tasks that different arms can do at the same time, each at its own stations."""
    largest: bool
    """Whether no larger set exists; False if the search ended at its time limit."""
    problems: tuple[str, ...]


def layout_report(scenario: Scenario, progress: Progress = quiet) -> LayoutReport:
    """The layout of a scenario's cell. Plans the scenario's work (cached); problems are part of the result."""
    folder = cache_folder()
    works = all_works(scenario)
    arms = plan_arms(scenario, range(len(scenario.arms)), works, folder, progress)
    problems = cell_problems(scenario, arms, folder)
    plans = [plan for arm in arms for plan in arm.all_plans]
    space = space_of(scenario, [arm.hardware.robot for arm in arms], plans, folder, progress)
    exclusions = _exclusions(scenario, plans, space)
    at_once, largest = _most_at_once(scenario, plans, space)
    volumes, conflicts = space.rows(plans)
    of_arm = np.array([plan.arm for plan in plans])
    close = conflicts[np.ix_(volumes, volumes)][np.triu(of_arm[:, None] != of_arm)]
    return LayoutReport(
        scenario=scenario.name,
        clearance_m=scenario.clearance_m,
        reach=tuple(each for place in scenario.places for each in _reach(place, arms, works)),
        exclusions=exclusions,
        excluded_share=float(close.mean()) if close.size else 0.0,
        at_once=at_once,
        largest=largest,
        problems=tuple(problems),
    )


def layout_parts(scenario: Scenario, report: LayoutReport) -> list[Table | str]:
    """Reach, reasons and exclusions; and the most arms at work at once, in a sentence."""
    able = {place.name: list[str]() for place in scenario.places}
    for entry in report.reach:
        if entry.payload_kg is not None:
            able[entry.place].append(f"{entry.arm} {entry.payload_kg:g} kg")
    places, notes = _first(
        [(place, names_text(able[place]) or "none") for place in sorted(able, key=lambda place: bool(able[place]))]
    )
    reach = Table(
        caption=f"{scenario.name}: arms that can do jobs at a place, each with the heaviest payload of these jobs",
        head=("place", "arms"),
        rows=places,
        numbers=False,
        notes=notes,
    )
    near = sorted(report.reach, key=lambda entry: entry.lacks_m or 0.0)
    cannot, notes = _first([(f"{entry.arm} at {entry.place}", entry.reason) for entry in near if entry.reason])
    reasons = Table(head=("cannot do", "reason"), rows=cannot, numbers=False, notes=notes)
    shared = [pair for pair in report.exclusions if not pair.same_place]
    always = sum(pair.share == 1 for pair in shared)
    rows, notes = _first(
        [
            (*(f"{job}, {arm}" for job, arm in zip(pair.jobs, pair.arms, strict=True)), f"{pair.share:.0%}")
            for pair in shared
        ]
    )
    pairs = Table(
        caption=f"{report.excluded_share:.0%} of the pairs of plans of two arms come closer than "
        f"{report.clearance_m * 1e3:g} mm and exclude each other. Pairs of jobs at different "
        f"stations: {always} exclude each other always, {len(shared) - always} for some plans{':' if shared else '.'}",
        head=("job", "excludes", "share of plans") if shared else ("", "", ""),
        rows=rows,
        numbers=False,
        notes=notes,
    )
    most = names_text([f"{task.arm} {task.job}" for task in report.at_once])
    sentence = (
        f"{'At most' if report.largest else 'At least'} {len(report.at_once)} of {len(scenario.arms)} arms can work "
        f"at once{most and f', for example {most}'}."
        + ("" if report.largest else f" The search for more ended after {SEARCH_S:g} s.")
    )
    return [reach, reasons, pairs, sentence]


def _first(rows: Sequence[T], complete: str = "--json") -> tuple[tuple[T, ...], tuple[str, ...]]:
    """The first rows, and a sentence with the number of the others, if any, and with the option that prints all."""
    others = len(rows) - MOST_ROWS
    return tuple(rows[:MOST_ROWS]), (f"… and {others} more; {complete} has all.",) if others > 0 else ()


def _reach(place: Place, arms: Sequence[PlannedArm], works: Sequence[Work]) -> Iterator[Reach]:
    """What each arm can do at a place."""
    works_there = [work for work in works if place.name in work.stations]
    for arm in arms:
        robot = arm.hardware.robot
        able_kg = [work.payload_kg for work in works_there if work in arm.plans]
        reasons = dict.fromkeys(error.reason for error in arm.infeasible if error.place == place.name)
        far_m = float(np.linalg.norm(np.subtract(place.position_m, shoulder_m(robot))))
        beyond_m = max(0.0, far_m - REACH_M)
        yield Reach(
            arm=robot.name,
            place=place.name,
            payload_kg=max(able_kg, default=None),
            lacks_m=None if reasons and not able_kg and not beyond_m else beyond_m,
            reason="; ".join(reasons),
        )


def shoulder_m(robot: Robot) -> Array:
    """Position of an arm's joint 2, the centre of its reach, m, [3]."""
    return np.array(robot.mount.position_m) + SHOULDER_M * robot.mount.rotation()[:, 2]


def _streams(scenario: Scenario, plans: Sequence[Plan]) -> list[str]:
    """Name of the first stream that each plan serves."""
    streams = {work: s.name for s in reversed(scenario.jobs) for work in works_of(scenario, s)}
    return [streams[plan.work] for plan in plans]


def _exclusions(scenario: Scenario, plans: Sequence[Plan], space: SpaceTable) -> tuple[Exclusion, ...]:
    """Every two streams of two arms with plans that exclude each other, the most excluding first."""
    volumes, conflicts = space.rows(plans)
    groups: dict[tuple[str, str], list[int]] = {}
    for row, (plan, stream) in enumerate(zip(plans, _streams(scenario, plans), strict=True)):
        groups.setdefault((plan.arm, stream), []).append(row)
    exclusions = []
    for (one, rows), (other, others) in combinations(groups.items(), 2):
        share = float(conflicts[np.ix_(volumes[rows], volumes[others])].mean())
        if one[0] == other[0] or not share:
            continue
        same = not set(plans[rows[0]].work.stations).isdisjoint(plans[others[0]].work.stations)
        exclusions.append(Exclusion(jobs=(one[1], other[1]), arms=(one[0], other[0]), share=share, same_place=same))
    return tuple(sorted(exclusions, key=lambda pair: (-pair.share, pair.same_place, pair.jobs, pair.arms)))


def _most_at_once(scenario: Scenario, plans: Sequence[Plan], space: SpaceTable) -> tuple[tuple[ArmTask, ...], bool]:
    """Volumes without conflicts and with different stations, and whether no set is larger; an integer program."""
    volumes, conflicts = space.rows(plans)
    used, first = np.unique(volumes, return_index=True)
    if not len(used):
        return (), True
    stations = [plans[row].work.stations for row in first]
    rows = []  # groups of volumes of which at most one is chosen
    arms = np.array([plans[row].arm for row in first])
    for arm in dict.fromkeys(arms.tolist()):
        rows.append(np.flatnonzero(arms == arm))
    for station in dict.fromkeys(name for own in stations for name in own):
        rows.append(np.flatnonzero([station in own for own in stations]))
    rows += list(np.argwhere(np.triu(conflicts[np.ix_(used, used)] & (arms[:, None] != arms))))
    columns = np.concatenate(rows)
    lengths = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
    matrix = csr_array((np.ones(len(columns)), (lengths, columns)), shape=(len(rows), len(used)))
    result = milp(
        -np.ones(len(used)),
        integrality=np.ones(len(used)),
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(matrix, ub=1.0),
        options={"time_limit": SEARCH_S},
    )
    chosen = [] if result.x is None else first[result.x > 0.5].tolist()
    streams = _streams(scenario, plans)
    tasks = (ArmTask(arm=plans[i].arm, job=streams[i], places=plans[i].work.stations) for i in chosen)
    return tuple(tasks), result.status == 0


SEEDS = 5
"""Shifts over which the load factor is averaged."""
REGIMES = {
    "hopeless": "The shift is hopeless: by its averages, the fleet cannot do all jobs in time below the warning limit",
    "heat decides": "Heat decides: by averages over the shift, motors are clearly cooler with the best assignment than "
    "with an equal split",
    "time decides": "Time decides: by averages over the shift, the arms are busy, and an equal split heats motors "
    "little, or like the best assignment",
    "nothing decides": "Nothing decides: by averages over the shift, the arms have time, and an equal split heats "
    "motors little, or like the best assignment",
}
"""Sentences of the regimes of `LoadFactor`."""
MOST_TIMES = 4
"""Times of a trace in a description."""


def describe(scenario: Scenario, progress: Progress = quiet) -> list[Table | str]:
    """Heading, arms, jobs, the load, and what single arms cannot do. Plans the scenario's work (cached)."""
    fleet = prepare(scenario, difficulty="blind", progress=progress)
    factory = ShiftFactory(fleet)
    factors = [load_factor(factory(np.random.SeedSequence(seed)).world) for seed in range(SEEDS)]
    load = LoadFactor(*np.mean([astuple(f) for f in factors], axis=0).tolist())
    points = [f"{c:g} °C at {t / 3600:g} h" for t, c in scenario.ambient.points]
    ambient = ", ".join(points) if len(points) > 1 else f"{scenario.ambient.at(np.zeros(1))[0]:g} °C"
    people = scenario.people
    able = f"{load.able:.0%} of the arms can do a job (mean over the jobs)"
    if not load.able:  # every job that arrives is for some arm
        able = f"No job arrives in the shifts of {SEEDS} seeds: compare the arrivals of the jobs with horizon_s"
    head = (
        f"{scenario.name}: {scenario.description}\n{scenario.horizon_s / 3600:g} h, a decision every "
        f"{scenario.decision_interval_s:g} s, {scenario.slots} slots, ambient {ambient}\n"
        f"{REGIMES[load.regime]}\nthermal load factor "
        f"{load.thermal:.2f} for the best assignment that the arms have time for, {load.blind:.2f} for an equal split; "
        f"time load {load.time:.2f} (mean of {SEEDS} seeds; 1 is what the fleet can do)\n"
        f"{able}\n"
        f"{_fault_cost(scenario)}\n"
        f"people touch an arm for up to {people.contact_s:g} s: a surface of {people.burn_c:g} °C or more burns"
    )
    nobody = [
        f"No arm can do '{stream.name}' at {' → '.join(names)}; its other places serve."
        for stream in scenario.jobs
        for works, names in zip(
            zip(*(alternatives_of(scenario, stream, kg) for kg in stream.payload_kg), strict=True),
            stream.alternatives,
            strict=True,
        )
        if not any(work in arm.plans for work in works for arm in fleet.arms)
    ]
    refused, notes = _first([*nobody, *dict.fromkeys(map(str, fleet.infeasible))], "thermofleet layout --json")
    tail = [*refused, *notes, *_limits_passed_idle(fleet)]
    if not refused:
        tail.insert(0, "Every arm can do every job.")
    return ["\n".join([head, *_absences(scenario)]), _arms(scenario), _jobs(scenario), "\n".join(tail)]


def _limits_passed_idle(fleet: Fleet) -> Iterator[str]:
    """A sentence for each limit that motors pass at home without work, when the cell is at its warmest."""
    scenario, hottest = fleet.scenario, dict[str, float]()
    horizon_s = scenario.horizon_s
    times_s = np.clip([0.0, horizon_s, *(time_s for time_s, _ in scenario.ambient.points)], 0.0, horizon_s)
    ambient_c = float(scenario.ambient.at(times_s).max())
    for arm, offset_k in zip(fleet.arms, air_offsets(scenario), strict=True):
        with suppress(ValueError):  # no steady state
            hottest[arm.robot.name] = float(warm_start(arm, ambient_c + float(offset_k))[WINDING].max())
    limits = scenario.limits
    for name, low_c, high_c in (("warning", limits.warning_c, limits.error_c), ("error", limits.error_c, np.inf)):
        if passed := [arm for arm, motor_c in hottest.items() if low_c <= motor_c < high_c]:
            yield (
                f"Without work, motors of {names_text(passed)} are above the {name} limit of {low_c:g} °C at "
                f"{ambient_c:g} °C ambient temperature: up to {max(hottest[arm] for arm in passed):.1f} °C."
            )


def _fault_cost(scenario: Scenario) -> str:
    of = fault_price(scenario)
    hourly, minutes = 3600.0 * of.value_per_s, of.downtime_s / 60.0
    factors = f"jobs worth {hourly:.1f} arrive per hour, times {minutes:.0f} min until the arm works again"
    if scenario.reward.faults is None:
        return f"a fault costs {of.price:.1f}: {factors}"
    return f"a fault costs {-scenario.reward.faults:g} (reward.faults); its price would be {of.price:.1f}: {factors}"


def _arms(scenario: Scenario) -> Table:
    """One row per arm; columns with default values only are left out."""
    usual = ArmSpec(name="usual")
    columns: list[tuple[str, Callable[[ArmSpec], str]]] = [
        ("home", lambda a: a.home),
        ("tool, kg", lambda a: f"{a.tool_kg:g}"),
        ("payload limit, kg", lambda a: "–" if a.payload_limit_kg is None else f"{a.payload_limit_kg:g}"),
        ("cooling", lambda a: a.cooling if a.cooling_factor == 1 else f"{a.cooling} × {a.cooling_factor:g}"),
        ("ambient, K", lambda a: f"{a.ambient_offset_k:+g}"),
        ("wear", lambda a: f"{a.wear:g}"),
    ]
    shown = [(name, text) for name, text in columns if any(text(a) != text(usual) for a in scenario.arms)]
    rows, notes = _first(
        [
            (
                a.name,
                ", ".join(f"{v:g}" for v in a.position_m),
                ", ".join(f"{v:g}" for v in a.tilt_deg),
                *(text(a) for _, text in shown),
            )
            for a in scenario.arms
        ]
    )
    head = ("arms", "position, m", "tilt, deg", *(name for name, _ in shown))
    return Table(head=head, rows=rows, numbers=False, notes=notes)


def _jobs(scenario: Scenario) -> Table:
    """One row per stream, then one per row of job tables, as sentences that fit any terminal."""
    streams, notes = _first(sorted(scenario.jobs, key=lambda stream: bool(stream.row)))
    rows = tuple((s.name, f"{_work(s)}\nworth {s.value:g}, {_due(s)}; {_arrivals(scenario, s)}") for s in streams)
    return Table(head=("jobs", ""), rows=rows, numbers=False, notes=notes)


def _due(stream: JobStream) -> str:
    return f"{'expires' if stream.due == 'hard' else 'due'} after {duration(stream.due_s)}"


def _work(stream: JobStream) -> str:
    loads = " or ".join(f"{p:g}" for p in stream.payload_kg)
    low, high = stream.repetitions
    times = f"{low}" if low == high else f"{low}–{high}"
    where = " or ".join(" → ".join(names) for names in stream.alternatives)
    match stream.kind:
        case "hold":
            return f"hold {loads} kg at {where}, {times} × {stream.dwell_s:g} s"
        case "press":
            held = f" and {loads} kg" if any(stream.payload_kg) else ""
            return f"press {where} with {stream.force_n:g} N{held}, {times} × {stream.dwell_s:g} s"
        case "pick_place" | "sort":
            return f"{stream.kind} {where}, {loads} kg, {times} times"


def _moment(scenario: Scenario, time_s: float) -> str:
    """A time of the shift; as a date where its begin is one."""
    if scenario.shift_begin is None:
        return clock(time_s)
    return moment_text(date_at(begin_of(scenario.shift_begin, scenario.time_zone), time_s), "%a %d %b %H:%M")


def _absences(scenario: Scenario) -> list[str]:
    """Breaks and failures, a sentence each."""
    breaks, more_breaks = _first(scenario.breaks)
    failing, more_failing = _first([(arm.name, arm.fails) for arm in scenario.arms if arm.fails is not None])
    return [
        *(
            f"break '{each.name}' of {names_text(each.arms) or 'all arms'}: "
            f"{_moment(scenario, max(each.begin_s, 0.0))} to {_moment(scenario, each.end_s)}, "
            f"after the present {each.finish}"
            for each in breaks
        ),
        *more_breaks,
        *(
            f"{arm} fails every {duration(fails.every_s)} of work and is repaired in "
            f"{duration(fails.repair_s)}, both at random"
            for arm, fails in failing
        ),
        *more_failing,
    ]


def _arrivals(scenario: Scenario, stream: JobStream) -> str:
    spec = stream.arrivals
    after = f", after {', '.join(stream.after)}" if stream.after else ""
    match spec.kind:
        case "poisson":
            first = f" from {spec.start_s:g} s" if spec.start_s else ""
            last = f" until {spec.stop_s:g} s" if spec.stop_s is not None else ""
            return f"Poisson, one every {spec.every_s:g} s{first}{last}{after}"
        case "batch":
            again = f", again every {spec.every_s:g} s" if spec.every_s else ""
            return f"{spec.count} at {spec.start_s:g} s{again}{after}"
        case "trace":
            times_s = spec.times_s or ()
            if not stream.numbered:
                return f"one at {_moment(scenario, sum(times_s))}{after}"
            first = ", ".join(_moment(scenario, time_s) for time_s in times_s[:MOST_TIMES])
            return f"{len(times_s)} at {first}{', …' if len(times_s) > MOST_TIMES else ''}{after}"
