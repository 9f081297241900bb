"""Breaks and failures of arms: what becomes of their jobs, by the phases (approach 3 s, cycle 10 s, retreat 2 s)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.engine.batch import RewardWeights
from fleet.engine.shift import Episode, open_jobs
from fleet.engine.state import BROKEN, FINISH_CYCLE, FINISH_JOB, WAITING
from fleet.env.lookahead import CellSimulator
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED
from tests.engine.play import play, times
from tests.profiles import examples
from tests.shifts import Single

CLAIM = 1


def shift(small, absences, actions, *, repetitions=6, ticks=30, **more):
    """The events and the steps of a shift of one arm with one job."""
    log = []
    jobs = [[small.job("a", repetitions=repetitions)]]
    world, plant = small.shop(jobs, arms=1, ticks=ticks, absences=absences, **more)
    return log, play(world, plant, actions, log), world


def test_an_arm_gives_its_job_back_after_the_cycle_in_which_a_break_begins(small) -> None:
    """At 30 s it is 27 s into the cycles: it ends the third one at 33 s, is home at 35 s, and begins again at 60 s."""
    log, steps, _ = shift(small, [(0, 3, 6, FINISH_CYCLE)], [[CLAIM]] * 30)
    assert times(log, "give_back") == [33.0]
    assert times(log, "home") == [35.0, 60.0 + 3.0 + 3 * 10.0 + 2.0]
    assert times(log, "award") == [0.0, 60.0]
    assert times(log, "finish") == [60.0 + 3.0 + 3 * 10.0]
    assert (times(log, "break"), times(log, "break_end")) == ([30.0], [60.0])
    assert [(e.value, e.reason) for e in log if e.kind == "break"] == [(30.0, "for 0.5 min")]
    assert steps[3].state.status[0, 0] == WAITING


def test_an_arm_finishes_its_job_first_where_the_break_says_so_or_in_its_last_cycle(small) -> None:
    for kind, repetitions in ((FINISH_JOB, 6), (FINISH_CYCLE, 3)):
        log, _, _ = shift(small, [(0, 3, 9, kind)], [[CLAIM]], repetitions=repetitions)
        assert (times(log, "finish"), times(log, "give_back")) == ([3.0 + 10.0 * repetitions], [])
    jobs = [[small.job("a"), small.job("b")]]
    log = []
    world, plant = small.shop(jobs, arms=1, absences=[(0, 3, 9, FINISH_JOB)])
    play(world, plant, [[CLAIM]] * 30, log)
    assert times(log, "award") == [0.0, 90.0]


def test_a_failure_stops_an_arm_at_once_and_keeps_whole_cycles(small) -> None:
    """At 50 s it is 47 s into the cycles: four are kept. It is repaired at 90 s."""
    limits = ThermalLimits(clear_s=5.0, move_home_s=15.0)
    log, steps, _ = shift(small, [(0, 5, 9, BROKEN)], [[CLAIM]] * 30, limits=limits)
    assert [e.reason for e in log if e.kind == "failure"] == ["not by heat; repaired after 0.7 min"]
    assert [(e.time_s, e.value) for e in log if e.kind in ("failure", "return")] == [(50.0, 40.0), (50.0, 4.0)]
    assert times(log, "moved") == [65.0]
    assert times(log, "recover") == [90.0]
    assert times(log, "finish") == [100.0 + 3.0 + 2 * 10.0]  # from the next decision on
    end = steps[-1].state
    assert (end.faults[0, 0], end.returns[0, 0]) == (0, 0)  # neither by heat
    assert end.lost_s[0, 0] == pytest.approx(40.0)
    assert steps[5].state.mode[0, 0] == FAULTED


def test_a_failure_ends_with_its_repair_also_in_an_arm_that_is_too_warm_to_clear_a_fault(small) -> None:
    """Between restart and warning limit: only a fault by heat waits until it has cooled."""
    limits = ThermalLimits(warning_c=60.0, error_c=75.0, restart_c=1.0, clear_s=20.0, move_home_s=1e5)
    log, steps, _ = shift(small, [(0, 5, 9, BROKEN)], [[CLAIM]] * 30, limits=limits)
    assert [(e.time_s, e.reason) for e in log if e.kind == "recover"] == [(90.0, "repaired")]
    assert times(log, "finish")
    assert steps[-1].state.lost_s[0, 0] == pytest.approx(40.0)


def test_a_hot_arm_is_repaired_and_cool_before_it_goes_on(small) -> None:
    """Whichever is later; a failure during a fault by heat makes the fault no shorter."""
    limits = ThermalLimits(warning_c=40.0, error_c=45.0, restart_c=38.0, clear_s=20.0)
    jobs = [[small.job("a", small.work(payload_kg=small.HOT), repetitions=60)]]

    def recoveries(absences):
        log = []
        world, plant = small.shop(jobs, arms=1, ticks=200, limits=limits, absences=absences)
        play(world, plant, [[CLAIM]], log)
        return times(log, "fault"), times(log, "recover")

    faults, cool = recoveries([])
    assert len(faults) == len(cool) == 1
    first, last = int(faults[0] // 10) + 2, int(cool[0] // 10)
    assert recoveries([(0, first, last - 1, BROKEN)]) == (faults, cool)
    assert recoveries([(0, first, last + 7, BROKEN)]) == (faults, [10.0 * (last + 7)])


def test_an_arm_on_its_way_to_the_first_cycle_goes_home(small) -> None:
    """A break at 10 s, with an approach of 14 s: no cycle is done, and it is home after approach and retreat."""
    arms = [small.arm(0, [small.work()], times=small.Times(approach=14.0))]
    jobs, log = [[small.job("a")]], []
    world, plant = small.shop(jobs, arms=arms, absences=[(0, 1, 9, FINISH_CYCLE)])
    play(world, plant, [[CLAIM]], log)
    assert [(e.time_s, e.value) for e in log if e.kind == "give_back"] == [(14.0, 0.0)]
    assert times(log, "home") == [16.0]


@examples(40)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 12))
def test_no_absent_arm_takes_a_job_and_each_goes_on_afterwards(small, seed, count) -> None:
    make = small.Shifts(arms=3, jobs=10, ticks=50, ambient_c=40.0, crowding=0.3, absences=count)
    episode = make(np.random.SeedSequence(seed))
    runner, rng = Single(episode, keep_events=True), np.random.default_rng(seed)
    windows = episode.world.shifts[0].absences.tolist()
    while runner.tick < episode.world.ticks:
        absent = {a for a, begin, end, _ in windows if begin <= runner.tick < end}
        for a in range(3):
            claims = runner.mask[a, 1:-1]
            assert not (a in absent and claims.any())
            assert (runner.state.absent[0, a] > 0) == (a in absent)
            down = any(a == b and begin <= runner.tick < end and kind == BROKEN for b, begin, end, kind in windows)
            assert not down or runner.state.mode[0, a] == FAULTED
        runner.step(np.array([rng.choice(np.flatnonzero(mask)) for mask in runner.mask]))
    for event in runner.env.events:
        if event.kind == "award":
            tick, arm = round(event.time_s / 10.0), int(event.arm.rpartition("_")[2])
            assert not any(arm == a and begin <= tick < end for a, begin, end, _ in windows)


def test_a_state_in_a_break_is_loaded_with_it(small) -> None:
    _, steps, world = shift(small, [(0, 3, 6, FINISH_CYCLE)], [[CLAIM]])
    for tick, legal in ((4, False), (6, True)):
        _, mask = open_jobs(world, steps[tick].state)
        assert mask[0, 0, 1:-1].any() == legal


def test_a_simulator_for_policies_knows_breaks_and_no_future_failures(small) -> None:
    make = small.Shifts(arms=1, jobs=2)
    absences = [(0, 5, 9, FINISH_JOB), (0, 2, 4, BROKEN), (0, 0, 2, BROKEN)]
    world, plant = small.shop([make.drawn(np.random.SeedSequence(1))[0]], arms=1, absences=absences)
    runner = Single(Episode(world, plant, ("t",), np.random.SeedSequence(1)))
    simulator = CellSimulator(runner.engine.tables, 1, world.slots, RewardWeights())
    layout = runner.layout
    seen = layout.read_each(["arm_0"], runner.parts[0], runner.parts[1], runner.mask)
    simulator.look(runner.engine, 0, seen)
    known = simulator._engine.state.absences[0]
    assert [each for each in known.tolist() if each[3]] == [(0, 5, 9, FINISH_JOB), (0, 0, 2, BROKEN)]
