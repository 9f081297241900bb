"""Simulated logs of an arm at work, and its thermal network identified from them."""

from collections.abc import Sequence

import numpy as np

from fleet.motion import RATE_HZ, Drive, Plan, static_drive
from fleet.motor import friction_heat, magnet_factor, reference_current
from fleet.physics.models import ArmModel
from fleet.thermal import HOUSING, WINDING, node_heat, temperature_steps
from scenarios.prepare.planned_arm import ArmHardware
from twin.logs.heat_log import STEP_S
from twin.logs.recording import Recording
from twin.thermal.identify import identify
from twin.thermal.result import Identified

Array = np.ndarray

LOG_HZ = 2.0
"""Sampling rate of the public logs of a real Gen3."""
AIR_SD_K = 1.5
"""Standard deviation of a recording's ambient temperature around the usual one."""
LOGS = 6
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
