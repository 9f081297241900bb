"""An own policy on the environment: leave a job alone when it would leave too little headroom.

Run: python examples/own_policy.py
"""

import numpy as np

import scenarios
from agents.policy import WAIT, legal_slots


def careful(observation):
    """The easiest legal job, but nothing for an arm with less than 10 K of headroom."""
    slots = legal_slots(observation)
    if not slots or observation.headroom_k < 10:
        return WAIT
    return slots[int(np.argmin(observation.difficulty[slots]))] + 1


def main(horizon_s=7200, difficulty="twin"):
    env = scenarios.make_env("quickstart", horizon_s=horizon_s, difficulty=difficulty)
    env.reset(seed=0)
    total = 0.0
    while env.agents:
        knowledge = env.knowledge()  # by name; the same numbers as the observation vectors
        _, rewards, _, _, infos = env.step({arm: careful(knowledge[arm]) for arm in env.agents})
        total += rewards["arm_0"]
    print(f"reward {total:.1f}, jobs done {infos['arm_0']['jobs_done']:.0f}")
    for arm, info in infos.items():
        print(f"{arm}: peak {info['peak_c']:.1f} °C, faults {info['faults']:.0f}")
    env.close()
    return total


if __name__ == "__main__":
    main()
