"""Time of a decision of every built-in policy, for 16 arms and 50 open jobs with two plans each.

    python -m benchmarks.bench_decisions [--arms 16] [--jobs 50] [--decisions 30] [--policies a,b] [--wall] [--out FILE]

Prints Markdown for docs/policies.md and writes JSON to FILE. The observations are sampled: jobs of 2 to 30 min, values
of 1 to 4 and predicted peaks of 35 to 75 °C. Each arm can do 60 % of them, and half of the arms are free. The time is
CPU time, which other programs on the machine hardly change; with --wall real time, for a policy `bus:NAME`. That of a
policy of scope `arm` is for one free arm; that of `mpc` for the decisions with a search in a shift of 16 arms and 48
slots. For `rolling_horizon` the largest gap that the solver left is added. Exits with an error if a median exceeds its
limit.

The last column is the CPU time of `compare` for a shift of `quickstart`, blind, with --shifts of them side by side
(default 20), without the policies `mpc` and `rolling_horizon`, which take seconds.
"""

import json
import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from agents.auction import Consensus
from agents.planners import Mpc, RollingHorizon
from agents.policy import PlanningPolicy, Shared
from agents.registry import RULES
from agents.rules import Ssi
from benchmarks.harness import options, seconds, write_text
from fleet.env.lookahead import Lookahead
from fleet.observation import BIDS, Layout, Observation
from scenarios.evaluate.hindsight import ShiftSimulator
from scenarios.evaluate.rollout import outcomes
from scenarios.policy_loader import policy_at, scope_of
from scenarios.prepare.fleet import Fleet, ShiftFactory, prepare, simulator_of_shift
from scenarios.spec.jobs import weights_of
from scenarios.spec.load import load
from scenarios.suite.splits import instance

PLANS = 2
WARNING_C = 60.0
RULE_MS, MATCHING_MS, HORIZON_MS = 1.0, 5.0, 1000.0
"""Largest median of a rule, of a matching, an auction or a policy that calls one, and of a plan of the next minutes."""
SHIFT = "validation/0005"
"""Shift of 16 arms and 48 slots in which a policy plans that needs a simulator of its cell."""


def limit_ms(name: str) -> float:
    """The largest median of a policy."""
    kind = RULES[name].kind if name in RULES else None
    if kind is None or issubclass(kind, RollingHorizon | PlanningPolicy):
        return HORIZON_MS
    return MATCHING_MS if issubclass(kind, Ssi | Consensus | Shared) else RULE_MS


def draw(rng: np.random.Generator, arms: int, jobs: int) -> dict[str, Observation]:
    """What the arms of a fleet know at one moment."""
    layout, options = Layout(arms, jobs, plans=PLANS, bids=True), jobs * PLANS
    age_s, due_s = np.sort(rng.uniform(0, 1800, jobs))[::-1], rng.uniform(-600, 3600, jobs)
    value, payload_kg, station = rng.integers(1, 5, jobs), rng.uniform(0, 4, jobs), rng.random(jobs) < 0.7
    difficulty = rng.uniform(0, 3, (arms, options))
    free = np.arange(arms) % 2 == 0
    headroom_k, busy_s = rng.uniform(0, 35, arms), np.where(free, 0.0, rng.uniform(0, 1200, arms))
    shared = {
        "fleet_working": ~free, "fleet_headroom_k": headroom_k, "fleet_busy_s": busy_s,
        "fleet_difficulty": difficulty.reshape(arms, jobs, PLANS).min(axis=2), "left_s": 3600.0,
        "group": np.arange(1, jobs + 1), "station_free": station, "due_in_s": due_s, "age_s": age_s,
        "payload_kg": payload_kg, "value": value,
    }  # fmt: skip
    seen = {}
    for arm in range(arms):
        feasible = np.repeat(rng.random(jobs) < 0.6, PLANS)
        space = feasible & (rng.random(options) < 0.8) & free[arm]
        duration_s = np.sort(rng.uniform(120, 1800, (jobs, PLANS)), axis=1).ravel()
        legal = space & np.repeat(station, PLANS)
        temp_c = WARNING_C - headroom_k[arm] - np.append(0.0, rng.uniform(0, 10, 6))
        known = {
            "working": float(not free[arm]), "busy_s": busy_s[arm], "temp_c": temp_c,
            "housing_c": temp_c - 3.0, "ambient_c": 25.0, "headroom_k": headroom_k[arm],
            "error_headroom_k": headroom_k[arm] + 15.0, "difficulty": difficulty[arm] * feasible,
            "peak_c": rng.uniform(35, 75, options), "p_saturation": rng.uniform(0, 0.8, options),
            "duration_s": duration_s * feasible, "blocked": (feasible & ~space)[::PLANS],
        }  # fmt: skip
        mask = np.pad(legal, 1, constant_values=(1, 0)).astype(np.int8)
        blank = layout.read(np.zeros(layout.size, np.float32), mask)
        fields = {name: np.asarray(each, np.float32) for name, each in (shared | known).items()}
        seen[f"arm_{arm}"] = replace(blank, peers=layout.peers[arm], **fields)
    bids = {name: np.stack([getattr(each, own) for each in seen.values()]) for name, own in BIDS.items()}
    return {arm: replace(each, **bids) for arm, each in seen.items()}


def measure(name: str, moments: list[dict[str, Observation]], clock: Callable[[], float]) -> dict[str, float | str]:
    """Median and largest time of a decision by a clock, in ms, and the largest gap of the solver."""
    policy, times_ms, gaps = policy_at(name, 0), [], []
    policy.act(moments[0])  # imports
    for seen in moments:
        times_ms.append(1e3 * seconds(partial(policy.act, seen), clock))
        if isinstance(policy, RollingHorizon) and policy.solution:
            gaps.append(policy.solution.gap)
    arms = len(moments[0]) / 2 if scope_of(name) == "arm" else 1  # those that are free
    row = {"policy": name, "scope": scope_of(name), "median_ms": statistics.median(times_ms) / arms}
    return row | {"largest_ms": max(times_ms) / arms} | ({"largest_gap": max(gaps)} if gaps else {})


class _Timed:
    """A policy that plans, with the times of its decisions."""

    scope: ClassVar = "central"
    only_choices = True

    def __init__(self, policy: Mpc, clock: Callable[[], float]) -> None:
        self._policy, self._clock, self.times_ms = policy, clock, list[float]()

    def plan_in(self, cell: Lookahead) -> None:
        """Let the policy plan."""
        self._policy.plan_in(cell)

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Its decision; the time of one without a search does not count."""
        began_s, searched_s = self._clock(), self._policy.searched_s
        actions = self._policy.act(observations)
        if self._policy.searched_s > searched_s:
            self.times_ms.append((self._clock() - began_s) * 1e3)
        return actions


def measure_planner(name: str, clock: Callable[[], float]) -> dict[str, float | str]:
    """Median and largest time of a decision with a search, in ms, in `SHIFT`."""
    shift, policy = instance(SHIFT), policy_at(name, 0)
    assert isinstance(policy, Mpc)
    fleet = prepare(shift.scenario, difficulty="oracle")
    world = ShiftFactory(fleet)(np.random.SeedSequence(shift.seed)).world
    timed = _Timed(policy, clock)
    simulator = partial(simulator_of_shift, fleet, shift.seed)
    ShiftSimulator(world, weights_of(shift.scenario), 1, simulator=simulator).follow([timed])
    median_ms = statistics.median(timed.times_ms)
    return {"policy": name, "scope": "central", "median_ms": median_ms, "largest_ms": max(timed.times_ms)}


def measure_shift(name: str, fleet: Fleet, shifts: int, clock: Callable[[], float]) -> float:
    """Time of a shift of a fleet, ms, the least of two measurements."""
    outcomes(fleet, name, range(2))  # imports
    return min(1e3 * seconds(partial(outcomes, fleet, name, range(shifts)), clock) / shifts for _ in range(2))


def main() -> None:
    """Print the table."""
    given = options(__doc__, arms=16, jobs=50, decisions=30, shifts=20, policies=",".join(RULES), wall=False, out=Path)
    rng = np.random.default_rng(0)
    moments = [draw(rng, given.arms, given.jobs) for _ in range(given.decisions)]
    clock = time.perf_counter if given.wall else time.process_time
    names = given.policies.split(",")
    plans = {name: name in RULES and RULES[name].plans for name in names}
    measured = {  # planners last: the next policy measured would pay for the memory that they leave
        name: measure_planner(name, clock) if plans[name] else measure(name, moments, clock)
        for name in sorted(names, key=plans.__getitem__)
    }
    rows = [measured[name] for name in names]
    fleet = prepare(load("quickstart"), difficulty="blind")
    for row in rows:
        if limit_ms(str(row["policy"])) < HORIZON_MS:
            row["shift_ms"] = measure_shift(str(row["policy"]), fleet, given.shifts, clock)
    print("| policy | scope | median ms | largest ms | ms a shift |\n|---|---|---|---|---|")
    for row in rows:
        times = f"{row['median_ms']:.2f} | {row['largest_ms']:.2f} | {row.get('shift_ms', math.nan):.1f}"
        print(f"| `{row['policy']}` | {row['scope']} | {times} |".replace("nan", ""))
    for row in rows:
        if "largest_gap" in row:
            print(f"\n`{row['policy']}`: largest gap {row['largest_gap']:.1%}")
    slow = [str(row["policy"]) for row in rows if float(row["median_ms"]) > limit_ms(str(row["policy"]))]
    if given.out:
        sizes = {"arms": given.arms, "jobs": given.jobs, "decisions": given.decisions}
        write_text(given.out, json.dumps(sizes | {"rows": rows}, indent=1) + "\n")
    if slow:
        raise SystemExit(f"Slower than allowed: {', '.join(slow)}.")


if __name__ == "__main__":
    main()
