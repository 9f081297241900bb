"""The environment as a BenchMARL task: any of its algorithms with masks, and the state for central critics.

Example, installation and tested versions: docs/trainers.md.

Traps:

- BenchMARL 1.5 needs torchrl < 0.12 and av < 14, older than the extra `learn`: use a separate virtual environment.
- TorchRL warns of every PettingZoo but 1.24.3. What is used here was run with 1.27.
- BenchMARL steps one environment at a time, at most some 900 steps per second on one core whatever the environment;
  for speed use `fleet.env.adapters.torchrl`.
- The task is pickled with the experiment, so the factory must pickle (a `functools.partial` does, a lambda does not).
- TorchRL puts each agent whose name does not end in a number into a group of its own, and BenchMARL trains each group
  alone: an arm named "wall" would share no MAPPO policy. The adapter puts all arms into one group, "arm".
- BenchMARL makes all environments of a training with one seed, so all would simulate the same shifts. The adapter seeds
  each environment of a process with a child of it.
- `max_steps` limits evaluation only; the environment sets an episode's length.
"""

# pyright: reportMissingImports=false

from collections.abc import Callable

import numpy as np

from fleet.env.adapters.arguments import Env, imported_trainer

with imported_trainer("benchmarl", "constraints/benchmarl.txt"):
    from benchmarl.environments.pettingzoo.common import PettingZooClass
    from torchrl.envs import EnvBase
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper

GROUP = "arm"


class AllocationTask(PettingZooClass):
    """A BenchMARL task with environments made by a factory.

    Args:
        name: Task name in BenchMARL's folders and logs.
        factory: Makes an environment; must pickle.
        max_steps: Decisions after which an evaluation episode is truncated.
    """

    def __init__(self, name: str, factory: Callable[[], Env], *, max_steps: int) -> None:
        super().__init__(name, {"max_steps": max_steps})
        self.factory = factory

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: str
    ) -> Callable[[], EnvBase]:
        """Factory of one environment; BenchMARL runs as many of them as it needs. Each draws shifts of its own."""
        seeds = np.random.SeedSequence(seed)

        def make() -> EnvBase:
            env = self.factory()
            own = int(seeds.spawn(1)[0].generate_state(1)[0])
            return PettingZooWrapper(
                env,
                return_state=True,
                categorical_actions=True,
                seed=own,
                device=device,
                group_map={GROUP: list(env.possible_agents)},
            )

        return make

    def supports_continuous_actions(self) -> bool:
        """False: claims are discrete."""
        return False

    def supports_discrete_actions(self) -> bool:
        """True: claims are discrete."""
        return True

    def has_state(self) -> bool:
        """True: the environment has `state()`."""
        return True

    def has_render(self, env: EnvBase) -> bool:
        """False: evaluation renders nothing."""
        return False

    def max_steps(self, env: EnvBase) -> int:
        """Decisions after which an evaluation episode is truncated."""
        return self.config["max_steps"]

    @staticmethod
    def env_name() -> str:
        """The name of the environment in BenchMARL's logs."""
        return "thermofleet"
