"""The jobs of a shift are what its streams ask for, drawn once per seed."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.arrivals import Arrivals
from scenarios.spec.jobs import all_works, draw_jobs, rehearsal_works, works_of
from scenarios.spec.load import load
from scenarios.spec.schema import Scenario


@pytest.fixture
def small(small_toml) -> Scenario:
    return load(small_toml)


def drawn(scenario: Scenario, seed: int):
    return draw_jobs(scenario, np.random.SeedSequence(seed))


def with_stream(scenario: Scenario, index: int, **changes) -> Scenario:
    streams = list(scenario.jobs)
    streams[index] = replace(streams[index], **changes)
    return replace(scenario, jobs=tuple(streams))


def test_the_same_seed_draws_the_same_jobs_and_another_seed_others(small):
    assert drawn(small, 3) == drawn(small, 3)
    assert drawn(small, 3) != drawn(small, 4)


def test_jobs_come_in_order_of_release_and_inside_the_shift(small):
    jobs = drawn(small, 0)
    times = [job.release_s for job in jobs]
    assert times == sorted(times)
    assert 0 <= times[0] <= times[-1] < small.horizon_s
    assert len({job.name for job in jobs}) == len(jobs)


def test_every_job_is_one_its_stream_asks_for(small):
    streams = {stream.name: stream for stream in small.jobs}
    for seed in range(20):
        for job in drawn(small, seed):
            stream = streams[job.name.rsplit("-", 1)[0]]
            low, high = stream.repetitions
            assert low <= job.repetitions <= high
            assert job.work in works_of(small, stream)
            assert job.due_s == job.release_s + stream.due_s
            assert job.value == stream.value


def test_payloads_and_repetitions_are_drawn_evenly(small):
    """Against the binomial and uniform laws at four standard deviations."""
    many = with_stream(small, 1, arrivals=Arrivals(kind="batch", count=3000))
    jobs = [job for job in drawn(many, 0) if job.name.startswith("sort")]
    light = sum(job.work.payload_kg == 0.2 for job in jobs)
    assert abs(light - 1500) < 4 * np.sqrt(3000 / 4)
    for repetitions in (1, 2, 3):
        count = sum(job.repetitions == repetitions for job in jobs)
        assert abs(count - 1000) < 4 * np.sqrt(3000 * (1 / 3) * (2 / 3))


def test_a_poisson_stream_brings_horizon_over_gap_jobs_on_average(small):
    """Mean and variance of a Poisson variable are both 180 s / 30 s = 6."""
    counts = np.array([sum(j.name.startswith("sort") for j in drawn(small, seed)) for seed in range(500)])
    assert counts.mean() == pytest.approx(6.0, abs=4 * np.sqrt(6 / 500))
    assert counts.var() == pytest.approx(6.0, rel=4 * np.sqrt(2 / 500) + 0.05)


def test_a_further_stream_disturbs_none_of_the_others(small):
    further = replace(small, jobs=(*small.jobs, replace(small.jobs[1], name="more")))
    before, after = drawn(small, 5), drawn(further, 5)
    assert set(before) == {job for job in after if not job.name.startswith("more")}


def test_a_stream_after_another_waits_for_the_job_of_the_same_number(small):
    chained = with_stream(small, 1, after=("hold",), arrivals=Arrivals(kind="batch", count=3))
    after = {job.name: job.after for job in drawn(chained, 0)}
    assert after["sort-001"] == ("hold-001",)
    assert after["sort-002"] == ("hold-002",)
    assert after["sort-003"] == ()  # there are only two holds


def test_works_are_one_per_payload_without_repeats(small):
    assert [(work.kind, work.payload_kg) for work in all_works(small)] == [("hold", 2.0), ("sort", 0.2), ("sort", 0.5)]
    doubled = with_stream(small, 0, payload_kg=(2.0, 2.0))
    assert all_works(doubled) == all_works(small)


def test_an_arm_rehearses_every_motion_with_its_own_and_with_light_payloads(small):
    rehearsed = {(work.kind, work.payload_kg) for work in rehearsal_works(small)}
    light = {(kind, kg) for kind in ("hold", "sort") for kg in small.twin.payload_kg}
    assert rehearsed == light | {(work.kind, work.payload_kg) for work in all_works(small)}
