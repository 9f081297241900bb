"""The single environment: its reward against numbers by hand, the end of an episode, steps until events."""

from dataclasses import asdict

import numpy as np
import pytest

from fleet.bus.exchange.memory import Exchange
from fleet.engine.batch import TERMS, RewardWeights
from fleet.engine.tables import drive_of
from fleet.env.allocation_v2 import AllocationEnv, Episode, parallel_env
from fleet.env.vector import BatchEnv
from fleet.robot import ThermalLimits
from fleet.telemetry import WORKING

# End of an episode


def test_all_arms_end_at_the_horizon_also_without_jobs(make) -> None:
    env = make({"ticks": 12, "jobs": 0})
    env.reset(seed=1)
    ends = [env.step(dict.fromkeys(env.possible_agents, 0)) for _ in range(12)]
    assert [(set(t.values()), set(u.values())) for _, _, t, u, _ in ends] == [({False}, {False})] * 11 + [
        ({False}, {True})
    ]
    assert env.agents == []


def test_jobs_done_in_the_last_step_terminate_and_do_not_truncate(make, play) -> None:
    def last(max_cycles: int | None = None) -> tuple[int, bool, bool]:
        env = make({"arms": 2, "jobs": 1, "ticks": 400, "ambient_c": 20.0}, max_cycles=max_cycles)
        env.reset(seed=2)
        trace = play.go_on(env, np.random.default_rng(2))
        return len(trace), trace[-1][2]["arm_0"], trace[-1][3]["arm_0"]

    steps, *_ = last()
    assert steps < 400
    assert last() == last(steps) == (steps, True, False)
    assert last(steps - 1) == (steps - 1, False, True)


def test_watcher_and_event_log_record_every_step(make, play) -> None:
    steps = []
    env = make(watch=steps.append, keep_events=True)
    env.reset(seed=8)
    trace = play.go_on(env, np.random.default_rng(8))
    assert len(steps) == len(trace)
    np.testing.assert_array_equal(steps[-1].end_c, env.truth.temp_c)
    assert [int(step.tick[0]) for step in steps] == list(range(len(steps)))
    kinds = [e.kind for e in env.events]
    assert kinds.count("finish") == trace[-1][4]["arm_0"]["jobs_done"]
    assert {"award", "release", "finish", "home"} <= set(kinds)


def played_alone(small, jobs, weights=None, *, ticks: int, **world) -> tuple[AllocationEnv, dict[str, np.ndarray]]:
    """Play one arm that claims the oldest job if it may; return the reward terms of each step."""
    made, plant = small.shop([jobs], arms=1, ticks=ticks, **world)
    env = parallel_env(
        lambda seed: Episode(made, plant, ("t",), seed), weights=weights or RewardWeights(), keep_events=True
    )
    observations, _ = env.reset(seed=0)
    terms: dict[str, list[float]] = {name: [] for name in TERMS}
    while env.agents:
        observations, _, _, _, infos = env.step({"arm_0": int(observations["arm_0"]["action_mask"][1])})
        for name, values in terms.items():
            values.append(infos["arm_0"][f"reward_{name}"])
    return env, {name: np.array(values) for name, values in terms.items()}


def test_value_and_tardiness_are_rewarded_in_the_step_that_finishes_a_job(small) -> None:
    """A job lasts 3 s + 3 · 10 s, and 2 s more on the way home: the jobs begin at 0 s and at 40 s."""
    jobs = [small.job("a", value=3.0, due_s=100.0), small.job("b", value=2.0, due_s=13.0)]
    weights = RewardWeights(finished_value=2.0, tardiness=-1.0)
    _, terms = played_alone(small, jobs, weights, ticks=20)
    assert terms["finished_value"].tolist() == [0.0, 0.0, 0.0, 6.0, 0.0, 0.0, 0.0, 4.0]
    assert terms["tardiness"] == pytest.approx([0.0] * 7 + [-2.0 * (73.0 - 13.0) / 60.0])
    assert not terms["faults"].any()
    assert not terms["above_warning"].any()


def test_an_idle_step_costs_only_its_energy(small) -> None:
    env, terms = played_alone(small, [small.job("a", release_s=5000.0)], RewardWeights(energy=-0.5), ticks=6)
    for name in TERMS[:-1]:
        assert not terms[name].any()
    assert terms["energy"].sum() == pytest.approx(-0.5 * env.truth.energy_j.sum() / 3600.0)
    # Idle drives, and the current that holds the arm at home, near 25 °C.
    watts = (
        env.world.motors.idle_w.sum()
        + (env.world.motors.copper_w_per_a2 * drive_of(env.world.tables.start[0])[0]).sum()
    )
    assert terms["energy"].sum() == pytest.approx(-0.5 * watts * 60.0 / 3600.0, rel=1e-3)


def test_the_rewards_of_an_episode_add_up_to_the_event_log(small) -> None:
    limits = ThermalLimits(warning_c=45.0, error_c=50.0, restart_c=42.0)
    weights = RewardWeights(tardiness=-0.1)
    env = parallel_env(small.Shifts(jobs=15, ticks=100, limits=limits), weights=weights, keep_events=True)
    env.reset(seed=0)
    rng, got = np.random.default_rng(0), dict.fromkeys(TERMS, 0.0)
    total = 0.0
    while env.agents:
        _, rewards, *_, infos = env.step(
            {a: int(rng.choice(np.flatnonzero(o.action_mask))) for a, o in env.knowledge().items()}
        )
        total += rewards["arm_0"]
        for name in TERMS:
            got[name] += infos["arm_0"][f"reward_{name}"]
    value = {job.name: job.value for job in env.world.kinds}
    finishes = [e for e in env.events if e.kind == "finish"]
    faults = [e for e in env.events if e.kind == "fault"]
    assert finishes
    assert faults
    measured = {
        "finished_value": sum(value[e.job] for e in finishes),
        "tardiness": sum(value[e.job] * e.value / 60.0 for e in finishes),
        "above_warning": env.truth.above_warning_s.sum() / 60.0,
        "faults": len(faults),
        "energy": env.truth.energy_j.sum() / 3600.0,
    }
    for name, weight in asdict(weights).items():
        assert got[name] == pytest.approx(weight * measured[name])
    assert total == pytest.approx(sum(got.values()))


@pytest.mark.parametrize(("repetitions", "returns"), [(16, 1), (40, 2)], ids=["finished", "given up"])
def test_a_returned_job_is_rewarded_once_and_one_that_is_given_up_never(small, repetitions, returns) -> None:
    """The arm faults in the twelfth cycle; the rest is short enough for a second try, or not."""
    jobs = [small.job("a", small.work(payload_kg=small.HOT), value=4.0, repetitions=repetitions)]
    env, terms = played_alone(small, jobs, RewardWeights(faults=-7.0, above_warning=-10.0), ticks=600)
    faults = [event.time_s for event in env.events if event.kind == "fault"]
    assert len(faults) == env.truth.returns[0, 0] == returns
    assert (env.events[-1].kind == "give_up") == (returns == 2)
    assert terms["finished_value"].sum() == (4.0 if returns == 1 else 0.0)
    assert np.flatnonzero(terms["faults"]).tolist() == [int(time_s // 10.0) for time_s in faults]
    assert terms["faults"].sum() == -7.0 * len(faults)
    assert terms["above_warning"].sum() == pytest.approx(-10.0 * env.truth.above_warning_s.sum() / 60.0)


SEED = 7


def first_legal(mask) -> np.ndarray:
    """Claim the first slot that may be claimed, else wait: int [...] of masks [..., action]."""
    claims = np.asarray(mask)[..., 1:-1]
    return np.where(claims.any(axis=-1), claims.argmax(axis=-1) + 1, 0)


def played(env, seed=SEED):
    """Play an episode; return its state, its rewards and the seconds of each step."""
    observations, _ = env.reset(seed=seed)
    rewards, seconds = [], []
    while env.agents:
        actions = {arm: int(first_legal(seen["action_mask"])) for arm, seen in observations.items()}
        observations, reward, _, _, infos = env.step(actions)
        rewards.append(next(iter(reward.values())))
        seconds.append(next(iter(infos.values()))["elapsed_s"])
    return env.truth, rewards, seconds


@pytest.mark.parametrize("seed", [1, 2])
def test_an_episode_ends_the_same_in_fewer_steps(small, seed) -> None:
    shifts = small.Shifts(ticks=80)
    every, all_rewards, intervals = played(parallel_env(shifts), seed)
    some, rewards, seconds = played(parallel_env(shifts, decisions="events"), seed)
    for name in some.named():
        if name != "last_award":  # of the last step
            np.testing.assert_array_equal(getattr(some, name), getattr(every, name), err_msg=name)
    assert sum(rewards) == pytest.approx(sum(all_rewards), rel=1e-12)
    assert sum(seconds) == sum(intervals)
    assert len(seconds) < len(intervals) / 2
    assert set(intervals) == {10.0}


def test_a_step_ends_as_soon_as_an_arm_may_claim_a_job(small) -> None:
    env = parallel_env(small.Shifts(ticks=80), decisions="events")
    observations, _ = env.reset(seed=SEED)
    while env.agents:
        actions = {arm: int(first_legal(seen["action_mask"])) for arm, seen in observations.items()}
        observations, _, over, cut, _ = env.step(actions)
        ended = any((*over.values(), *cut.values()))
        may_claim = any(seen["action_mask"][1:-1].any() for seen in observations.values())
        at_work = env.truth.mode[0] == WORKING
        warned = (env.truth.temp_c[0, :, :7].max(axis=1) >= env.world.tables.warning_c) & at_work
        assert ended or may_claim or warned.any()


def test_bad_choices_are_refused(small) -> None:
    shifts = small.Shifts()
    for given in ("event", None, 1):
        with pytest.raises(ValueError, match="decisions must be one of 'interval', 'events'"):
            parallel_env(shifts, decisions=given)
        with pytest.raises(ValueError, match="decisions must be one of 'interval', 'events'"):
            BatchEnv(shifts.library(), 2, decisions=given)
    library = shifts.library()
    with pytest.raises(ValueError, match="takes no exchanges"):
        BatchEnv(library, 1, decisions="events", exchanges=[Exchange(library.arms)])
