"""Batches of a scenario: equal to `make_env`, and randomised."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.engine.batch import shifts_of
from fleet.engine.tables import stack_tables, tables_of
from fleet.engine.world import Space
from fleet.env.vector import BatchEnv, Library
from fleet.motion import Plan
from scenarios.evaluate.rollout import outcomes
from scenarios.prepare.fleet import Fleet, Randomisation, library_of, make_batch, make_env, prepare
from scenarios.run.shift import run
from scenarios.spec.jobs import draw_jobs
from scenarios.spec.options import RunSpec
from tests.profiles import examples

SEED = 30
VARIED = Randomisation(ambient_k=(-1.0, 3.0), arrivals=(0.8, 1.5), variants=[{"spread": {"scale": 2.0, "seed": 9}}])


@pytest.fixture(scope="module")
def fleet(cell, plans) -> Fleet:
    """Return the prepared cell."""
    return prepare(cell, difficulty="blind", cache=plans)


def actions_of(play, mask: np.ndarray, step: int) -> np.ndarray:
    """Return actions that do not depend on the number of rows."""
    return play.chosen(mask, np.random.default_rng(step).random((1, 3, 2)))


@pytest.mark.parametrize("difficulty", ["blind", "oracle"])
@pytest.mark.parametrize("e", [0, 5])
@pytest.mark.parametrize("randomise", [None, VARIED], ids=["plain", "randomised"])
def test_a_row_equals_make_env_with_the_same_seed(cell, plans, play, e, difficulty, randomise) -> None:
    options: dict[str, Any] = {"difficulty": difficulty, "randomise": randomise, "cache": plans}
    batch, env = make_batch(cell, 6, SEED, **options), make_env(cell, **options)
    obs, _ = batch.reset()
    observed = play.single(env, env.reset(seed=SEED + e))
    ends, faults = [], 0
    for step in range(140):
        play.same({n: v[e : e + 1] for n, v in obs.items()}, {n: observed[n] for n in obs})
        actions = actions_of(play, obs["action_mask"], step)
        given = batch.step(actions)
        obs = given[0]
        observed = play.single(env, env.step(dict(zip(env.possible_agents, actions[e].tolist(), strict=True))))
        expected = play.rows(given, e)
        play.same(
            {n: v for n, v in observed.items() if n not in obs}, {n: expected[n] for n in observed if n not in obs}
        )
        faults += int(observed["faults"].sum())
        if not env.agents:
            ends.append(bool(observed["terminated"]))
            play.same({n: expected[f"final_{n}"] for n in obs}, {n: observed[n] for n in obs})
            observed = play.single(env, env.reset())
    assert len(ends) >= 2
    assert faults > 0


@examples(25)
@given(seed=st.integers(0, 2**63))
def test_a_shift_as_arrays_has_the_jobs_of_the_scenario(fleet, seed) -> None:
    library, entropy = library_of(fleet), np.random.SeedSequence(seed)
    jobs, shift = draw_jobs(fleet.scenario, np.random.SeedSequence(seed, spawn_key=(0,))), library.draw(entropy)
    place = {job.name: j for j, job in enumerate(jobs)}
    tables = library.tables
    assert shift.repetitions.tolist() == [job.repetitions for job in jobs]
    assert shift.release_s.tolist() == [job.release_s for job in jobs]
    assert shift.due_s.tolist() == [job.due_s for job in jobs]
    assert [{j for j in row if j >= 0} for row in shift.after.tolist()] == [
        {place[name] for name in job.after} for job in jobs
    ]
    assert tables.payload_kg[0, shift.kind].tolist() == [job.work.payload_kg for job in jobs]
    assert tables.value[0, shift.kind].tolist() == [job.value for job in jobs]
    again = library.draw(entropy)
    assert all(np.array_equal(value, getattr(again, name)) for name, value in vars(shift).items())


def test_policies_are_compared_on_the_shifts_that_run_plays(cell, plans) -> None:
    fleets = [prepare(cell, difficulty="blind", randomise=each, cache=plans) for each in (None, VARIED)]
    rewards = [[outcome.reward for outcome in outcomes(fleet, "wspt", range(6))] for fleet in fleets]
    for fleet, expected in zip(fleets, rewards, strict=True):
        specs = [RunSpec(policy="wspt", seed=seed, bus="memory", difficulty="blind") for seed in range(6)]
        assert [run(fleet, spec, record=False).reward for spec in specs] == pytest.approx(expected)
    assert sum(one != other for one, other in zip(*rewards, strict=True)) == 6


def test_an_empty_randomisation_changes_nothing(fleet) -> None:
    plain, zero = library_of(fleet), library_of(replace(fleet, randomise=Randomisation(ambient_k=(0.0, 0.0))))
    for seed in range(5):
        one, other = (lib.draw(np.random.SeedSequence(seed)) for lib in (plain, zero))
        assert all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())


def test_randomised_values_cover_their_range(fleet) -> None:
    randomise = Randomisation(ambient_k=(-2.0, 6.0), arrivals=(0.5, 2.0))
    library = library_of(replace(fleet, randomise=randomise, variants=(fleet, fleet)))
    shifts = [library.draw(np.random.SeedSequence(seed)) for seed in range(300)]
    offset_k = np.array([shift.ambient_offset_k for shift in shifts])
    assert -2.0 <= offset_k.min() < -1.8
    assert 5.8 < offset_k.max() <= 6.0
    assert offset_k.mean() == pytest.approx(2.0, abs=4 * 8.0 / np.sqrt(12 * 300))
    fleets = np.bincount([shift.fleet for shift in shifts], minlength=3)
    assert len(fleets) == 3
    assert np.abs(fleets - 100).max() < 4 * np.sqrt(300 * 2 / 9)
    # 240 s / 60 s + 200 s / 40 s = 9 jobs, times 1.25 on average, and 3 at once.
    often = Randomisation(arrivals=(3.0, 3.0))
    for chosen, expected in ((Randomisation(), 12.0), (randomise, 3 + 9 * 1.25), (often, 3 + 9 * 3.0)):
        counts = [
            len(library_of(replace(fleet, randomise=chosen)).draw(np.random.SeedSequence(s)).kind) for s in range(200)
        ]
        assert np.mean(counts) == pytest.approx(expected, abs=4 * np.std(counts) / np.sqrt(200))


def test_randomisation_depends_on_the_seed_and_not_on_noise(fleet, play) -> None:
    randomise = Randomisation(ambient_k=(0.0, 5.0), arrivals=(0.8, 1.2))
    library = library_of(replace(fleet, randomise=randomise))
    for seed in range(4):
        plain, one, again = (lib.draw(np.random.SeedSequence(seed)) for lib in (library_of(fleet), library, library))
        assert all(np.array_equal(value, getattr(again, name)) for name, value in vars(one).items())
        assert (one.noise_key, plain.ambient_offset_k) == (plain.noise_key, 0.0)
        assert one.ambient_offset_k > 0.0
    three, seven = BatchEnv(library, 3, seed=4), BatchEnv(library, 7, seed=2)
    rows = three.reset()[0], seven.reset()[0]
    play.same(rows[0], {name: values[2:5] for name, values in rows[1].items()})


def test_a_warmer_cell_warms_every_motor(cell, plans) -> None:
    options: dict[str, Any] = {"difficulty": "blind", "cache": plans, "limits": {}}
    cool = make_batch(cell, 5, 0, **options)
    warm = make_batch(cell, 5, 0, randomise=Randomisation(ambient_k=(3.0, 3.0)), **options)
    nobody = np.zeros((5, 3), int)
    for batch in (cool, warm):
        batch.reset()
    np.testing.assert_allclose(warm.state.temp_c - cool.state.temp_c, 3.0)
    for batch in (cool, warm):
        for _ in range(15):
            batch.step(nobody)
    warmer = warm.state.temp_c - cool.state.temp_c
    assert warmer.min() > 3.0 - 1e-9
    assert 3.0 + 1e-6 < warmer.max() < 3.1  # a warmer motor has slightly higher losses


def test_rows_of_two_variants_equal_batches_of_each(cell, plans, play) -> None:
    """Compare the rows of a batch of two variants with a batch of each."""
    options: dict[str, Any] = {"difficulty": "oracle", "cache": plans}
    variant = {"spread": {"scale": 2.0, "seed": 9}}
    both = make_batch(cell, 12, SEED, randomise=Randomisation(variants=[variant]), **options)
    alone = [make_batch(cell, 12, SEED, **options, **each) for each in ({}, variant)]
    obs, given = both.reset()[0], [env.reset()[0] for env in alone]
    fleet = (obs["observation"] == given[1]["observation"]).all(axis=(1, 2)).astype(int)
    for step in range(70):
        is_one = [(obs["observation"] == each["observation"]).all(axis=(1, 2)) for each in given]
        assert np.choose(fleet, is_one).all()
        assert not (is_one[0] & is_one[1]).any()
        for each, env in enumerate(alone):
            np.testing.assert_array_equal(env.state.temp_c[fleet == each], both.state.temp_c[fleet == each])
        actions = actions_of(play, obs["action_mask"], step)
        (obs, _, terminated, truncated, _), given = both.step(actions), [env.step(actions)[0] for env in alone]
        if (terminated | truncated).any():  # the next shift of a row may be of the other variant
            break
    assert step > 10
    assert 0 < fleet.sum() < 12


def sparse(space: Space) -> Space:
    """Return a space with the same conflicts and 20 times as many volumes."""

    def numbered(plans: Sequence[Plan]) -> tuple[np.ndarray, np.ndarray]:
        volume, conflicts = space(plans)
        return 20 * volume, np.kron(conflicts, np.ones((20, 20), bool)).astype(bool)

    return numbered


def test_variants_with_different_risk_models_do_not_mix(small, play) -> None:
    """Variants without risks, with risks of one piece, of three pieces and a curve; with one and two stations; with no
    shared space, and with volumes in one word of bits and in several."""
    models = [
        [small.ByPayload(1.0 + 0.1 * i) for i in range(3)],
        [play.Learned(1, curve=False) for _ in range(3)],
        [play.Learned(3, curve=True), small.ByPayload(1.0), play.Learned(2, curve=False)],
    ]
    works = [small.work("bench", small.HOT), small.work("rack", 1.0, to="bench"), small.work("rack")]
    flat = [small.work("bench", small.HOT), small.work("rack", 1.0), small.work("rack")]
    tables, shifts = [], []
    for fleet, own in enumerate(models):
        content = flat if fleet == 1 else works
        arms = [small.arm(i, content, model=model, times=small.Times(cycle=8.0 + fleet)) for i, model in enumerate(own)]
        jobs = [small.job(f"j{j}", content[j % 3], release_s=30.0 * (j // 2), repetitions=2 + j % 2) for j in range(9)]
        space = (None, small.crowded(0.4), sparse(small.crowded(0.4)))[fleet]
        world, _ = small.shop([jobs], arms=arms, ticks=40, ambient_c=30.0 + fleet, space=space)
        own_tables, drawn = tables_of(world)
        tables.append(own_tables)
        shifts += shifts_of(drawn, [77])
    assert len({(*table.forecast_block.shape, *table.forecast_curve.shape) for table in tables}) == 3
    assert [table.excluded.shape[1] for table in tables] == [1, 1, 3]
    assert [bool(table.excluded.any()) for table in tables] == [False, True, True]
    assert len({int(np.bitwise_count(table.stations).max()) for table in tables}) == 2
    names, together = ("arm_0", "arm_1", "arm_2"), stack_tables(tables)
    for fleet, own_tables in enumerate(tables):
        in_all = replace(shifts[fleet], fleet=fleet)
        alone = BatchEnv(Library(names, 4, own_tables, lambda _, fleet=fleet: shifts[fleet]), 1, seed=0)
        among = BatchEnv(Library(names, 4, together, lambda _, shift=in_all: shift), 1, seed=0)
        one, other = alone.reset(), among.reset()
        for step in range(40):
            play.same(play.rows(one, 0), play.rows(other, 0))
            actions = actions_of(play, one[0]["action_mask"], step)
            one, other = alone.step(actions), among.step(actions)
