"""The batch: a row equals the single environment bit for bit, does not depend on other rows, and is randomised."""

import gc
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.memory import Exchange
from fleet.engine.batch import BLOCK
from fleet.engine.tables import stack_tables
from fleet.engine.world import Space
from fleet.env.allocation_v2 import AllocationEnv
from fleet.env.vector import BatchEnv, Library, Shelf
from fleet.motion import Plan
from scenarios.evaluate.rollout import outcomes
from scenarios.prepare.batch import library_of, make_batch
from scenarios.prepare.fleet import Fleet, Randomisation, env_of, make_env, prepare, simulator_of_shift
from scenarios.run.shift import run
from scenarios.spec.jobs import draw_jobs
from scenarios.spec.options import RunSpec
from tests.profiles import examples

SHIFT: dict[str, Any] = {"arms": 3, "jobs": 4, "ticks": 22, "ambient_c": 20.0, "crowding": 0.2}
"""Some of these shifts end when all jobs are finished, some at the horizon, at different times."""

STEPS = 110
SEED = 100


def numbers(env: int, steps: int = STEPS, arms: int = 3) -> np.ndarray:
    """Return random numbers for the actions of one env, [step, arm, 2]."""
    return np.random.default_rng(1000 + env).random((steps, arms, 2))


def played(env: BatchEnv, play, who: list[int], steps: int = STEPS) -> list[dict[str, Any]]:
    """Return all results of a batch from reset on, with the actions of the envs `who`."""
    all_numbers = np.stack([numbers(e, steps) for e in who], axis=1)
    given = env.reset()
    trace = [play.rows(given, range(env.num_envs))]
    for each in all_numbers:
        given = env.step(play.chosen(given[0]["action_mask"], each))
        trace.append(play.rows(given, range(env.num_envs)))
    return trace


def row(step: dict[str, Any], e: int) -> dict[str, Any]:
    """Return one row of a step of `played`."""
    place = int(np.count_nonzero(step["ended"][:e]))
    ended = bool(step["ended"][e])
    return {n: v[place : place + ended] if n.startswith("final_") else v[e : e + 1] for n, v in step.items()}


@pytest.fixture(scope="module")
def library(small) -> Library:
    return small.Shifts(**SHIFT).library()


@pytest.fixture(scope="module")
def many(library, play) -> list[dict[str, Any]]:
    return played(BatchEnv(library, 64, seed=SEED), play, list(range(64)))


def test_shifts_of_these_tests_terminate_and_truncate_at_different_times(many) -> None:
    terminated = np.array([step["terminated"] for step in many[1:]])
    truncated = np.array([step["truncated"] for step in many[1:]])
    assert min(terminated.sum(), truncated.sum()) > 20
    assert not (terminated & truncated).any()
    assert len(set((terminated | truncated).argmax(axis=0).tolist())) > 5
    assert (terminated | truncated).sum(axis=0).min() >= 3  # each env is at least in its fourth shift


@pytest.mark.parametrize("who", [[1], [5, 6, 7, 8, 9, 10, 11], [63, 2, 31, 0, 17, 30, 44]])
def test_a_row_does_not_depend_on_the_other_rows_or_their_order(many, batch, play, who) -> None:
    trace = played(batch(len(who), SHIFT, seed=[SEED + e for e in who]), play, who)
    for one, all_rows in zip(trace, many, strict=True):
        for place, e in enumerate(who):
            play.same(row(one, place), row(all_rows, e))


def test_a_row_of_a_thousand_equals_the_row_alone(library, play) -> None:
    """Also at the boundaries of the engine's blocks of rows."""
    thousand = played(BatchEnv(library, 1024, seed=SEED), play, list(range(1024)), steps=50)
    for e in (0, BLOCK - 1, BLOCK, 1023):
        for one, all_rows in zip(played(BatchEnv(library, 1, seed=SEED + e), play, [e], 50), thousand, strict=True):
            play.same(row(one, 0), row(all_rows, e))


ARMS = ("arm_0", "arm_1", "arm_2")
LATE = Channel(delay_s=25.0, loss=0.3)


def both(
    batch: BatchEnv, env: AllocationEnv, e: int, seed: int, play, *, steps: int = STEPS, rtol: float = 0.0
) -> Iterator[dict[str, Any]]:
    """What a single env returns at each step; everything equals row `e` of a batch with the same actions."""
    given, observed = batch.reset(), play.single(env, env.reset(seed=seed))
    for step in range(steps):
        obs = given[0]
        play.same({n: v[e : e + 1] for n, v in obs.items()}, {n: observed[n] for n in obs})
        together = play.named(batch.knowledge())
        for a, known in enumerate(env.knowledge().values()):
            play.same({name: values[e, a] for name, values in together.items()}, play.named(known))
        np.testing.assert_array_equal(batch.state.temp_c[e], env.truth.temp_c[0])
        actions = actions_of(play, obs["action_mask"], step)
        given = batch.step(actions)
        observed = play.single(env, env.step(dict(zip(env.possible_agents, actions[e].tolist(), strict=True))))
        expected = play.rows(given, e)
        assert expected["ended"][0] == (not env.agents)
        final = "" if env.agents else "final_"
        for n, values in observed.items():
            row_values = expected[f"{final}{n}" if n in obs else n]
            assert values.dtype == row_values.dtype, n
            np.testing.assert_allclose(values, row_values, rtol=rtol, err_msg=n)
        yield observed
        if not env.agents:
            observed = play.single(env, env.reset())


def actions_of(play, mask: np.ndarray, step: int) -> np.ndarray:
    """Return actions that do not depend on the number of rows."""
    return play.chosen(mask, np.random.default_rng(step).random((1, 3, 2)))


@pytest.mark.parametrize(
    ("e", "single", "many"),
    [
        (0, {}, {}),
        (5, {"keep_events": True}, {}),
        (3, {"decisions": "events"}, {"decisions": "events", "threads": 2}),
        (3, {"exchange": Exchange(ARMS, LATE)}, {"exchanges": [Exchange(ARMS, LATE) for _ in range(7)]}),
    ],
    ids=["interval", "events recorded", "steps until events", "late messages"],
)
def test_a_row_equals_the_single_env_over_several_shifts(make, batch, play, e, single, many) -> None:
    shift = {**SHIFT, "absences": 5}
    together, alone = batch(7, shift, seed=SEED, **many), make(shift, **single)
    rtol = 1e-12 if "decisions" in single else 0.0  # rewards of intervals are added up in another order
    steps = list(both(together, alone, e, SEED + e, play, rtol=rtol))
    assert sum(bool(step["terminated"] | step["truncated"]) for step in steps) > 1
    assert len({float(step["elapsed_s"][0]) for step in steps}) > 1 or "decisions" not in single


@pytest.mark.parametrize("threads", [3, 7])
def test_results_do_not_depend_on_the_number_of_threads(library, play, threads) -> None:
    who = list(range(2 * BLOCK + 40))
    one, several = (played(BatchEnv(library, len(who), seed=SEED, threads=n), play, who, 30) for n in (1, threads))
    for a, b in zip(one, several, strict=True):
        play.same(a, b)


def test_resetting_other_rows_keeps_delivered_messages(batch, play) -> None:
    """Also if the caller has overwritten returned observations."""
    one, other = (batch(3, SHIFT, seed=SEED, autoreset=False, exchanges=[Exchange(ARMS, LATE)] * 3) for _ in range(2))
    for env in (one, other):
        env.reset()
    for _ in range(4):
        kept = one.step(np.zeros((3, 3), int))[0]
        spoilt = other.step(np.zeros((3, 3), int))[0]
    kept = {name: values[1:].copy() for name, values in kept.items()}
    spoilt["shared"][:] = spoilt["own"][:] = -1.0
    again, info = other.reset(rows=[0])
    assert info["elapsed_s"].tolist() == [0.0, 10.0, 10.0]
    play.same({name: values[1:] for name, values in again.items()}, kept)
    known = other.knowledge()
    np.testing.assert_array_equal(known.peer_age_s[1:], one.knowledge().peer_age_s[1:])
    assert (known.peer_age_s[1:] >= 25.0).all()


def test_one_seed_counts_up_and_a_list_gives_one_per_row(batch, play) -> None:
    up, listed = batch(5, SHIFT, seed=7).reset(), batch(5, SHIFT, seed=[7, 8, 9, 10, 11]).reset()
    play.same(up[0], listed[0])
    again = batch(5, SHIFT, seed=1)
    again.reset()
    again.step(np.zeros((5, 3), int))
    for seed in (7, np.int64(7), np.arange(7, 12)):
        play.same(again.reset(seed=seed)[0], up[0])
    alike = batch(3, SHIFT, seed=[4, 4, 4]).reset()[0]
    assert all((values == values[:1]).all() for values in alike.values())


def test_autoreset_returns_the_first_observation_of_a_reset(batch, play) -> None:
    """With `autoreset` the same shifts begin one step earlier than without it."""
    by_itself, by_hand = batch(16, SHIFT, seed=3), batch(16, SHIFT, seed=3, autoreset=False)
    one, other = by_itself.reset(), by_hand.reset()
    play.same(one[0], other[0])
    ends, rng = 0, np.random.default_rng(0)
    for _ in range(STEPS):
        actions = play.chosen(one[0]["action_mask"], rng.random((16, 3, 2)))
        one, other = by_itself.step(actions), by_hand.step(actions)
        for a, b in zip(one[1:4], other[1:4], strict=True):
            np.testing.assert_array_equal(a, b)
        over = other[2] | other[3]
        np.testing.assert_array_equal(np.flatnonzero(over), other[4]["final_envs"])
        np.testing.assert_array_equal(one[4]["final_envs"], other[4]["final_envs"])
        play.same(one[4]["final_obs"], {name: values[over] for name, values in other[0].items()})
        for name in ("faults", "peak_c", "jobs_done", "reward_energy"):  # infos are of the step, not of the new shift
            np.testing.assert_array_equal(one[4][name], other[4][name])
        assert all(len(values) == 0 for values in other[4]["final_obs"].values())
        if over.any():
            ends += 1
            fresh, _ = by_hand.reset(rows=over if ends % 2 else np.flatnonzero(over))
            play.same(one[0], fresh)
        else:
            play.same(one[0], other[0])
        play.same(play.named(by_itself.knowledge()), play.named(by_hand.knowledge()))
        play.same(by_itself.state.named(), by_hand.state.named())
    assert ends > 10


@settings(max_examples=20)
@given(chosen=st.sets(st.integers(0, 5)), as_mask=st.booleans(), at=st.integers(0, 30))
def test_resetting_some_rows_does_not_change_the_others(library, play, chosen, as_mask, at) -> None:
    one, other, rng = BatchEnv(library, 6, seed=1), BatchEnv(library, 6, seed=1), np.random.default_rng(at)
    here, there = one.reset(), other.reset()
    for _ in range(at):
        actions = play.chosen(here[0]["action_mask"], rng.random((6, 3, 2)))
        here, there = one.step(actions), other.step(actions)
    rest = [e for e in range(6) if e not in chosen]
    rows = np.isin(np.arange(6), list(chosen)) if as_mask else sorted(chosen)
    obs, _ = one.reset(rows=rows)
    for _ in range(20):
        play.same({n: v[rest] for n, v in obs.items()}, {n: v[rest] for n, v in there[0].items()})
        actions = play.chosen(there[0]["action_mask"], rng.random((6, 3, 2)))
        here, there = one.step(actions), other.step(actions)
        obs = here[0]
        play.same(play.rows(here, rest), play.rows(there, rest))


def test_growing_the_job_arrays_changes_no_result(small, library, play) -> None:
    """A row with many jobs enlarges the arrays of all rows."""
    few, lots = library.draw, small.Shifts(**{**SHIFT, "jobs": 23}).library().draw
    mixing = replace(library, draw=lambda seed: (lots if seed.entropy == 2 else few)(seed))
    mixed, alone = BatchEnv(mixing, 3, seed=0), BatchEnv(library, 2, seed=0)
    for one, other in zip(played(mixed, play, [0, 1, 2], 12), played(alone, play, [0, 1], 12), strict=True):
        for e in range(2):
            play.same(row(one, e), row(other, e))
    assert mixed.state.status.shape[1] >= 23 > alone.state.status.shape[1]


def test_max_cycles_end_a_shift_earlier(batch) -> None:
    env = batch(3, SHIFT, seed=0, max_cycles=5)
    env.reset()
    ends = [env.step(np.zeros((3, 3), int))[3].tolist() for _ in range(11)]
    assert [all(end) for end in ends] == [False] * 4 + [True] + [False] * 4 + [True, False]


def test_staggered_envs_end_their_first_shifts_one_after_the_other(small) -> None:
    make = small.Shifts(jobs=30, ticks=20)
    env = BatchEnv(make.library(), 5, seed=0, stagger=True)
    env.reset()
    waits = np.zeros((5, make.arms), dtype=int)
    ends = [np.flatnonzero(env.step(waits)[3]).tolist() for _ in range(24)]
    assert {tick + 1: which for tick, which in enumerate(ends) if which} == {
        4: [0], 8: [1], 12: [2], 16: [3], 20: [4], 24: [0],
    }  # fmt: skip


def test_referenced_arrays_are_never_reused() -> None:
    shelf = Shelf((3, 4), np.float32, keep=2)
    held = [shelf.take() for _ in range(5)]
    assert len({id(array) for array in held}) == 5
    assert all(array.shape == (3, 4) and array.dtype == np.float32 for array in held)
    for array in held:
        array[:] = 7.0
    part, raw = held[0][1, 2:], memoryview(held[1])
    held.clear()
    gc.collect()
    taken = [shelf.take() for _ in range(4)]
    for array in taken:
        array[:] = 0.0
    assert part.tolist() == [7.0, 7.0]
    assert raw[0, 0] == 7.0


def test_released_arrays_are_reused() -> None:
    shelf = Shelf((8,), np.int64)
    place = shelf.take().ctypes.data
    assert shelf.take().ctypes.data == place
    kept = shelf.take()
    assert shelf.take().ctypes.data != kept.ctypes.data


TURNOVER = """
import resource, sys
import numpy as np
from fleet.env.vector import keep_pages
if sys.argv[1] == "kept":
    assert keep_pages()
for _ in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(5_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_keep_pages_reuses_memory() -> None:
    """Allocate 40 MB twice: the second time the process gets no new pages."""
    faults = {
        how: int(subprocess.run([sys.executable, "-c", TURNOVER, how], capture_output=True, check=True).stdout)
        for how in ("given back", "kept")
    }
    assert faults["kept"] < 100
    assert faults["given back"] > 3 * faults["kept"]


LAST_SEED = 30
VARIED = Randomisation(ambient_k=(-1.0, 3.0), arrivals=(0.8, 1.5), variants=[{"spread": {"scale": 2.0, "seed": 9}}])


@pytest.fixture(scope="module")
def fleet(cell, plans) -> Fleet:
    return prepare(cell, difficulty="blind", cache=plans)


@pytest.mark.parametrize(
    ("difficulty", "e", "randomise"), [("blind", 0, None), ("oracle", 5, VARIED)], ids=["plain", "randomised"]
)
def test_a_row_equals_make_env_with_the_same_seed(cell, plans, play, e, difficulty, randomise) -> None:
    options: dict[str, Any] = {"difficulty": difficulty, "randomise": randomise, "cache": plans}
    batch, env = make_batch(cell, 6, LAST_SEED, **options), make_env(cell, **options)
    steps = list(both(batch, env, e, LAST_SEED + e, play, steps=220))
    assert sum(bool(step["terminated"] | step["truncated"]) for step in steps) >= 2
    assert sum(int(step["faults"].sum()) for step in steps) > 0


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
    rewards = [[outcome.reward for outcome in outcomes(fleet, "wspt", range(3))] for fleet in fleets]
    for fleet, expected in zip(fleets, rewards, strict=True):
        specs = [RunSpec(policy="wspt", seed=seed, bus="memory", difficulty="blind") for seed in range(3)]
        assert [run(fleet, spec, record=False).reward for spec in specs] == pytest.approx(expected)
    assert sum(one != other for one, other in zip(*rewards, strict=True)) == 3


def test_an_empty_randomisation_changes_nothing(fleet) -> None:
    plain, zero = library_of(fleet), library_of(replace(fleet, randomise=Randomisation(ambient_k=(0.0, 0.0))))
    for seed in range(5):
        one, other = (lib.draw(np.random.SeedSequence(seed)) for lib in (plain, zero))
        assert all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())


def test_randomised_values_cover_their_range(fleet) -> None:
    randomise = Randomisation(ambient_k=(-2.0, 6.0), arrivals=(0.5, 2.0))
    library = library_of(replace(fleet, randomise=randomise, variants=(fleet, fleet)))
    shifts = [library.draw(np.random.SeedSequence(seed)) for seed in range(200)]
    offset_k = np.array([shift.ambient_offset_k for shift in shifts])
    assert -2.0 <= offset_k.min() < -1.8
    assert 5.8 < offset_k.max() <= 6.0
    assert offset_k.mean() == pytest.approx(2.0, abs=4 * 8.0 / np.sqrt(12 * 200))
    fleets = np.bincount([shift.fleet for shift in shifts], minlength=3)
    assert len(fleets) == 3
    assert np.abs(fleets - 200 / 3).max() < 4 * np.sqrt(200 * 2 / 9)
    # 240 s / 60 s + 200 s / 40 s = 9 jobs, times 1.25 on average, and 3 at once.
    often = Randomisation(arrivals=(3.0, 3.0))
    for chosen, expected in ((Randomisation(), 12.0), (randomise, 3 + 9 * 1.25), (often, 3 + 9 * 3.0)):
        counts = [
            len(library_of(replace(fleet, randomise=chosen)).draw(np.random.SeedSequence(s)).kind) for s in range(100)
        ]
        assert np.mean(counts) == pytest.approx(expected, abs=4 * np.std(counts) / np.sqrt(100))


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
    np.testing.assert_allclose(warm.state.temp_c - cool.state.temp_c, 3.0, atol=1e-5)  # float32
    for batch in (cool, warm):
        for _ in range(15):
            batch.step(nobody)
    warmer = warm.state.temp_c - cool.state.temp_c
    assert warmer.min() > 3.0 - 1e-5
    assert 3.0 + 1e-6 < warmer.max() < 3.1  # a warmer motor has slightly higher losses


def test_the_single_env_and_its_simulator_are_those_of_the_variant_of_a_seed(cell, plans) -> None:
    """And a reset of the same fleet draws a shift only: the tables stay."""
    spread = {"spread": {"scale": 2.0, "seed": 9}}
    fleet = prepare(cell, difficulty="oracle", cache=plans, randomise=Randomisation(variants=[spread]))
    env, capacity, tables = env_of(fleet), [], set()
    for seed in range(8):
        variant = fleet.conditions(np.random.SeedSequence(seed)).fleet
        env.reset(seed=seed)
        expected = [arm.thermal.capacity for arm in fleet.all[variant].arms]
        np.testing.assert_array_equal(env.world.thermal.capacity, expected)
        simulated = simulator_of_shift(fleet, seed)._engine.tables.modal["root_capacity"][0]
        np.testing.assert_allclose(simulated**2, expected)
        capacity.append(float(expected[0][0]))
        tables.add(id(env.batch.engine.tables))
    assert len(set(capacity)) == len(tables) == 2


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
        tables.append(world.tables)
        shifts.append(replace(world.shifts[0], noise_key=77))
    assert len({(*table.forecast_block.shape, *table.forecast_curve.shape) for table in tables}) == 3
    assert [table.excluded.shape[1] for table in tables] == [1, 1, 3]
    assert [bool(table.excluded.any()) for table in tables] == [False, True, True]
    assert len({int(np.bitwise_count(table.stations).max()) for table in tables}) == 2
    names, together = ("arm_0", "arm_1", "arm_2"), stack_tables(tables)
    for name, values in together._asdict().items():  # other types would be compiled anew
        assert np.asarray(values).dtype == np.asarray(getattr(tables[0], name)).dtype, name
    for fleet, own_tables in enumerate(tables):
        in_all = replace(shifts[fleet], fleet=fleet)
        alone = BatchEnv(Library(names, 4, own_tables, lambda _, fleet=fleet: shifts[fleet]), 1, seed=0)
        among = BatchEnv(Library(names, 4, together, lambda _, shift=in_all: shift), 1, seed=0)
        for one, other in zip(played(alone, play, [0], 40), played(among, play, [0], 40), strict=True):
            play.same(one, other)
