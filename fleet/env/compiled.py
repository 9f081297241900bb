"""One shift in the engine of the batch: for arms that follow their plans and hear each other at once."""

import numpy as np

from fleet.env.engine import Engine, shifts_of
from fleet.env.episode import Episode
from fleet.env.observation import Layout
from fleet.env.reward import RewardWeights
from fleet.sim.noise import key_of
from fleet.sim.state import State
from fleet.sim.tables import tables_of

Array = np.ndarray


class CompiledShift:
    """Steps an episode as row 0 of an `Engine`; the same doors as `fleet.env.plain.PlainShift`."""

    def __init__(self, episode: Episode, weights: RewardWeights, layout: Layout | None = None) -> None:
        """Begin it."""
        world = episode.world
        layout = layout or Layout(len(world.arms), world.slots)
        tables, drawn = tables_of(world)
        (shift,) = shifts_of(drawn, [key_of(episode.sensors)])
        self._engine = Engine(tables, 1, layout, weights, jobs=world.jobs.exists.shape[1])
        self._engine.begin(np.zeros(1, dtype=int), [shift])
        self._vectors = np.empty((1, layout.arms, layout.size), np.float32)
        self._engine.observe(np.zeros(1, dtype=int), self._vectors)

    @property
    def state(self) -> State:
        """The simulator's, [1, ...]."""
        return self._engine.state()

    @property
    def vectors(self) -> Array:
        """What each arm knows, float32 [arm, size]; the next step overwrites it."""
        return self._vectors[0]

    @property
    def mask(self) -> Array:
        """Legal actions, int8 [arm, slot + 1]; the next step overwrites it."""
        return self._engine.mask[0]

    @property
    def messages(self) -> int:
        """Words that reached a peer."""
        arms = self._engine.layout.arms
        return arms * (arms - 1) * (int(self._engine.rows.tick[0]) + 1)

    @property
    def counts(self) -> tuple[Array, Array, Array, Array, int]:
        """Faults, illegal actions, peaks, seconds above the warning limit, each [arm], and jobs done."""
        rows, engine = self._engine.rows, self._engine
        done = int(engine.drawn.jobs[0] - engine.open[0])
        return rows.faults[0], rows.illegal[0], rows.peak_c[0], rows.above_warning_s[0], done

    @property
    def tick(self) -> int:
        """Decision intervals that are over."""
        return int(self._engine.rows.tick[0])

    def step(self, actions: Array) -> tuple[Array, bool]:
        """One decision interval: weighted reward terms [term], and whether all jobs are done.

        Args:
            actions: int64 [arm].
        """
        terms, _, finished = self._engine.step(actions[None], self._vectors)
        return terms[0], bool(finished[0])
