"""Speed of closed-loop simulation: steps per second of the MuJoCo plant, beside bare `mj_step` of its scene.

    python -m benchmarks.bench_plant

The plant is driven through ticks of the quickstart scenario in which its arms work: references, control, payload
changes, simulation and heat. Bare is MuJoCo's own loop (`mj_step(model, data, nstep)`) with the same model and number
of steps and the arms held at home. `no contacts` is the plant with contacts disabled; `reported` is the plant that also
reports contacts. All alternate on one core; speeds are medians.
"""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

import os

os.environ["OMP_NUM_THREADS"] = "1"

import statistics
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np

from agents.registry import make_policy
from benchmarks.harness import in_turns
from fleet.arm.plant import MujocoPlant
from fleet.engine.shift import StepRecord
from fleet.engine.state import State
from scenarios.prepare.fleet import ShiftFactory, env_of, prepare
from scenarios.spec.load import load

TICKS = 20
RUNS = 9
COLUMNS = ("bare mj_step", "no contacts", "plant", "reported")


def at_work(factory: ShiftFactory) -> tuple[list[State], list[StepRecord]]:
    """States and records of the first steps of a shift with the profile plant."""
    states, records = list[State](), list[StepRecord]()
    policy = make_policy("round_robin")
    policy.reset(np.random.default_rng(0))
    env = env_of(factory.fleet, max_cycles=TICKS, watch=records.append)
    env.reset(seed=0)
    while env.agents:
        states.append(env.truth)
        env.step(policy.act(env.knowledge()))
    env.close()
    return states, records


def measure(arms: int) -> str:
    """One row of the table."""
    base = load("quickstart")
    # All jobs are released at the start, so that the arms work.
    jobs = tuple(
        replace(s, arrivals=replace(s.arrivals, kind="batch", every_s=None, count=4), repetitions=(40, 40))
        for s in base.jobs
    )
    fleet = prepare(replace(base, arms=base.arms[:arms], jobs=jobs, horizon_s=TICKS * 10.0), difficulty="blind")
    states, records = at_work(ShiftFactory(fleet))
    episode = ShiftFactory(fleet, "mujoco")(np.random.SeedSequence(0))
    plant, world = episode.plant, episode.world
    assert isinstance(plant, MujocoPlant)
    held, count = mujoco.MjData(plant.model), round(TICKS * world.dt_s / plant.model.opt.timestep)
    held.qpos[:] = held.ctrl[:] = np.concatenate([arm.robot.home_q() for arm in fleet.arms])

    def driven() -> None:
        for state in states:
            plant.drive(world, state)

    def reported() -> None:
        for state, record in zip(states, records, strict=True):
            plant.drive(world, state)
            plant.contacts(world, record)

    def without() -> None:
        plant.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        driven()
        plant.model.opt.disableflags ^= mujoco.mjtDisableBit.mjDSBL_CONTACT

    bare = partial(mujoco.mj_step, plant.model, held, count)
    took_s = in_turns(dict(zip(COLUMNS, (bare, without, driven, reported), strict=True)), RUNS, warm_up=0)
    speeds = {name: count / statistics.median(column) for name, column in took_s.items()}
    pairs = zip(took_s["bare mj_step"], took_s["plant"], strict=True)
    ratio = statistics.median(bare_s / ours_s for bare_s, ours_s in pairs)
    busy = np.mean([state.mode[0] == 1 for state in states])
    real_time = speeds["plant"] * plant.model.opt.timestep
    speeds_text = "".join(f"{speed:>16,.0f}" for speed in speeds.values())
    return f"{arms:>5}{busy:>8.0%}{speeds_text}{ratio:>9.2f}{real_time:>13,.0f} x"


def main() -> None:
    """Print the table."""
    print(f"{RUNS} runs of {TICKS} ticks; median steps/s of CPU time; ratio: plant over bare")
    heads = "".join(f"{head:>16}" for head in COLUMNS)
    print(f"{'arms':>5}{'busy':>8}{heads}{'ratio':>9}{'real time':>15}")
    for arms in (2, 4):
        print(measure(arms), flush=True)


if __name__ == "__main__":
    main()
