"""The single environment: end of an episode, exchanges, text, watchers."""

import numpy as np

from fleet.bus.exchange.zenoh import ZenohExchange

# End of an episode


def test_all_arms_end_at_the_horizon(make) -> None:
    env = make({"ticks": 12})
    env.reset(seed=1)
    ends = [env.step(dict.fromkeys(env.possible_agents, 0)) for _ in range(12)]
    assert [(set(t.values()), set(u.values())) for _, _, t, u, _ in ends] == [({False}, {False})] * 11 + [
        ({False}, {True})
    ]
    assert env.agents == []


def test_max_cycles_end_an_episode_earlier(make, play) -> None:
    env = make({"ticks": 50}, max_cycles=7)
    env.reset(seed=1)
    assert len(play.go_on(env, np.random.default_rng(0))) == 7


def test_an_episode_ends_when_all_jobs_are_done(make, small, play) -> None:
    env = make({"arms": 2, "jobs": 1, "ticks": 400, "ambient_c": 20.0})
    env.reset(seed=2)
    trace = play.go_on(env, np.random.default_rng(2))
    assert set(trace[-1][2].values()) == {True}
    assert set(trace[-1][3].values()) == {False}
    assert trace[-1][4]["arm_0"]["jobs_done"] == 1.0
    assert env.world.jobs.due_s[0, 0] < env.world.horizon_s


def test_jobs_done_in_the_last_step_terminate_and_do_not_truncate(make, play) -> None:
    def last(max_cycles: int | None = None) -> tuple[int, bool, bool]:
        env = make({"arms": 2, "jobs": 1, "ticks": 400, "ambient_c": 20.0}, max_cycles=max_cycles)
        env.reset(seed=2)
        trace = play.go_on(env, np.random.default_rng(2))
        return len(trace), trace[-1][2]["arm_0"], trace[-1][3]["arm_0"]

    steps, *_ = last()
    assert last() == last(steps) == (steps, True, False)
    assert last(steps - 1) == (steps - 1, False, True)


def test_a_shift_without_jobs_lasts_to_the_horizon(make, play) -> None:
    env = make({"jobs": 0, "ticks": 9})
    env.reset(seed=0)
    trace = play.go_on(env, np.random.default_rng(0))
    assert len(trace) == 9
    assert set(trace[-1][3].values()) == {True}


# Exchanges and watchers


def test_zenoh_and_memory_give_the_same_episode(make, play) -> None:
    memory = make({"ticks": 12}, keep_events=True)
    over_zenoh = make(
        {"ticks": 12}, exchange=ZenohExchange(memory.possible_agents, fleet="same episode", timeout_s=120.0)
    )
    try:
        traces = [[env.reset(seed=6), *play.go_on(env, np.random.default_rng(6))] for env in (memory, over_zenoh)]
        assert play.plain(traces[0]) == play.plain(traces[1])
        assert over_zenoh.messages == memory.messages > 0
    finally:
        over_zenoh.close()


def test_the_fleet_is_rendered_as_text(make) -> None:
    env = make(render_mode="ansi")
    env.reset(seed=0)
    lines = (env.render() or "").splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [[f"arm_{i}", "idle"] for i in range(3)]
    assert make().render() is None


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
