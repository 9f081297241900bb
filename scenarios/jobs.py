"""The jobs of a shift: what a scenario's streams ask for, drawn for one seed."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from fleet.arrivals import oftener, release_times
from fleet.job import Job, Work
from scenarios.scenario import JobStream, Scenario

Array = np.ndarray


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


@dataclass(frozen=True, eq=False)
class DrawnJobs:
    """The jobs of one shift as arrays [job], in order of release, and of their names where they come together."""

    stream: Array
    """Index into the scenario's streams."""
    number: Array
    """Of the job in its stream, from 0."""
    payload: Array
    """Index into the stream's payloads."""
    repetitions: Array
    release_s: Array
    after: Array
    """Indices of the jobs that must be done first, int [job, n], −1 for none."""


class JobSource:
    """Draws the jobs of a scenario's shifts."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self._arrivals = [stream.arrivals.arrivals() for stream in scenario.jobs]
        self._ranges = [
            (np.array([0, stream.repetitions[0]]), np.array([len(stream.payload_kg), stream.repetitions[1] + 1]))
            for stream in scenario.jobs
        ]
        self._index = {stream.name: i for i, stream in enumerate(scenario.jobs)}
        self._waits = max((len(stream.after) for stream in scenario.jobs), default=0) or 1
        self._rank: Array = np.zeros((len(scenario.jobs), 0), dtype=int)

    def draw(self, seed: np.random.SeedSequence, often: float = 1.0) -> DrawnJobs:
        """The jobs of one shift; each stream has a random row of its own, so none disturbs another.

        Args:
            often: They come so many times as often.
        """
        streams = self.scenario.jobs
        horizon_s = self.scenario.ticks * self.scenario.decision_interval_s
        times: list[Array] = []
        choices: list[Array] = []
        arriving = self._arrivals if often == 1.0 else [oftener(each, often) for each in self._arrivals]
        for arrivals, (low, high), child in zip(arriving, self._ranges, seed.spawn(len(self._ranges)), strict=True):
            rng = np.random.default_rng(child)
            times.append(release_times(arrivals, horizon_s, rng))
            choices.append(rng.integers(low, high, size=(len(times[-1]), 2)))
        counts = [len(each) for each in times]
        release_s = np.concatenate([np.zeros(0), *times])
        chosen = np.concatenate([np.zeros((0, 2), dtype=int), *choices])
        payload, repetitions = np.moveaxis(chosen, -1, 0)
        stream = np.repeat(np.arange(len(counts)), counts)
        first = np.cumsum([0, *counts])
        number = np.arange(len(stream)) - first[stream]
        order = np.lexsort((self.ranks(max(counts, default=0))[stream, number], release_s))
        after = np.full((len(stream), self._waits), -1)
        if any(spec.after for spec in streams):
            place = np.empty(len(order), dtype=int)
            place[order] = np.arange(len(order))
            for i, spec in enumerate(streams):
                for n, other in enumerate(spec.after):
                    o = self._index[other]
                    both = min(counts[i], counts[o])
                    after[first[i] : first[i] + both, n] = place[first[o] : first[o] + both]
        return DrawnJobs(
            stream=stream[order],
            number=number[order],
            payload=payload[order],
            repetitions=repetitions[order],
            release_s=release_s[order],
            after=after[order],
        )

    def ranks(self, most: int) -> Array:
        """Place of each job's name among all names, [stream, number], for so many jobs a stream at least."""
        if self._rank.shape[1] < most:
            most = max(most, 2 * self._rank.shape[1])
            names = np.array([[_name(stream.name, n) for n in range(most)] for stream in self.scenario.jobs])
            self._rank = np.argsort(np.argsort(names, axis=None)).reshape(names.shape)
        return self._rank


def draw_jobs(scenario: Scenario, seed: np.random.SeedSequence) -> tuple[Job, ...]:
    """The jobs of one shift in order of release."""
    drawn = JobSource(scenario).draw(seed)
    streams = scenario.jobs
    works = [works_of(scenario, stream) for stream in streams]
    rows = zip(drawn.stream.tolist(), drawn.number.tolist(), strict=True)
    names = [_name(streams[i].name, number) for i, number in rows]
    return tuple(
        Job(
            name=names[j],
            work=works[i][drawn.payload[j]],
            repetitions=int(drawn.repetitions[j]),
            release_s=float(drawn.release_s[j]),
            due_s=float(drawn.release_s[j]) + streams[i].due_s,
            value=streams[i].value,
            after=tuple(names[k] for k in drawn.after[j].tolist() if k >= 0),
        )
        for j, i in enumerate(drawn.stream.tolist())
    )


def _name(stream: str, number: int) -> str:
    return f"{stream}-{number + 1:03d}"


def rehearsal_works(scenario: Scenario) -> tuple[Work, ...]:
    """What an arm rehearses: every motion of the scenario, with its own payloads and with light ones."""
    light = scenario.twin.payload_kg
    both = product(scenario.jobs, (None, light))
    return tuple(dict.fromkeys(w for stream, payload in both for w in works_of(scenario, stream, payload)))
