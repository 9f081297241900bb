"""Posture recovery: a warm arm that holds a payload moves to a nearby posture that its twin rates as easier.

Candidates are sampled near the latent of the hold (decoded to positions) and near the posture in joint space, then
again around the best of them. They are ranked by the twin's one-sided torque error of the hottest measured motor: of
nine scores its rank correlation with the true temperature after ten minutes was highest (.95 to 1.00 over ten holds of
two arms; the paper's d of that motor .29 to .96). The largest torque over nominal, without a twin, reached 1.00.

The thermal model then accepts a posture only if the hottest motor is predicted to cool, and no motor to become as warm
as it was. The prediction needs housing temperatures, which have no sensor: the arm first measures for half a minute how
fast its windings warm, which determines the heat flow into the housings (`housing_estimate`).

MuJoCo performs the posture found, and the same hold without recovery from the same temperatures. In both the arm first
observes its motors for `Nearby.watch_s`.
"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import repeat
from operator import attrgetter
from pathlib import Path
from typing import Any  # Any: values of the JSON card

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.arm.model import ArmModel
from fleet.arm.random_motions import plan_motion
from fleet.engine.world import Arm
from fleet.errors import FleetError, InfeasibleJob, distinguish, nearest
from fleet.files import cache_folder
from fleet.heat.motor import Motors
from fleet.heat.thermal import (
    HOUSING,
    NODES,
    WINDING,
    ThermalModel,
    drive_heat,
    simulate_temperatures,
    temperature_steps,
)
from fleet.job import BOUNDS, Fixture
from fleet.motion import RATE_HZ, Plan, static_drive
from fleet.robot import JOINTS, POSTURES, Mount, Robot
from scenarios.motion.generate import Generated, Performance, Verification, bare_arm, perform
from scenarios.prepare.arms import plan_arms
from scenarios.prepare.twins import require_cool_plans, train_twins
from scenarios.progress import Progress, quiet
from scenarios.result_folder import ResultKind, new_folder
from scenarios.spec.jobs import rehearsal_works
from scenarios.spec.schema import Scenario
from twin.thermal.identify import Identified
from twin.vae.measures import Features
from twin.vae.twin import Twin
from twin.vae.window import PHASES

Array = np.ndarray

INSTANT_S = 0.02
"""Duration of the first stop, one sample: the payload is grasped at its end, then the observation begins."""
STOP_S = 1.0
"""Standstill at each posture of a motion that postures describe."""
BEST = 10
"""Number of candidates with a second search around them."""
ROUNDS = 3
"""Fixed-point iterations; the magnets weaken by only 0.1 % per kelvin of the housing, so they converge fast."""
CLOSER = 0.3
"""Size of the second search relative to the first."""


class RecoveryError(FleetError):
    """A posture recovery that is out of range or has no better posture."""


@dataclass(frozen=True, kw_only=True)
class Nearby:
    """Limits and sampling of the search."""

    joint_rad: float = 0.6
    """Largest displacement of a joint."""
    tool_m: float = 0.3
    """Largest displacement of the tool."""
    candidates: int = 600
    """Postures drawn from each neighbourhood."""
    latent_scale: float = 4.0
    """Largest perturbation of the latent, in posterior standard deviations."""
    cooling_k: float = 2.0
    """Least predicted cooling of the hottest motor, because the prediction is not exact."""
    watch_s: float = 30.0
    """Observation time before the arm moves. Twice as long heats the motors longer; half as long doubles the housing
    error of 0.2 K that 0.05 K of noise causes."""
    speed: float = 0.5
    """Share of the joint limits at which the arm moves."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A posture near the hold."""

    q: Array
    """rad, [joint]."""
    origin: str
    """latent or joint space."""
    tool_m: float
    """Displacement of the tool."""
    error: float
    """One-sided torque error of the hottest motor, z units; it also ranks where the difficulty has saturated."""


@dataclass(frozen=True, eq=False)
class Search:
    """Search for one arm that holds a payload."""

    twin: Twin
    model: ArmModel
    known: Verification
    """The arm's thermal parameters."""
    near: Nearby
    q: Array
    """rad, [joint]."""
    payload_kg: float
    before_c: Array
    """Winding temperatures as measured when the arm began to watch, [joint]."""
    winding_c: Array
    """As measured now, `Nearby.watch_s` later, [joint]."""
    hold_s: float
    """Remaining time of the hold."""

    @property
    def hottest(self) -> int:
        """The hottest motor, index 0..6."""
        return int(np.argmax(self.winding_c))

    def best(self, rng: np.random.Generator) -> tuple[Candidate, Plan, dict[str, int], dict[str, float]]:
        """The easiest candidate that passes every check.

        Returns:
            The candidate; its plan: from home to the old posture while observing, to the new one for the rest of the
            time, and back; easier candidates that were rejected, by reason; and the smallest error by origin.

        Raises:
            RecoveryError: no candidate passes.
        """
        now = float(holding(self.twin, self.model, self.q[None], self.payload_kg).one_sided[0, self.hottest])
        latent = self._candidates(self._decoded(rng), "latent")
        around = self.q + self.near.joint_rad * rng.uniform(-1.0, 1.0, (self.near.candidates, JOINTS))
        joint_space = self._candidates(around, "joint space")
        first = sorted(latent + joint_space, key=attrgetter("error"))
        ranked = sorted(first + self._refined(first[:BEST], rng), key=attrgetter("error"))
        best_error = {some[0].origin: min(c.error for c in some) for some in (latent, joint_space) if some}
        passed_over = Counter[str]()
        for candidate in ranked:
            if candidate.error >= now:
                break
            plan = self._plan_or_reason(candidate.q)
            if isinstance(plan, Plan):
                return candidate, plan, dict(passed_over), best_error
            passed_over[plan] += 1
        raise RecoveryError(self._failure(len(ranked), passed_over))

    def _plan_or_reason(self, posture: Array) -> Plan | str:
        """The plan of moving there and holding, or the reason of a rejection."""
        if reason := self._thermal_objection(posture):
            return reason
        try:
            return plan_motion(
                self.model,
                np.stack([self.q, self.q, posture]),
                dwell_s=[INSTANT_S, self.near.watch_s, self.hold_s],
                payload_kg=self.payload_kg,
                speed=self.near.speed,
                name="recovery",
            )
        except InfeasibleJob as error:
            return error.reason.split(":")[0]

    def _failure(self, count: int, passed_over: Counter[str]) -> str:
        reasons = ", ".join(f"{reason} {times}" for reason, times in passed_over.most_common())
        return (
            f"No better posture near: of {count} within {self.near.joint_rad:g} rad per joint and "
            f"{self.near.tool_m:g} m of the tool, {passed_over.total()} are easier for joint {self.hottest + 1}"
            + (f", and all of them were rejected ({reasons})" if reasons else "")
            + ". Allow more displacement, or put the payload down."
        )

    def _decoded(self, rng: np.random.Generator) -> Array:
        """Postures decoded around the latent of this hold, or between the hold and those."""
        mu, sigma = self.twin.posterior(_windows(self.twin, self.model, self.q[None], self.payload_kg))
        count = self.near.candidates
        scale = rng.uniform(0.0, self.near.latent_scale, (count, 1, 1))
        latent = mu + scale * rng.standard_normal((count, *mu.shape[1:])) * sigma
        decoded = self.twin.decode(latent.astype(np.float32))[..., 0].mean(axis=1)
        away = decoded - self.q
        endless = np.isinf(self.model.position_range).any(axis=1)
        away -= np.where(endless, 2 * np.pi * np.round(away / (2 * np.pi)), 0.0)
        return self.q + rng.uniform(0.0, 1.0, (count, 1)) * away

    def _refined(self, leaders: list[Candidate], rng: np.random.Generator) -> list[Candidate]:
        """Candidates near the easiest ones, including the border of the allowed range."""
        refined: list[Candidate] = []
        for leader in leaders:
            step = CLOSER * self.near.joint_rad * rng.standard_normal((self.near.candidates // BEST + 1, JOINTS))
            away = np.clip(leader.q + step - self.q, -self.near.joint_rad, self.near.joint_rad)
            refined += self._candidates(self.q + away, leader.origin)
        return refined

    def _candidates(self, postures: Array, origin: str) -> list[Candidate]:
        """Postures within the limits and joint stops, with the twin's score."""
        low, high = self.model.position_range.T
        here = self.model.tool_pose(self.q)[0]
        turned = np.abs(postures - self.q).max(axis=1) <= self.near.joint_rad + 1e-9
        postures = postures[turned & ((postures >= low) & (postures <= high)).all(axis=1)]
        tool_m = np.array([np.linalg.norm(self.model.tool_pose(posture)[0] - here) for posture in postures])
        kept = tool_m <= self.near.tool_m
        if not kept.any():
            return []
        error = holding(self.twin, self.model, postures[kept], self.payload_kg).one_sided[:, self.hottest]
        rows = zip(postures[kept], tool_m[kept].tolist(), error.tolist(), strict=True)
        return [Candidate(q, origin, far, e) for q, far, e in rows]

    def _thermal_objection(self, posture: Array) -> str | None:
        """Reason why the predicted temperatures exclude a posture, or None."""
        end_c = self._end_temperatures(posture)
        if end_c[self.hottest] > self.before_c[self.hottest] - self.near.cooling_k:
            return "would not cool"
        return "another motor as hot" if end_c.max() >= self.before_c.max() else None

    def _end_temperatures(self, posture: Array) -> Array:
        """Predicted winding temperatures after the rest of the hold in this posture, °C, [joint]."""
        known, tau = self.known, self.model.gravity_torque(posture, self.payload_kg)
        simulated = simulate_temperatures(
            static_drive(tau, known.motors),
            [self.hold_s],
            motors=known.motors,
            thermal=known.thermal,
            start_c=self._start_c,
            ambient_c=known.ambient_c,
        )
        return simulated.end_c[0, WINDING]

    @cached_property
    def _start_c(self) -> Array:
        """Estimated temperatures of the nodes, °C, [node]."""
        known, tau = self.known, self.model.gravity_torque(self.q, self.payload_kg)
        housing_c = housing_estimate(
            self.before_c, self.winding_c, self.near.watch_s, tau, known.motors, known.thermal, known.ambient_c
        )
        return np.concatenate([self.winding_c, housing_c])


def holding(twin: Twin, model: ArmModel, q: Array, payload_kg: float) -> Features:
    """Twin features of standing in postures [posture, joint] with a payload, [posture, joint, part]."""
    return twin.window_features(_windows(twin, model, q, payload_kg))


def _windows(twin: Twin, model: ArmModel, q: Array, payload_kg: float) -> Array:
    """Windows of standing still, [posture, time, joint, channel]."""
    tau = np.stack([model.gravity_torque(posture, payload_kg) for posture in q])
    return np.repeat(np.stack([q, np.zeros_like(q), tau], axis=-1)[:, None], twin.config.window, axis=1)


def housing_estimate(
    before_c: Array,
    winding_c: Array,
    watched_s: float,
    tau: Array,
    motors: Motors,
    thermal: ThermalModel,
    ambient_c: float,
) -> Array:
    """Housing temperatures of an arm that holds `tau` N·m, °C, [joint], from two readings of its windings.

    Heat that a winding does not store flows into its housing, C Tw' = P − (Tw − Th) / R, averaged over the time between
    the readings. The result is never below the ambient temperature. It neglects the housing's drift and the curvature
    of the winding temperature, some tenths of a kelvin. Readings rounded to 1 K would cause 2 K over half a minute.

    Args:
        before_c: Winding temperatures at the first reading, °C, [joint].
        winding_c: The same `watched_s` later.
    """
    mean_c = 0.5 * (before_c + winding_c)
    conductance = -np.diagonal(thermal.laplacian[WINDING, HOUSING])
    kept_w = thermal.capacity[WINDING] * (winding_c - before_c) / watched_s
    load, housing_c = static_drive(tau, motors), mean_c
    for _ in range(ROUNDS):
        loss_w = drive_heat(np.concatenate([mean_c, housing_c]), load.current_sq, load.friction_w, motors)[WINDING]
        housing_c = np.maximum(mean_c - (loss_w - kept_w) / conductance, ambient_c)
    return housing_c


MOST_PAYLOAD_KG = 4.5
"""Kinova's rating of a Gen3 without gripper: 4.5 kg at full reach for a while (user guide, technical
specifications)."""
TICK_S = 2.0
"""Time step of temperatures while a hold is performed."""
MOST_HOLD_S = BOUNDS["dwell_s"].high
"""Longest hold that is planned, s."""
LEAST_REST_S = BOUNDS["dwell_s"].low
"""Shortest hold in the new posture, s."""


@dataclass(frozen=True, eq=False)
class Recovery:
    """A hold with and without recovery, both performed from the same temperatures."""

    search: Search
    """The arm, its twin and the hold."""
    found: Candidate
    """The new posture."""
    passed_over: dict[str, int]
    """Easier candidates that were rejected, by reason."""
    best_error: dict[str, float]
    """Smallest one-sided torque error of the hottest motor, z units, by origin of the candidates."""
    time_s: Array
    """Time since the arm left home to hold, at `start_c`, s, [time]."""
    without_c: Array
    """True winding temperatures without recovery, °C, [time, joint]."""
    with_c: Array
    """The same with recovery, °C, [time, joint]."""
    error_rad: float
    """Largest deviation of a joint from its plan during the recovery."""

    @property
    def hottest(self) -> int:
        """Hottest motor at the start, index 0..6."""
        return self.search.hottest

    @property
    def cooled_k(self) -> float:
        """Temperature drop of the hottest motor from start to end."""
        return float(self.with_c[0, self.hottest] - self.with_c[-1, self.hottest])

    @property
    def spared_k(self) -> float:
        """Difference of the hottest motor at the end, without minus with recovery."""
        return float(self.without_c[-1].max() - self.with_c[-1].max())


def recover(
    twin: Twin,
    arm: Arm,
    q: Array,
    payload_kg: float,
    *,
    start_c: Array,
    verification: Verification,
    hold_s: float = 600.0,
    nearby: Nearby | None = None,
    fixtures: Sequence[Fixture] = (),
    seed: int = 0,
) -> Recovery:
    """Find an easier posture near a hold, and perform the hold with and without moving there.

    Args:
        arm: The true arm.
        q: Posture in which it holds the payload, rad, [joint].
        start_c: True temperatures, °C, [node]; the arm measures those of the windings.
        verification: The arm's thermal parameters and the ambient temperature.
        hold_s: Remaining time of the hold.
        fixtures: Boxes that neither the arm nor its payload may touch.

    Raises:
        RecoveryError: the payload, the posture or the time is out of range, the hold is infeasible, or no near posture
            is better.
    """
    near = nearby or Nearby()
    model = ArmModel(arm.robot, fixtures)
    check_hold(model, q, payload_kg, hold_s, near)
    try:
        stay = plan_motion(model, np.stack([q]), dwell_s=[hold_s], payload_kg=payload_kg, speed=near.speed, name="hold")
    except InfeasibleJob as error:
        raise RecoveryError(f"Arm '{arm.robot.name}' cannot hold {payload_kg:g} kg there: {error.reason}.") from error
    on = partial(perform, arm, start_c=start_c, ambient_c=verification.ambient_c, tick_s=TICK_S)
    time_s = np.arange(0.0, hold_s + 1e-9, TICK_S)
    stayed = on(stay)
    before_c, now_c = _held(stayed, np.array([0.0, near.watch_s]))
    search = Search(
        twin, model, verification, near, np.asarray(q, dtype=float), payload_kg, before_c, now_c, hold_s - near.watch_s
    )
    found, plan, passed_over, best_error = search.best(np.random.default_rng(np.random.SeedSequence(seed)))
    recovered = on(plan)
    return Recovery(
        search=search,
        found=found,
        passed_over=passed_over,
        best_error=best_error,
        time_s=time_s,
        without_c=stayed.temp_c[: len(time_s)],
        with_c=recovered.temp_c[: len(time_s)],
        error_rad=recovered.error_rad,
    )


def _held(run: Performance, time_s: Array) -> Array:
    """Winding temperatures at times since the arm began to hold, °C, [time, joint]."""
    since_s = run.time_s - run.plan.approach.duration_s
    return np.stack([np.interp(time_s, since_s, temp_c) for temp_c in run.temp_c.T], axis=1)


def check_hold(model: ArmModel, q: Array, payload_kg: float, hold_s: float, near: Nearby) -> None:
    """Raise RecoveryError if the payload, the posture or the remaining time of a hold is out of range."""
    if not 0 <= payload_kg <= MOST_PAYLOAD_KG:
        raise RecoveryError(f"A Gen3 is rated for a payload of 0 … {MOST_PAYLOAD_KG:g} kg (got {payload_kg:g}).")
    posture = np.asarray(q, dtype=float)
    if posture.shape != (JOINTS,) or not np.isfinite(posture).all():
        raise RecoveryError(f"A posture is {JOINTS} finite joint angles, rad (got {q}).")
    low, high = model.position_range.T
    for j in np.flatnonzero((posture < low) | (posture > high)):
        raise RecoveryError(
            f"Joint {j + 1} turns from {low[j]:.2f} to {high[j]:.2f} rad, so the arm cannot hold at {posture[j]:.2f}."
        )
    if not hold_s - near.watch_s >= LEAST_REST_S:
        raise RecoveryError(
            f"The arm observes its motors for {near.watch_s:g} s before it moves, so the hold must be longer by "
            f"{LEAST_REST_S:g} s or more (got {hold_s:g} s)."
        )
    if hold_s > MOST_HOLD_S:
        raise RecoveryError(f"A hold lasts {MOST_HOLD_S:g} s at most (got {hold_s:g} s).")


def hold_until(
    arm: Arm, q: Array, payload_kg: float, *, ambient_c: float, until_c: float, most_s: float = 7200.0
) -> Array:
    """True temperatures when the hottest motor reaches `until_c` in a hold from a cold start, °C, [node].

    Raises:
        RecoveryError: it stays cooler, or the air is warmer.
    """
    if until_c <= ambient_c:
        raise RecoveryError(f"A motor is never at {until_c:g} °C in air of {ambient_c:g} °C: give a warmer one.")
    temp_c = np.full(NODES, float(ambient_c))
    load = static_drive(ArmModel(arm.robot).gravity_torque(q, payload_kg), arm.motors)
    alike = {"motors": arm.motors, "thermal": arm.thermal, "start_c": temp_c, "ambient_c": ambient_c}
    for temp_c in temperature_steps(repeat(load, round(most_s / TICK_S)), TICK_S, **alike):
        if temp_c[WINDING].max() >= until_c:
            return temp_c
    hottest, until = distinguish(float(temp_c[WINDING].max()), until_c)
    raise RecoveryError(
        f"Arm '{arm.robot.name}' does not get warm: holding {payload_kg:g} kg there for {most_s / 60:g} min heats its "
        f"hottest motor to {hottest} °C, less than {until} °C. There is nothing to recover from."
    )


class PostureError(FleetError):
    """A posture that cannot be read, or that is beyond a joint stop; says what is allowed."""


def parse_posture(text: str, position_range: Array | None = None) -> Array:
    """Joint positions, rad, [joint], of a posture's name or of seven comma-separated angles in degrees.

    Args:
        position_range: Lowest and highest joint position, rad, [joint, 2]; not checked if not given.

    Raises:
        PostureError: unknown name, not seven numbers, or a joint beyond its stop.
    """
    if text in POSTURES:
        return np.array(POSTURES[text])
    try:
        degrees = np.array([float(part) for part in text.split(",")])
    except ValueError:
        hint = nearest(text, POSTURES).removesuffix(".")
        raise PostureError(f"No posture '{text}'{hint}, or {JOINTS} comma-separated angles in degrees.") from None
    if degrees.shape != (JOINTS,) or not np.all(np.isfinite(degrees)):
        raise PostureError(f"A posture is a name or {JOINTS} comma-separated angles in degrees (got '{text}').")
    if position_range is not None:
        low, high = np.rad2deg(position_range).T
        for j in np.flatnonzero((degrees < low) | (degrees > high)):
            raise PostureError(f"Joint {j + 1} turns from {low[j]:.1f} to {high[j]:.1f} degrees (got {degrees[j]:g}).")
    return np.deg2rad(degrees)


@dataclass(frozen=True, eq=False)
class KnownArm:
    """An arm, its twin, and its motions that stay cool over the horizon of a rehearsal."""

    arm: Arm
    twin: Twin
    sources: tuple[Plan, ...]
    verification: Verification
    """With what the arm knows of its motors, at the rehearsal's ambient temperature, horizon and limit."""


def known_arm(
    scenario: Scenario,
    name: str | None = None,
    *,
    twin: Twin | None = None,
    network: Identified | None = None,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> KnownArm:
    """An arm of a scenario by name; without one, the first.

    Args:
        network: Its thermal network, for predictions; by default that of a nominal Gen3 with the arm's cooling.
        twin: Its twin; by default that with which the arm works in the scenario's fleet, trained or from the cache.

    Raises:
        FleetError: no such arm, a twin of another arm, or no motion of this arm stays cool.
    """
    name = scenario.arms[0].name if name is None else name
    index = scenario.index_of(name)
    if twin is not None and twin.arm != name:
        raise FleetError(f"This is the twin of arm '{twin.arm}', not of '{name}'; give the one that belongs to it.")
    folder = cache or cache_folder()
    (planned,) = plan_arms(scenario, [index], rehearsal_works(scenario), folder, progress)
    robot, motors, thermal = planned.hardware
    if twin is None:
        (twin,) = train_twins(scenario, [planned], folder, progress)
    sources = require_cool_plans(planned.all_plans, planned.hardware, scenario)
    spec = scenario.twin
    verification = Verification.nominal(robot, spec.ambient_c, cool_c=spec.cool_c, horizon_s=spec.horizon_s)
    if network is not None:
        model = network.heat_model
        verification = replace(verification, motors=model.motors, thermal=model.thermal())
    return KnownArm(bare_arm(robot, motors, thermal), twin, sources, verification)


def logged_arm(twin: Twin, network: Identified, tilt_deg: str, tool_kg: float) -> KnownArm:
    """An arm that is known by its logs: simulated with the thermal network that they gave, without known motions.

    Args:
        tilt_deg: Roll, pitch and yaw of its base, degrees, with commas between them.

    Raises:
        FleetError: the tilt or the mass of the tool is out of range.
    """
    try:
        roll, pitch, yaw = (float(part) for part in tilt_deg.split(","))
        robot = Robot(name=twin.arm, mount=Mount(tilt_deg=(roll, pitch, yaw)), tool_kg=tool_kg)
    except ValueError as error:
        raise FleetError(f"The tilt is three angles in degrees, as 0,90,0 (got '{tilt_deg}': {error}).") from error
    model = network.heat_model
    verification = Verification(motors=model.motors, thermal=model.thermal(), ambient_c=network.ambient_c)
    return KnownArm(bare_arm(robot, model.motors, model.thermal()), twin, (), verification)


def motion_through(model: ArmModel, postures: Sequence[str], payload_kg: float) -> tuple[Plan, ...]:
    """The motion from posture to posture and back, each a name or seven angles in degrees.

    Raises:
        FleetError: a posture cannot be read, all are the same, or the motion is not possible.
    """
    stops = np.stack([parse_posture(each, model.position_range) for each in postures])
    if (stops == stops[0]).all():
        raise FleetError(f"A motion has at least two different postures (got {'; '.join(postures)}).")
    try:
        return (plan_motion(model, stops, dwell_s=STOP_S, payload_kg=payload_kg, speed=Nearby().speed),)
    except InfeasibleJob as error:
        raise FleetError(f"The motion through {', '.join(postures)} is not possible: {error.reason}.") from error


GENERATED = ResultKind(name="generation", card="generated.json", files=("generated.json", "motion_*.parquet"))
"""One table per motion, and a card with sources and rejections."""
RECOVERY = ResultKind(name="recovery", card="recovery.json", files=("recovery.json", "recovery.parquet"))
"""Temperatures with and without recovery, and a card with the postures."""


def save_generated(made: Generated, out: Path, *, overwrite: bool = False) -> None:
    """Write `motion_000` and so on, and `generated.json`.

    Raises:
        FleetError: `out` cannot be written, or holds something that is not ours to replace.
    """
    with new_folder(out, GENERATED, overwrite=overwrite) as folder:
        for i, motion in enumerate(made.motions):
            pq.write_table(motion_table(made.arm, motion.plan), folder / f"motion_{i:03d}.parquet")
        _write_card(generated_summary(made), folder / GENERATED.card)


def save_recovery(recovery: Recovery, out: Path, *, overwrite: bool = False) -> None:
    """Write `recovery.parquet` and `recovery.json`.

    Raises:
        FleetError: `out` cannot be written, or holds something that is not ours to replace.
    """
    with new_folder(out, RECOVERY, overwrite=overwrite) as folder:
        temperatures = {
            **_columns("without", "_c", recovery.without_c),
            **_columns("with", "_c", recovery.with_c),
        }
        pq.write_table(pa.table({"time_s": recovery.time_s, **temperatures}), folder / "recovery.parquet")
        _write_card(recovery_summary(recovery), folder / RECOVERY.card)


def motion_table(arm: str, plan: Plan) -> pa.Table:
    """A plan as one row per sample, a log as telemetry.parquet is one: q_1 … rad, qd_1 … rad/s, tau_1 … N·m."""
    profile = np.concatenate([phase.profile for phase in plan.phases])
    lengths = [len(phase.profile) for phase in plan.phases]
    return pa.table(
        {
            "time_s": np.arange(len(profile)) / RATE_HZ,
            "arm": [arm] * len(profile),
            "phase": np.repeat(PHASES, lengths),
            "payload_kg": np.concatenate([phase.payload_kg for phase in plan.phases]),
            **_columns("q", "", profile[:, 0]),
            **_columns("qd", "", profile[:, 1]),
            **_columns("tau", "", profile[:, 2]),
        }
    )


def _columns(name: str, unit: str, values: Array) -> dict[str, Array]:
    """Columns `name_1unit` … of values [row, joint]."""
    return {f"{name}_{j + 1}{unit}": values[:, j] for j in range(JOINTS)}


def generated_summary(made: Generated) -> dict[str, Any]:
    """Motions, sources and rejections as plain values."""
    return {
        "status": "finished",
        "arm": made.arm,
        "twin": made.twin_version,
        "s": made.s,
        "seed": made.seed,
        "asked": made.asked,
        "handed_out": len(made.motions),
        "rejected": dict(made.rejected),
        "truly_cool": made.truly_cool,
        **{name: getattr(made.verification, name) for name in ("cool_c", "margin_k", "horizon_s", "ambient_c")},
        "rate_hz": RATE_HZ,
        "motions": [
            {
                "file": f"motion_{i:03d}.parquet",
                "source": {
                    "kind": motion.source.work.kind,
                    "places": list(motion.source.work.stations),
                    "elbow": motion.source.elbow,
                    "speed": motion.source.speed,
                },
                "payload_kg": motion.source.work.payload_kg,
                "duration_s": motion.plan.duration_s(1),
                "distance_rad": motion.distance_rad,
                "distance_z": motion.distance_z,
                "predicted_peak_c": float(motion.predicted_c.max()),
                "true_peak_c": float(motion.peak_c.max()),
                "tracking_error_rad": motion.error_rad,
            }
            for i, motion in enumerate(made.motions)
        ],
    }


def recovery_summary(recovery: Recovery) -> dict[str, Any]:
    """The recovery as plain values; joints are counted from one."""
    search, found, hottest = recovery.search, recovery.found, recovery.hottest
    before, after = (
        holding(search.twin, search.model, q[None], search.payload_kg).load[0] for q in (search.q, found.q)
    )
    return {
        "status": "finished",
        "arm": search.model.robot.name,
        "twin": search.twin.version,
        "payload_kg": search.payload_kg,
        "hottest_joint": hottest + 1,
        "q_before_rad": search.q.tolist(),
        "q_after_rad": found.q.tolist(),
        "origin": found.origin,
        "most_moved_rad": float(np.abs(found.q - search.q).max()),
        "tool_moved_m": found.tool_m,
        "difficulty_before": before.tolist(),
        "difficulty_after": after.tolist(),
        "best_error": recovery.best_error,
        "passed_over": recovery.passed_over,
        "start_c": float(recovery.with_c[0, hottest]),
        "end_with_c": float(recovery.with_c[-1, hottest]),
        "end_without_c": float(recovery.without_c[-1, hottest]),
        "cooled_k": recovery.cooled_k,
        "spared_k": recovery.spared_k,
        "tracking_error_rad": recovery.error_rad,
    }


def _write_card(card: dict[str, Any], path: Path) -> None:
    path.write_text(json.dumps(card, indent=1, allow_nan=False) + "\n", encoding="utf-8")
