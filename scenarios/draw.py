"""Shifts for the batch, drawn quickly: the very numbers that `scenarios.jobs.JobSource` draws with NumPy's generators.

What is slow there is to make a generator for every stream of every shift, and to ask it for a few integers. Here the
state that NumPy would seed it with is worked out (`SeedSequence` mixes in the key of a child last, so a child's state
follows from its parent's pool; PCG64 is seeded as O'Neill has it), one generator is put into it, and its raw words
are turned into times and integers as NumPy does: the upper 53 bits of a word, and Lemire's multiplication
(ACM TOMACS 29(1), 2019). A test holds both ways together.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet.arrivals import Poisson, oftener, release_times
from fleet.seeds import child
from fleet.sim.jit import entry
from scenarios.jobs import JobSource
from scenarios.scenario import Scenario

Array = np.ndarray

_32, _64, _128 = 2**32 - 1, 2**64 - 1, 2**128 - 1
_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
"""Of PCG64."""
_SPARE = 8
"""Words drawn for integers that are thrown away, as one in many millions is."""


@entry
def descend(pool: Array, mixed: int, keys: Array, out: Array) -> None:
    """The words of the state that NumPy's `SeedSequence` gives to children of a seed.

    Args:
        pool: Of the seed, uint32 [4].
        mixed: Words mixed into it.
        keys: What each child's key adds, int [child, n].
        out: Takes four words for each child, uint64 [child, 4].
    """
    mask, half = np.uint64(0xFFFFFFFF), np.uint64(16)
    first, word = np.uint64(0x931E8875), np.empty(8, np.uint64)
    left, right = np.uint64(0xCA01F9DD), np.uint64(0x4973F715)
    begin = np.uint64(0x43B0D7E5)
    for _ in range(16 + 4 * max(mixed - 4, 0)):
        begin = (begin * first) & mask
    for c in range(len(keys)):
        own, scramble = np.empty(4, np.uint64), begin
        for i in range(4):
            own[i] = pool[i]
        for n in range(keys.shape[1]):
            for i in range(4):
                value = np.uint64(keys[c, n]) ^ scramble
                scramble = (scramble * first) & mask
                value = (value * scramble) & mask
                value ^= value >> half
                both = (left * own[i] - right * value) & mask
                own[i] = both ^ (both >> half)
        scramble = np.uint64(0x8B51F9DD)
        for i in range(8):
            value = own[i % 4] ^ scramble
            scramble = (scramble * np.uint64(0x58F38DED)) & mask
            value = (value * scramble) & mask
            word[i] = value ^ (value >> half)
        for i in range(4):
            out[c, i] = word[2 * i] | (word[2 * i + 1] << np.uint64(32))


@entry
def lay_out(
    counts: Array,
    words: Array,
    begins: Array,
    times_s: Array,
    window_s: Array,
    spans: Array,
    rank: Array,
    after_streams: Array,
    release_s: Array,
    stream: Array,
    chosen: Array,
    after: Array,
) -> bool:
    """From raw words to jobs in order of release; False where NumPy would have thrown away more words than there are.

    Args:
        counts: Jobs of each stream, int [stream].
        words: All streams' raw words, one after the other, uint64.
        begins: Where each stream's begin, int [stream + 1].
        times_s: When the jobs come, [job]; of a stream whose window is open the words say it.
        window_s: Begin and end of a stream's arrivals, [stream, 2]; NaN where its times are given.
        spans: How many payloads and repetitions there are to choose from, int [stream, 2].
        rank: Places of names among all names, int [stream, number].
        after_streams: Streams that a stream's jobs come after, int [stream, n], −1 for none.
        release_s, stream, chosen, after: Take the jobs: [job], int [job], int [job, 2], int [job, n].
    """
    jobs, streams = len(times_s), len(counts)
    source, number = np.empty(jobs, np.int64), np.empty(jobs, np.int64)
    picked, first = np.empty((jobs, 2), np.int64), np.zeros(streams + 1, np.int64)
    low = np.uint64(0xFFFFFFFF)
    for i in range(streams):
        count, at = counts[i], begins[i]
        first[i + 1] = first[i] + count
        if not np.isnan(window_s[i, 0]):
            length_s = window_s[i, 1] - window_s[i, 0]
            for n in range(count):
                share = np.float64(words[at + n] >> np.uint64(11)) * (1.0 / 9007199254740992.0)
                times_s[first[i] + n] = window_s[i, 0] + length_s * share
            times_s[first[i] : first[i] + count].sort()
            at += count
        upper = False
        for n in range(count):
            source[first[i] + n], number[first[i] + n] = i, n
            for c in range(2):
                span = np.uint64(spans[i, c])
                picked[first[i] + n, c] = 0
                if spans[i, c] == 1:
                    continue
                while True:
                    if at == begins[i + 1]:
                        return False
                    part = (words[at] >> np.uint64(32)) if upper else (words[at] & low)
                    at, upper = (at + 1, False) if upper else (at, True)
                    product = part * span
                    if (product & low) >= span or (product & low) >= (low + np.uint64(1) - span) % span:
                        picked[first[i] + n, c] = np.int64(product >> np.uint64(32))
                        break
    order = np.argsort(times_s, kind="mergesort")
    for n in range(1, jobs):  # those that come together by their names
        job, place = order[n], n
        mine = rank[source[job], number[job]]
        while place > 0:
            other = order[place - 1]
            if times_s[other] < times_s[job] or rank[source[other], number[other]] < mine:
                break
            order[place] = other
            place -= 1
        order[place] = job
    where = np.empty(jobs, np.int64)
    for n in range(jobs):
        where[order[n]] = n
    for n in range(jobs):
        job = order[n]
        i, k = source[job], number[job]
        release_s[n], stream[n] = times_s[job], i
        chosen[n, 0], chosen[n, 1] = picked[job, 0], picked[job, 1]
        for w in range(after.shape[1]):
            after[n, w] = -1
            before = after_streams[i, w]
            if before >= 0 and k < counts[before]:
                after[n, w] = where[first[before] + k]
    return True


@dataclass(frozen=True, eq=False)
class QuickJobs:
    """The jobs of one shift, arrays [job] in order of release; see `scenarios.jobs.DrawnJobs`."""

    stream: Array
    payload: Array
    more: Array
    """Repetitions beyond the fewest of the stream."""
    release_s: Array
    after: Array


class QuickSource:
    """Draws the jobs of a scenario's shifts; `JobSource` says what they are."""

    def __init__(self, scenario: Scenario) -> None:
        self._source, streams = JobSource(scenario), scenario.jobs
        self._horizon_s = scenario.ticks * scenario.decision_interval_s
        self._arrivals = [stream.arrivals.arrivals() for stream in streams]
        names = [stream.name for stream in streams]
        waits = max((len(stream.after) for stream in streams), default=0) or 1
        self._after = np.full((len(streams), waits), -1)
        for i, stream in enumerate(streams):
            self._after[i, : len(stream.after)] = [names.index(other) for other in stream.after]
        lowest, most = (np.array([stream.repetitions[i] for stream in streams], dtype=int) for i in (0, 1))
        self.lowest = lowest
        """Fewest repetitions of each stream, int [stream]."""
        self.spans = np.stack([[len(stream.payload_kg) for stream in streams], most - lowest + 1], axis=-1)
        """How many payloads and repetitions each stream chooses from, int [stream, 2]."""
        self._keys = np.array([[0, i] for i in range(len(streams))], dtype=int).reshape(-1, 2)
        """A shift's first child is its jobs', and the children of that are the streams'."""
        self._generator = np.random.Generator(np.random.PCG64(0))
        self._alike = True
        """Whether this NumPy draws as the one this was written for."""
        self._alike = all(self._agrees(np.random.SeedSequence(seed)) for seed in range(2))

    def _agrees(self, seed: np.random.SeedSequence) -> bool:
        one, other = self.draw(seed), self._slow(seed, 1.0)
        return all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())

    def _slow(self, seed: np.random.SeedSequence, often: float) -> QuickJobs:
        """With NumPy's own generators."""
        slow = self._source.draw(child(seed, 0), often)
        return QuickJobs(
            slow.stream, slow.payload, slow.repetitions - self.lowest[slow.stream], slow.release_s, slow.after
        )

    def draw(self, seed: np.random.SeedSequence, often: float = 1.0) -> QuickJobs:
        """The jobs of the shift of a seed: those that `JobSource` draws from its first child."""
        if not self._alike:
            return self._slow(seed, often)
        states = children_of(seed, self._keys)
        generator, bits = self._generator, self._generator.bit_generator
        arriving = self._arrivals if often == 1.0 else [oftener(each, often) for each in self._arrivals]
        counts, given, raw = np.empty(len(arriving), dtype=int), [], []
        window_s = np.full((len(arriving), 2), np.nan)
        for i, (arrivals, words) in enumerate(zip(arriving, states, strict=True)):
            bits.state = pcg64(*words)
            if isinstance(arrivals, Poisson):
                begin_s = arrivals.start_s
                stop_s = max(min(arrivals.stop_s, self._horizon_s), begin_s)
                count = generator.poisson((stop_s - begin_s) / arrivals.every_s)
                window_s[i] = begin_s, stop_s
                given.append(np.empty(count))
                raw.append(bits.random_raw(2 * count + _SPARE))
            else:
                given.append(release_times(arrivals, self._horizon_s, generator))
                count = len(given[-1])
                raw.append(bits.random_raw(count + _SPARE))
            counts[i] = count
        times_s = np.concatenate([np.empty(0), *given])
        begins = np.cumsum([0, *map(len, raw)])
        jobs = len(times_s)
        release_s, stream = np.empty(jobs), np.empty(jobs, dtype=int)
        chosen, after = np.empty((jobs, 2), dtype=int), np.empty((jobs, self._after.shape[1]), dtype=int)
        words = np.concatenate([np.empty(0, np.uint64), *raw])
        rank = self._source.ranks(int(counts.max(initial=0)))
        done = lay_out(
            counts, words, begins, times_s, window_s, self.spans, rank, self._after, release_s, stream, chosen, after
        )
        return QuickJobs(stream, chosen[:, 0], chosen[:, 1], release_s, after) if done else self._slow(seed, often)


def children_of(seed: np.random.SeedSequence, keys: Array) -> list[list[int]]:
    """The states of descendants of a seed, four words of 64 bits each.

    Args:
        keys: What each descendant's spawn key adds to the seed's, int [child, n].
    """
    out = np.empty((len(keys), 4), np.uint64)
    descend(seed.pool, max(4, _words(seed.entropy)) + sum(map(_words, seed.spawn_key)), keys, out)
    return out.tolist()


def _words(entropy: Any) -> int:
    """So many words of 32 bits NumPy makes of some entropy."""
    if isinstance(entropy, int | np.integer):
        return max(1, -(-int(entropy).bit_length() // 32))
    return sum(map(_words, entropy))


def pcg64(first: int, second: int, third: int, fourth: int) -> dict[str, object]:
    """The state of a PCG64 that is seeded with these words."""
    increment = ((third << 64 | fourth) << 1 | 1) & _128
    state = (((first << 64 | second) + increment) * _MULTIPLIER + increment) & _128
    return {"bit_generator": "PCG64", "state": {"state": state, "inc": increment}, "has_uint32": 0, "uinteger": 0}
