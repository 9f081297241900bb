"""Which signal notices a surprise first, at a rate of false alarms of 1 % of arm-shifts.

    python -m benchmarks.alarms [--out docs/results/alarms.jsonl]

Arms of the test split with twins work under `wsept` at level `hot`, with and without surprises of the suite, and
correct nothing. Each arm measures joint torque and motor current in the first `WATCHED_S` of the first cycle of every
job, both with noise of `NOISE` of the rated torque, and motor temperatures all the time. The true mass of every load
deviates from the declared one by `TOLERANCE`, without a surprise as well; this changes the measured torques, not the
simulated temperatures. What an arm measures from its first fault on does not count. Arm-shifts are kept in
runs/alarms.jsonl, and the command continues there. It takes ten minutes of a core, once the twins are prepared.
"""

from argparse import ArgumentParser
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import get_args

import numpy as np
from rich.console import Console

from benchmarks.freeze_suite import surprises_in
from benchmarks.paper.harness import WIDEST, KeyedRows, Unit, compute, matching, mean_share, number, plain, table_of
from fleet.arm.model import ArmModel
from fleet.engine.shift import StepRecord, stack_records
from fleet.engine.world import Arm, World
from fleet.files import cache_folder
from fleet.heat.motor import friction_torque, reference_current
from fleet.heat.thermal import HOUSING, NODES, WINDING, temperature_steps
from fleet.motion import RATE_HZ, Drive, Phase, Plan, drives
from fleet.robot import GEN3, Robot
from scenarios.evaluate.statistics import Interval
from scenarios.json_rows import Row, Rows
from scenarios.policy_loader import OnBus, policy_at
from scenarios.prepare.fleet import Fleet, ShiftFactory, env_of, prepare, with_surprises
from scenarios.prepare.surprise import phase_with_load
from scenarios.prepare.twins import train_twins
from scenarios.progress import quiet
from scenarios.spec.schema import Scenario, SurpriseKind
from scenarios.suite.instances import CELLS, Axes, SuiteCell, Surprising, scenario_of
from scenarios.table import Table
from twin.baselines import untrained_config
from twin.thermal.thermal_twin import CalibratedTwin
from twin.vae.config import TwinConfig
from twin.vae.measures import TAU, Features, fewest
from twin.vae.twin import Twin

Array = np.ndarray

WATCHED_S = 30.0
NOISE = 0.01
"""Standard deviation of a sample of measured torque, and of current times torque constant, over the rated torque."""
TOLERANCE = 0.03
"""Standard deviation of the true mass of a job's load over the declared one."""
MINUTE_S = 60.0
"""Time over which temperatures are averaged."""
FALSE_ALARMS = 0.01
MOST_ARMS = 6
POLICY = "wsept"
SCALING, LIMIT, CHECK = "scaling", "limit", "check"
QUIET, SURPRISED = {SCALING: 20, LIMIT: 40, CHECK: 40}, 12
"""Shifts of a cell without surprise by what they are for, and with each kind of surprise."""
NOTHING: Surprising = "nothing"
KINDS: tuple[Surprising, ...] = get_args(SurpriseKind)
TEMPERATURE, BY_PLAN = "temperature", " by plan"
SIGNALS = {
    "d": "d of the measured motion, Σ over joints",
    "d_above": "d measured − d planned",
    "d_weighted": "d measured − d planned, weighted by w_k",
    "d_untrained": "d measured − d planned, untrained",
    "error": "error e measured − planned",
    "error_untrained": "error e measured − planned, untrained",
    "torque": "torque residual",
    "heat": "heat ratio",
    "rms": "RMS torque over that of training",
    TEMPERATURE: "temperature residual",
    f"d{BY_PLAN}": "d, less the plan's usual",
    f"torque{BY_PLAN}": "torque residual, less the plan's usual",
    f"heat{BY_PLAN}": "heat ratio, less the plan's usual",
    f"rms{BY_PLAN}": "RMS torque, less the plan's usual",
}
"""error: e = −ln(1 − d_k), Σ over joints. torque: RMS of measured minus planned torque over rated torque, worst joint.
heat: heat by current and torque over that of the plan, less 1. temperature: measured minus the open-loop prediction of
the identified network for the planned work, largest absolute value; the network knows the ambient temperature. With
`BY_PLAN`: less its median for the same plan in quiet shifts."""
OUT, SHIFTS = Path("docs/results/alarms.jsonl"), Path("runs/alarms.jsonl")
RATED_NM = np.array(GEN3.torque_warning)


@dataclass(frozen=True, eq=False)
class Measured:
    """The beginning of a job's first cycle as the arm measures it."""

    planned: Plan
    by_current: Plan
    """With the joint torque that the current stands for, less the friction that the arm knows; so it holds friction
    that has grown since."""
    drive: Drive
    """By current and measured joint torque."""


@lru_cache(maxsize=1024)
def first_cycle(plan: Plan, robot: Robot) -> tuple[Plan, Array]:
    """The first `WATCHED_S` of a plan's cycle, and the torque of its load, N·m, [time, joint]."""

    def part(phase: Phase, seconds: float) -> Phase:
        count = int(seconds * RATE_HZ)
        return Phase(phase.profile[:count], phase.payload_kg[:count])

    cycle = part(plan.cycle, WATCHED_S)
    more = phase_with_load(ArmModel(robot), cycle, 2.0).profile[:, TAU] - cycle.profile[:, TAU]
    return replace(plan, approach=part(plan.approach, 0.0), cycle=cycle, retreat=part(plan.retreat, 0.0)), more


def measure(arm: Arm, planned: Plan, more_nm: Array, rng: np.random.Generator, noise: float = NOISE) -> Measured:
    """What an arm measures of a cycle.

    Args:
        more_nm: Torque of the load beyond the declared one, [time, joint].
        noise: See `NOISE`.
    """
    _, qd, tau = planned.cycle.profile.astype(float).transpose(1, 0, 2)
    known = arm.beliefs[1]
    sensed_nm, noise_nm = noise * RATED_NM * rng.standard_normal((2, *tau.shape))
    sensed_nm += tau + more_nm
    amps = reference_current(tau + more_nm, qd, arm.motors) + noise_nm / known.torque_per_amp
    motor_nm = amps * known.torque_per_amp
    profile = np.array(planned.cycle.profile)
    profile[:, TAU] = known.eta * (motor_nm - friction_torque(qd, known))
    friction_w = ((motor_nm - sensed_nm / known.eta) * qd).mean(axis=0)
    by_current = replace(planned, cycle=Phase(profile, planned.cycle.payload_kg))
    return Measured(planned, by_current, Drive((amps**2).mean(axis=0), friction_w))


def job_signals(arm: Arm, jobs: Sequence[Measured], twin: Twin, untrained: Twin) -> dict[str, Array]:
    """The signals of jobs, [job]; all but that of temperature."""

    def features(model: Twin) -> tuple[Features, Features]:
        ones = [1] * len(jobs)
        measured = model.features([job.by_current for job in jobs], ones)
        return measured, model.features([job.planned for job in jobs], ones)

    (measured, planned), (blank_measured, blank_planned) = features(twin), features(untrained)
    d_above = measured.difficulty - planned.difficulty
    known_nm = np.sqrt(twin.scaler.mean[:, TAU] ** 2 + twin.scaler.std[:, TAU] ** 2)
    torques = [[plan.cycle.profile[:, TAU] for plan in (job.by_current, job.planned)] for job in jobs]
    return {
        "d": measured.difficulty.sum(axis=-1),
        "d_above": d_above.sum(axis=-1),
        "d_weighted": d_above @ twin.joint_weight,
        "d_untrained": (blank_measured.difficulty - blank_planned.difficulty).sum(axis=-1),
        "error": (measured.errors - planned.errors).sum(axis=(-2, -1)),
        "error_untrained": (blank_measured.errors - blank_planned.errors).sum(axis=(-2, -1)),
        "torque": np.array([(root_mean_square(one - other) / RATED_NM).max() for one, other in torques]),
        "heat": np.array([arm.excess(job.planned, job.drive) for job in jobs]),
        "rms": np.array([(root_mean_square(one) / known_nm).max() for one, _ in torques]),
    }


def root_mean_square(values: Array) -> Array:
    """Over time, [time, joint] to [joint]."""
    return np.sqrt(np.square(values, dtype=float).mean(axis=0))


def planned_temperatures(arm: Arm, a: int, world: World, record: StepRecord) -> Array:
    """Motor temperatures by the identified network after each step of the planned work, °C, [step, joint]."""
    thermal, motors = arm.beliefs
    rows, row = np.unique(record.plan[:, a], return_inverse=True)
    rest = arm.rest_drive(motors)
    work = [drives([phase.profile for phase in world.plans[r].phases], motors) if r >= 0 else None for r in rows]
    times_s = np.array([[phase.duration_s for phase in world.plans[r].phases] if r >= 0 else [0.0] * 3 for r in rows])[
        row
    ]
    times_s[:, 1] *= record.todo[:, a]
    ends_s = np.cumsum(times_s, axis=1) - record.progress_s[:, a, None]
    inside_s = np.diff(np.clip(ends_s, 0.0, world.dt_s), axis=1, prepend=0.0)
    inside_s[:, :1] = np.clip(ends_s[:, :1], 0.0, world.dt_s)
    share = np.column_stack([inside_s, world.dt_s - inside_s.sum(axis=1)]) / world.dt_s  # [step, phase and rest]

    def mean(name: str) -> Array:
        home = getattr(rest, name)
        tables = np.array([[*(getattr(each, name) if each else np.zeros((3, len(home)))), home] for each in work])
        return np.einsum("sp,spj->sj", share, tables[row])

    loads = (Drive(sq, w) for sq, w in zip(mean("current_sq"), mean("friction_w"), strict=True))
    start_c = np.empty(NODES)
    modal = world.tables.modal[0, a]
    start_c[WINDING], start_c[HOUSING] = modal["start_c"][WINDING], modal["start_housing_c"]
    course = temperature_steps(
        loads,
        world.dt_s,
        motors=motors,
        thermal=thermal,
        start_c=start_c,
        ambient_c=float(world.tables.ambient_c[0, 0, a]),
    )
    return np.array([*course])[1:, WINDING]


def work(fleet: Fleet, seed: int) -> StepRecord:
    """A shift under `POLICY`."""
    policy, records = policy_at(POLICY, seed, OnBus(fleet=fleet.scenario.name)), list[StepRecord]()
    env = env_of(fleet, watch=records.append, scaled=False, ahead_s=np.inf)
    env.reset(seed=seed)
    while env.agents:
        env.advance(policy.act(env.knowledge()) if env.may_claim else {})
    env.close()
    return stack_records(records)


@dataclass(frozen=True, eq=False)
class Shift:
    """A shift as it was, and what the arms had planned."""

    fleet: Fleet
    world: World
    record: StepRecord
    untrained: Sequence[Twin]

    def row(self, a: int, rng: np.random.Generator) -> Row:
        """What an arm measures until its first fault.

        Returns:
            `since_s`: when a surprise began to act, None if none did; `fault_s`: of the first fault, None without one;
            `job_s`: when the signals of each job are known; `plan`: its number; `signals`: their values.
        """
        arm, record, dt_s = self.fleet.arms[a], self.record, self.world.dt_s
        cut = np.flatnonzero(record.cut_s[:, a] < dt_s)
        fault_s = float(cut[0] * dt_s + record.cut_s[cut[0], a]) if len(cut) else np.inf
        steps = int(cut[0]) if len(cut) else len(record.tick)
        begun = np.flatnonzero((record.plan[:steps, a] >= 0) & (record.progress_s[:steps, a] == 0.0))
        plans = [self.world.plans[row] for row in record.plan[begun, a]]
        taken_s = [plan.approach.duration_s + min(plan.cycle.duration_s, WATCHED_S) for plan in plans]
        known_s = begun * dt_s + np.array(taken_s)
        whole = np.flatnonzero(known_s <= steps * dt_s)
        jobs = [self._measured(arm, plans[i], rng) for i in whole]
        signals = job_signals(arm, jobs, twin_of(arm), self.untrained[a]) if jobs else {}
        signals[TEMPERATURE] = self._residual_k(a, steps, rng)
        own = [plan for variants in arm.plans.values() for plan in variants]
        return {
            "arm": arm.robot.name,
            "since_s": self._since_s(arm, begun * dt_s, plans),
            "fault_s": fault_s,
            "job_s": known_s[whole],
            "plan": [own.index(plans[i]) for i in whole],
            "signals": {name: values.round(5) for name, values in signals.items()},
        }

    def _measured(self, arm: Arm, plan: Plan, rng: np.random.Generator) -> Measured:
        planned, load_nm = first_cycle(plan, arm.robot)
        mass = 1.0 + TOLERANCE * rng.standard_normal()
        if plan in arm.executed:
            mass *= arm.executed[plan].cycle.payload_kg.max() / plan.cycle.payload_kg.max()
        return measure(arm, planned, (mass - 1.0) * load_nm, rng)

    def _residual_k(self, a: int, steps: int, rng: np.random.Generator) -> Array:
        """Largest absolute mean of measured minus planned temperature in each minute, K, [minute]."""
        arm, time_s = self.fleet.arms[a], (np.arange(steps) + 1) * self.world.dt_s
        true_c = self.record.end_c[:steps, a, WINDING]
        noise_k = arm.motors.sensor_noise_k * rng.standard_normal(true_c.shape)
        planned_c = planned_temperatures(arm, a, self.world, self.record)[:steps]
        off_k = true_c + noise_k + arm.drift_k_per_s * time_s[:, None] - planned_c
        each = round(MINUTE_S / self.world.dt_s)
        minutes = off_k[: steps // each * each].reshape(-1, each, off_k.shape[1])
        return np.abs(minutes.mean(axis=1)).max(axis=1)

    def _since_s(self, arm: Arm, begun_s: Array, plans: Sequence[Plan]) -> float | None:
        own = {each.kind for each in self.fleet.scenario.surprises if each.arm == arm.robot.name}
        if own & {"fan", "sensor"}:
            return 0.0
        acts = [s for s, plan in zip(begun_s.tolist(), plans, strict=True) if own or plan in arm.executed]
        return min(acts, default=None)


def twin_of(arm: Arm) -> Twin:
    """The trained twin of a prepared arm."""
    assert isinstance(arm.model, CalibratedTwin)
    return arm.model.twin


def cell_rows(cell: SuiteCell, wanted: Collection[str]) -> KeyedRows:
    """What the arms of a cell measure; a row for each shift."""

    def scenario(kind: Surprising, seed: int) -> Scenario:
        axes = Axes(heat="hot", arrivals="poisson", due="usual", faults="attended", bus="perfect", surprise=kind)
        return scenario_of(cell.name, cell, axes, seed)

    fleet = prepare(scenario("nothing", 0), difficulty="twin")
    config = untrained_config(TwinConfig.quick())
    untrained = train_twins(fleet.scenario, fleet.planned, cache_folder(), quiet, config=config)
    believing = replace(fleet, arms=tuple(replace(arm, learns=False) for arm in fleet.arms))
    for key, (kind, role, seed) in shifts_of(cell).items():
        if key in wanted:
            own = with_surprises(replace(believing, scenario=scenario(kind, seed)))
            world = ShiftFactory(own)(np.random.SeedSequence(seed)).world
            shift = Shift(own, world, work(own, seed), untrained)
            random = np.random.SeedSequence([cell.seed, seed]).spawn(len(own.arms))
            arms = [shift.row(a, np.random.default_rng(each)) for a, each in enumerate(random)]
            yield key, {"cell": cell.name, "kind": kind, "role": role, "arms": arms}


def shifts_of(cell: SuiteCell) -> dict[str, tuple[Surprising, str, int]]:
    """Kind of surprise, use and seed of each shift of a cell, by key; all seeds differ."""
    roles = [role for role, count in QUIET.items() for _ in range(count)]
    shifts: list[tuple[Surprising, str, int]] = [(NOTHING, role, seed) for seed, role in enumerate(roles)]
    for kind in surprises_in(cell):
        shifts.extend((kind, CHECK, 1000 * (1 + KINDS.index(kind)) + i) for i in range(SURPRISED))
    return {f"{cell.name}/{kind}/{seed}": (kind, role, seed) for kind, role, seed in shifts}


def threshold(scores: Sequence[float], share: float = FALSE_ALARMS) -> float:
    """The score that another one, exchangeable with these, exceeds with at most this probability.

    Of n scores it is the ⌈(n + 1)(1 − share)⌉-th smallest, as in conformal prediction.

    Raises:
        ValueError: fewer than 1/share − 1 scores.
    """
    rank = int(np.ceil((len(scores) + 1) * (1.0 - share) - 1e-9))
    if rank > len(scores):
        raise ValueError(f"A threshold of {share:g} needs at least {fewest(share)} scores (got {len(scores)}).")
    return float(np.sort(scores)[rank - 1])


@dataclass(frozen=True, eq=False)
class Course:
    """One signal of an arm in a shift, in units of the arm's quiet shifts."""

    cell: str
    since_s: float
    """NaN if no surprise acts on the arm."""
    fault_s: float
    """inf without a fault."""
    time_s: Array
    values: Array

    @property
    def highest(self) -> float:
        return float(self.values.max(initial=-np.inf))

    def alarm_s(self, limit: float) -> float:
        """The first moment above the limit; inf if there is none."""
        return float(self.time_s[self.values > limit].min(initial=np.inf))


def courses(rows: Sequence[Row], signal: str) -> dict[tuple[str, str], list[Course]]:
    """A signal of all arms by kind and role of the shift.

    0 is the median of the arm's shifts for scaling, 1 the largest value there. A signal by plan is first reduced by
    the median of the same plan there; a plan that did not occur there gives no value.
    """
    base, by_plan = signal.removesuffix(BY_PLAN), signal.endswith(BY_PLAN)

    def of(arm: Row) -> tuple[Array, Array, Array]:
        values = np.array(arm["signals"].get(base, ()))
        if base == TEMPERATURE:
            return (np.arange(len(values)) + 1) * MINUTE_S, np.zeros(len(values), int), values
        return np.array(arm["job_s"]), np.array(arm["plan"], int) * by_plan, values

    before: dict[tuple[str, str], list[tuple[Array, Array, Array]]] = {}
    for row in matching(rows, role=SCALING):
        for arm in row["arms"]:
            before.setdefault((row["cell"], arm["arm"]), []).append(of(arm))
    usual: dict[tuple[str, str], tuple[dict[int, float], float]] = {}
    for name, several in before.items():
        _, plan, values = map(np.concatenate, zip(*several, strict=True))
        middle = {int(p): float(np.median(values[plan == p])) for p in np.unique(plan)}
        above = values - [middle[p] for p in plan.tolist()]
        usual[name] = middle, max(float(above.max(initial=0.0)), 1e-9)
    found: dict[tuple[str, str], list[Course]] = {}
    for row in rows:
        for arm in row["arms"]:
            (time_s, plan, values), (middle, most) = of(arm), usual[row["cell"], arm["arm"]]
            scaled = np.array([(v - middle.get(p, np.inf)) / most for p, v in zip(plan.tolist(), values, strict=True)])
            ends_s = number(arm["since_s"]), np.inf if arm["fault_s"] is None else arm["fault_s"]
            found.setdefault((row["kind"], row["role"]), []).append(Course(row["cell"], *ends_s, time_s, scaled))
    return found


def summary(rows: Sequence[Row]) -> Iterator[tuple[str, Row]]:
    """A row for each kind of surprise and signal; medians over the affected arms, None where most have no alarm."""
    for signal in SIGNALS:
        of = courses(rows, signal)
        limit, undisturbed = threshold([each.highest for each in of[NOTHING, LIMIT]]), of[NOTHING, CHECK]
        false = share_of((each.cell, each.highest > limit) for each in undisturbed)
        for kind in KINDS:
            arms = [each for each in of[kind, CHECK] if np.isfinite(each.since_s)]
            alarm_s, since_s, fault_s = np.array([(one.alarm_s(limit), one.since_s, one.fault_s) for one in arms]).T
            faulted = np.isfinite(fault_s)
            lead_s = fault_s[faulted] - alarm_s[faulted]
            by_cell: dict[str, list[bool]] = {}
            for each in arms:
                by_cell.setdefault(each.cell, []).append(each.alarm_s(limit) < np.inf)
            yield (
                f"{kind}/{signal}",
                {
                    "kind": kind,
                    "signal": signal,
                    "arms": len(arms),
                    "share": share_of((each.cell, each.alarm_s(limit) < np.inf) for each in arms),
                    "cells": {name: np.mean(own) for name, own in by_cell.items()},
                    "alarm_min": np.median(alarm_s) / MINUTE_S,
                    "delay_min": np.median(alarm_s - since_s) / MINUTE_S,
                    "faults": len(lead_s),
                    "before_fault": int(np.isfinite(lead_s).sum()),
                    "lead_min": np.median(lead_s) / MINUTE_S if len(lead_s) else np.nan,
                    "quiet": len(undisturbed),
                    "false_alarms": false,
                },
            )


def share_of(values: Iterable[tuple[str, bool]]) -> list[float]:
    """Mean of the cells' shares with its interval: mean, low, high."""
    found = mean_share((cell, float(value)) for cell, value in values)
    return [found.mean, found.low, found.high]


def alarm_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Alarms of each signal by kind of surprise, and alarms before the first fault."""
    of = {(row["signal"], row["kind"]): row for row in rows}

    def noticed(row: Row) -> str:
        mean, low, high = map(number, row["share"])
        text = Interval(mean, low, high).text()
        return text if row["delay_min"] is None else f"{text}; {row['delay_min']:.1f} min"

    def early(row: Row) -> str:
        text = f"{row['before_fault']} of {row['faults']}"
        return text if row["lead_min"] in (None, -np.inf) else f"{text}; {row['lead_min']:.1f} min"

    false = {name: f"{100 * of[name, KINDS[0]]['false_alarms'][0]:.1f} %" for name in SIGNALS}
    heads = [f"{kind} ({of[TEMPERATURE, kind]['arms']})" for kind in KINDS]
    shares = [(text, false[name], *(noticed(of[name, kind]) for kind in KINDS)) for name, text in SIGNALS.items()]
    leads = [(text, *(early(of[name, kind]) for kind in KINDS)) for name, text in SIGNALS.items()]
    return {
        "alarms": table_of(("signal", "false alarms", *heads), shares),
        "alarms_before_faults": table_of(("signal", *KINDS), leads),
    }


def stored_table(which: str, path: Path) -> str:
    """One of the tables of a file of the summary, as Markdown."""
    return alarm_tables([*Rows(path).by_key.values()])[which].markdown()


def main(argv: Sequence[str] | None = None) -> None:
    """Compute what is missing, write the summary, and print the tables."""
    parser = ArgumentParser(prog="python -m benchmarks.alarms", description=__doc__)
    parser.add_argument("--out", type=Path, default=OUT, help=f"file of the summary [{OUT}]")
    given = parser.parse_args(argv)
    cells = [cell for cell in CELLS if cell.split == "test" and cell.arms <= MOST_ARMS and cell.asks != "light_work"]
    units = [Unit((*shifts_of(cell),), partial(cell_rows, cell)) for cell in cells]
    shifts, out = Rows(SHIFTS), Rows(given.out)
    compute(units, shifts)
    for key, row in summary(shifts.some(key for unit in units for key in unit.keys)):
        out.append(key, plain(row))
    out.sort(by=lambda row: (KINDS.index(row["kind"]), [*SIGNALS].index(row["signal"])))
    for table in alarm_tables([*out.by_key.values()]).values():
        Console(width=WIDEST, highlight=False).print(table)


if __name__ == "__main__":
    main()
