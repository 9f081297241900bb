"""Detection of wear and weaker cooling by an arm's twins, and cost of retraining: `drift`.

Every day the arm does cool work and work of the natural mix. Its learned twin scores the cool jobs, its thermal network
predicts the peak temperature of all jobs. Upward CUSUMs watch the daily means. An alarm retrains the twin that it
watches, from recent cool jobs alone.
"""

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import networkx as nx
import numpy as np
from scipy.stats import norm

from benchmarks.paper.features import with_wear
from benchmarks.paper.harness import (
    matching,
    number,
    seeded,
    table_of,
)
from benchmarks.paper.subjects import SHORT, Study, make_study, sensed, with_steps
from benchmarks.paper.transfer import continue_training
from fleet.errors import FleetError
from fleet.heat.motor import Motors
from fleet.heat.thermal import ThermalModel, thermal_model
from fleet.motion import Plan
from fleet.seeding import child
from scenarios.evaluate.statistics import interval
from scenarios.json_rows import Row
from scenarios.prepare.arms import ArmHardware
from scenarios.prepare.calibrate import own_logs
from scenarios.prepare.twins import cold_peaks, records
from scenarios.table import Table
from twin.thermal.identify import HeatModel, identify
from twin.vae.config import TwinConfig
from twin.vae.measures import Measures
from twin.vae.train import train
from twin.vae.twin import Twin

Array = np.ndarray

NONE, WEAR, COOLING, NEW_WORK = "none", "wear", "cooling", "new work"
KINDS = (NONE, WEAR, COOLING, NEW_WORK)
"""What changes from the onset: nothing; friction grows; conductance to ambient falls; half of the work is replaced by
light new motion, while the arm stays as it is."""
NEVER, ON_ALARM, ALWAYS = "never", "on alarm", "always"
POLICIES = (NEVER, ON_ALARM, ALWAYS)
D_CAL, P_VALUE, THERMAL = "d_cal", "p_value", "thermal"
WATCHED = (D_CAL, P_VALUE, THERMAL)
"""Calibrated difficulty d of the cool jobs, which retrains nothing; normal score of their conformal p-values; logarithm
of measured over predicted rise of the motor that is predicted to be hottest, all jobs."""
AMBIENT_SD_K = 1.5
"""Of a day's ambient temperature."""
THERMOMETER_SD_K = 0.3
"""Error of a day's measured ambient temperature."""
LOGS = 4
LOG_STEP_S = 30.0


@dataclass(frozen=True, kw_only=True)
class DriftSize:
    """Times, numbers of jobs and training steps."""

    days: int = 84
    onset: int = 28
    """Last day before the change."""
    reference: int = 14
    """Days that set mean and deviation of a CUSUM, after the start and after each retraining."""
    full: int = 42
    """Days from the onset until the change is complete."""
    wear: float = 1.0
    """Share by which friction has grown then."""
    cooling: float = 0.6
    """Factor of the conductance to ambient then."""
    jobs: int = 4
    """Per day, of cool work, and as many of the natural mix."""
    window: int = 14
    """Days whose cool jobs retrain a twin."""
    period: int = 28
    """Days between retrainings under `ALWAYS`."""
    least: int = 12
    """Fewest cool jobs for a retraining."""
    train: int = 40
    pool: int = 40
    """Other cool jobs, for calibration, and as many for the daily work; the natural mix has three times as many."""
    steps: int = 200
    further_steps: int = 50
    slack: float = 0.5
    """Of a CUSUM, in standard deviations of a day."""
    threshold: float = 5.0
    """Of a CUSUM, in standard deviations of a day."""
    config: TwinConfig = SHORT

    def __post_init__(self) -> None:
        if not 2 <= self.reference <= self.onset < self.days:
            raise FleetError(
                "--reference must be 2 or more and at most --onset, and --onset less than --days, so that something "
                f"changes (got {self.reference}, {self.onset} and {self.days})."
            )
        if self.jobs > self.pool:
            raise FleetError(f"--jobs must be at most --pool (got {self.jobs} and {self.pool}).")


@dataclass(frozen=True, eq=False)
class Day:
    """The work of one day as the arm records it."""

    plans: tuple[Plan, ...]
    """With the torque computed from current."""
    planned: tuple[Plan, ...]
    """The same jobs as planned."""
    peak_c: Array
    """Measured peak of each motor while the job repeats over the horizon from a cold start, °C, [job, joint]."""
    ambient_c: float
    """Measured."""
    hardware: ArmHardware
    """The true arm of this day, whose logs a network is identified from."""

    def cool(self, cool_c: float) -> Array:
        """Whether no motor passed the limit over the whole horizon, bool [job]."""
        return self.peak_c.max(axis=1) <= cool_c


class Cusum:
    """An upward CUSUM of daily values, with mean and deviation from its first days.

    Source: Page, Biometrika 41, 1954.
    """

    def __init__(self, reference: int, slack: float, threshold: float) -> None:
        self._days, self._slack, self._threshold = reference, slack, threshold
        self.restart()

    def restart(self) -> None:
        """Take the next days as the reference."""
        self._first: list[float] = []
        self._sum = 0.0

    def add(self, value: float) -> bool:
        """Whether the sum passes the threshold with the value of one more day; then the sum begins anew."""
        if np.isnan(value):
            return False
        if len(self._first) < self._days:
            self._first.append(value)
            return False
        deviation = max(float(np.std(self._first, ddof=1)), 1e-9)
        self._sum = max(0.0, self._sum + (value - float(np.mean(self._first))) / deviation - self._slack)
        alarm = self._sum > self._threshold
        self._sum *= not alarm
        return alarm


def work_days(study: Study, kind: str, size: DriftSize, rng: np.random.Generator) -> list[Day]:
    """What the arm does and records from day to day while it changes."""
    cool_work, mix = study.reference.plans[size.pool :], study.test.plans
    days = []
    for day in range(1, size.days + 1):
        share = float(np.clip((day - size.onset) / size.full, 0.0, 1.0))
        motors = with_wear(study.motors, size.wear * share) if kind == WEAR else study.motors
        factor = 1.0 + (size.cooling - 1.0) * share if kind == COOLING else 1.0
        thermal = thermal_model(with_cooling(study.network, factor)) if factor < 1.0 else study.thermal
        chosen = [cool_work[i] for i in rng.choice(len(cool_work), size.jobs, replace=False)]
        chosen += [mix[i] for i in rng.choice(len(mix), size.jobs, replace=False)]
        if kind == NEW_WORK and day > size.onset:
            chosen[::2] = [study.novel.plans[i] for i in rng.choice(len(study.novel), size.jobs, replace=False)]
        days.append(_day(study, motors, thermal, tuple(chosen), rng))
    return days


def with_cooling(network: "nx.Graph[str]", factor: float) -> "nx.Graph[str]":
    """The network with every conductance to ambient scaled."""
    scaled = network.copy()
    for _, _, edge in scaled.edges("ambient", data=True):
        edge["conductance_w_per_k"] *= factor
    return scaled


def _day(study: Study, motors: Motors, thermal: ThermalModel, plans: tuple[Plan, ...], rng: np.random.Generator) -> Day:
    ambient_c = study.ambient_c + AMBIENT_SD_K * float(rng.standard_normal())
    peak_c = cold_peaks(plans, motors, thermal, ambient_c=ambient_c, horizon_s=study.horizon_s)
    peak_c = peak_c + motors.sensor_noise_k * rng.standard_normal(peak_c.shape)
    measured_c = ambient_c + THERMOMETER_SD_K * float(rng.standard_normal())
    return Day(sensed(plans, motors), plans, peak_c, measured_c, ArmHardware(study.robot, motors, thermal))


def cool_jobs(days: Sequence[Day], cool_c: float) -> list[tuple[Day, int]]:
    """The jobs of these days in which no motor passed the limit over the whole horizon: all that a twin may learn."""
    return [(day, int(i)) for day in days for i in np.flatnonzero(day.cool(cool_c))]


def life(
    study: Study,
    days: Sequence[Day],
    twin: Twin,
    network: HeatModel,
    size: DriftSize,
    kind: str,
    policy: str,
    seed: int,
) -> Row:
    """The days of one arm under one policy.

    Returns:
        `alarms`: days by `WATCHED`. `retrainings`: of the twin of `P_VALUE` or the network of `THERMAL`, each with its
        day, number of jobs, highest temperature in these and CPU time. `peak_rms_k`: RMS error of the predicted peak of
        the hottest motor over the last `DriftSize.window` days. `cool_flagged`: share of cool jobs with a conformal
        p-value of at most 5 % in the same days. And the times of the size that tables need.
    """
    watch = {name: Cusum(size.reference, size.slack, size.threshold) for name in WATCHED}
    alarms: dict[str, list[int]] = {name: [] for name in WATCHED}
    done: list[Row] = []
    errors_k: list[float] = []
    flags: list[bool] = []
    for today, day in enumerate(days, start=1):
        predicted_c = predicted_peaks(network, day, study.horizon_s)
        cool = np.flatnonzero(day.cool(study.cool_c))
        measures = twin.measures([day.plans[i] for i in cool], [1] * len(cool))
        if today > size.days - size.window:
            errors_k += (day.peak_c.max(axis=1) - predicted_c.max(axis=1)).tolist()
            flags += (_p_values(measures) <= 0.05).tolist()
        for name, value in _daily(measures, twin, day, predicted_c).items():
            alarm = watch[name].add(value)
            if alarm:
                alarms[name].append(today)
            due = today % size.period == 0 if policy == ALWAYS else alarm and policy == ON_ALARM
            recent = cool_jobs(days[max(0, today - size.window) : today], study.cool_c)
            if name == D_CAL or not due or len(recent) < size.least:
                continue
            began_s, random = time.process_time(), child(np.random.SeedSequence(seed), 4, today)
            if name == P_VALUE:
                twin = retrain_learned(twin, recent, size, random)
                watch[D_CAL].restart()
            else:
                network = reidentify(network, recent, random)
            cost_s = time.process_time() - began_s
            hottest_c = max(float(each.peak_c[i].max()) for each, i in recent)
            card = {"day": today, "watched": name, "jobs": len(recent), "hottest_c": hottest_c, "cpu_s": cost_s}
            done.append(card)
            watch[name].restart()
    return {
        "kind": kind,
        "seed": seed,
        "policy": policy,
        "alarms": alarms,
        "retrainings": done,
        "peak_rms_k": float(np.sqrt(np.mean(np.square(errors_k)))),
        "cool_flagged": float(np.mean(flags)) if flags else float("nan"),
        **{name: getattr(size, name) for name in ("days", "onset", "reference", "window")},
    }


def _daily(measures: Measures, twin: Twin, day: Day, predicted_c: Array) -> dict[str, float]:
    """The value of the day of each of `WATCHED`; NaN without cool jobs."""
    hottest = predicted_c.argmax(axis=1)[:, None]
    rise = np.take_along_axis(day.peak_c - day.ambient_c, hottest, axis=1)
    expected = np.take_along_axis(predicted_c - day.ambient_c, hottest, axis=1)
    thermal = float(np.log(np.maximum(rise, 0.1) / np.maximum(expected, 0.1)).mean())
    p = _p_values(measures)
    if not len(p):
        return {D_CAL: float("nan"), P_VALUE: float("nan"), THERMAL: thermal}
    assert twin.calibration is not None
    assert measures.calibrated is not None
    middle = p - 0.5 / (len(twin.calibration.reference.packed) + 1.0)  # between the steps, so never 0 or 1
    return {
        D_CAL: float((measures.calibrated @ measures.weight).mean()),
        P_VALUE: float(norm.isf(middle).mean()),
        THERMAL: thermal,
    }


def _p_values(measures: Measures) -> Array:
    assert measures.p_value is not None
    return measures.p_value


def predicted_peaks(network: HeatModel, day: Day, horizon_s: float) -> Array:
    """Peaks of the day's jobs by a network, from planned motion and measured ambient temperature, °C, [job, joint]."""
    return cold_peaks(day.planned, network.motors, network.thermal(), ambient_c=day.ambient_c, horizon_s=horizon_s)


def retrain_learned(
    twin: Twin, recent: Sequence[tuple[Day, int]], size: DriftSize, random: np.random.SeedSequence
) -> Twin:
    """The learned twin trained further on every second of the jobs, and calibrated on the others."""
    plans = [day.plans[i] for day, i in recent]
    parts = records(plans[::2])
    config = replace(with_steps(size.config, parts, size.further_steps), learning_rate=1e-3)
    return continue_training(twin, parts, config, random, arm=twin.arm).with_calibration([(p, 1) for p in plans[1::2]])


def reidentify(network: HeatModel, recent: Sequence[tuple[Day, int]], random: np.random.SeedSequence) -> HeatModel:
    """The network identified again from the logs of the latest of the jobs, with the present one as the prior."""
    logs = []
    for n, (day, i) in enumerate(recent[-LOGS:]):
        rng = np.random.default_rng(child(random, n))
        logs += [
            replace(log, name=f"log {n}")
            for log in own_logs(day.hardware, [day.planned[i]], rng, ambient_c=day.ambient_c)
        ]
    ambient_c = float(np.mean([day.ambient_c for day, _ in recent[-LOGS:]]))
    return identify(logs, nominal=network, ambient_c=ambient_c, ambient_sd_k=AMBIENT_SD_K, step_s=LOG_STEP_S).heat_model


def drift_rows(seed: int, size: DriftSize, wanted: Collection[str]) -> Iterator[tuple[str, Row]]:
    """Kinds of change under policies; the days of one kind are the same for all policies.

    Raises:
        FleetError: nearly no motion of the arm stays cool.
    """
    root = np.random.SeedSequence(seed)
    study = make_study(child(root, 0), train=size.train, reference=2 * size.pool, test=3 * size.pool, novel=size.pool)
    known = sensed(study.train.plans, study.motors)
    parts = records(known)
    twin = train(parts, with_steps(size.config, parts, size.steps), child(root, 1), arm=study.robot.name)
    twin = twin.with_calibration([(p, 1) for p in sensed(study.reference.plans[: size.pool], study.motors)])
    logs = own_logs(
        study.hardware, study.train.plans[:LOGS], np.random.default_rng(child(root, 2)), ambient_c=study.ambient_c
    )
    network = identify(logs, ambient_c=study.ambient_c, ambient_sd_k=AMBIENT_SD_K, step_s=LOG_STEP_S).heat_model
    for i, kind in enumerate(KINDS):
        policies = [policy for policy in POLICIES if f"{kind}/{policy}" in wanted]
        days = work_days(study, kind, size, np.random.default_rng(child(root, 3, i))) if policies else []
        for policy in policies:
            yield f"{kind}/{policy}", life(study, days, twin, network, size, kind, policy, seed)


def drift_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Delay and false alarms by what changes, and errors and cost by policy."""
    kinds, policies = (dict.fromkeys(row[name] for row in rows) for name in ("kind", "policy"))
    before = matching(rows, policy=NEVER if NEVER in policies else next(iter(policies)))
    noticed = [(kind, *(_delays(matching(before, kind=kind), name) for name in WATCHED)) for kind in kinds]
    watched_days = sum((row["days"] if row["kind"] == NONE else row["onset"]) - row["reference"] for row in before)
    false = (f"{100 * sum(_false_alarms(row, name) for row in before) / watched_days:.2f}" for name in WATCHED)
    measures: dict[str, Callable[[Row], float]] = {
        "peak error, K": lambda row: row["peak_rms_k"],
        "p ≤ 5 %, %": lambda row: 100 * number(row["cool_flagged"]),
        "retrained": lambda row: float(len(row["retrainings"])),
        "CPU s": lambda row: sum(each["cpu_s"] for each in row["retrainings"]),
    }
    costs = [
        (f"{kind}, {policy}", *(interval([of(row) for row in own], least=0.0).text(1) for of in measures.values()))
        for kind in kinds
        for policy in policies
        if (own := matching(rows, kind=kind, policy=policy))
    ]
    return {
        "drift_delays": table_of(
            ("change", "calibrated d", "conformal p-value", "thermal residual"),
            [*noticed, ("false alarms per 100 days", *false)],
            "Days from the onset to the first alarm, without retraining: median, and seeds with an alarm",
        ),
        "drift_costs": table_of(
            ("change, retraining", *measures),
            costs,
            f"In the last {rows[0]['window']} days: error of the predicted peak and share of cool jobs that are "
            "flagged; retrainings and their CPU seconds in all",
        ),
    }


def delay_days(row: Row, watched: Sequence[str] = (P_VALUE, THERMAL)) -> float:
    """Days from the onset to the first alarm of these after it; inf for none."""
    later = [day - row["onset"] for name in watched for day in row["alarms"][name] if day > row["onset"]]
    return float(min(later, default=np.inf))


def _delays(rows: Sequence[Row], name: str) -> str:
    found = [day for row in rows if np.isfinite(day := delay_days(row, (name,)))]
    return f"{np.median(found):.0f} ({len(found)} of {len(rows)})" if found else f"– (0 of {len(rows)})"


def _false_alarms(row: Row, name: str) -> int:
    """Alarms while the arm had not changed."""
    return sum(row["kind"] == NONE or day <= row["onset"] for day in row["alarms"][name])


DRIFT = seeded(
    "Detection of wear and weaker cooling by a twin, and cost of retraining.\n\nA seed takes a minute of one core.",
    DriftSize,
    3,
    drift_rows,
    drift_tables,
    parts=[f"{kind}/{policy}" for kind in KINDS for policy in POLICIES],
)
