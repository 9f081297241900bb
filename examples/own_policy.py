"""A custom policy: least difficulty, but an arm with little headroom waits.

Compare it with built-in policies:
    thermofleet compare active_waiting --policies round_robin,least_difficulty,examples/own_policy.py:Careful
Run one shift in the environment, as below:
    python examples/own_policy.py
"""

from agents.policy import WAIT, EveryArm
from agents.rules import LeastDifficulty

HEADROOM_K = 3.0


class Careful:
    """As `least_difficulty`, but wait if the hottest motor is close to its warning limit.

    Scope "arm": it chooses for one arm. A policy of scope "central" has `act(observations)` and chooses for all arms.
    """

    scope = "arm"

    def __init__(self):
        self._rule = LeastDifficulty()

    def reset(self, rng):
        """Begin a shift; sample all random numbers from `rng`."""
        self._rule.reset(rng)

    def choose(self, observation, arm_index):
        """Return WAIT, or 1 + k to claim option k; fleet/observation.py defines the observation.

        `arm_index` is the arm's index in the fleet.
        """
        return WAIT if observation.headroom_k < HEADROOM_K else self._rule.choose(observation, arm_index)


def main(horizon_s=7200, difficulty="twin"):
    """Run one shift of quickstart with each of the two policies."""
    import numpy as np

    import scenarios

    env = scenarios.make_env("quickstart", horizon_s=horizon_s, difficulty=difficulty)
    for kind in (LeastDifficulty, Careful):
        policy = EveryArm(kind)
        policy.reset(np.random.default_rng(0))
        env.reset(seed=0)
        reward, infos = 0.0, {}
        while env.agents:
            _, rewards, _, _, infos = env.step(policy.act(env.knowledge()))
            reward += rewards["arm_0"]  # all arms get the same reward
        peaks = ", ".join(f"{arm} {info['peak_c']:.1f} °C" for arm, info in infos.items())
        print(f"{kind.__name__}: reward {reward:.1f}, jobs {infos['arm_0']['jobs_done']:.0f}, peaks {peaks}")
    env.close()


if __name__ == "__main__":
    main()
