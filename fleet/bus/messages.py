"""What is said on the bus: JSON words with a versioned schema, checked on both ends.

A word is checked when it is made, by its sender and by its reader alike: NaN and infinity are refused (a JSON writer
would turn them into `null` in silence), a score that is not known is `null`. Unknown fields are ignored, so a later
version may add some; a change that a reader of today could misread takes a new version in the schema name.
"""

from functools import cache
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


class State(msgspec.Struct, frozen=True, omit_defaults=True):
    """How an arm is: telemetry, the newest one counts. What is measured besides is left out where nobody measures."""

    arm: Name
    tick: Tick
    """Counts the words of one exchange; state and difficulty of one tick belong together."""
    time_s: float
    mode: Mode
    temp_c: tuple[float, ...]
    """Measured motor temperatures, [joint]."""
    headroom_k: float
    """Warning limit minus hottest motor."""
    job: str = ""
    """The job in hand; "" for none."""
    q: tuple[float, ...] = ()
    """rad, [joint]."""
    qd: tuple[float, ...] = ()
    """rad/s, [joint]."""
    tau: tuple[float, ...] = ()
    """N·m at the joint output, [joint]."""
    current_a: tuple[float, ...] = ()
    """[joint]."""

    def __post_init__(self) -> None:
        for name in ("time_s", "headroom_k"):
            finite("State", name, (getattr(self, name),))
        for name in ("temp_c", "q", "qd", "tau", "current_a"):
            values = getattr(self, name)
            finite("State", name, values)
            if values and len(values) != len(self.temp_c):
                raise ValueError(f"State.{name} needs one value per joint ({len(self.temp_c)}, got {len(values)}).")


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
        finite("DifficultyWord", "time_s", (self.time_s,))
        for name, values in (("difficulty", self.difficulty), ("p_saturation", self.p_saturation)):
            if len(values) != len(self.jobs):
                raise ValueError(
                    f"DifficultyWord.{name} needs one value per job ({len(self.jobs)}, got {len(values)})."
                )
            finite("DifficultyWord", name, values)
        if len(set(self.jobs)) != len(self.jobs):
            raise ValueError(f"DifficultyWord.jobs names a job twice (got {self.jobs}).")


class Info(msgspec.Struct, frozen=True):
    """What an arm is: said once, and again when it changes."""

    arm: Name
    joints: Annotated[int, msgspec.Meta(ge=1)]
    twin: str
    """Version of its twin."""


class Refusal(msgspec.Struct, frozen=True):
    """Instead of any other answer, under the key of who refuses: why there is none.

    An answer like others. An error of Zenoh's travels under the key of the question: asked under a wildcard, that is
    nobody's own key, and a router that keeps rules drops it.
    """

    reason: str
    """A sentence."""


Kind = TypeVar("Kind", bound=msgspec.Struct)

_ENCODER = msgspec.json.Encoder()


def schema(kind: type[msgspec.Struct]) -> str:
    """Name and version of a message's schema, for example `thermofleet.State.v1`."""
    return f"thermofleet.{kind.__name__}.v{VERSION}"


@cache
def encoding(kind: type[msgspec.Struct]) -> str:
    """The encoding that travels with every message, for example `application/json;thermofleet.State.v1`."""
    return f"application/json;{schema(kind)}"


def encode(message: msgspec.Struct) -> bytes:
    """The message as JSON; floats come back exactly."""
    return _ENCODER.encode(message)


def read(kind: type[Kind], payload: bytes) -> Kind:
    """The message of this kind that the payload is.

    Raises:
        MalformedMessage: not JSON, not of this kind, or not finite.
    """
    try:
        return msgspec.json.decode(payload, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MalformedMessage(f"Not a {schema(kind)}: {error}") from error


def read_as(kind: type[Kind], said_encoding: str, payload: bytes) -> Kind:
    """The message of this kind, which its encoding says that the payload is.

    Raises:
        MalformedMessage: encoded otherwise, or not of this kind.
    """
    if said_encoding != encoding(kind):
        raise MalformedMessage(f"It is encoded as '{said_encoding}', not as '{encoding(kind)}'.")
    return read(kind, payload)


def decode(kind: type[Kind], payload: bytes, *, arm: str) -> Kind:
    """The message that `arm` is said to have sent.

    Args:
        arm: Name in the key it came under; a word that speaks for another arm is refused.

    Raises:
        MalformedMessage: not JSON, not of this kind, not finite, or not by this arm.
    """
    try:
        message = read(kind, payload)
    except MalformedMessage as error:
        raise MalformedMessage(f"By '{arm}': {error}") from error
    return spoken_by(message, arm, "arm")


def spoken_by(message: Kind, name: str, role: str) -> Kind:
    """The message, if the arm or auctioneer that it names in its field `role` is the one whose key it came under.

    Raises:
        MalformedMessage: it speaks for another.
    """
    claimed = getattr(message, role)
    if claimed != name:
        raise MalformedMessage(f"A {schema(type(message))} under the key of '{name}' claims to be by '{claimed}'.")
    return message


def finite(kind: str, name: str, values: tuple[float | None, ...]) -> None:
    """Refuse NaN and infinity in a field.

    Raises:
        ValueError: names the field.
    """
    for value in values:
        if value is not None and not isfinite(value):
            raise ValueError(f"{kind}.{name} must be finite (got {value}).")
