"""The jobs of a shift, sampled from a scenario's streams for one seed, and the default price of a fault.

The two factors of the price, `fleet.engine.batch.FaultPrice`, follow from the scenario alone.

- Value rate: expected value of arriving jobs per second, over all streams.
- Downtime: time in which all motors of a nominal arm cool below `limits.restart_c`, plus `limits.clear_s`. The arm
  starts at the steady temperatures of a constant load on joint 2 that brings its winding to `limits.error_c`. The
  ambient temperature is the mean of the shift.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from fleet.arrivals import ArrivalTable, arrival_table, sample_arrivals, scale_rate
from fleet.engine.batch import FaultPrice, RewardWeights, Shift
from fleet.errors import ScenarioError
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, gen3_network, node_heat, thermal_model
from fleet.jit import kernel
from fleet.job import Job, Work
from fleet.robot import JOINTS, ThermalLimits
from fleet.seeding import random_uniform, random_word, shift_seeds
from scenarios.spec.schema import JobStream, Scenario

Array = np.ndarray


def works_of(scenario: Scenario, stream: JobStream, payload_kg: Sequence[float] | None = None) -> tuple[Work, ...]:
    """The works of a stream, of each payload (its own payloads unless others are given) at each alternative."""
    payloads = stream.payload_kg if payload_kg is None else payload_kg
    return tuple(work for payload in payloads for work in alternatives_of(scenario, stream, payload))


def alternatives_of(scenario: Scenario, stream: JobStream, payload_kg: float) -> tuple[Work, ...]:
    """The task of a stream with a payload at each of its alternative places."""
    place = {p.name: p for p in scenario.places}
    return tuple(
        Work(
            kind=stream.kind,
            places=tuple(place[name] for name in names),
            payload_kg=float(payload_kg),
            dwell_s=stream.dwell_s,
            force_n=stream.force_n,
        )
        for names in stream.alternatives
    )


def all_works(scenario: Scenario) -> tuple[Work, ...]:
    """Every different work of a scenario."""
    return tuple(dict.fromkeys(work for stream in scenario.jobs for work in works_of(scenario, stream)))


def kinds_of(scenario: Scenario) -> list[Job]:
    """One job of every kind in a scenario's streams: each payload, each number of repetitions."""
    return [
        Job(name=f"{stream.name}/{p}/{repetitions}", work=work, alternatives=others, repetitions=repetitions,
            release_s=0.0, due_s=0.0, value=stream.value)
        for stream in scenario.jobs
        for p, payload_kg in enumerate(stream.payload_kg)
        for work, *rest in [alternatives_of(scenario, stream, payload_kg)]
        for others in [tuple(rest)]
        for repetitions in range(stream.repetitions[0], stream.repetitions[1] + 1)
    ]  # fmt: skip


@kernel
def sample_jobs(
    table: ArrivalTable, key: Array, choices: Array, after_streams: Array, release_s: Array, job: Array, after: Array
) -> int:
    """Sample the jobs of one shift; return their number, or −1 if the output arrays are too short.

    A value depends on the key, its stream and its number only, so streams are independent.

    Args:
        key: Key of the shift's jobs, uint64 [1].
        choices: Numbers of possible payloads and repetitions, int [stream, 2].
        after_streams: Streams that must finish before a stream's jobs, int [stream, n], −1 for none.
        release_s: Output, release times, [room].
        job: Output, stream, number, payload and extra repetitions, int [room, 4].
        after: Output, jobs that must finish first, int [room, n].
    """
    streams, total = len(choices), 0
    first = np.zeros(streams + 1, np.int64)
    times = np.empty(len(release_s))
    drawn = np.empty((len(release_s), 4), np.int64)
    for i in range(streams):
        own = random_word(key[0], np.uint64(i + 1))
        count = sample_arrivals(table, i, own, times[total:])
        if count < 0:
            return -1
        chosen = random_word(own, np.uint64(0))
        for n in range(count):
            drawn[total + n, 0], drawn[total + n, 1] = i, n
            for c in range(2):
                share = random_uniform(chosen, np.uint64(2 * n + c))
                drawn[total + n, 2 + c] = int(share * choices[i, c])
        total += count
        first[i + 1] = total
    order, place = np.empty(total, np.int64), np.empty(total, np.int64)
    for row in range(total):  # NumPy's stable sort takes seconds to compile
        n = row
        while n > 0 and times[order[n - 1]] > times[row]:
            order[n] = order[n - 1]
            n -= 1
        order[n] = row
    for n in range(total):
        place[order[n]] = n
    for n in range(total):
        row = order[n]
        release_s[n] = times[row]
        for c in range(4):
            job[n, c] = drawn[row, c]
        for w in range(after.shape[1]):
            before, number = after_streams[drawn[row, 0], w], drawn[row, 1]
            exists = before >= 0 and number < first[before + 1] - first[before]
            after[n, w] = place[first[before] + number] if exists else -1
    return total


class JobSampler:
    """Samples the jobs of a scenario's shifts."""

    def __init__(self, scenario: Scenario) -> None:
        streams = scenario.jobs
        self._scenario, self._streams = scenario, streams
        self._arrivals = [stream.arrivals for stream in streams]
        self._horizon_s = scenario.ticks * scenario.decision_interval_s
        self._table = arrival_table(self._arrivals, self._horizon_s)
        lowest, most = (np.array([stream.repetitions[i] for stream in streams], dtype=int) for i in (0, 1))
        self._fewest = lowest
        """Fewest repetitions of each stream, int [stream]."""
        self._choices = np.stack(
            [np.array([len(stream.payload_kg) for stream in streams], dtype=int), most - lowest + 1], axis=-1
        )
        """Numbers of possible payloads and repetitions, int [stream, 2]."""
        self._first_kind = np.cumsum([0, *self._choices.prod(axis=1)])[:-1]
        """Where the kinds of each stream begin; see `kinds_of`."""
        self._expires = np.array([stream.due == "hard" for stream in streams], dtype=bool)
        self._due_s = np.array([stream.due_s for stream in streams], dtype=float)
        index = {stream.name: i for i, stream in enumerate(streams)}
        waits = max((len(stream.after) for stream in streams), default=0) or 1
        self._after = np.full((len(streams), waits), -1)
        for i, stream in enumerate(streams):
            self._after[i, : len(stream.after)] = [index[name] for name in stream.after]
        self._room = 64

    @cached_property
    def _kinds(self) -> list[Job]:
        return kinds_of(self._scenario)

    def shift(
        self, seed: np.random.SeedSequence, rate: float = 1.0, *, named: bool = True, **conditions: Any
    ) -> Shift:  # of several types
        """The jobs of one shift in order of release, then of stream and number.

        Args:
            rate: Factor on the rates of Poisson streams and repeated batches.
            named: With the names of the jobs.
            conditions: Other fields of the shift.
        """
        table = self._table
        if rate != 1.0:
            table = arrival_table([scale_rate(each, rate) for each in self._arrivals], self._horizon_s)
        key = seed.generate_state(1, np.uint64)
        while True:
            release_s = np.empty(self._room)
            job, after = np.empty((self._room, 4), int), np.empty((self._room, self._after.shape[1]), int)
            total = sample_jobs.chosen()(table, key, self._choices, self._after, release_s, job, after)
            if total >= 0:
                break
            self._room *= 2
        stream, number, payload, extra = job[:total].T
        numbered = zip(stream.tolist(), number.tolist(), strict=True) if named else ()
        return Shift(
            kind=self._first_kind[stream] + payload * self._choices[stream, 1] + extra,
            release_s=release_s[:total],
            due_s=release_s[:total] + self._due_s[stream],
            repetitions=self._fewest[stream] + extra,
            expires=self._expires[stream],
            after=after[:total],
            names=tuple(job_name(self._streams[i], n) for i, n in numbered),
            **conditions,
        )

    def jobs(self, seed: np.random.SeedSequence, rate: float = 1.0) -> tuple[Job, ...]:
        """The jobs of `shift`."""
        shift = self.shift(seed, rate)
        columns = (shift.kind, shift.release_s, shift.due_s, shift.after, shift.expires)
        return tuple(
            replace(
                self._kinds[kind],
                name=name,
                release_s=release_s,
                due_s=due_s,
                after=tuple(shift.names[k] for k in after if k >= 0),
                expires=expires,
            )
            for name, kind, release_s, due_s, after, expires in zip(
                shift.names, *(column.tolist() for column in columns), strict=True
            )
        )


def job_name(stream: JobStream, number: int) -> str:
    """Name of a job of a stream; `number` counts from 0."""
    return f"{stream.name}-{number + 1:03d}" if stream.numbered else stream.name


def draw_jobs(scenario: Scenario, seed: np.random.SeedSequence) -> tuple[Job, ...]:
    """The jobs of one shift in order of release."""
    return JobSampler(scenario).jobs(seed)


def check_some_jobs(scenario: Scenario, seed: int) -> None:
    """Check that the shift of a seed has a job.

    Raises:
        ScenarioError: it has none; names the expected number of each stream.
    """
    if draw_jobs(scenario, shift_seeds(np.random.SeedSequence(seed))[0]):
        return
    expected = ", ".join(f"'{each.name}' {each.arrivals.expected(scenario.horizon_s):g}" for each in scenario.jobs)
    raise ScenarioError(
        f"{scenario.name}, seed {seed}: no job arrives in this shift of {scenario.horizon_s:g} s. Expected numbers: "
        f"{expected}. Change the arrivals or horizon_s, or give another --seed."
    )


def rehearsal_works(scenario: Scenario) -> tuple[Work, ...]:
    """Works for a twin's training: every motion of the scenario, with its own payloads and with light ones."""
    light = scenario.twin.payload_kg
    both = product(scenario.jobs, (None, light))
    return tuple(dict.fromkeys(w for stream, payload in both for w in works_of(scenario, stream, payload)))


CARRIER = 1
"""Index of joint 2, which carries most of the torque of an outstretched arm."""
AMBIENT_SAMPLES = 100


def weights_of(scenario: Scenario) -> RewardWeights:
    """Weights of the reward terms; the default of `faults` is minus the price of a fault."""
    given = scenario.reward
    faults = -fault_price(scenario).price if given.faults is None else given.faults
    return RewardWeights(**{**vars(given), "faults": faults})


def fault_price(scenario: Scenario) -> FaultPrice:
    """The price of a fault by value rate and downtime; it ignores `reward.faults` of the scenario."""
    value = sum(stream.value * stream.arrivals.expected(scenario.horizon_s) for stream in scenario.jobs)
    shift_s = scenario.horizon_s
    ambient_c = float(np.mean(scenario.ambient.at(np.linspace(0.0, shift_s, AMBIENT_SAMPLES))))
    return FaultPrice(value / shift_s, downtime_s(scenario.limits, ambient_c, most_s=shift_s))


def downtime_s(limits: ThermalLimits, ambient_c: float, *, most_s: float) -> float:
    """Time from a fault until the arm works again, s, at most `most_s`; see the module docstring.

    Args:
        ambient_c: Mean ambient temperature.
    """
    from scipy.optimize import brentq  # slow import that an arm does not need

    motors, thermal = gen3_motors(), thermal_model(gen3_network())
    idle_w = node_heat(np.zeros(JOINTS), motors.idle_w)
    rise_k = thermal.steady(np.eye(NODES)[CARRIER], 0.0)  # per W into the winding
    idle_c = thermal.steady(idle_w, ambient_c)
    fault_c = idle_c + (limits.error_c - idle_c[CARRIER]) / rise_k[CARRIER] * rise_k
    cooling_w = np.zeros(NODES) if limits.power_off_on_fault else idle_w

    def excess_k(time_s: float) -> float:
        return float(thermal.step(fault_c, cooling_w, ambient_c, time_s)[WINDING].max() - limits.restart_c)

    if excess_k(most_s) >= 0:
        return most_s
    cooled_s = brentq(excess_k, 0.0, most_s)
    assert isinstance(cooled_s, float)
    return min(most_s, cooled_s + limits.clear_s)
