"""Describe a scenario in sentences and tables."""

from collections.abc import Callable
from dataclasses import astuple

import numpy as np

from scenarios.fault_price import fault_price
from scenarios.prepare.fleet import ShiftFactory, prepare
from scenarios.prepare.load_factor import load_factor
from scenarios.progress import Progress, quiet
from scenarios.schema import ArmSpec, JobStream, Scenario
from scenarios.show.table import Table

SEEDS = 5
"""Shifts over which the load factor is averaged."""
MOST_REASONS = 20
"""Reasons that are shown why an arm cannot do a job."""


def describe(scenario: Scenario, progress: Progress = quiet) -> list[Table | str]:
    """Heading, arms, jobs, the load, and what single arms cannot do. Plans the scenario's work (cached)."""
    fleet = prepare(scenario, difficulty="blind", progress=progress)
    factory = ShiftFactory(fleet)
    factors = [load_factor(factory(np.random.SeedSequence(seed)).world) for seed in range(SEEDS)]
    thermal, blind, time = np.mean([astuple(f) for f in factors], axis=0)
    regimes = [f.regime for f in factors]
    points = [f"{c:g} °C at {t / 3600:g} h" for t, c in scenario.ambient.points]
    ambient = ", ".join(points) if len(points) > 1 else f"{scenario.ambient.at(np.zeros(1))[0]:g} °C"
    people = scenario.people
    head = (
        f"{scenario.name}: {scenario.description}\n{scenario.horizon_s / 3600:g} h, a decision every "
        f"{scenario.decision_interval_s:g} s, {scenario.slots} slots, ambient {ambient}\n"
        f"thermal load factor {thermal:.2f} for the best assignment, {blind:.2f} for an equal split, "
        f"time load {time:.2f} (mean of {SEEDS} seeds): {max(set(regimes), key=regimes.count)}\n"
        f"{_fault_cost(scenario)}\n"
        f"people touch an arm for up to {people.contact_s:g} s: surfaces burn from {people.burn_c:g} °C"
    )
    refused = list(dict.fromkeys(map(str, fleet.infeasible)))
    more = [f"… and {len(refused) - MOST_REASONS} more."] if len(refused) > MOST_REASONS else []
    tail = "\n".join([*refused[:MOST_REASONS], *more]) or "Every arm can do every job."
    return [head, _arms(scenario), _jobs(scenario), tail]


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
    rows = tuple(
        (
            a.name,
            ", ".join(f"{v:g}" for v in a.position_m),
            ", ".join(f"{v:g}" for v in a.tilt_deg),
            *(text(a) for _, text in shown),
        )
        for a in scenario.arms
    )
    head = ("arms", "position, m", "tilt, deg", *(name for name, _ in shown))
    return Table(head=head, rows=rows, numbers=False)


def _jobs(scenario: Scenario) -> Table:
    """One row per stream, as sentences that fit any terminal."""
    rows = tuple(
        (s.name, f"{_work(s)}\nworth {s.value:g}, due after {s.due_s / 60:g} min; {_arrivals(s)}")
        for s in scenario.jobs
    )
    return Table(head=("jobs", ""), rows=rows, numbers=False)


def _work(stream: JobStream) -> str:
    loads = " or ".join(f"{p:g}" for p in stream.payload_kg)
    low, high = stream.repetitions
    times = f"{low}" if low == high else f"{low}–{high}"
    where = " → ".join(stream.places)
    match stream.kind:
        case "hold":
            return f"hold {loads} kg at {where}, {times} × {stream.dwell_s:g} s"
        case "press":
            held = f" and {loads} kg" if any(stream.payload_kg) else ""
            return f"press {where} with {stream.force_n:g} N{held}, {times} × {stream.dwell_s:g} s"
        case "pick_place" | "sort":
            return f"{stream.kind} {where}, {loads} kg, {times} times"


def _arrivals(stream: JobStream) -> str:
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
            return f"a trace of {len(spec.times_s or ())}{after}"
