"""The words of a tick as messages of every arm, and messages that arrive as words again."""

import logging
import math
from typing import Literal

from fleet.bus import keys
from fleet.bus.exchange import Array, Condition, Scores, Words
from fleet.bus.messages import DifficultyWord, MalformedMessage, State, decode, encoding
from fleet.telemetry import MODES

_LOG = logging.getLogger(__name__)

Topic = Literal["state", "difficulty", "alive"]
_ENCODINGS: dict[Topic, str] = {"state": encoding(State), "difficulty": encoding(DifficultyWord)}


def spoken(words: Words, arms: tuple[str, ...], tick: int) -> list[tuple[State, DifficultyWord]]:
    """What every arm says at one tick, [arm]; nothing is said of empty slots."""
    slots = [slot for slot, job in enumerate(words.jobs) if job]
    jobs = tuple(words.jobs[slot] for slot in slots)
    time_s = float(words.time_s)
    columns = zip(
        arms,
        words.mode.tolist(),
        words.temp_c.tolist(),
        words.headroom_k.tolist(),
        words.twin,
        _nullable(words.difficulty[:, slots]),
        _nullable(words.p_saturation[:, slots]),
        strict=True,
    )
    return [
        (
            State(arm, tick, time_s, MODES[mode], tuple(temp_c), headroom_k),
            DifficultyWord(arm, tick, time_s, twin, jobs, difficulty, p_saturation),
        )
        for arm, mode, temp_c, headroom_k, twin, difficulty, p_saturation in columns
    ]


def condition_of(state: State) -> Condition:
    """What an exchange keeps of a state."""
    return Condition(state.time_s, MODES.index(state.mode), state.headroom_k)


def scores_of(word: DifficultyWord) -> Scores:
    """What an exchange keeps of a difficulty word."""
    return Scores(word.time_s, word.jobs, _numbers(word.difficulty), _numbers(word.p_saturation))


class Reader:
    """Reads what arrives: counts and logs what is malformed, and reads equal bytes of one tick once."""

    def __init__(self, fleet: str, arms: tuple[str, ...]) -> None:
        topics: tuple[Topic, ...] = ("state", "difficulty", "alive")
        self.malformed = 0
        self.places: dict[str, tuple[Topic, int]] = {
            keys.of_arm(fleet, arm, topic): (topic, index) for topic in topics for index, arm in enumerate(arms)
        }
        """Topic and index of the arm for every key that is listened to."""
        self._arms = arms
        self._complained: set[str] = set()
        self._read: dict[tuple[Topic, int, bytes, str], tuple[int, Condition | Scores] | None] = {}

    def forget(self) -> None:
        """A new tick: nothing that was read before will come again."""
        self._read.clear()
        self._complained.clear()

    def read(
        self, topic: Topic, sender: int, payload: bytes, said_encoding: str
    ) -> tuple[int, Condition | Scores] | None:
        """Tick and content of a word that came under the key of arm `sender`; None when malformed."""
        said = (topic, sender, payload, said_encoding)
        if said not in self._read:
            try:
                self._read[said] = _content(topic, self._arms[sender], payload, said_encoding)
            except MalformedMessage as error:
                self._read[said] = None
                self._complain(f"{topic} {sender}", str(error))
        word = self._read[said]
        if word is None:
            self.malformed += 1
        return word

    def refuse(self, key: str, reason: str) -> None:
        """Count and log a word that was read, but cannot be."""
        self.malformed += 1
        self._complain(key, f"under '{key}': {reason}.")

    def strange(self, key: str) -> None:
        """Judge a key under which no arm of this exchange speaks: another arm of the fleet may, a wildcard may not."""
        try:
            keys.parse(key)
        except ValueError as error:
            self.malformed += 1
            self._complain(key, str(error))

    def _complain(self, place: str, reason: str) -> None:
        """Log the first complaint of a tick about a place: whoever floods the bus shall not flood the log."""
        if place not in self._complained:
            self._complained.add(place)
            _LOG.warning("Left out: %s", reason)


def _content(topic: Topic, arm: str, payload: bytes, said_encoding: str) -> tuple[int, Condition | Scores]:
    """Tick and content of a word by `arm`.

    Raises:
        MalformedMessage: not what the topic promises.
    """
    if said_encoding != _ENCODINGS[topic]:
        raise MalformedMessage(f"A {topic} by '{arm}' is encoded as '{said_encoding}', not as '{_ENCODINGS[topic]}'.")
    if topic == "state":
        state = decode(State, payload, arm=arm)
        return state.tick, condition_of(state)
    word = decode(DifficultyWord, payload, arm=arm)
    return word.tick, scores_of(word)


def _nullable(values: Array) -> list[tuple[float | None, ...]]:
    """Rows of an array [arm, job], with None for NaN."""
    return [tuple(None if math.isnan(value) else float(value) for value in row) for row in values.tolist()]


def _numbers(values: tuple[float | None, ...]) -> list[float]:
    return [math.nan if value is None else value for value in values]
