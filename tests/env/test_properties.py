"""Invariants of random shifts of random fleets: no job is lost, done twice, or in two places, and no arms touch."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from fleet.engine.state import DONE, EXPIRED, RUNNING, WAITING, State
from fleet.env.allocation_v1 import AllocationEnv, Episode, parallel_env
from fleet.job import MOST_FAULTS, Job
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING
from tests.profiles import examples

TICKS, DT_S = 45, 10.0
PLACES = ("bench", "press", "rack")


@dataclass(frozen=True)
class Draft:
    """A random scenario."""

    works: tuple[tuple[str, str | None, float], ...]
    """From, to (None for a hold), kg."""
    able: tuple[frozenset[int], ...]
    """Works that each arm can do."""
    jobs: tuple[tuple[int, int, float, frozenset[int]], ...]
    """Work, repetitions, release and predecessors."""
    slots: int
    error_c: float
    ambient_c: float
    start_warm: bool
    power_off: bool
    touching: float
    """Share of the pairs of plans of two arms that exclude each other."""
    move_home_s: float
    seed: int


@st.composite
def drafts(draw: Any) -> Draft:
    """Draw small scenarios; some arm can do every work."""
    payload = st.sampled_from([8.0, 4.0, 0.0])
    pair = st.tuples(st.sampled_from(PLACES), st.none() | st.sampled_from(PLACES), payload)
    works = draw(st.lists(pair.filter(lambda w: w[0] != w[1]), min_size=1, max_size=4, unique=True))
    arms = draw(st.integers(1, 4))
    numbers = st.just(frozenset(range(len(works)))) | st.frozensets(st.integers(0, len(works) - 1))
    able = [draw(numbers) for _ in range(arms)]
    able[0] |= set(range(len(works))) - frozenset().union(*able)
    jobs = []
    for j in range(draw(st.integers(0, 10))):
        before = draw(st.frozensets(st.integers(0, j - 1), max_size=2)) if j else frozenset[int]()
        release = draw(st.just(0.0) | st.floats(0.0, TICKS * DT_S, allow_nan=False))
        jobs.append((draw(st.integers(0, len(works) - 1)), draw(st.integers(1, 5)), release, before))
    return Draft(
        works=tuple(works),
        able=tuple(able),
        jobs=tuple(jobs),
        slots=draw(st.integers(1, 5)),
        error_c=draw(st.sampled_from([44.0, 50.0, 75.0])),
        ambient_c=draw(st.sampled_from([38.0, 25.0, -10.0])),
        start_warm=draw(st.booleans()),
        power_off=draw(st.booleans()),
        touching=draw(st.sampled_from([0.0, 0.3, 1.0])),
        move_home_s=draw(st.sampled_from([900.0, 60.0, 0.0])),
        seed=draw(st.integers(0, 2**32)),
    )


def env_of(small, draft: Draft, **options: Any) -> AllocationEnv:
    """Return the environment of a draft."""
    works = [small.work(place, kg, to=to) for place, to, kg in draft.works]
    arms = [
        small.arm(i, [works[w] for w in sorted(able)], times=small.Times(3.0 + i, 7.0 + 2 * i, 2.0))
        for i, able in enumerate(draft.able)
    ]
    jobs: list[Job] = [
        small.job(
            f"j{j}",
            works[w],
            repetitions=n,
            release_s=s,
            due_s=s + 60.0,
            value=1.0 + j,
            after=tuple(f"j{k}" for k in sorted(before)),
        )
        for j, (w, n, s, before) in enumerate(draft.jobs)
    ]
    e = draft.error_c
    limits = ThermalLimits(
        warning_c=e - 4, error_c=e, restart_c=e - 6, clear_s=25.0, power_off_on_fault=draft.power_off,
        move_home_s=draft.move_home_s,
    )  # fmt: skip
    world, plant = small.shop(
        [jobs], arms=arms, limits=limits, ticks=TICKS, slots=draft.slots, ambient_c=draft.ambient_c, dt_s=DT_S,
        start_warm=draft.start_warm, space=small.crowded(draft.touching),
    )  # fmt: skip
    return parallel_env(lambda seed: Episode(world, plant, ("t",) * len(arms), seed), **options)


@examples(100)
@given(draft=drafts())
def test_invariants_of_a_shift(small, play, draft) -> None:
    env, rng = env_of(small, draft), np.random.default_rng(draft.seed)
    observed, infos = env.reset(seed=draft.seed)
    before, value = env.truth, 0.0
    check_observations(env, observed, play)
    while env.agents:
        check_offers(env)
        observed, rewards, terminated, truncated, infos = env.step(play.wild(env, rng))
        now = env.truth
        check_state(env, now)
        check_progress(env, before, now)
        check_observations(env, observed, play)
        assert np.isfinite(list(rewards.values())).all()
        value += infos["arm_0"]["reward_finished_value"]
        before = now
    jobs = env.world.jobs
    status = before.status[0][jobs.exists[0]]
    done, given_up = status == DONE, status > DONE
    assert terminated["arm_0"] == (len(done) > 0 and bool((done | given_up).all()))
    assert truncated["arm_0"] == (not terminated["arm_0"])
    assert infos["arm_0"]["jobs_done"] == done.sum()
    assert value == np.float64(jobs.value[0][jobs.exists[0]][done].sum())
    event(
        f"faults: {min(int(before.faults.sum()), 2)}, done: {'all' if done.all() else 'some' if done.any() else 'none'}"
    )
    event(f"given up: {bool(given_up.any())}, touching: {draft.touching}")


@pytest.mark.parametrize("seed", range(4))
def test_arms_of_a_crowded_cell_do_not_touch(small, play, seed) -> None:
    """Many claims at once for plans that exclude each other, and arms that stop in the space of others."""
    limits = ThermalLimits(warning_c=46.0, error_c=50.0, restart_c=44.0, clear_s=25.0, move_home_s=200.0)
    env = parallel_env(small.Shifts(arms=4, jobs=30, ticks=80, limits=limits, crowding=0.5))
    observed, _ = env.reset(seed=seed)
    rng, before, stopped, kept_apart = np.random.default_rng(seed), env.truth, 0, 0
    while env.agents:
        observed, *_ = env.step(play.wild(env, rng))
        now = env.truth
        check_state(env, now)
        check_progress(env, before, now)
        check_observations(env, observed, play)
        stopped += int(((now.mode == FAULTED) & (now.plan >= 0)).sum())
        kept_apart += sum(int((seen.feasible > seen.space_free).sum()) for seen in env.knowledge().values())
        before = now
    assert stopped > 0
    assert kept_apart > 0


def check_state(env: AllocationEnv, now: State) -> None:
    """Check the invariants of one state."""
    world, jobs, exists = env.world, env.world.jobs, env.world.jobs.exists[0]
    mode, job, status = now.mode[0], now.job[0], now.status[0]
    elapsed_s = now.tick[0] * world.dt_s
    assert np.isfinite(now.temp_c).all()
    assert (now.temp_c > world.ambient_c.min() - 1e-6).all()
    # No two arms have one job or one station, and no arm has a job that waits.
    current = job[job >= 0]
    assert len(set(current.tolist())) == len(current)
    assert (job[mode != WORKING] == -1).all()
    # But for one that it gave back, on its way home.
    times_s = world.plans.times_s[now.plan[0]]
    over = now.progress_s[0] >= times_s[:, 0] + now.todo[0] * times_s[:, 1] - 1e-6
    assert over[(job >= 0) & (status[job] == WAITING)].all()
    assert set(np.flatnonzero(status == RUNNING).tolist()) <= set(current.tolist())
    places = [s for j in current.tolist() for s in set(jobs.stations[0, j].tolist()) if s >= 0]
    assert len(set(places)) == len(places)
    # Arms at home take no space; of two arms that are away, neither takes space that the other needs.
    away = now.plan[0][now.plan[0] >= 0]
    assert (mode[now.plan[0] < 0] != WORKING).all()
    assert (mode[now.plan[0] >= 0] != IDLE).all()
    volume = world.plans.volume[away]
    assert not world.conflicts[np.ix_(volume, volume)].any()
    # A job is given up at its last fault, at the second one of an arm, or with a job that it waits for.
    for j in np.flatnonzero(exists).tolist():
        arms = now.failed_arm[0, j][now.failed_arm[0, j] >= 0].tolist()
        last = now.returns[0, j] - len(arms)  # the fault that gives it up adds no arm
        assert len(set(arms)) == len(arms) < MOST_FAULTS
        assert last in (0, 1)
        lost = any(status[k] > DONE for k in jobs.after[0, j].tolist() if k >= 0)
        expired = status[j] == EXPIRED
        assert expired <= (jobs.expires[0, j] and jobs.due_s[0, j] < elapsed_s)
        assert (status[j] > DONE) == (lost or last == 1 or expired)
    # Cycles and completions.
    cycles, repetitions = now.cycles[0][exists], jobs.repetitions[0][exists]
    done = status[exists] == DONE
    assert (cycles >= 0).all()
    assert (cycles <= repetitions).all()
    assert (cycles[done] == repetitions[done]).all()
    finished_s = now.finished_s[0][exists]
    assert (np.isnan(finished_s) == ~done).all()
    assert (finished_s[done] >= jobs.release_s[0][exists][done]).all()
    assert (finished_s[done] <= elapsed_s + 1e-9).all()
    for j in np.flatnonzero(exists & np.isin(status, (RUNNING, DONE))).tolist():
        for first in jobs.after[0, j][jobs.after[0, j] >= 0].tolist():
            assert status[first] == DONE
            assert not now.finished_s[0, j] < now.finished_s[0, first]
    # Time and heat are accounted for.
    assert (now.busy_s + now.lost_s <= elapsed_s + 1e-6).all()
    assert (now.above_warning_s <= elapsed_s + 1e-6).all()
    assert (now.lost_s[now.faults == 0] == 0).all()
    assert (now.peak_c[0] >= now.temp_c[0, :, :7].max(axis=1) - 1e-9).all()
    assert (
        now.peak_c <= max(world.limits.error_c, float(world.start_c[:, :7].max()), world.ambient_c.max()) + 1e-6
    ).all()
    assert now.returns.sum() <= now.faults.sum()
    assert (now.faults[0][mode == FAULTED] > 0).all()


def check_progress(env: AllocationEnv, before: State, now: State) -> None:
    """Check the invariants from one step to the next."""
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


def check_observations(env: AllocationEnv, observed: dict[str, Any], play: Any) -> None:
    """Check masks and offers by the rules, and the observation."""
    world, now, known = env.world, env.truth, env.knowledge()
    slot_job = play.slots_of(world, now)
    taken = {s for j in now.job[0].tolist() if j >= 0 for s in world.jobs.stations[0, j].tolist()} - {-1}
    volume = world.plans.volume
    for a, arm in enumerate(env.possible_agents):
        own, mask = known[arm], observed[arm]["action_mask"]
        assert env.observation_space(arm).contains(observed[arm])
        assert mask[0] == 1
        for k, j in enumerate(slot_job):
            plan = world.offers.plan[0, a, j, 0] if j >= 0 else -1
            able = plan >= 0
            free = j >= 0 and not taken & set(world.jobs.stations[0, j].tolist())
            others = np.delete(now.plan[0], a)
            clear = able and not world.conflicts[volume[plan], volume[others[others >= 0]]].any()
            assert mask[k + 1] == (able and free and clear and now.mode[0, a] == IDLE)
            assert own.offered[k] == (j >= 0)
            assert own.station_free[k] == free
            assert own.space_free[k] == clear
            assert own.feasible[k] == able
            assert own.known[k] == able
        assert [own.idle, own.working, own.faulted] == [now.mode[0, a] == m for m in (IDLE, WORKING, FAULTED)]
        filled = own.offered == 1
        assert (np.diff(filled.astype(int)) <= 0).all()  # no gaps between filled slots
        assert (np.diff(own.age_s[filled]) <= 1e-3).all()  # in order of age
        assert own.last_award == now.last_award[0, a]
        assert (own.busy_s > 0) == (now.mode[0, a] == WORKING)


def check_offers(env: AllocationEnv) -> None:
    """Check that slots hold the jobs that are released, wait, and have finished predecessors."""
    world, now = env.world, env.truth
    after, done = world.jobs.after[0], now.status[0] == DONE
    ready = world.jobs.exists[0] & (now.status[0] == WAITING)
    ready &= (world.jobs.release_s[0] <= now.tick[0] * world.dt_s) & (done[after] | (after < 0)).all(axis=1)
    for observed in env.knowledge().values():
        assert observed.offered.sum() == min(ready.sum(), world.slots)


def test_the_state_has_as_many_jobs_as_the_world(small) -> None:
    """More predecessors do not add jobs: pictures and tables use the number of the world."""
    many = tuple((0, 1, 0.0, frozenset(range(j - 2, j)) if j > 2 else frozenset[int]()) for j in range(12))
    draft = Draft((("bench", None, 0.0),), (frozenset({0}),), many, 3, 75.0, 25.0, False, False, 0.0, 900.0, 0)
    env = env_of(small, draft, render_mode="ansi")
    env.reset(seed=0)
    assert env.truth.status.shape == env.world.jobs.exists.shape == (1, 12)
    env.step({"arm_0": 1})
    assert "working" in str(env.render())
