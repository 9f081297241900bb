"""Observations: the layout, and every field against a reference computed from `World` and `State`."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from fleet.engine.batch import RewardWeights
from fleet.engine.profile_plant import sensor_noise
from fleet.engine.shift import Episode, ShiftRunner
from fleet.engine.state import State, World
from fleet.observation import FIELDS, Layout, Observation
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED, IDLE, WORKING
from tests.profiles import examples


def test_fields_and_attributes_are_the_same_in_the_same_order() -> None:
    assert [f.name for f in FIELDS] == [f.name for f in fields(Observation) if f.name != "action_mask"]


@examples(60)
@given(
    arms=st.integers(1, 6), slots=st.integers(1, 9), plans=st.integers(1, 3),
    lead=st.sampled_from([(), (2,), (3, 2)]), seed=st.integers(0, 99),
)  # fmt: skip
def test_a_packed_observation_is_read_back(arms, slots, plans, lead, seed) -> None:
    layout, rng = Layout(arms, slots, plans=plans), np.random.default_rng(seed)
    named = {f.name: rng.uniform(f.low, f.high, (*lead, *layout.shape(f))).astype(np.float32) for f in FIELDS}
    mask = rng.integers(0, 2, (*lead, layout.actions)).astype(np.int8)
    vector = layout.pack(Observation(**named, action_mask=mask))
    assert vector.shape == (*lead, layout.size)
    assert vector.dtype == np.float32
    again = layout.read(vector, mask)
    for name, value in named.items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    assert again.action_mask is mask
    assert layout.size == sum(int(np.prod(layout.shape(f))) for f in FIELDS)


def test_values_out_of_range_are_clipped() -> None:
    layout = Layout(2, 3)
    named = {f.name: np.full(layout.shape(f), 1e9) for f in FIELDS}
    again = layout.read(layout.pack(Observation(**named, action_mask=np.ones(4, np.int8))), np.ones(4, np.int8))
    for f in FIELDS:
        assert (getattr(again, f.name) == np.float32(f.high)).all()


def test_vectors_of_wrong_size_are_refused() -> None:
    layout = Layout(2, 3)
    with pytest.raises(
        ValueError, match=rf"An observation of 3 slots and 1 peer\(s\) has {layout.size} elements, got 5"
    ):
        layout.read(np.zeros(5, np.float32), np.ones(4, np.int8))


# The reference


def with_second_plans(world: World, rng: np.random.Generator) -> World:
    """Return the world in which arms have a second, slower plan for some jobs, with its own space and scores."""
    table, offers, count = world.plans, world.offers, len(world.plans.volume)
    twice = {name: np.concatenate([values, values]) for name, values in vars(table).items()}
    twice["times_s"][count:] *= 1.5
    twice["volume"][count:] += len(world.conflicts)
    new = np.triu(rng.random((2 * len(world.conflicts),) * 2) < 0.2)
    conflicts = np.tile(world.conflicts, (2, 2)) ^ (new | new.T)
    for own in np.moveaxis(offers.plan, 1, 0):  # an arm's plans never exclude each other
        volumes = twice["volume"][np.concatenate([own[own >= 0], own[own >= 0] + count])]
        conflicts[np.ix_(volumes, volumes)] = False
    second = (offers.plan >= 0) & (rng.random(offers.plan.shape) < 0.7)
    scored = second & (rng.random(offers.plan.shape) < 0.7)
    more = {
        "plan": np.where(second, offers.plan + count, -1),
        "difficulty": np.where(scored, rng.uniform(0.0, 2.0, offers.plan.shape), np.nan),
        "p_saturation": np.where(scored, rng.random(offers.plan.shape), np.nan),
        "risk": np.full(offers.plan.shape, -1),
        "peak": np.full(offers.plan.shape, -1),
    }
    both = {name: np.concatenate([getattr(offers, name), values], axis=-1) for name, values in more.items()}
    return replace(world, plans=replace(table, **twice), conflicts=conflicts, offers=replace(offers, **both))


def value_of(world: World, row: int, known_c: np.ndarray, left_s: float = np.inf) -> float:
    """Value of a forecast by its definition."""
    forecasts = world.offers.forecasts
    assert forecasts is not None
    counts = np.isfinite(forecasts.offset[row])
    if forecasts.time_s is not None:
        counts &= forecasts.time_s[row] <= left_s
    return max((forecasts.offset[row] + forecasts.weight[row] @ known_c)[counts], default=-np.inf)


def prediction(world: World, at: tuple[int, ...], known_c: np.ndarray, left_s: float = np.inf) -> tuple[float, float]:
    """P and the predicted peak of an option (env, arm, job, plan), 0.5 and 0 if unknown."""
    p, risk, peak = (getattr(world.offers, name)[at] for name in ("p_saturation", "risk", "peak"))
    if risk >= 0:
        forecasts = world.offers.forecasts
        assert forecasts is not None
        curve = np.zeros((0, 2)) if forecasts.curve is None else forecasts.curve[risk]
        curve = curve[np.isfinite(curve[:, 0])]
        score = value_of(world, risk, known_c, left_s)
        p = np.interp(score, *curve.T) if len(curve) else expit(score)
    peak_c = value_of(world, peak, known_c, left_s) if peak >= 0 else 0.0
    return 0.5 if np.isnan(p) else float(p), max(peak_c, -60.0)


def reference(world: World, state: State, slots: list[int], key: int) -> dict[str, np.ndarray]:
    """Compute the fields of all arms of env 0, [arm, ...], one by one; peers as of this moment."""
    arms, now_s, jobs, offers = len(world.arms), state.tick[0] * world.dt_s, world.jobs, world.offers
    measured_c = state.temp_c[0, :, :7] + world.motors.sensor_noise_k * sensor_noise(key, state.tick[0], arms, 7)
    ambient_c = world.ambient_c[min(int(state.tick[0]), world.ticks - 1)]
    volume, times_s, away = world.plans.volume, world.plans.times_s, state.plan[0]
    occupied = {s for j in state.job[0].tolist() if j >= 0 for s in jobs.stations[0, j].tolist() if s >= 0}
    own: list[dict[str, object]] = []
    for a in range(arms):
        mode, todo = state.mode[0, a], int(state.todo[0, a])
        known_c = np.concatenate([measured_c[a], state.housing_c[0, a], ambient_c[a : a + 1]])
        busy_s = times_s[away[a]] @ [1, todo, 1] - state.progress_s[0, a] if mode == WORKING else 0.0
        mine = {
            "clock": now_s / world.horizon_s, "left_s": world.horizon_s - now_s,
            "idle": mode == IDLE, "working": mode == WORKING, "faulted": mode == FAULTED,
            "last_award": state.last_award[0, a], "temp_c": measured_c[a],
            "busy_s": busy_s, "headroom_k": world.limits.warning_c - measured_c[a].max(),
            "error_headroom_k": world.limits.error_c - measured_c[a].max(),
            "housing_c": state.housing_c[0, a], "ambient_c": ambient_c[a],
            "job_value": 0.0, "job_cycles": 0.0, "job_peak_c": 0.0, "job_p": 0.0, "give_back": 0.0,
        }  # fmt: skip
        into_s = state.progress_s[0, a] - times_s[away[a], 0]
        if mode == WORKING and state.job[0, a] >= 0 and into_s < todo * times_s[away[a], 1] - 1e-6:
            j = int(state.job[0, a])
            n = offers.plan[0, a, j].tolist().index(away[a])
            p, peak_c = prediction(world, (0, a, j, n), known_c, busy_s)
            cycles = max(into_s, 0.0) / times_s[away[a], 1]
            mine |= {
                "job_value": jobs.value[0, j], "job_p": p,
                "job_peak_c": max(peak_c, measured_c[a].max()) if offers.peak[0, a, j, n] >= 0 else 0.0,
                "job_cycles": jobs.repetitions[0, j] - state.cycles[0, j] - int(cycles + 1e-9),
                "give_back": np.ceil(cycles - 1e-9) < todo,
            }  # fmt: skip
        rows, options, blocks = [], [], np.zeros((arms, len(slots)))
        for k, j in enumerate(slots):
            if j < 0:
                rows.append([0] * 8)
                options += [[0, 0, 0, 0, 0.5, 0, 0, 0]] * world.plans_per_job
                continue
            free = not occupied & set(jobs.stations[0, j].tolist())
            age_s = now_s - state.queued_s[0, j]
            rows.append(
                [1, free, age_s, jobs.payload_kg[0, j], jobs.value[0, j], state.returns[0, j], jobs.expires[0, j],
                 offers.too_heavy[0, a, j]]
            )  # fmt: skip
            for n, plan in enumerate(offers.plan[0, a, j].tolist()):
                if plan < 0:
                    options.append([0, 0, 0, 0, 0.5, 0, 0, 0])
                    continue
                closed = [
                    b for b in range(arms) if b != a and away[b] >= 0 and world.conflicts[volume[plan], volume[away[b]]]
                ]
                if n == 0:
                    blocks[closed, k] = 1.0
                left_s = times_s[plan] @ [1, jobs.repetitions[0, j] - state.cycles[0, j], 1]
                d = offers.difficulty[0, a, j, n]
                p, peak_c = prediction(world, (0, a, j, n), known_c)
                slack_s = jobs.due_s[0, j] - now_s - left_s
                options.append([1, not closed, not np.isnan(d), np.nan_to_num(d), p, peak_c, left_s, slack_s])
        names = ("offered", "station_free", "age_s", "payload_kg", "value", "returns", "expires", "too_heavy")
        mine |= dict(zip(names, np.array(rows, dtype=float).T, strict=True))
        names = ("feasible", "space_free", "known", "difficulty", "p_saturation", "peak_c", "duration_s", "slack_s")
        mine |= dict(zip(names, np.array(options, dtype=float).T, strict=True))
        own.append(mine | {"peer_blocks": np.delete(blocks, a, axis=0)})
    shared = []
    for mine in own:
        known, d = (np.reshape(mine[name], (len(slots), -1)) for name in ("known", "difficulty"))
        least = np.where(known > 0, d, np.inf).min(axis=1)
        shared.append({"known": known.any(axis=1), "difficulty": np.where(np.isinf(least), 0.0, least)})
    told = ("working", "faulted", "headroom_k", "busy_s", "known", "difficulty")
    for a, mine in enumerate(own):
        others = [{**own[b], **shared[b]} for b in range(arms) if b != a]
        mine |= {f"peer_{n}": [o[n] for o in others] for n in told}
        mine |= {"peer_heard": [1.0] * len(others), "peer_age_s": [0.0] * len(others)}
    return {name: np.array([each[name] for each in own], dtype=float) for name in own[0]}


def reference_mask(expected: dict[str, np.ndarray], plans: int) -> np.ndarray:
    """Legal actions by the fields: wait, every plan of an idle arm with free stations and space, and give back."""
    legal = expected["idle"][:, None] * expected["feasible"] * expected["space_free"]
    legal *= np.repeat(expected["station_free"], plans, axis=1)
    return np.concatenate([np.ones((len(legal), 1)), legal, expected["give_back"][:, None]], axis=1)


def compare_with_reference(play, episode: Episode, seed: int) -> tuple[State, int]:
    """Play a shift and compare every vector; return the last state, and the number of plans without free space."""
    world, rng = episode.world, np.random.default_rng(seed)
    runner, closed = ShiftRunner(episode, RewardWeights()), 0
    layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job)
    while True:
        slots = play.slots_of(world, runner.state)
        assert runner.slot_job.tolist() == slots
        actual = layout.read(runner.vectors, runner.mask)
        expected = reference(world, runner.state, slots, episode.noise_key)
        assert set(expected) - {"give_back"} == {field.name for field in FIELDS}
        for name in (field.name for field in FIELDS):
            values = expected[name]
            observed = getattr(actual, name)
            np.testing.assert_allclose(observed, values.reshape(observed.shape), rtol=1e-6, atol=2e-5, err_msg=name)
        np.testing.assert_array_equal(runner.mask, reference_mask(expected, layout.plans))
        closed += int((expected["feasible"] > expected["space_free"]).sum())
        if runner.tick == world.ticks:
            return runner.state.copy(), closed
        runner.step(play.chosen(runner.mask, rng.random((len(world.arms), 2))))


@examples(25)
@given(
    seed=st.integers(0, 2**31), arms=st.integers(1, 4), jobs=st.integers(0, 9), slots=st.integers(1, 5),
    ambient_c=st.sampled_from([20.0, 45.0, 58.0]), power_off=st.booleans(), share=st.sampled_from([0.0, 0.2, 1.0]),
    two_plans=st.booleans(),
)  # fmt: skip
def test_vectors_equal_the_reference(
    small, play, seed, arms, jobs, slots, ambient_c, power_off, share, two_plans
) -> None:
    limits = ThermalLimits(warning_c=56.0, error_c=60.0, restart_c=54.0, clear_s=25.0, power_off_on_fault=power_off)
    make = small.Shifts(arms=arms, jobs=jobs, slots=slots, ticks=60, ambient_c=ambient_c, limits=limits, crowding=share)
    episode = make(np.random.SeedSequence(seed))
    if two_plans:
        episode = replace(episode, world=with_second_plans(episode.world, np.random.default_rng(seed)))
    compare_with_reference(play, episode, seed)


def test_shifts_of_the_comparison_include_faults_returned_jobs_and_closed_space(small, play) -> None:
    limits = ThermalLimits(warning_c=56.0, error_c=60.0, restart_c=54.0, clear_s=25.0)
    make = small.Shifts(arms=3, jobs=9, ticks=80, ambient_c=45.0, limits=limits, crowding=0.3)
    played = [compare_with_reference(play, make(np.random.SeedSequence(seed)), seed) for seed in range(4)]
    last = [state for state, _ in played]
    assert sum(closed for _, closed in played) > 0
    assert sum(int(state.faults.sum()) for state in last) > 0
    assert sum(int(state.returns.sum()) for state in last) > 0
    assert sum(int(((state.faults > 0) & (state.mode != FAULTED)).sum()) for state in last) > 0


@pytest.mark.parametrize(("pieces", "curve"), [(1, False), (3, False), (2, True)])
def test_risks_equal_the_reference(small, play, pieces, curve) -> None:
    content = [small.work(place, payload) for place in ("a", "b") for payload in (small.LIGHT, small.HOT)]
    arms = [
        small.arm(0, content, model=play.Learned(pieces, curve=curve)),
        small.arm(1, content[:2], model=play.Learned(1, curve=False)),
        small.arm(2, content),
    ]
    jobs = [small.job(f"j{i}", content[i % 4], release_s=50.0 * (i % 3)) for i in range(6)]
    world, plant = small.shop([jobs], arms=arms, ticks=60)
    compare_with_reference(play, Episode(world, plant, ("t",) * 3, np.random.SeedSequence(1)), 3)
