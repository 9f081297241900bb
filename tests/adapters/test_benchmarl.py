"""BenchMARL takes the environment: MAPPO and QMIX, a few iterations."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from pettingzoo.utils import BaseParallelWrapper

from tests.adapters.training import (  # noqa: F401 -- the tests of every trainer
    Parameters,
    parameters,
    test_a_seed_repeats_the_training_and_another_does_not,
    test_it_trains_and_sends_no_illegal_action,
    test_the_hash_seed_changes_nothing,
)

pytestmark = [
    pytest.mark.adapter,
    pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested using"),
    pytest.mark.filterwarnings("ignore:max_n_frames and max_n_iters have both been set"),
    pytest.mark.filterwarnings("ignore:size_average and reduce args will be deprecated"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


def trained(workshop, seed: int, algorithm: str = "Mappo") -> tuple[Parameters, Parameters]:
    import benchmarl.algorithms
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig

    from fleet.env.adapters.benchmarl import AllocationTask

    config = ExperimentConfig.get_from_yaml()
    config.loggers, config.create_json, config.render = [], False, False
    config.max_n_iters, config.lr = 2, 1e-3
    config.on_policy_collected_frames_per_batch = config.off_policy_collected_frames_per_batch = 60
    config.on_policy_n_envs_per_worker = config.off_policy_n_envs_per_worker = 2
    config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = 30, 2
    config.off_policy_train_batch_size, config.off_policy_n_optimizer_steps = 30, 4
    config.evaluation_interval, config.evaluation_episodes = 60, 1
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        experiment = Experiment(
            task=AllocationTask("small", workshop, max_steps=400),
            algorithm_config=getattr(benchmarl.algorithms, f"{algorithm}Config").get_from_yaml(),
            model_config=MlpConfig.get_from_yaml(),
            seed=seed,
            config=config,
        )
        before = parameters(experiment.policy)
        experiment.run()
        after = parameters(experiment.policy)
        assert (Path(folder) / experiment.name / "config.pkl").exists()
    return before, after


@pytest.fixture(scope="module", params=["Mappo", "Qmix"])
def session(request, small_workshop):
    workshop = small_workshop()
    return workshop.log, *trained(workshop, 0, request.param)


def test_a_rollout_is_the_episode_of_the_environment(small_workshop, by_hand, ending) -> None:
    import torch

    from fleet.env.adapters.benchmarl import AllocationTask

    workshop = small_workshop(**ending.shift)
    torch.manual_seed(0)
    task = AllocationTask("small", workshop, max_steps=400)
    env = task.get_env_fun(1, False, 5, "cpu")()
    env.set_seed(5)
    rollout = env.rollout(task.max_steps(env))
    plain = workshop()
    plain.reset(seed=5)
    begin, _ = plain.reset()  # a rollout begins with a reset of its own
    drawn = iter(rollout["arm", "action"].tolist())
    claims = by_hand.turns(plain, begin, lambda seen: dict(zip(seen, next(drawn), strict=True)))
    for row, turn in zip(rollout, claims, strict=True):
        after = row["next"]
        for i, (arm, seen) in enumerate(turn.seen.items()):
            np.testing.assert_array_equal(after["arm", "observation", "observation"][i], seen["observation"])
            assert after["arm", "reward"][i].item() == pytest.approx(turn.rewards[arm], rel=1e-6)
            assert after["arm", "info", "illegal"][i].item() == turn.infos[arm]["illegal"] == 0
            if not turn.last:
                np.testing.assert_array_equal(after["arm", "action_mask"][i], seen["action_mask"] == 1)
        np.testing.assert_array_equal(after["state"], plain.state())
        assert (after["terminated"].item(), after["truncated"].item()) == turn.ends
        assert turn.ends == (turn.last and ending.finished, turn.last and not ending.finished)
    assert plain.agents == []
    env.close()


def test_the_environments_of_a_training_draw_shifts_of_their_own(small_workshop) -> None:
    from fleet.env.adapters.benchmarl import AllocationTask

    def offers(env) -> np.ndarray:
        return np.stack([env.reset()["state"].numpy() for _ in range(3)])

    task = AllocationTask("small", small_workshop(), max_steps=400)
    make, again = (task.get_env_fun(2, False, 5, "cpu") for _ in range(2))
    first, second = offers(make()), offers(make())
    assert (first != second).any(axis=1).all()
    np.testing.assert_array_equal(offers(again()), first)


class Renamed(BaseParallelWrapper):
    """The same with arms that are called otherwise."""

    def __init__(self, env, names: dict[str, str]) -> None:
        super().__init__(env)
        self.names = names
        self.old = {new: old for old, new in names.items()}
        self.possible_agents = list(names.values())

    @property
    def agents(self) -> list[str]:
        return [self.names[arm] for arm in self.env.agents]

    def observation_space(self, agent: str):
        return self.env.observation_space(self.old[agent])

    def action_space(self, agent: str):
        return self.env.action_space(self.old[agent])

    def reset(self, seed: int | None = None, options=None):
        return tuple(self.named(each) for each in self.env.reset(seed, options))

    def step(self, actions):
        return tuple(self.named(each) for each in self.env.step({self.old[a]: k for a, k in actions.items()}))

    def named(self, told):
        return {self.names[arm]: value for arm, value in told.items()}


def test_arms_are_one_group_whatever_their_names(small_workshop) -> None:
    import torch

    from fleet.env.adapters.benchmarl import GROUP, AllocationTask

    workshop = small_workshop()
    names = {"arm_0": "floor_left", "arm_1": "wall", "arm_2": "arm_7"}
    rollouts = []
    for make in (workshop, lambda: Renamed(workshop(), names)):
        torch.manual_seed(0)
        env = AllocationTask("small", make, max_steps=400).get_env_fun(1, False, 5, "cpu")()
        assert list(env.group_map) == [GROUP]
        rollouts.append(env.rollout(400))
        assert env.group_map[GROUP] == env.possible_agents
        env.close()
    plain, renamed = rollouts
    for key in ("action", ("observation", "observation"), "action_mask"):
        assert torch.equal(plain[GROUP][key], renamed[GROUP][key])


def test_the_example_of_the_page_runs(example) -> None:
    log = example("BenchMARL")["log"]
    assert log.steps == 600
    assert log.illegal == 0
