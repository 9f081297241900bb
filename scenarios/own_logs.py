"""What a studied arm would have logged of its own work: recordings of a simulated Gen3, for identification."""

from collections.abc import Sequence

import numpy as np

from fleet.motion import RATE_HZ, Plan
from fleet.motor import friction_heat, magnet_factor, reference_current
from fleet.sim.models import ArmModel
from fleet.thermal import HOUSING, NODES, WINDING, advance, drive_heat, node_heat
from scenarios.study import Study
from twin.recording import Recording

Array = np.ndarray

LOG_HZ = 2.0
"""At which the public logs of a real Gen3 were taken."""
AIR_SD_K = 1.5
"""By which the air of one recording is off the study's."""


def own_logs(
    study: Study, plans: Sequence[Plan], rng: np.random.Generator, *, work_s: float = 1200.0, rest_s: float = 600.0
) -> list[Recording]:
    """One recording for each plan: from idle, its cycle over and over, then rest at home; sensors with their noise.

    Heat is that of every planned sample; the log shows only two of them a second, as a real one.
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
    square = np.zeros((work + rest, len(home)))
    rubbing = np.zeros_like(square)
    _, qd, tau = moving.transpose(1, 0, 2)
    square[:work] = (reference_current(tau, qd, motors) ** 2).reshape(work, every, -1).mean(axis=1)
    square[work:] = reference_current(still[2], still[1], motors) ** 2
    rubbing[:work] = friction_heat(qd, motors).reshape(work, every, -1).mean(axis=1)
    air_c = study.ambient_c + AIR_SD_K * rng.standard_normal()
    start = thermal.steady(node_heat(np.zeros_like(home), motors.idle_w), air_c)
    temps = np.empty((work + rest + 1, NODES))
    temps[0] = start
    phi, gamma = thermal.step_matrices(1.0 / LOG_HZ)
    for k in range(work + rest):
        heat_w = drive_heat(temps[k], square[k], rubbing[k], motors)
        temps[k + 1] = advance(temps[k], heat_w, air_c, phi, gamma, thermal.to_ambient)
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
