"""A scenario in words and tables."""

from itertools import groupby

import numpy as np
from rich.table import Table
from rich.text import Text

from scenarios.build import Progress, ShiftFactory, prepare, quiet
from scenarios.load_factor import LoadFactor, load_factor
from scenarios.scenario import Scenario

SEEDS = 5
"""Shifts over which the load factor is averaged."""


def describe(scenario: Scenario, progress: Progress = quiet) -> list[Table | Text]:
    """Heading, arms, jobs, what is out of reach, and the load. Plans the scenario's work (cached)."""
    fleet = prepare(scenario, difficulty="blind", progress=progress)
    factory = ShiftFactory(fleet)
    factors = [load_factor(factory(np.random.SeedSequence(seed)).world) for seed in range(SEEDS)]
    thermal = float(np.mean([f.thermal for f in factors]))
    time = float(np.mean([f.time for f in factors]))
    air = ", ".join(f"{c:g} °C at {t / 3600:g} h" for t, c in scenario.ambient.points)
    head = (
        f"{scenario.name}: {scenario.description}\n{scenario.horizon_s / 3600:g} h, a decision every "
        f"{scenario.decision_interval_s:g} s, {scenario.slots} slots, air {air}\n"
        f"thermal load factor {thermal:.2f}, time load {time:.2f} (mean of {SEEDS} seeds): {_regime(factors)}"
    )
    refused = [
        f"{arm}: {', '.join(sorted({e.place for e in es}))}" for arm, es in groupby(fleet.infeasible, lambda e: e.arm)
    ]
    tail = Text("Out of reach: " + "; ".join(refused) if refused else "Every arm reaches every place.")
    return [Text(head), _arms(scenario), _jobs(scenario), tail]


def _regime(factors: list[LoadFactor]) -> str:
    words = [f.regime for f in factors]
    return max(set(words), key=words.count)


def _arms(scenario: Scenario) -> Table:
    table = _table("arm", "position, m", "tilt, deg", "home", "cooling", "air, K", "wear")
    for a in scenario.arms:
        where = ", ".join(f"{v:g}" for v in a.position_m)
        tilt = ", ".join(f"{v:g}" for v in a.tilt_deg)
        cooling = a.cooling if a.cooling_factor == 1 else f"{a.cooling} × {a.cooling_factor:g}"
        table.add_row(a.name, where, tilt, a.home, cooling, f"{a.ambient_offset_k:+g}", f"{a.wear:g}")
    return table


def _jobs(scenario: Scenario) -> Table:
    table = _table("jobs", "kind", "places", "payload, kg", "repetitions", "value", "due, min", "arrivals")
    for s in scenario.jobs:
        spec = s.arrivals
        when = {
            "poisson": f"Poisson, every {spec.every_s} s",
            "batch": f"{spec.count} at {spec.start_s:g} s" + (f", every {spec.every_s:g} s" if spec.every_s else ""),
            "trace": f"trace of {len(spec.times_s or ())}",
        }[spec.kind]
        loads = ", ".join(f"{p:g}" for p in s.payload_kg)
        low, high = s.repetitions
        reps = f"{low}" if low == high else f"{low}–{high}"
        table.add_row(s.name, s.kind, " → ".join(s.places), loads, reps, f"{s.value:g}", f"{s.due_s / 60:g}", when)
    return table


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in columns:
        table.add_column(column)
    return table
