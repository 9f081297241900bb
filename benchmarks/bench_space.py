"""Whether arms ever touch, and what that costs: contacts in shifts, time to compare all plans, value of shifts.

    python -m benchmarks.bench_space [--seeds 5] [--policies all] [--scenarios all] [--mujoco-s 1800]

Every shift is played on the profile plant and its recorded postures, one each second, are given to MuJoCo, which finds
contacts of arms, floor and fixtures; the plant `mujoco` is played for `--mujoco-s` seconds of each and looks at 100
postures a second. The time to compare the plans is that of one core with nothing cached but the plans. The value of
finished jobs is compared with the same shifts of arms that pass through each other (twins, paired, 95 % interval).
"""

import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from agents.registry import RULES
from benchmarks.harness import options
from fleet.arm.cell import ContactFinder
from fleet.arm.model import build_cell
from fleet.arm.space import space_table
from fleet.robot import Mount, Robot
from scenarios.evaluate.rollout import outcomes
from scenarios.evaluate.statistics import interval
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.run.shift import run
from scenarios.spec.load import library, load
from scenarios.spec.options import RunSpec

SIXTEEN = 4
"""Cells of four arms that stand beside each other, for the larger table."""
APART_M = 2.0
WORTH = ("round_robin", "wspt", "least_difficulty")
"""Policies whose value is compared."""


def shifts(fleet: Fleet, policies: list[str], seeds: range, mujoco_s: float) -> None:
    """Print the contacts of the shifts of one scenario."""
    scenario, robots = fleet.scenario, [arm.robot for arm in fleet.arms]
    model = build_cell(robots, scenario.places, scenario.fixtures)
    short = Fleet(replace(scenario, horizon_s=min(mujoco_s, scenario.horizon_s)), fleet.arms, (), fleet.space)
    instants = touching = contacts = 0
    for policy in policies:
        for seed in seeds:
            spec = RunSpec(policy=policy, seed=seed, bus="memory", difficulty="blind")
            recorded = run(fleet, spec).telemetry
            assert recorded is not None
            finder = ContactFinder(model, robots)
            found = finder.events(recorded.time_s, recorded.q, np.zeros(recorded.q.shape[:2]))
            instants, touching = instants + len(recorded.time_s), touching + len(found)
            contacts += run(short, replace(spec, plant="mujoco"), record=False).metrics.contacts or 0
    print(f"{scenario.name:<16}{len(policies) * len(seeds):>8}{instants:>12}{touching:>10}{contacts:>10}", flush=True)


def tables(names: list[str]) -> None:
    """Print the time that the comparison of all plans takes."""
    for name in names:
        fleet = prepare(load(name), difficulty="blind")
        for cells in (1, SIXTEEN):
            arms = [_beside(arm.robot, n) for n in range(cells) for arm in fleet.arms]
            plans = [
                replace(plan, arm=robot.name)
                for n in range(cells)
                for arm, robot in zip(fleet.arms, arms[n * len(fleet.arms) :], strict=False)
                for variants in arm.plans.values()
                for plan in variants
            ]
            folder = Path(tempfile.mkdtemp())
            try:
                began = time.process_time()
                table = space_table(arms, plans, fleet.scenario.clearance_m, folder)
                took_s = time.process_time() - began
            finally:
                shutil.rmtree(folder)
            share = table.conflicts[~_same_arm(table, arms)].mean() if len(arms) > 1 else 0.0
            print(f"{name:<16}{len(arms):>8}{len(plans):>12}{share:>10.1%}{took_s:>9.1f} s", flush=True)


def value(fleet: Fleet, seeds: range) -> None:
    """Print what solid arms cost in finished value."""
    ghosts = replace(fleet, space=replace(fleet.space, conflicts=np.zeros_like(fleet.space.conflicts)))
    for policy in WORTH:
        solid, free = ([each.value for each in outcomes(one, policy, seeds)] for one in (fleet, ghosts))
        lost = np.subtract(solid, free)
        name = f"{fleet.scenario.name} {policy}"
        print(f"{name:<36}{np.mean(solid):>8.1f}{np.mean(free):>8.1f}{interval(lost).text(1):>24}")


def _beside(robot: Robot, cell: int) -> Robot:
    x, y, z = robot.mount.position_m
    place = (x + APART_M * (cell % 2), y + APART_M * (cell // 2), z)
    return replace(robot, name=f"{robot.name}_{cell}", mount=Mount(position_m=place, tilt_deg=robot.mount.tilt_deg))


def _same_arm(table, arms: list[Robot]) -> np.ndarray:
    owner = np.empty(len(table.conflicts), dtype=int)
    names = [robot.name for robot in arms]
    for (arm, *_), row in table.volume.items():
        owner[row] = names.index(arm)
    return owner[:, None] == owner


def main() -> None:
    """Print both tables."""
    policies, scenarios = ",".join(RULES), ",".join(library())
    given = options(__doc__, seeds=5, policies=policies, scenarios=scenarios, mujoco_s=1800.0, value_seeds=20)
    names = given.scenarios.split(",")
    print("scenario            arms       plans  conflict  one core")
    tables(names)
    print("\nvalue                                  solid  ghosts    lost")
    for name in names:
        value(prepare(load(name)), range(given.value_seeds))
    print("\nscenario          shifts    instants  touching  contacts")
    for name in names:
        shifts(prepare(load(name), difficulty="blind"), given.policies.split(","), range(given.seeds), given.mujoco_s)


if __name__ == "__main__":
    main()
