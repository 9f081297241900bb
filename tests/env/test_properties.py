"""Invariants of random shifts of random fleets: no job is lost, done twice, or in two places, and no arms touch."""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import event, given

from fleet.engine.state import DONE, EXPIRED, RUNNING, WAITING, State
from fleet.env.allocation_v2 import AllocationEnv, Episode, parallel_env
from fleet.job import MOST_FAULTS
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING
from tests.env.drafts import DT_S, Draft, drafts, world_of
from tests.profiles import examples


def env_of(small, draft: Draft, **options: Any) -> AllocationEnv:
    world, plant = world_of(small, draft)
    return parallel_env(lambda seed: Episode(world, plant, ("t",) * len(world.arms), seed), **options)


@examples(100)
@given(draft=drafts())
def test_invariants_of_a_shift(small, play, draft) -> None:
    env = env_of(small, draft, keep_events=True)
    steps = list(checked(env, play, draft.seed))
    terminated, truncated, infos = steps[-1][2:]
    shift, end = env.world.shifts[0], env.truth
    status = end.status[0, : len(shift.kind)]
    done, given_up = status == DONE, status > DONE
    assert terminated["arm_0"] == (len(done) > 0 and bool((done | given_up).all()))
    assert truncated["arm_0"] == (not terminated["arm_0"])
    assert infos["arm_0"]["jobs_done"] == done.sum()
    value = sum(infos["arm_0"]["reward_finished_value"] for *_, infos in steps)
    assert value == np.float64(env.world.tables.value[0, shift.kind][done].sum())
    check_events(env, end)
    event(f"faults: {min(int(end.faults.sum()), 2)}, done: {'all' if done.all() else 'some' if done.any() else 'none'}")
    event(f"given up: {bool(given_up.any())}, touching: {draft.touching}")


@pytest.mark.parametrize("seed", range(2))
def test_arms_of_a_crowded_cell_do_not_touch(small, play, seed) -> None:
    """Many claims at once for plans that exclude each other, and arms that stop in the space of others."""
    limits = ThermalLimits(warning_c=46.0, error_c=50.0, restart_c=44.0, clear_s=25.0, move_home_s=200.0)
    env = parallel_env(small.Shifts(arms=4, jobs=30, ticks=80, limits=limits, crowding=0.5))
    stopped = kept_apart = 0
    for _ in checked(env, play, seed):
        stopped += int(((env.truth.mode == FAULTED) & (env.truth.plan >= 0)).sum())
        kept_apart += sum(int(seen.blocked.sum()) for seen in env.knowledge().values())
    assert stopped > 0
    assert kept_apart > 0


def checked(env: AllocationEnv, play, seed: int) -> Iterator[tuple[Any, ...]]:
    """What each step of an episode returned, after a check of its invariants."""
    observed, _ = env.reset(seed=seed)
    rng, before = np.random.default_rng(seed), env.truth
    assert all(env.observation_space(arm).contains(seen) for arm, seen in observed.items())
    while env.agents:
        observed, rewards, *_ = step = env.step(play.wild(env, rng))
        check_state(env, env.truth)
        check_progress(env, before, env.truth)
        assert all(env.observation_space(arm).contains(seen) for arm, seen in observed.items())
        assert np.isfinite(list(rewards.values())).all()
        yield step
        before = env.truth


def check_state(env: AllocationEnv, now: State) -> None:
    world, shift = env.world, env.world.shifts[0]
    exists = np.arange(now.status.shape[1]) < len(shift.kind)
    mode, job, status = now.mode[0], now.job[0], now.status[0]
    elapsed_s = now.tick[0] * world.dt_s
    assert np.isfinite(now.temp_c).all()
    assert (now.temp_c > world.tables.ambient_c.min() - 1e-6).all()
    # No two arms have one job or one station, and no arm has a job that waits.
    current = job[job >= 0]
    assert len(set(current.tolist())) == len(current)
    assert (job[mode != WORKING] == -1).all()
    # But for one that it gave back, on its way home.
    times_s = world.tables.plans["times_s"][now.plan[0]]
    over = now.progress_s[0] >= times_s[:, 0] + now.todo[0] * times_s[:, 1] - 1e-6
    assert over[(job >= 0) & (status[job] == WAITING)].all()
    assert set(np.flatnonzero(status == RUNNING).tolist()) <= set(current.tolist())
    places = [name for j in current.tolist() for name in world.kinds[shift.kind[j]].stations]
    assert len(set(places)) == len(places)
    # Arms at home take no space; of two arms that are away, neither takes space that the other needs.
    away = now.plan[0][now.plan[0] >= 0]
    assert (mode[now.plan[0] < 0] != WORKING).all()
    assert (mode[now.plan[0] >= 0] != IDLE).all()
    assert not world.conflicts[np.ix_(away, away)].any()
    # A job is given up at its last fault, at the second one of an arm, or with a job that it waits for.
    for j in np.flatnonzero(exists).tolist():
        arms = now.failed_arm[0, j][now.failed_arm[0, j] >= 0].tolist()
        last = now.returns[0, j] - len(arms)  # the fault that gives it up adds no arm
        assert len(set(arms)) == len(arms) < MOST_FAULTS
        assert last in (0, 1)
        lost = any(status[k] > DONE for k in shift.after[j].tolist() if k >= 0)
        expired = status[j] == EXPIRED
        assert expired <= (shift.expires[j] and shift.due_s[j] < elapsed_s)
        assert (status[j] > DONE) == (lost or last == 1 or expired)
    # Cycles and completions.
    cycles, repetitions = now.cycles[0][exists], shift.repetitions
    done = status[exists] == DONE
    assert (cycles >= 0).all()
    assert (cycles <= repetitions).all()
    assert (cycles[done] == repetitions[done]).all()
    finished_s = now.finished_s[0][exists]
    assert (np.isnan(finished_s) == ~done).all()
    assert (finished_s[done] >= shift.release_s[done]).all()
    assert (finished_s[done] <= elapsed_s + 1e-9).all()
    for j in np.flatnonzero(exists & np.isin(status, (RUNNING, DONE))).tolist():
        for first in shift.after[j][shift.after[j] >= 0].tolist():
            assert status[first] == DONE
            assert not now.finished_s[0, j] < now.finished_s[0, first]
    # Time and heat are accounted for.
    assert (now.busy_s + now.lost_s <= elapsed_s + 1e-6).all()
    assert (now.above_warning_s <= elapsed_s + 1e-6).all()
    assert (now.lost_s[now.faults == 0] == 0).all()
    assert (now.peak_c[0] >= now.temp_c[0, :, :7].max(axis=1) - 1e-9).all()
    first_c = float(world.tables.modal["start_c"][..., :7].max())
    assert (now.peak_c <= max(world.tables.error_c, first_c, world.tables.ambient_c.max()) + 1e-6).all()
    assert now.returns.sum() <= now.faults.sum()
    assert (now.faults[0][mode == FAULTED] > 0).all()


def check_progress(env: AllocationEnv, before: State, now: State) -> None:
    assert now.tick[0] == before.tick[0] + 1
    for name in ("faults", "illegal", "peak_c", "above_warning_s", "busy_s", "lost_s", "energy_j", "cycles", "returns"):
        assert (getattr(now, name) >= getattr(before, name) - 1e-9).all(), name
    was = before.status[0] >= DONE
    np.testing.assert_array_equal(now.status[0][was], before.status[0][was])
    np.testing.assert_array_equal(now.finished_s[0][was], before.finished_s[0][was])
    # A job changes arms only through its end or a fault.
    for a in np.flatnonzero(before.job[0] >= 0).tolist():
        j = before.job[0, a]
        others = np.delete(now.job[0], a)
        assert j not in others.tolist() or now.faults[0, a] > before.faults[0, a]


def check_events(env: AllocationEnv, end: State) -> None:
    """Check the event log of a shift against its last state: numbers of events, and seconds busy and lost."""
    counts = Counter(e.kind for e in env.events)
    running = int((end.status == RUNNING).sum())
    over = counts["finish"] + counts["return"] + counts["give_back"]
    given_up_at_work = int(end.returns.sum()) - counts["return"]
    assert counts["award"] == over + given_up_at_work + running
    assert counts["fault"] == end.faults.sum() == counts["recover"] + (end.mode == FAULTED).sum()
    elapsed_s = float(end.tick[0]) * DT_S
    for a, name in enumerate(env.possible_agents):
        busy = lost = 0.0
        since_award, since_fault, away = None, None, False
        for e in sorted((e for e in env.events if e.arm == name), key=lambda e: e.time_s):
            if e.kind == "award":
                since_award = e.time_s
            elif e.kind in ("home", "fault") and since_award is not None:
                busy, since_award, away = busy + e.time_s - since_award, None, e.kind == "fault"
            if e.kind == "fault":
                since_fault = e.time_s
            elif e.kind == "moved":
                away = False
            elif e.kind == "recover":
                assert since_fault is not None
                lost, since_fault = lost + e.time_s - since_fault, None
                if away:  # it goes home from the beginning of the next step
                    since_award = math.ceil(e.time_s / DT_S - 1e-9) * DT_S
        busy += 0.0 if since_award is None else max(0.0, elapsed_s - since_award)
        lost += 0.0 if since_fault is None else elapsed_s - since_fault
        assert end.busy_s[0, a] == pytest.approx(busy, abs=1e-6)
        assert end.lost_s[0, a] == pytest.approx(lost, abs=1e-6)


def test_the_state_has_as_many_jobs_as_the_world(small) -> None:
    """More predecessors do not add jobs: pictures and tables use the number of the world."""
    many = tuple((0, 1, 0.0, frozenset(range(j - 2, j)) if j > 2 else frozenset[int]()) for j in range(12))
    draft = Draft((("bench", None, 0.0),), (frozenset({0}),), many, 3, 75.0, 25.0, False, False, 0.0, 900.0, 0)
    env = env_of(small, draft, render_mode="ansi")
    env.reset(seed=0)
    assert env.truth.status.shape == (1, env.world.jobs) == (1, 12)
    env.step({"arm_0": 1})
    assert "working" in str(env.render())
