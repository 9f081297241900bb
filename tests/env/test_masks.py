"""Action masks: legal claims made alone are won, illegal actions only counted, waiting is always legal."""

from itertools import product
from typing import Any

import numpy as np

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
    for seed, stop in product(range(3), range(2, 32, 5)):
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
                    np.array_equal(v[e], v[-1], equal_nan=True) for n, v in now.named().items() if n != "illegal"
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
        offered = env.layout.read_parts(obs["shared"][0], obs["own"][0], mask).offered
        counts["taken"] += int((offered & (mask[:, 1:-1] == 0))[before.mode[0] == IDLE].sum())
    assert min(counts.values()) > 5, counts


def test_illegal_and_missing_actions_equal_a_wait(make, play) -> None:
    envs = [make(), make(), make()]
    for env in envs:
        env.reset(seed=3)
    for _ in range(20):
        masks = {a: o.action_mask for a, o in envs[0].knowledge().items()}
        wrong = {arm: int(np.flatnonzero(m == 0)[-1]) if (m == 0).any() else 99 for arm, m in masks.items()}
        actions = ({}, dict.fromkeys(masks, 0), wrong)
        given = [play.plain(env.step(each)) for env, each in zip(envs, actions, strict=True)]
        for step in given:
            for info in step[-1].values():
                del info["illegal"]
        assert given[0] == given[1] == given[2]
