"""Simulated logs of a studied arm at work, for identification."""

from collections.abc import Sequence

import numpy as np

from fleet.motion import RATE_HZ, Plan, drive, static_drive
from fleet.motor import magnet_factor, reference_current
from fleet.physics.models import ArmModel
from fleet.thermal import HOUSING, WINDING, node_heat, temperature_steps
from scenarios.studies.setup import Study
from twin.logs.recording import Recording
from twin.thermal.identify import identify
from twin.thermal.result import Identified

Array = np.ndarray

LOG_HZ = 2.0
"""Sampling rate of the public logs of a real Gen3."""
AIR_SD_K = 1.5
"""Standard deviation of a recording's ambient temperature around the study's."""


LOGS = 6
"""Recordings, half an hour each, from which the arm is identified."""


def identify_from_work(study: Study, plans: Sequence[Plan], rng: np.random.Generator) -> Identified:
    """The studied arm identified from logs of these plans; none of them should overheat it."""
    logs = own_logs(study, plans, rng)
    return identify(logs, arm=study.robot.name, ambient_c=study.ambient_c, ambient_sd_k=AIR_SD_K)


def own_logs(
    study: Study, plans: Sequence[Plan], rng: np.random.Generator, *, work_s: float = 1200.0, rest_s: float = 600.0
) -> list[Recording]:
    """One recording for each plan: from idle, its cycle repeated, then rest at home, with sensor noise.

    Heat follows from every planned sample; the log has two samples a second, as a real one.
    """
    return [_log(study, plan, rng, work_s, rest_s, f"log {i}") for i, plan in enumerate(plans)]


def _log(study: Study, plan: Plan, rng: np.random.Generator, work_s: float, rest_s: float, name: str) -> Recording:
    motors, thermal = study.motors, study.thermal
    every = round(RATE_HZ / LOG_HZ)
    work, rest = round(work_s * LOG_HZ), round(rest_s * LOG_HZ)
    index = np.arange(work * every) % len(plan.cycle.profile)
    moving = np.asarray(plan.cycle.profile, dtype=float)[index]  # [sample, channel, joint]
    home = study.robot.home_q()
    still = np.stack([home, np.zeros_like(home), ArmModel(study.robot).gravity_torque(home)])
    shown = np.concatenate([moving[::every], np.broadcast_to(still, (rest + 1, *still.shape))])
    loads = [drive(part, motors) for part in moving.reshape(work, every, *moving.shape[1:])]
    loads += [static_drive(still[2], motors)] * rest
    ambient_c = study.ambient_c + AIR_SD_K * rng.standard_normal()
    start_c = thermal.steady(node_heat(np.zeros_like(home), motors.idle_w), ambient_c)
    temps = np.stack(
        list(
            temperature_steps(loads, 1.0 / LOG_HZ, motors=motors, thermal=thermal, start_c=start_c, ambient_c=ambient_c)
        )
    )
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
