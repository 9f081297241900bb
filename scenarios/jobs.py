"""The jobs of a shift: what a scenario's streams ask for, drawn for one seed."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from fleet.arrivals import release_times
from fleet.job import Job, Work
from scenarios.scenario import JobStream, Scenario


def works_of(scenario: Scenario, stream: JobStream, payload_kg: Sequence[float] | None = None) -> tuple[Work, ...]:
    """The works a stream can ask for, one per payload (its own payloads unless others are given)."""
    place = {p.name: p for p in scenario.places}
    return tuple(
        Work(
            kind=stream.kind,
            places=tuple(place[name] for name in stream.places),
            payload_kg=float(payload),
            dwell_s=stream.dwell_s,
            force_n=stream.force_n,
        )
        for payload in (stream.payload_kg if payload_kg is None else payload_kg)
    )


def all_works(scenario: Scenario) -> tuple[Work, ...]:
    """Every different work of a scenario."""
    return tuple(dict.fromkeys(work for stream in scenario.jobs for work in works_of(scenario, stream)))


def draw_jobs(scenario: Scenario, seed: np.random.SeedSequence) -> tuple[Job, ...]:
    """The jobs of one shift in order of release; each stream has a random row of its own, so none disturbs another."""
    horizon_s = scenario.ticks * scenario.decision_interval_s
    jobs: list[Job] = []
    counts: dict[str, int] = {}
    for stream, child in zip(scenario.jobs, seed.spawn(len(scenario.jobs)), strict=True):
        rng = np.random.default_rng(child)
        times = release_times(stream.arrivals.arrivals(), horizon_s, rng)
        choices = works_of(scenario, stream)
        low, high = stream.repetitions
        counts[stream.name] = len(times)
        for number, release_s in enumerate(times.tolist()):
            jobs.append(
                Job(
                    name=_name(stream.name, number),
                    work=choices[int(rng.integers(len(choices)))],
                    repetitions=int(rng.integers(low, high + 1)),
                    release_s=release_s,
                    due_s=release_s + stream.due_s,
                    value=stream.value,
                    after=tuple(_name(other, number) for other in stream.after if number < counts[other]),
                )
            )
    return tuple(sorted(jobs, key=lambda job: (job.release_s, job.name)))


def _name(stream: str, number: int) -> str:
    return f"{stream}-{number + 1:03d}"


def rehearsal_works(scenario: Scenario) -> tuple[Work, ...]:
    """What an arm rehearses: every motion of the scenario, with its own payloads and with light ones."""
    light = scenario.twin.payload_kg
    both = product(scenario.jobs, (None, light))
    return tuple(dict.fromkeys(w for stream, payload in both for w in works_of(scenario, stream, payload)))
