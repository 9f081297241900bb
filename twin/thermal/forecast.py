"""Temperatures of an arm's motors in a planned motion, with intervals, from the log of what it has done so far.

The log updates the network: its parameters are the most probable ones by the log and by a prior, which is the earlier
identification of the arm or the spread of arms. Housings have no sensor; their temperatures follow from the same least
squares (`twin.thermal.identify`). Samples of the distribution of both (a sandwich estimate), simulated through the
plan, give all intervals.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import cycle, islice, pairwise

import numpy as np
from scipy.interpolate import make_interp_spline

from fleet.errors import FleetError, distinguish
from fleet.fields import MAX_SEED, check_instance, check_value
from fleet.heat.motor import Motors, magnet_factor
from fleet.heat.thermal import HOUSING, WINDING, temperature_steps
from fleet.motion import Drive
from fleet.robot import JOINTS, half_turn
from twin.logs.recording import (
    HEAT_GAP_S,
    STEP_S,
    HeatLog,
    Recording,
    check_recordings,
    heat_logs,
    source_of,
    without_repeats,
)
from twin.thermal.identify import (
    AMBIENT_C,
    RESIDUAL_S,
    Identified,
    Noise,
    ParameterVector,
    Problem,
    Unlike,
    check_ambient,
    nominal_heat_model,
    solve,
)

Array = np.ndarray

SAMPLES = 200
"""Samples of network and start: a probability is a multiple of 1/200."""
RISK = 0.025
"""Accepted probability of reaching a limit, and that of either tail of an interval."""
REST_K, HEAT_ERROR = 0.05, 0.05
"""Residual of a motor at rest, and that of its heat, as a share of the rise of its winding above its housing. Of values
up to .1 and .15 those with the least errors of all joints of public logs, cut at .3, .5 and .7 of their time."""
OBSERVED = 0.25
"""Observed spread of the estimates by residuals, as a share of that by these cautious ones."""
FROM_LOG_TO_LOG = 0.05
"""Relative standard deviation of the parameters of one arm, as friction and cooling vary."""
DRIFT_K = 1.0
"""Standard deviation of the ambient temperature in the run from that before it. With these three, 95 % intervals hold
95 % of the temperatures at the ends of public logs, by networks of other logs (docs/identification.md)."""
MEMORY_S = 2 * 3600.0
"""Length of the log that is used: three time constants of a housing."""
LEAST_S, LEAST_SAMPLES = 60.0, 3
"""Least length of the log, and least samples of a plan."""
MOST_RESIDUAL_K = 0.5
"""Residual from which a log does not fit the network; of public logs it is at most 0.34 K, with currents three times as
large 1.8 K (median)."""
MOST_SD = 4.0
"""Usual distance of an arm from what was known of it, in standard deviations: up to 3 in public logs, 7.5 with currents
three times as large."""
MOST_WAY_RAD = 0.2
"""Largest way from the end of a plan to its begin that repetitions may leave out."""
LONGEST_S = 4 * 3600.0
"""Time for which longer runs of the same motion are simulated: temperatures are steady by then."""
MOST_S = 7 * 86400.0
"""Longest run."""
MOST_STEPS = 180
"""Steps of the log."""
MOST_POINTS = 3000
"""Points of a long run."""


@dataclass(frozen=True, eq=False)
class ThermalForecast:
    """Sampled courses of the motor temperatures from the end of a log."""

    time_s: Array
    """Since the end of the log, [time]."""
    sampled_c: Array
    """Motor temperatures, float32 [sample, time, joint]; of a run of many steps the highest since the time before."""
    slope: Array
    """Change by a start that is 1 K warmer everywhere, [time, joint]."""
    run_s: float
    """Length of the planned run; later times show longer runs."""
    cycle_s: float
    """Length of one repetition."""
    ambient_c: float
    """Assumed ambient temperature."""
    residual_k: Array
    """Root mean square difference of the updated network's temperatures from those of the log, K, [joint]."""
    distance_sd: float
    """Largest distance of a parameter of the updated network from the one before, in its standard deviations."""
    unlike: Unlike
    """Without a network: common changes of the updated one that no Gen3 has."""
    way_back_rad: float
    """Largest change of a joint from the begin to the end of the plan; with repetitions, a motion that is left out."""

    @cached_property
    def _planned(self) -> Array:
        """Motor temperatures in the planned run, [sample, time, joint]."""
        return self.sampled_c[:, self.in_run]

    @cached_property
    def in_run(self) -> Array:
        """Which times belong to the planned run, bool [time]."""
        return self.time_s <= self.run_s + 1e-6

    def interval(self) -> tuple[Array, Array, Array]:
        """Lower end, median and upper end of the 95 % intervals in the planned run, °C, each [time, joint]."""
        low, middle, high = np.quantile(self._planned, (RISK, 0.5, 1.0 - RISK), axis=0)
        return low, middle, high

    def probability(self, limit_c: float) -> float:
        """P(some motor reaches a temperature in the planned run)."""
        return float((self._planned.max(axis=(1, 2)) >= limit_c).mean())

    def reached_s(self, limit_c: float) -> tuple[float, float, float]:
        """Earliest, median and latest time at which a motor reaches a temperature in the planned run; inf: it does not.

        Earliest and latest are the ends of the 95 % interval.
        """
        first_s = self._first_s(limit_c)
        first_s = np.sort(np.where(first_s <= self.run_s + 1e-6, first_s, np.inf))
        early, middle, late = first_s[[round(q * (len(first_s) - 1)) for q in (RISK, 0.5, 1.0 - RISK)]]
        return float(early), float(middle), float(late)

    def longest_s(self, limit_c: float) -> float:
        """Longest run of this motion in which a motor reaches a temperature with a probability of `RISK` at most.

        Returns:
            inf if it is longer than the simulated time.
        """
        first_s = float(np.sort(self._first_s(limit_c))[int(RISK * len(self.sampled_c))])
        before = int(np.searchsorted(self.time_s, first_s)) - 1  # at that time it is already there
        return np.inf if math.isinf(first_s) else float(self.time_s[max(before, 0)])

    def safe_start_k(self, limit_c: float) -> float:
        """By how much all motors may be warmer at the start, K; negative: they must be cooler. To first order.

        The probability of reaching the temperature in the planned run is then `RISK`.

        Returns:
            -inf if the hottest motor had to be below the ambient temperature: no start of a powered arm is safe.
        """
        room_k = (limit_c - self._planned) / np.maximum(self.slope[self.in_run], 1e-3)
        change_k = float(np.sort(room_k.min(axis=(1, 2)))[int(RISK * len(room_k))])
        return change_k if self.sampled_c[0, 0].max() + change_k >= self.ambient_c else -np.inf

    def _first_s(self, limit_c: float) -> Array:
        """First time at which a motor reaches a temperature, inf for never, [sample]."""
        hot = self.sampled_c.max(axis=2) >= limit_c
        return np.where(hot.any(axis=1), self.time_s[hot.argmax(axis=1)], np.inf)


def forecast(
    so_far: Recording,
    plan: Recording,
    repetitions: int = 1,
    *,
    network: Identified | None = None,
    ambient_c: float | None = None,
    seed: int = 0,
) -> ThermalForecast:
    """Temperatures of the motors if the arm repeats a motion right after a log.

    Args:
        so_far: With motor temperatures; its last two hours are used.
        plan: One repetition; its temperatures are not read.
        network: Of this arm; default: a nominal Gen3 in still air, with the spread of arms.
        ambient_c: Default: that of the identification.

    Raises:
        FleetError: an argument is not allowed; the log has no temperatures, or less than a minute since its last gap; a
            motor is below the ambient temperature; the plan has a gap or too few samples; there are other than seven
            joints; or the run is longer than a week.
    """
    check_recordings((so_far, plan))
    repetitions = check_value("repetitions", repetitions, int, low=1, high=1_000_000)
    ambient_c = check_value("ambient_c", ambient_c, float, low=-40, high=60, takes_none=True)
    seed = check_value("seed", seed, int, low=0, high=MAX_SEED)
    if network is not None:
        check_instance("network", network, Identified, "the result of identify()")
    vector = _parameters(network)
    ambient_c = (AMBIENT_C if network is None else network.ambient_c) if ambient_c is None else ambient_c
    motors = vector.nominal.motors
    (log, last_c), cycle_log = _end_of(so_far, motors, ambient_c), _cycle_of(plan, motors)
    cycle_s = plan.duration_s
    run_s = repetitions * cycle_s
    if run_s > MOST_S:
        hours, most = distinguish(run_s / 3600, MOST_S / 3600)
        raise FleetError(f"The run takes {hours} h; at most {most} h can be forecast.")
    problem = Problem([log], ambient_c, 0.0, vector, _noise(log, vector))
    problem.relative_sd = OBSERVED
    likely, rng = solve(problem, vector.mean), np.random.default_rng(np.random.SeedSequence(seed))
    x = problem.samples(likely, SAMPLES, rng)
    start_c = np.stack([problem.temperatures(each, rng)[0][-1] for each in x])
    likely_c = problem.temperatures(likely)[0][-1]
    # Two more with the likely network, of which one starts 1 K warmer.
    x = np.concatenate([x, likely[None], likely[None]])
    start_c = np.concatenate([start_c, likely_c[None], likely_c[None]])
    start_c[:, WINDING] = last_c
    start_c[-1] += 1.0
    steps = max(round(cycle_s / STEP_S), 1)
    dt_s = cycle_s / steps if steps > 1 else run_s / max(round(run_s / STEP_S), 1)
    values = vector.values(x)
    loads = _loads(cycle_log, motors, steps, values, start_c)
    count = math.ceil(max(run_s, LONGEST_S) / dt_s - 1e-9)
    course = temperature_steps(
        islice(cycle(loads), count),
        dt_s,
        motors=replace(motors, **{name: values[name] for name in values if hasattr(motors, name)}),
        thermal=vector.models(x),
        start_c=start_c,
        ambient_c=ambient_c + np.append(DRIFT_K * rng.standard_normal(SAMPLES), [0.0, 0.0]),  # of the likely ones
    )
    # Of a long run the highest temperature in several steps is kept, so that no peak is lost.
    edges = sorted({*range(0, count, math.ceil(count / MOST_POINTS)), round(run_s / dt_s), count})
    kept = [next(course)[:, WINDING]]
    for first, last in pairwise(edges):
        kept.append(np.max([each[:, WINDING] for each in islice(course, last - first)], axis=0))
    temp_c = np.stack(kept, axis=1)
    return ThermalForecast(
        time_s=dt_s * np.array(edges),
        sampled_c=temp_c[:SAMPLES].astype(np.float32),
        slope=temp_c[-1] - temp_c[-2],
        run_s=run_s,
        cycle_s=cycle_s,
        ambient_c=ambient_c,
        residual_k=np.sqrt(np.mean(problem.unexplained(likely)[0] ** 2, axis=0)),
        distance_sd=float((np.abs(likely - vector.mean) / np.hypot(vector.sd, FROM_LOG_TO_LOG)).max()),
        unlike=Unlike() if network is not None else _unlike(problem, likely),
        way_back_rad=float(np.abs(half_turn(plan.q[-1] - plan.q[0])).max()),
    )


def _unlike(problem: Problem, likely: Array) -> Unlike:
    """Common changes of a nominal Gen3 by a log."""
    vector, jacobian = problem.vector, problem.jacobian(likely)
    prior = vector.information.T @ vector.information
    return Unlike.of(vector.names, likely - vector.mean, prior, jacobian.T @ jacobian, problem.logs[0].source)


def _parameters(network: Identified | None) -> ParameterVector:
    """The parameters of an arm with their standard deviations; those of any Gen3 without a network."""
    if network is None:
        return ParameterVector(nominal_heat_model())
    vector = ParameterVector(network.heat_model, tuple(dict.fromkeys(p.name for p in network.parameters)))
    vector.sd = np.array([p.sd for p in network.parameters])  # in the order of the vector, as `identify` made them
    root = np.diag(1.0 / vector.sd) if network.information is None else network.information.astype(float)
    covariance = np.linalg.inv(root.T @ root) + FROM_LOG_TO_LOG**2 * np.eye(len(vector))
    vector.information = np.linalg.cholesky(np.linalg.inv(covariance)).T
    return vector


def _noise(log: HeatLog, vector: ParameterVector) -> Noise:
    """Cautious noise of the residuals: most of that of a motor under load is an error of its heat."""
    values = vector.values(vector.mean)
    current_sq = log.current_sq(values["coulomb_nm"], values["viscous_nms_per_rad"])
    heat_w = values["copper_w_per_a2"] * np.average(current_sq, axis=0, weights=log.dt_s)
    rise_k = heat_w * values["winding_housing_k_per_w"]
    steps = max(RESIDUAL_S / float(np.median(log.dt_s)), 1.0)
    return Noise(np.hypot(REST_K, HEAT_ERROR * rise_k), np.full(JOINTS, steps))


def _end_of(so_far: Recording, motors: Motors, ambient_c: float) -> tuple[HeatLog, Array]:
    """The last stretch of a log without a gap, in at most `MOST_STEPS` steps, and its last motor temperatures."""
    if so_far.temp_c is None:
        raise FleetError(f"The log '{so_far.name}' has no motor temperatures, from which a forecast starts.")
    late = so_far.part(so_far.time_s >= so_far.time_s[-1] - MEMORY_S)
    logs = heat_logs(late, motors, source_of([late]), step_s=max(STEP_S, late.duration_s / MOST_STEPS))
    if not logs or logs[-1].time_s[-1] < late.time_s[-1] - LEAST_S or np.ptp(logs[-1].time_s) < LEAST_S:
        raise FleetError(
            f"The log '{so_far.name}' has less than {LEAST_S:.0f} s since its start or its last gap. Housings have no "
            "sensor: record some minutes before the forecast, better half an hour."
        )
    check_ambient(late, ambient_c)
    return logs[-1], so_far.temp_c[-1]


def _cycle_of(plan: Recording, motors: Motors) -> HeatLog:
    """The heat of a repetition, in every interval between samples."""
    fresh = without_repeats(plan)
    plan = fresh if len(fresh.time_s) >= LEAST_SAMPLES else plan  # of a constant plan nothing would be left
    silent = replace(plan, temp_c=np.tile(plan.time_s[:, None], plan.joints))  # of no use here, but never repeats
    logs = heat_logs(silent, motors, source_of([plan]), step_s=0.0)
    if len(plan.time_s) < LEAST_SAMPLES:
        raise FleetError(
            f"The plan '{plan.name}' has {len(plan.time_s)} samples; at least {LEAST_SAMPLES} are needed, better 2 a "
            "second."
        )
    gap = int(np.diff(plan.time_s).argmax())
    if len(logs) != 1 or len(logs[0].time_s) != len(plan.time_s):
        length, most = distinguish(plan.time_s[gap + 1] - plan.time_s[gap], HEAT_GAP_S)
        raise FleetError(
            f"The plan '{plan.name}' has a gap of {length} s after {plan.time_s[gap]:.6g} s; at most {most} s are "
            "allowed, as its heat is unknown."
        )
    return logs[0]


def _loads(cycle_log: HeatLog, motors: Motors, steps: int, values: Mapping[str, Array], start_c: Array) -> list[Drive]:
    """Mean drives of a repetition in equal steps, each [sample, joint]."""
    time_s = cycle_log.time_s
    edges_s = np.linspace(time_s[0], time_s[-1], steps + 1)
    log = replace(
        cycle_log,
        time_s=edges_s,
        current_terms=_means(time_s, cycle_log.current_terms, edges_s),
        friction_terms=_means(time_s, cycle_log.friction_terms, edges_s),
    )
    current_sq = log.current_sq(values["coulomb_nm"], values["viscous_nms_per_rad"])
    if log.source == "current":  # of warm magnets
        current_sq = current_sq * magnet_factor(start_c[:, None, HOUSING], motors) ** 2
    friction_w = log.friction_w(values["coulomb_nm"], values["viscous_nms_per_rad"])
    return [Drive(current_sq[:, i], friction_w[:, i]) for i in range(steps)]


def _means(time_s: Array, values: Array, edges_s: Array) -> Array:
    """Time means between edges of values that are constant between samples."""
    total = np.cumsum(values * np.diff(time_s)[:, None, None], axis=0)
    integral = make_interp_spline(time_s, np.concatenate([np.zeros_like(total[:1]), total]), k=1)
    return np.diff(integral(edges_s), axis=0) / np.diff(edges_s)[:, None, None]
