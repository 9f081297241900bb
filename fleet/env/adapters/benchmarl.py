"""The environment as a BenchMARL task: any algorithm of theirs with masks, the state for central critics.

    from functools import partial
    from fleet.env.adapters.benchmarl import AllocationTask
    from scenarios import make_env
    task = AllocationTask("quickstart", partial(make_env, "quickstart", difficulty="blind"), max_steps=180)
    Experiment(task, MappoConfig.get_from_yaml(), MlpConfig.get_from_yaml(), seed=0, config=config).run()

Install: `pip install 'thermofleet[benchmarl]' -c constraints/benchmarl.txt`. Run with benchmarl 1.5.2, torchrl 0.11.1,
tensordict 0.11.0, torch 2.13.0.

Traps:

- BenchMARL 1.5 wants torchrl < 0.12 and av < 14, older than the extra `learn`: give it an environment of its own.
- TorchRL warns of every PettingZoo but 1.24.3. What is used here was run with 1.27.
- It steps one environment at a time, at most some 900 steps a second on one core whatever the environment; for speed
  use `fleet.env.adapters.torchrl`.
- The task is pickled with the experiment: the factory must pickle (a `functools.partial` does, a lambda does not).
- TorchRL makes a group of each agent whose name does not end in a number, and BenchMARL learns each group for itself:
  MAPPO for an arm named "wall" would share no policy. The adapter puts all arms into one group, "arm", whatever their
  names.
- `max_steps` bounds evaluation only; an episode's length is the environment's own.
"""

# pyright: reportMissingImports=false

from collections.abc import Callable
from typing import Any

from benchmarl.environments.pettingzoo.common import PettingZooClass
from pettingzoo import ParallelEnv
from torchrl.envs import EnvBase
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

GROUP = "arm"


class AllocationTask(PettingZooClass):
    """A task of BenchMARL whose environments a factory makes.

    Args:
        name: Of the task, in BenchMARL's folders and logs.
        factory: Makes an environment; must pickle.
        max_steps: Decisions after which an evaluation episode is cut.
    """

    def __init__(self, name: str, factory: Callable[[], ParallelEnv[str, Any, Any]], *, max_steps: int) -> None:
        super().__init__(name, {"max_steps": max_steps})
        self.factory = factory

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """Makes one environment (BenchMARL puts as many as it wants side by side)."""

        def make() -> EnvBase:
            env = self.factory()
            return PettingZooWrapper(
                env,
                return_state=True,
                categorical_actions=True,
                seed=seed,
                device=device,
                group_map={GROUP: list(env.possible_agents)},
            )

        return make

    def supports_continuous_actions(self) -> bool:
        """Claims are discrete."""
        return False

    def supports_discrete_actions(self) -> bool:
        """Claims are discrete."""
        return True

    def has_state(self) -> bool:
        """The environment has a `state()`."""
        return True

    def has_render(self, env: EnvBase) -> bool:
        """No pictures in evaluation."""
        return False

    def max_steps(self, env: EnvBase) -> int:
        """Decisions after which an evaluation episode is cut."""
        return self.config["max_steps"]

    @staticmethod
    def env_name() -> str:
        """The name of the environment in BenchMARL's logs."""
        return "thermofleet"
