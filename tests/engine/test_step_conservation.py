"""Jobs and time are conserved, whatever the actions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.engine.shift import open_jobs, step
from fleet.engine.state import DONE, GIVEN_UP, RUNNING, WAITING, initial
from fleet.events import Event
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING
from tests.engine.play import DT_S, times, with_random_difficulty
from tests.profiles import examples


@st.composite
def shifts(draw):
    """Draw a small shift, and a seed for legal and illegal actions."""
    arms, jobs = draw(st.integers(1, 3)), draw(st.integers(0, 6))
    rows = [
        (
            draw(st.sampled_from(["bench", "rack", "press"])),
            draw(st.sampled_from([0.0, 4.0, 8.0, 10.0])),
            draw(st.integers(1, 12)),
            draw(st.sampled_from([0.0, 5.0, 50.0, 1e4])),
            draw(st.booleans()) and i > 0,
        )
        for i in range(jobs)
    ]
    ticks = draw(st.integers(1, 60))
    actions = draw(st.integers(0, 2**32 - 1))
    narrow = draw(st.booleans())
    crowded = draw(st.sampled_from([0.0, 0.3, 0.9]))
    return arms, rows, ticks, actions, narrow, crowded


@examples(60)
@given(shifts())
def test_jobs_and_time_are_conserved(small, shift) -> None:
    arms, rows, ticks, seed, narrow, crowded = shift
    works = [small.work(place, payload) for place, payload, *_ in rows]
    jobs = [
        small.job(f"j{i}", works[i], repetitions=n, release_s=release, due_s=2e4, after=(f"j{i - 1}",) if after else ())
        for i, (_, _, n, release, after) in enumerate(rows)
    ]
    near = ThermalLimits(warning_c=40.0, error_c=42.0, restart_c=39.9, clear_s=7.0, power_off_on_fault=False)
    fleet = [small.arm(i, dict.fromkeys(works) or [small.work()], times=small.Times(3, 7 + i, 2)) for i in range(arms)]
    world, plant = small.shop(
        [jobs], arms=fleet, ticks=ticks, slots=3, ambient_c=30.0, limits=near if narrow else ThermalLimits()
    )
    rng = np.random.default_rng(seed)
    world = with_random_difficulty(world, rng)
    conflicts = np.triu(rng.random((len(world.plans.volume),) * 2) < crowded, 1)
    conflicts |= conflicts.T
    world = replace(world, plans=replace(world.plans, volume=np.arange(len(conflicts))), conflicts=conflicts)
    log: list[Event] = []
    state = initial(world)
    for tick in range(ticks):
        actions = rng.choice([-7, 0, 1, 1, 2, 3, 4, 99], size=(1, arms))
        before = state.copy()
        _, mask = open_jobs(world, state)
        after = step(world, state, actions, plant, log).state
        for name, value in before._asdict().items():
            np.testing.assert_array_equal(getattr(state, name), value, err_msg=f"{name} of the state before")
        inside = (actions >= 0) & (actions <= 4)
        chosen = np.take_along_axis(mask, np.where(inside, actions, 0)[..., None], axis=2)[..., 0]
        allowed = inside & (chosen == 1)
        np.testing.assert_array_equal(after.illegal - state.illegal, ~allowed)
        state = after
        table, time_s = world.jobs, (tick + 1) * DT_S
        assert np.isin(state.status, [WAITING, RUNNING, DONE, GIVEN_UP]).all()
        assert (state.cycles <= table.repetitions).all()
        assert (state.cycles >= 0).all()
        held = [j for j in state.job[0].tolist() if j >= 0]
        running = np.flatnonzero(state.status[0] == RUNNING).tolist()
        assert len(held) == len(set(held))
        assert set(running) <= set(held)
        given_back = {e.job for e in log if e.kind == "give_back"}
        assert all(state.status[0, j] in (RUNNING, DONE) or f"j{j}" in given_back for j in held)
        assert (state.mode[0][state.job[0] >= 0] == WORKING).all()
        assert (state.plan[0][state.mode[0] == WORKING] >= 0).all()
        assert (state.plan[0][state.mode[0] == IDLE] < 0).all()
        places = [p for j in held for p in table.stations[0, j].tolist() if p >= 0]
        assert len(places) == len(set(places)), "two arms at one station"
        away = state.plan[0][state.plan[0] >= 0]
        assert not conflicts[np.ix_(away, away)].any(), "two arms whose plans touch"
        for j in held:
            assert all(state.status[0, p] == DONE for p in table.after[0, j].tolist() if p >= 0)
            assert table.release_s[0, j] <= time_s
        assert ((state.status == DONE) == ~np.isnan(state.finished_s)).all()
        assert (state.cycles[state.status == DONE] == table.repetitions[state.status == DONE]).all()
        # Seconds busy, lost and idle.
        assert (state.busy_s >= -1e-9).all()
        assert (state.lost_s >= -1e-9).all()
        assert (state.busy_s + state.lost_s <= time_s + 1e-6).all()
        assert (state.above_warning_s <= time_s + 1e-6).all()
    counts = {
        kind: len(times(log, kind))
        for kind in ("award", "finish", "return", "give_up", "fault", "recover", "give_back")
    }
    ended = counts["finish"] + counts["return"] + counts["give_up"] + counts["give_back"]
    assert counts["award"] == ended + int((state.status == RUNNING).sum())
    assert counts["fault"] == int(state.faults.sum())
    assert counts["return"] + counts["give_up"] == int(state.returns.sum())
    assert counts["fault"] == counts["recover"] + int((state.mode == FAULTED).sum())
    _check_seconds(world, state, log)


def _check_seconds(world, state, log) -> None:
    """Compute busy and lost time from the event log."""
    for a, name in enumerate(world.arms):
        busy = lost = 0.0
        since_award, since_fault, away = None, None, False
        for e in sorted((e for e in log if e.arm == name), key=lambda e: e.time_s):
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
        busy += 0.0 if since_award is None else world.horizon_s - since_award
        lost += 0.0 if since_fault is None else world.horizon_s - since_fault
        assert state.busy_s[0, a] == pytest.approx(busy, abs=1e-6)
        assert state.lost_s[0, a] == pytest.approx(lost, abs=1e-6)
