"""One shift in plain NumPy: any plant, any exchange, with an event log and a watcher if wanted."""

from collections.abc import Callable

import numpy as np

from fleet.bus.exchange import Exchange
from fleet.env.episode import Episode
from fleet.env.observation import Layout, observe, say
from fleet.env.reward import RewardWeights, terms
from fleet.events import Event
from fleet.sim import claims
from fleet.sim.kernel import Step, step
from fleet.sim.noise import key_of, standard_normal
from fleet.sim.state import DONE, State, initial
from fleet.thermal import WINDING

Array = np.ndarray


class PlainShift:
    """Steps an episode with `fleet.sim.kernel`."""

    def __init__(
        self,
        episode: Episode,
        exchange: Exchange,
        weights: RewardWeights,
        log: list[Event] | None,
        watch: Callable[[Step], None] | None,
        layout: Layout | None = None,
    ) -> None:
        """Begin it: every arm perceives, and tells what it knows."""
        self._episode, self._exchange, self._weights = episode, exchange, weights
        self._log, self._watch = log, watch
        self._layout = layout or Layout(len(episode.world.arms), episode.world.slots)
        self._noise_key = key_of(episode.sensors)
        exchange.begin(np.random.default_rng(episode.chance))
        self._spoken_before = exchange.delivered
        self._state = initial(episode.world)
        self._perceive()

    @property
    def state(self) -> State:
        """The simulator's, [1, ...]."""
        return self._state

    @property
    def vectors(self) -> Array:
        """What each arm knows, float32 [arm, size]."""
        return self._vectors[0]

    @property
    def mask(self) -> Array:
        """Legal actions, int8 [arm, slot + 1]."""
        return self._board.mask[0].astype(np.int8)

    @property
    def messages(self) -> int:
        """Words that reached a peer."""
        return self._exchange.delivered - self._spoken_before

    @property
    def counts(self) -> tuple[Array, Array, Array, Array, int]:
        """Faults, illegal actions, peaks, seconds above the warning limit, each [arm], and jobs done."""
        state = self._state
        done = int((state.status[0] == DONE).sum())
        return state.faults[0], state.illegal[0], state.peak_c[0], state.above_warning_s[0], done

    @property
    def tick(self) -> int:
        """Decision intervals that are over."""
        return int(self._state.tick[0])

    def step(self, actions: Array) -> tuple[Array, bool]:
        """One decision interval: weighted reward terms [term], and whether all jobs are done.

        Args:
            actions: int64 [arm].
        """
        world, before = self._episode.world, self._state
        arm = np.arange(len(world.arms))
        scores = self._heard.difficulty[arm, arm][None]  # each arm's own word, as it told it
        done = step(world, before, actions[None], scores, self._episode.plant, self._log, self._board)
        if self._watch is not None:
            self._watch(done)
        self._state = done.state
        self._perceive()
        parts = terms(world, before, done.state, self._weights)
        jobs = world.jobs.exists[0]
        # A shift without any job is stood through to its end.
        finished = bool(jobs.any() and (done.state.status[0][jobs] == DONE).all())
        return np.concatenate(list(parts.values())), finished

    def _perceive(self) -> None:
        """Read the sensors, tell the peers, hear them, and lay it all out."""
        world, state = self._episode.world, self._state
        self._board = claims.board(world, state)
        on_offer, mask = self._board.on_offer, self._board.mask
        true_c = state.temp_c[..., WINDING]
        noise = standard_normal(self._noise_key, int(state.tick[0]), true_c.shape)
        measured = true_c + world.motors.sensor_noise_k * noise
        words = say(world, state, on_offer, measured, self._episode.twins)
        self._heard = self._exchange.share(words)
        known = observe(world, state, on_offer, mask, measured, self._heard, self._layout.who)
        self._vectors = self._layout.pack(known)
