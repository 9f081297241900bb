"""Action masks: legal claims made alone are won, illegal actions only counted, waiting is always legal."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from fleet.env.allocation_v1 import Episode, parallel_env
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING

WARM: dict[str, Any] = {
    "jobs": 14,
    "ticks": 60,
    "limits": ThermalLimits(warning_c=48.0, error_c=55.0, restart_c=46.0, clear_s=30.0),
}


def test_a_legal_claim_made_alone_is_won_and_an_illegal_one_is_only_counted(batch, play) -> None:
    """Try every action of every arm at many steps, each in its own row, beside a row in which all wait."""
    slots, arms = 4, 3
    tries = [(a, action) for a in range(arms) for action in range(-1, slots + 3)]
    envs = len(tries) + 1
    rows, (arm, action) = np.arange(len(tries)), np.array(tries).T
    counts = dict.fromkeys(("legal", "illegal", "given back", "at work", "faulted", "taken"), 0)
    for seed, stop in product(range(3), range(2, 32, 3)):
        env, rng = batch(envs, WARM, seed=[seed] * envs, autoreset=False), np.random.default_rng(seed)
        obs, _ = env.reset()
        for _ in range(stop):
            one = play.chosen(obs["action_mask"][0], rng.random((arms, 2)))
            obs, *_ = env.step(np.repeat(one[None], envs, axis=0))
        before, mask = env.state, obs["action_mask"][0]
        actions = np.zeros((envs, arms), int)
        actions[rows, arm] = action
        given = env.step(actions)
        now, idle = env.state, play.rows(given, len(tries))
        for e, a, k in zip(rows.tolist(), arm.tolist(), action.tolist(), strict=True):
            legal = 0 <= k <= slots + 1 and bool(mask[a, k])
            if legal and k == slots + 1:
                assert now.todo[e, a] < before.todo[e, a] or now.mode[e, a] == FAULTED
                counts["given back"] += 1
                continue
            here = play.rows(given, e)
            assert now.illegal[e, a] - before.illegal[e, a] == (not legal)
            if k == 0 or not legal:
                here["illegal"] = idle["illegal"]
                play.same(here, idle)
                assert all(
                    np.array_equal(v[e], v[-1], equal_nan=True) for n, v in now._asdict().items() if n != "illegal"
                )
                counts["illegal"] += not legal
                continue
            assert now.last_award[e].tolist() == [int(b == a) for b in range(arms)]
            job = np.flatnonzero(now.status[e] != now.status[-1])
            assert len(job) == 1 or now.faults[e, a] > before.faults[e, a]
            assert now.busy_s[e, a] > before.busy_s[e, a]
            counts["legal"] += 1
        assert mask[:, 0].all()
        for a in range(arms):
            if before.mode[0, a] != IDLE:
                assert mask[a, :-1].tolist() == [1] + [0] * slots
        counts["at work"] += int((before.mode[0] == WORKING).sum())
        counts["faulted"] += int((before.mode[0] == FAULTED).sum())
        offered = env.layout.read(obs["observation"][0], mask).offered.astype(bool)
        counts["taken"] += int((offered & (mask[:, 1:-1] == 0))[before.mode[0] == IDLE].sum())
    assert min(counts.values()) > 10, counts


def test_legal_claims_are_won_or_lost_and_illegal_ones_only_counted(make) -> None:
    env = make({"jobs": 12, "ticks": 80})
    env.reset(seed=5)
    rng, counts = np.random.default_rng(5), {"won": 0, "lost": 0, "illegal": 0}
    while env.agents:
        before, masks = env.truth, {a: o.action_mask for a, o in env.knowledge().items()}
        actions = {arm: int(rng.integers(env.world.slots + 1)) for arm in env.possible_agents}
        _, _, _, _, infos = env.step(actions)
        for a, arm in enumerate(env.possible_agents):
            legal = masks[arm][actions[arm]] == 1
            assert infos[arm]["illegal"] - before.illegal[0, a] == (not legal)
            award = env.truth.last_award[0, a]
            assert award == 0 if not legal or actions[arm] == 0 else award in (1, -1)
            counts["won"] += award == 1
            counts["lost"] += award == -1
            counts["illegal"] += not legal
    assert min(counts.values()) > 0


@pytest.mark.parametrize("winner", [0, 1, 2])
def test_the_claim_of_lower_shared_difficulty_wins(small, winner) -> None:
    content = small.work()
    arms = [small.arm(i, [content], model=small.ByPayload(1.0 if i == winner else 2.0)) for i in range(3)]
    world, plant = small.shop([[small.job("a", content)]], arms=arms)
    env = parallel_env(lambda seed: Episode(world, plant, ("by payload",) * 3, seed))
    env.reset(seed=0)
    env.step(dict.fromkeys(env.possible_agents, 1))
    assert env.truth.last_award[0].tolist() == [1 if i == winner else -1 for i in range(3)]


def test_illegal_and_missing_actions_equal_a_wait(make, play) -> None:
    options = {"keep_events": True}
    for envs in ([make(), make(), make()], [make(**options), make(**options), make(**options)]):
        for env in envs:
            env.reset(seed=3)
        for _ in range(20):
            masks = {a: o.action_mask for a, o in envs[0].knowledge().items()}
            wrong = {arm: int(np.flatnonzero(m == 0)[-1]) if (m == 0).any() else 99 for arm, m in masks.items()}
            given = [
                play.plain(env.step(each)) for env, each in zip(envs, ({}, dict.fromkeys(masks, 0), wrong), strict=True)
            ]
            for step in given:
                for info in step[-1].values():
                    del info["illegal"]
            assert given[0] == given[1] == given[2]


def test_a_faulted_arm_remains_an_agent_and_may_only_wait(make, play) -> None:
    limits = ThermalLimits(warning_c=40.0, error_c=45.0, restart_c=38.0, clear_s=10.0)
    env = make({"jobs": 20, "ticks": 80, "limits": limits})
    observations, _ = env.reset(seed=4)
    rng, faulted = np.random.default_rng(4), 0
    while env.agents:
        observations, *_ = env.step(play.wild(env, rng))
        for a, arm in enumerate(env.possible_agents):
            if env.truth.mode[0, a] == FAULTED:
                faulted += 1
                assert observations[arm]["action_mask"].tolist() == [1, 0, 0, 0, 0, 0]
    assert faulted > 3
