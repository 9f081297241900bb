"""What is said on the bus: JSON words with a versioned schema, checked on both ends.

A word is checked when it is made, by its sender and by its reader alike: NaN and infinity are refused (a JSON writer
would turn them into `null` in silence), a score that is not known is `null`. Unknown fields are ignored, so a later
version may add some; a change that a reader of today could misread takes a new version in the schema name.
"""

from math import isfinite
from typing import Annotated, TypeVar

import msgspec

from fleet.errors import BusError
from fleet.telemetry import Mode

VERSION = 1
Name = Annotated[str, msgspec.Meta(min_length=1)]
Tick = Annotated[int, msgspec.Meta(ge=0)]


class MalformedMessage(BusError, ValueError):
    """A word that is not what its key and schema promise; says what is wrong with it."""


class State(msgspec.Struct, frozen=True):
    """How an arm is: telemetry, the newest one counts."""

    arm: Name
    tick: Tick
    """Counts the words of one exchange; state and difficulty of one tick belong together."""
    time_s: float
    mode: Mode
    temp_c: tuple[float, ...]
    """Measured motor temperatures, [joint]."""
    headroom_k: float
    """Warning limit minus hottest motor."""

    def __post_init__(self) -> None:
        _finite("State", "time_s", (self.time_s,))
        _finite("State", "temp_c", self.temp_c)
        _finite("State", "headroom_k", (self.headroom_k,))


class DifficultyWord(msgspec.Struct, frozen=True):
    """How hard an arm finds the jobs on offer."""

    arm: Name
    tick: Tick
    time_s: float
    twin: str
    """Version of the twin that scored."""
    jobs: tuple[Name, ...]
    """Names of the jobs on offer, each once; the columns of what follows."""
    difficulty: tuple[float | None, ...]
    """d, [job]; None where the arm has no score or cannot do the job."""
    p_saturation: tuple[float | None, ...]
    """Probability that a motor passes the warning limit, [job]; None where not known."""

    def __post_init__(self) -> None:
        _finite("DifficultyWord", "time_s", (self.time_s,))
        for name, values in (("difficulty", self.difficulty), ("p_saturation", self.p_saturation)):
            if len(values) != len(self.jobs):
                raise ValueError(
                    f"DifficultyWord.{name} needs one value per job ({len(self.jobs)}, got {len(values)})."
                )
            _finite("DifficultyWord", name, values)
        if len(set(self.jobs)) != len(self.jobs):
            raise ValueError(f"DifficultyWord.jobs names a job twice (got {self.jobs}).")


class Info(msgspec.Struct, frozen=True):
    """What an arm is: said once, and again when it changes."""

    arm: Name
    joints: Annotated[int, msgspec.Meta(ge=1)]
    twin: str
    """Version of its twin."""


Message = State | DifficultyWord | Info
Kind = TypeVar("Kind", bound=Message)

_ENCODER = msgspec.json.Encoder()


def schema(kind: type[Message]) -> str:
    """Name and version of a message's schema, for example `thermofleet.State.v1`."""
    return f"thermofleet.{kind.__name__}.v{VERSION}"


def encoding(kind: type[Message]) -> str:
    """The encoding that travels with every message, for example `application/json;thermofleet.State.v1`."""
    return f"application/json;{schema(kind)}"


def encode(message: Message) -> bytes:
    """The message as JSON; floats come back exactly."""
    return _ENCODER.encode(message)


def decode(kind: type[Kind], payload: bytes, *, arm: str) -> Kind:
    """The message that `arm` is said to have sent.

    Args:
        arm: Name in the key it came under; a word that speaks for another arm is refused.

    Raises:
        MalformedMessage: not JSON, not of this kind, not finite, or not by this arm.
    """
    try:
        message = msgspec.json.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MalformedMessage(f"Not a {schema(kind)} by '{arm}': {error}") from error
    if message.arm != arm:
        raise MalformedMessage(f"A {schema(kind)} under the key of '{arm}' claims to be by '{message.arm}'.")
    return message


def _finite(kind: str, name: str, values: tuple[float | None, ...]) -> None:
    for value in values:
        if value is not None and not isfinite(value):
            raise ValueError(f"{kind}.{name} must be finite (got {value}).")
