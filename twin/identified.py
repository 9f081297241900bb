"""An arm's thermal network as its logs told it: numbers, intervals, and what stayed unexplained."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from fleet.motor import gen3_motors
from fleet.thermal import gen3_network
from twin.heat_log import Source
from twin.thermal_values import Body

AMBIENT_C = 22.0
"""Air assumed where nobody measured it; that of the public Gen3 logs."""
INFORMED = 0.9
"""The logs tell a parameter if they narrow its prior to less than this."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One identified number."""

    name: str
    """As in `fleet/data/gen3_thermal.json`."""
    joint: int | None
    """1..7; None for the one conductance between neighbours."""
    value: float
    low: float
    """The true value lies between `low` and `high` with 95 % probability, given model, prior and logs."""
    high: float
    prior: float
    prior_sd: float
    """Of the logarithm, before the logs."""
    sd: float
    """Of the logarithm, after the logs."""

    @property
    def informed(self) -> bool:
        """Whether the logs told anything about it; if not it is the prior again."""
        return self.sd < INFORMED * self.prior_sd


@dataclass(frozen=True, kw_only=True, eq=False)
class Identified:
    """One arm's thermal network as its logs tell it."""

    arm: str
    body: Body
    """Motors and network with the identified values."""
    parameters: tuple[Parameter, ...]
    ambient_c: float
    """Air that was assumed."""
    ambient_sd_k: float
    source: Source
    """Where the current came from."""
    rms_k: dict[str, tuple[float, ...]]
    """What stays unexplained in each recording, per joint."""
    memory_s: tuple[float, ...]
    """How long a deviation lasts, per joint; the intervals count so much of a log as one observation."""
    seconds: float
    """Of recordings used."""
    data_hash: str

    @cached_property
    def version(self) -> str:
        """Short name by content: every number that a prediction depends on, and the data it came from."""
        came_from = [self.arm, self.data_hash, self.ambient_c, self.source, self.parameters]
        digest = hashlib.sha256(msgspec.json.encode(came_from))
        for value in vars(self.body.motors).values():
            digest.update(np.asarray(value, dtype=float).tobytes())
        for part in sorted(
            (*sorted(edge), value) for *edge, value in self.body.network.edges(data="conductance_w_per_k")
        ):
            digest.update(msgspec.json.encode(part))
        digest.update(msgspec.json.encode(sorted(self.body.network.nodes(data="capacity_j_per_k"))))
        return f"rc-{digest.hexdigest()[:13]}"

    def parameter(self, name: str, joint: int | None = None) -> Parameter:
        """One of the identified numbers, joint 1..7.

        Raises:
            KeyError: it was not free.
        """
        for parameter in self.parameters:
            if (parameter.name, parameter.joint) == (name, joint):
                return parameter
        raise KeyError(f"{name} of joint {joint} was not free. Free: {sorted({p.name for p in self.parameters})}.")


def nominal_body() -> Body:
    """A Gen3 by the project's defaults, in still air."""
    return Body(gen3_motors(), gen3_network())
