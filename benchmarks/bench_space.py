"""Whether arms ever touch, and what that costs: contacts in shifts, and the value of shifts.

    python -m benchmarks.bench_space [--seeds 5] [--policies all] [--scenarios all] [--mujoco-s 1800]

Every shift is played on the profile plant and its recorded postures, one each second, are given to MuJoCo, which finds
contacts of arms, floor and fixtures; the plant `mujoco` is played for `--mujoco-s` seconds of each and looks at 100
postures a second. The value of finished jobs is compared with the same shifts of arms that pass through each other
(twins, paired, 95 % interval). `benchmarks.scaling.arms` has the time that the comparison of all plans takes.
"""

from dataclasses import replace

import numpy as np

from agents.registry import RULES
from benchmarks.harness import options
from fleet.arm.cell import ContactFinder
from fleet.arm.model import build_cell
from scenarios.evaluate.rollout import outcomes
from scenarios.evaluate.statistics import interval
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.run.shift import run
from scenarios.spec.load import library, load
from scenarios.spec.options import RunSpec

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


def value(fleet: Fleet, seeds: range) -> None:
    """Print what solid arms cost in finished value."""
    ghosts = replace(fleet, space=replace(fleet.space, conflicts=np.zeros_like(fleet.space.conflicts)))
    for policy in WORTH:
        solid, free = ([each.value for each in outcomes(one, policy, seeds)] for one in (fleet, ghosts))
        lost = np.subtract(solid, free)
        name = f"{fleet.scenario.name} {policy}"
        print(f"{name:<36}{np.mean(solid):>8.1f}{np.mean(free):>8.1f}{interval(lost).text(1):>24}")


def main() -> None:
    """Print both tables."""
    policies, scenarios = ",".join(RULES), ",".join(library())
    given = options(__doc__, seeds=5, policies=policies, scenarios=scenarios, mujoco_s=1800.0, value_seeds=20)
    names = given.scenarios.split(",")
    print("value                                  solid  ghosts    lost")
    for name in names:
        value(prepare(load(name)), range(given.value_seeds))
    print("\nscenario          shifts    instants  touching  contacts")
    for name in names:
        shifts(prepare(load(name), difficulty="blind"), given.policies.split(","), range(given.seeds), given.mujoco_s)


if __name__ == "__main__":
    main()
