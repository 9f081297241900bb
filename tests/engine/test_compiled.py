"""Compiled and uncompiled loops of the engine give equal results, bit for bit."""

import numpy as np
import pytest

from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.memory import Exchange
from fleet.engine.shift import Episode
from fleet.engine.step import FINISHED
from fleet.motion import Drive
from fleet.robot import ThermalLimits
from tests.shifts import Single

LIMITS = ThermalLimits(warning_c=56.0, error_c=60.0, restart_c=54.0, clear_s=25.0)


def check_equal(episode: Episode, seed: int, **options) -> Single:
    """Play a shift both ways, with legal and illegal actions, and assert that all results are equal."""
    records: tuple[list, list] = ([], [])
    arms = episode.world.arms
    slow, fast = (
        Single(
            episode,
            compiled=compiled,
            keep_events=True,
            watch=record.append,
            **{name: make(arms) for name, make in options.items()},
        )
        for compiled, record in zip((False, True), records, strict=True)
    )
    rng, done = np.random.default_rng(seed), False
    while not done and slow.tick < episode.world.ticks:
        for one, other in zip(slow.parts, fast.parts, strict=True):
            np.testing.assert_array_equal(other, one)
        np.testing.assert_array_equal(fast.mask, slow.mask)
        np.testing.assert_array_equal(fast.engine.offers.slot_job, slow.engine.offers.slot_job)
        actions = np.array([rng.choice(np.flatnonzero(row)) for row in slow.mask])
        illegal = rng.random(len(actions)) < 0.1
        actions[illegal] = rng.integers(-2, episode.world.slots + 3, illegal.sum())
        outcome = slow.step(actions)
        np.testing.assert_array_equal(fast.step(actions), outcome)
        done = bool(outcome[FINISHED])
        for name, values in slow.state.named().items():
            np.testing.assert_array_equal(getattr(fast.state, name), values, err_msg=name)
    assert list(map(repr, fast.env.events)) == list(map(repr, slow.env.events))  # NaN equals itself in text
    assert (fast.env.messages, fast.engine.infos.tolist()) == (slow.env.messages, slow.engine.infos.tolist())
    for one, other in zip(*records, strict=True):
        for name, values in vars(one).items():
            np.testing.assert_array_equal(getattr(other, name), values, err_msg=name)
    return slow


def test_compiled_and_uncompiled_agree_with_faults_and_returned_jobs(small) -> None:
    make = small.Shifts(arms=3, jobs=9, ticks=80, ambient_c=45.0, limits=LIMITS, absences=5)
    runs = [check_equal(make(np.random.SeedSequence(seed)), seed) for seed in range(3)]
    kinds = {event.kind for run in runs for event in run.env.events}
    assert {"award", "lost", "illegal", "warning", "fault", "return", "recover", "finish", "home"} <= kinds


@pytest.mark.parametrize(("arms", "jobs", "slots"), [(1, 0, 1), (1, 1, 3), (4, 12, 5)])
def test_compiled_and_uncompiled_agree_for_any_size(small, arms, jobs, slots) -> None:
    make = small.Shifts(arms=arms, jobs=jobs, slots=slots, ticks=40, ambient_c=45.0, limits=LIMITS)
    check_equal(make(np.random.SeedSequence(5)), 5)


def test_compiled_and_uncompiled_agree_with_late_and_lost_messages(small) -> None:
    make = small.Shifts(arms=3, jobs=6, ticks=30)
    run = check_equal(
        make(np.random.SeedSequence(2)), 2, exchange=lambda arms: Exchange(arms, Channel(delay_s=20.0, loss=0.3))
    )
    assert 0 < run.env.messages < 3 * 2 * (run.tick + 1)


def test_compiled_and_uncompiled_agree_with_a_plant_that_measures_its_drive(small) -> None:
    content = small.work(payload_kg=small.HOT)
    world, plant = small.shop([[small.job("a", content, repetitions=60)]], ticks=80)

    class Measured:
        follows_plans, most_steps = False, 1
        motion, contacts = plant.motion, plant.contacts

        def drive(self, world, state) -> Drive:
            shape, working = (1, 2, 7), state.mode[..., None] == 1
            return Drive(np.where(working, np.linspace(1.0, 40.0, 7), 0.5), np.full(shape, 0.1))

    run = check_equal(Episode(world, Measured(), ("t",) * 2, np.random.SeedSequence(0)), 0)
    assert run.state.faults.sum() > 0
