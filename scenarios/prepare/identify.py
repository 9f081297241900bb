"""The thermal network of each arm of a scenario, identified from simulated logs of its own cool work."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from fleet.arm.model import ArmModel
from fleet.heat.motor import friction_heat, magnet_factor, reference_current
from fleet.heat.thermal import HOUSING, WINDING, node_heat, temperature_steps
from fleet.motion import RATE_HZ, Drive, Plan, static_drive
from scenarios.prepare.arms import ArmHardware, PlannedArm
from scenarios.prepare.twins import CachedModel, load_or_make, records, require_cool_plans
from scenarios.progress import Progress
from scenarios.spec.schema import Scenario
from twin.logs.recording import STEP_S, Recording
from twin.thermal.checkpoint import load, save
from twin.thermal.identify import Identified, identify

LOG_HZ = 2.0
"""Sampling rate of the public logs of a real Gen3."""
AIR_SD_K = 1.5
"""Standard deviation of a recording's ambient temperature around the usual one."""
SIMULATED_LOGS = 6
"""Recordings, half an hour each, from which the arm of a study is identified."""


def identify_from_work(
    hardware: ArmHardware, plans: Sequence[Plan], rng: np.random.Generator, *, ambient_c: float, step_s: float = STEP_S
) -> Identified:
    """The arm identified from logs of these plans; none of them should overheat it."""
    logs = own_logs(hardware, plans, rng, ambient_c=ambient_c)
    return identify(logs, arm=hardware.robot.name, ambient_c=ambient_c, ambient_sd_k=AIR_SD_K, step_s=step_s)


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


RECIPE = 1
"""Raise it whenever the same arm would get other logs or another result."""
LOGGED = 5
"""Spawn key, different from those of `scenarios.prepare.twins` and `calibrate` for the same arm."""
LOGS = 4
"""Recordings, half an hour each."""
FIT_STEP_S = 20.0
"""Step of the identification: a tenth of a winding's time constant."""


def identify_arms(scenario: Scenario, arms: Sequence[PlannedArm], folder: Path, progress: Progress) -> list[Identified]:
    """The identified network of every arm: from the cache while its inputs are unchanged.

    Raises:
        FleetError: an arm has no motion that stays cool.
    """
    return load_or_make([_model(scenario, arm, folder) for arm in arms], "identifying", progress)


def _model(scenario: Scenario, arm: PlannedArm, folder: Path) -> CachedModel[Identified]:
    cool, ambient_c = require_cool_plans(arm.all_plans, arm.hardware, scenario), scenario.twin.ambient_c
    seed = [scenario.spread.seed, arm.index]

    def make(home: Path, _report: Callable[[float], None]) -> None:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(LOGGED,)))
        chosen = rng.choice(len(cool), size=min(LOGS, len(cool)), replace=False)
        plans = [cool[i] for i in chosen]
        save(identify_from_work(arm.hardware, plans, rng, ambient_c=ambient_c, step_s=FIT_STEP_S), home)

    digest = hashlib.sha256(msgspec.json.encode([RECIPE, seed, ambient_c, arm.hardware.robot]))
    digest.update(arm.hardware.content())
    for record in records(cool):
        digest.update(np.ascontiguousarray(record).tobytes())
    return CachedModel(folder / "identified" / digest.hexdigest()[:32], load, make)
