"""A policy of your own: least difficulty, but an arm with little headroom rests.

Compare it with the rules that come along:
    thermofleet compare active_waiting --policies round_robin,least_difficulty,examples/own_policy.py:Careful
Or work one shift by hand, as below:
    python examples/own_policy.py
"""

from agents.policy import WAIT, EveryArm
from agents.rules import LeastDifficulty

HEADROOM_K = 3.0


class Careful:
    """What least_difficulty chooses, unless the hottest motor is close to its warning limit.

    Scope "arm": it sees what one arm knows. One of scope "central" has `act(observations)` instead, and sees all arms.
    """

    scope = "arm"

    def __init__(self):
        self._rule = LeastDifficulty()

    def reset(self, rng):
        """Begin a shift; `rng` is the only source of chance a policy should use."""
        self._rule.reset(rng)

    def choose(self, observation, place):
        """WAIT, or k for the job in slot k; see fleet/observation.py for what an arm knows.

        `place` is the arm's index in the fleet.
        """
        return WAIT if observation.headroom_k < HEADROOM_K else self._rule.choose(observation, place)


def main(horizon_s=7200, difficulty="twin"):
    """One shift of quickstart under each of the two."""
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
            reward += rewards["arm_0"]  # all arms share one reward
        peaks = ", ".join(f"{arm} {info['peak_c']:.1f} °C" for arm, info in infos.items())
        print(f"{kind.__name__}: reward {reward:.1f}, jobs {infos['arm_0']['jobs_done']:.0f}, peaks {peaks}")
    env.close()


if __name__ == "__main__":
    main()
