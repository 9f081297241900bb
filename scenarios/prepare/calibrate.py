"""The thermal network of a scenario's arms, and its P(saturation), from simulated experience.

An arm that has worked for weeks has logs of its cool work, from which its network is identified, and past jobs, from
which P(saturation) is fitted. Here both are simulated. Past jobs are the arm's own work and random work with heavy
payloads, in every ambient temperature of its hall, from cold, idle and hot starts. They hold what is known before the
job (measured motors, estimated housings, ambient temperature), and the hottest temperatures during it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleet.arm.plan_cache import RANDOM_MOTIONS_VERSION
from fleet.difficulty import SETTLING_S, known_temperatures
from fleet.heat.motor import Motors, friction_heat, magnet_factor, reference_current
from fleet.heat.thermal import (
    HOUSING,
    NODES,
    STEP_S,
    WINDING,
    ThermalModel,
    drive_heat,
    housing_observer,
    node_heat,
    temperature_steps,
)
from fleet.job import Work
from fleet.motion import RATE_HZ, Drive, Plan, drives, static_drive
from fleet.offered_plans import offered_plans
from fleet.robot import JOINTS, ThermalLimits
from scenarios.prepare.arms import ArmHardware, PlannedArm, air_offsets
from scenarios.prepare.twins import CachedModel, arm_seed, load_or_make, records, require_cool_plans
from scenarios.progress import Progress
from scenarios.spec.jobs import works_of
from scenarios.spec.options import RISK, RiskName
from scenarios.spec.schema import Scenario
from twin.logs.recording import Recording
from twin.thermal.checkpoint import load, load_curve, save, save_curve
from twin.thermal.identify import HeatModel, Identified, identify, nominal_heat_model
from twin.thermal.thermal_twin import PeakCurve, RcTwin

Array = np.ndarray

LOGS_VERSION = 1
"""Raise it whenever the same arm would get other logs or another identified network."""
PAST_VERSION = 3
"""Raise it whenever the same arm would get other past jobs or another fit."""
PAST, LOGGED = 4, 5
"""Spawn keys, different from those of `scenarios.prepare.twins` for the same arm."""

LOG_HZ = 2.0
"""Sampling rate of the public logs of a real Gen3."""
AIR_SD_K = 1.5
"""Standard deviation of a recording's ambient temperature around the usual one."""
LOGS = 4
"""Recordings, half an hour each."""
FIT_STEP_S = 20.0
"""Step of the identification: a tenth of a winding's time constant."""

AMBIENT_C = (19.0, 27.0)
"""Default range of the ambient temperature of past jobs."""
DURATION_S = (180.0, 2700.0)
EARLIER_S = (300.0, 3600.0)
"""Range of the duration of the work before."""
REST_S = (120.0, 1800.0)
"""Largest powered rest between the work before and this job, for one half of the jobs and for the other."""
BEFORE = {"cold": 0.1, "idle": 0.2, "work": 0.7}
"""Shares of the jobs that begin just after power-on, after a long idle time, and after work and a rest."""
LONG_S = 1e9
PAST_JOBS = 400
"""Past jobs of each arm: enough that even a well-cooled arm has some in which a motor passed the limit."""
OWN = 0.6
"""Share of the past jobs that are the scenario's own work."""
HEAVY_KG = (2.0, 4.0)
"""Payloads of the other jobs: lighter ones say little about saturation."""
AIR_MARGIN_K = 3.0
"""By how much the ambient temperature of past jobs exceeds the scenario's range at either end."""


def calibrate_networks(
    scenario: Scenario,
    arms: Sequence[PlannedArm],
    folder: Path,
    progress: Progress,
    *,
    risk: RiskName = RISK,
    jobs: int = PAST_JOBS,
) -> list[RcTwin]:
    """Every arm's thermal network, identified for `rc`, else nominal, with its P(saturation); cached in the folder.

    Args:
        arms: With their plans for all motion of the scenario, light loads included.
        jobs: Past jobs of each arm.

    Raises:
        FleetError: an arm has no motion that stays cool.
    """
    if risk == "rc":
        identified = load_or_make([_identified(scenario, arm, folder) for arm in arms], "identifying", progress)
        heats = [replace(RcTwin.of(each), warning_c=scenario.limits.warning_c) for each in identified]
    else:
        heats = [nominal_network(scenario, arm) for arm in arms]
    makers = [_curve(scenario, arm, heat, folder, jobs) for arm, heat in zip(arms, heats, strict=True)]
    curves = load_or_make(makers, "calibrating", progress)
    return [replace(heat, curve=curve) for heat, curve in zip(heats, curves, strict=True)]


def nominal_network(scenario: Scenario, arm: PlannedArm) -> RcTwin:
    """The thermal network of a nominal Gen3 in the arm's cooling, without P(saturation)."""
    robot = arm.hardware.robot
    nominal = RcTwin.nominal(robot.name, ambient_c=scenario.twin.ambient_c, cooling=robot.cooling)
    return replace(nominal, warning_c=scenario.limits.warning_c)


def _identified(scenario: Scenario, arm: PlannedArm, folder: Path) -> CachedModel[Identified]:
    hardware, ambient_c = arm.hardware, scenario.twin.ambient_c
    cool = require_cool_plans(arm.all_plans, hardware, scenario)
    seed = scenario.spread.seed, arm.index

    def make(home: Path, _report: Callable[[float], None]) -> None:
        rng = np.random.default_rng(arm_seed(*seed, LOGGED))
        chosen = rng.choice(len(cool), size=min(LOGS, len(cool)), replace=False)
        logs = own_logs(hardware, [cool[i] for i in chosen], rng, ambient_c=ambient_c)
        name = hardware.robot.name
        save(identify(logs, arm=name, ambient_c=ambient_c, ambient_sd_k=AIR_SD_K, step_s=FIT_STEP_S), home)

    motion = [np.ascontiguousarray(record).tobytes() for record in records(cool)]
    key = hardware.key([LOGS_VERSION, seed, ambient_c, hardware.robot], *motion)
    return CachedModel(folder / "identified" / key, load, make)


def own_logs(
    hardware: ArmHardware,
    plans: Sequence[Plan],
    rng: np.random.Generator,
    *,
    ambient_c: float,
    work_s: float = 1200.0,
    rest_s: float = 600.0,
) -> list[Recording]:
    """One recording for each plan: from idle, its cycle repeated, then rest at home, with sensor noise.

    Heat follows from every planned sample; the log has two samples a second, as a real one.
    """
    airs_c = ambient_c + AIR_SD_K * rng.standard_normal(len(plans))
    return [
        _log(hardware, plan, rng, air_c, work_s, rest_s, f"log {i}")
        for i, (plan, air_c) in enumerate(zip(plans, airs_c.tolist(), strict=True))
    ]


def _log(
    hardware: ArmHardware,
    plan: Plan,
    rng: np.random.Generator,
    ambient_c: float,
    work_s: float,
    rest_s: float,
    name: str,
) -> Recording:
    from fleet.arm.model import ArmModel

    robot, motors, thermal = hardware
    every = round(RATE_HZ / LOG_HZ)
    work, rest = round(work_s * LOG_HZ), round(rest_s * LOG_HZ)
    index = np.arange(work * every) % len(plan.cycle.profile)
    moving = np.asarray(plan.cycle.profile, dtype=float)[index]  # [sample, channel, joint]
    home = robot.home_q()
    still = np.stack([home, np.zeros_like(home), ArmModel(robot).gravity_torque(home)])
    shown = np.concatenate([moving[::every], np.broadcast_to(still, (rest + 1, *still.shape))])
    _, qd, tau = moving.reshape(work, every, *still.shape).transpose(2, 0, 1, 3)
    square = (reference_current(tau, qd, motors) ** 2).mean(axis=1)
    friction_w = friction_heat(qd, motors).mean(axis=1)
    loads = [Drive(*each) for each in zip(square, friction_w, strict=True)] + [static_drive(still[2], motors)] * rest
    start_c = thermal.steady(node_heat(np.zeros_like(home), motors.idle_w), ambient_c)
    course = temperature_steps(
        loads, 1.0 / LOG_HZ, motors=motors, thermal=thermal, start_c=start_c, ambient_c=ambient_c
    )
    temps = np.stack(list(course))
    q, qd, tau = shown.transpose(1, 0, 2)
    noise = motors.sensor_noise_k * rng.standard_normal((len(temps), len(home)))
    return Recording(
        name=name,
        time_s=np.arange(len(temps)) / LOG_HZ,
        q=q,
        qd=qd,
        tau=tau,
        current_a=reference_current(tau, qd, motors) / magnet_factor(temps[:, HOUSING], motors),
        temp_c=temps[:, WINDING] + noise,
    )


def _curve(scenario: Scenario, arm: PlannedArm, heat: RcTwin, folder: Path, jobs: int) -> CachedModel[PeakCurve]:
    def make(home: Path, _report: Callable[[float], None]) -> None:
        past = simulate_past(scenario, arm, heat.heat_model, jobs=jobs)
        fitted = heat.with_past_jobs(past.plans, past.repetitions, known_c=past.known_c, peak_c=past.hottest_c)
        assert fitted.curve is not None
        save_curve(fitted.curve, home)

    return CachedModel(folder / "saturation" / past_key(scenario, arm, heat.version, jobs), load_curve, make)


def past_key(scenario: Scenario, arm: PlannedArm, version: str, jobs: int) -> str:
    """Cache key of a model: the version of what it calibrates, the arm's hardware and plans, and the past jobs."""
    robot, air_c = arm.hardware.robot, _ambient_range(scenario, arm.index)
    parts = [PAST_VERSION, RANDOM_MOTIONS_VERSION, jobs, version, scenario.spread.seed, scenario.limits, robot, air_c]
    profiles = [phase.profile for plan in arm.all_plans for phase in plan.phases]
    motion = [f"{each.shape}".encode() + np.ascontiguousarray(each).tobytes() for each in profiles]
    return arm.hardware.key([*parts, _kinds_of_jobs(scenario)], *motion)


def simulate_past(scenario: Scenario, arm: PlannedArm, known: HeatModel, *, jobs: int = PAST_JOBS) -> "JobHistory":
    """Simulated past jobs of an arm with this heat model of itself; the same for every seed of a run.

    A share `OWN` of the jobs is sampled from the scenario's streams.
    """
    from fleet.arm.random_motions import random_jobs  # loads MuJoCo, which an arm with a fitted network does not need

    rng = np.random.default_rng(arm_seed(scenario.spread.seed, arm.index, PAST))
    own = _own_jobs(scenario, arm, round(OWN * jobs), rng)
    other = random_jobs(arm.hardware.robot, jobs - len(own), rng, payload_kg=HEAVY_KG)
    repetitions = [times for _, times in own] + repetitions_for(other, rng).tolist()
    return past_jobs(
        arm.hardware,
        [*(plan for plan, _ in own), *other],
        rng,
        limits=scenario.limits,
        ambient_c=_ambient_range(scenario, arm.index),
        repetitions=np.array(repetitions, dtype=int),
        known=known,
    )


def _own_jobs(scenario: Scenario, arm: PlannedArm, count: int, rng: np.random.Generator) -> list[tuple[Plan, int]]:
    """Plans that the arm offers for jobs of the scenario, with repetitions; none if it can do no work."""
    possible = [
        (repetitions, works)
        for repetitions, all_of_them in _kinds_of_jobs(scenario)
        if (works := [work for work in all_of_them if arm.plans.get(work)])
    ]
    jobs = []
    for _ in range(count if possible else 0):
        (fewest, most), works = possible[rng.integers(len(possible))]
        repetitions = int(rng.integers(fewest, most + 1))
        offered = offered_plans(arm.plans[works[rng.integers(len(works))]], repetitions)
        jobs.append((offered[rng.integers(len(offered))], repetitions))
    return jobs


def _kinds_of_jobs(scenario: Scenario) -> list[tuple[tuple[int, int], tuple[Work, ...]]]:
    """Repetitions and works of the streams, each once: arrivals, values and due dates do not matter to past jobs."""
    return list(dict.fromkeys((stream.repetitions, works_of(scenario, stream)) for stream in scenario.jobs))


def _ambient_range(scenario: Scenario, index: int) -> tuple[float, float]:
    """Ambient temperatures of past jobs at one arm: those of the scenario and a margin."""
    offset_k = float(air_offsets(scenario)[index])
    temps = [temp_c + offset_k for temp_c in scenario.twin.air_c or [temp_c for _, temp_c in scenario.ambient.points]]
    return min(temps) - AIR_MARGIN_K, max(temps) + AIR_MARGIN_K


@dataclass(frozen=True, eq=False)
class JobHistory:
    """Jobs that one arm has done, with what was known before and the outcome."""

    plans: tuple[Plan, ...]
    repetitions: Array
    """int [job]."""
    duration_s: Array
    """From leaving home to being home again, [job]."""
    start_c: Array
    """True temperatures at the start, [job, node]; hidden from the arm."""
    known_c: Array
    """Measured motors, estimated housings and ambient temperature at the start, [job, KNOWN]."""
    peak_c: Array
    """Hottest winding temperature during the job, counted as in `fleet.difficulty.SETTLING_S`, [job, joint]."""
    warning_c: float

    def __len__(self) -> int:
        return len(self.plans)

    @property
    def hottest_c(self) -> Array:
        """Temperature of the hottest winding, [job]."""
        return self.peak_c.max(axis=1, initial=-np.inf)

    @property
    def passed(self) -> Array:
        """Whether any motor reached the warning limit, bool [job]."""
        return self.hottest_c >= self.warning_c


def past_jobs(
    hardware: ArmHardware,
    plans: Sequence[Plan],
    rng: np.random.Generator,
    *,
    limits: ThermalLimits,
    ambient_c: tuple[float, float] = AMBIENT_C,
    repetitions: Array | None = None,
    known: HeatModel | None = None,
) -> JobHistory:
    """One past job of an arm for each plan. The earlier jobs are sampled from the same plans.

    Args:
        ambient_c: Range of the ambient temperature.
        repetitions: int [plan]; by default such that the jobs last from 3 to 45 minutes.
        known: The heat model by which the arm estimates its housings; default: nominal in the arm's cooling.
    """
    known = known or nominal_heat_model(hardware.robot.cooling)
    history = _Simulator(hardware, known.motors, known.thermal(), limits.error_c)
    count, noise_k = len(plans), hardware.motors.sensor_noise_k
    if repetitions is None:
        repetitions = repetitions_for(plans, rng)
    duration_s = np.array([p.duration_s(int(n)) for p, n in zip(plans, repetitions, strict=True)])
    ambient = rng.uniform(*ambient_c, count)
    start = history.start(plans, ambient, rng)
    measured_c = start.temp_c[:, WINDING] + noise_k * rng.standard_normal((count, noise_k.size))
    # Hottest windings, counted from `SETTLING_S` on.
    from_s, peak_c = np.minimum(SETTLING_S, duration_s) - 1e-6, np.full((count, JOINTS), -np.inf)
    for time_s, arms in history.work(plans, repetitions, start, ambient):
        counts = (time_s >= from_s)[:, None]
        peak_c = np.where(counts, np.maximum(peak_c, arms.temp_c[:, WINDING]), peak_c)
    return JobHistory(
        plans=tuple(plans),
        repetitions=repetitions,
        duration_s=duration_s,
        start_c=start.temp_c,
        known_c=known_temperatures(measured_c, start.housing_c, ambient),
        peak_c=peak_c,
        warning_c=limits.warning_c,
    )


def repetitions_for(
    plans: Sequence[Plan], rng: np.random.Generator, lasts_s: tuple[float, float] = DURATION_S
) -> Array:
    """Repetitions, at least one, such that the jobs last from 3 to 45 minutes, or in another range, int [job]."""
    around_s = [plan.approach.duration_s + plan.retreat.duration_s for plan in plans]
    wanted_s = rng.uniform(*lasts_s, len(plans))
    return np.array(
        [
            max(1, round((wanted - around) / plan.cycle.duration_s))
            for wanted, around, plan in zip(wanted_s, around_s, plans, strict=True)
        ],
        dtype=int,
    )


class _Arms(NamedTuple):
    """Temperatures of one arm in each job."""

    temp_c: Array
    """True, [job, node]."""
    housing_c: Array
    """The arm's estimate of its housings, [job, joint]."""


@dataclass(frozen=True, eq=False)
class _Simulator:
    """True temperatures of one arm through work and rest, and the arm's estimate of its housings."""

    hardware: ArmHardware
    known_motors: Motors
    known_thermal: ThermalModel
    error_c: float

    def start(self, plans: Sequence[Plan], ambient: Array, rng: np.random.Generator) -> _Arms:
        """Temperatures at which the jobs begin."""
        count = len(plans)
        before = rng.choice(list(BEFORE), size=count, p=list(BEFORE.values()))
        cold = _Arms(np.repeat(ambient[:, None], NODES, axis=1), np.repeat(ambient[:, None], JOINTS, axis=1))
        idle = self._idle(ambient)
        # Somewhere between power-on and a long idle time: shifts begin at any time.
        share = rng.uniform(0.0, 1.0, (count, 1))
        arms = _Arms(*(one + share * (other - one) for one, other in zip(cold, idle, strict=True)))
        earlier = [plans[i] for i in rng.integers(count, size=count)] if count else []
        repetitions = repetitions_for(earlier, rng, EARLIER_S)
        faulted = np.zeros((count, 1), bool)
        for _, warmer in self.work(earlier, repetitions, arms, ambient):
            arms = _choose(faulted, arms, warmer)  # a fault ends the work
            faulted |= arms.temp_c[:, WINDING].max(axis=1, keepdims=True, initial=-np.inf) >= self.error_c
        rest_s = rng.uniform(0.0, np.where(rng.random(count) < 0.5, *REST_S))
        for _, cooler in self._course(self._at_home(), np.zeros(JOINTS), rest_s, arms, ambient):
            arms = cooler
        worked = _choose(before[:, None] == "idle", idle, arms)
        return _choose(before[:, None] == "cold", cold, worked)

    def _idle(self, ambient: Array) -> _Arms:
        """Temperatures after hours at home."""
        _, motors, thermal = self.hardware
        load, temp = self._at_home(), np.repeat(ambient[:, None], NODES, axis=1)
        for _ in range(6):  # heat changes by a few percent with temperature
            temp = thermal.steady(drive_heat(temp, load.current_sq, load.friction_w, motors), ambient)
        observer = housing_observer(self.known_thermal, self.known_motors, LONG_S)
        estimate = np.zeros((len(ambient), JOINTS))
        return _Arms(temp, observer.step(estimate, temp[:, WINDING], ambient, 0.0))

    def _at_home(self) -> Drive:
        from fleet.arm.model import ArmModel

        robot, motors, _ = self.hardware
        return static_drive(ArmModel(robot).gravity_torque(robot.home_q()), motors)

    def work(
        self, plans: Sequence[Plan], repetitions: Array, start: _Arms, ambient: Array
    ) -> Iterator[tuple[Array, _Arms]]:
        """Time since the start, s, [job], and temperatures after each step of approach, repeated cycle and retreat."""
        arms, begun_s = start, np.zeros(len(plans))
        for name in ("approach", "cycle", "retreat"):
            profiles = [getattr(plan, name).profile for plan in plans]
            duration_s = np.array([getattr(plan, name).duration_s for plan in plans])
            if name == "cycle":
                duration_s = duration_s * repetitions
            load, friction_w = drives(profiles, self.hardware.motors), drives(profiles, self.known_motors).friction_w
            for time_s, warmer in self._course(load, friction_w, duration_s, arms, ambient):
                arms = warmer
                yield begun_s + time_s, arms
            begun_s = begun_s + duration_s

    def _course(
        self, load: Drive, friction_w: Array, duration_s: Array, start: _Arms, ambient: Array
    ) -> Iterator[tuple[Array, _Arms]]:
        """Time since the start, s, [job], and temperatures after each step under constant drives.

        Args:
            friction_w: By the arm's own parameters, [job, joint].
        """
        _, motors, thermal = self.hardware
        steps = np.ceil(duration_s / STEP_S)
        dt_s = duration_s / np.maximum(steps, 1)
        observer = housing_observer(self.known_thermal, self.known_motors, dt_s)
        most = int(steps.max(initial=0.0))
        course = temperature_steps(
            [load] * most, dt_s, motors=motors, thermal=thermal, start_c=start.temp_c, ambient_c=ambient, steps=steps
        )
        temp_c, housing_c = next(course), start.housing_c
        for step, next_c in enumerate(course, start=1):
            mean_c = (temp_c + next_c)[:, WINDING] / 2.0
            estimate = observer.step(housing_c, mean_c, ambient, friction_w)
            housing_c = np.where((step <= steps)[:, None], estimate, housing_c)
            temp_c = next_c
            yield np.minimum(step, steps) * dt_s, _Arms(temp_c, housing_c)


def _choose(first: Array, one: _Arms, other: _Arms) -> _Arms:
    """`one` where `first`, bool [job, 1], else `other`."""
    return _Arms(*(np.where(first, a, b) for a, b in zip(one, other, strict=True)))
