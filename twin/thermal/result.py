"""The result of an identification: parameters, intervals and residuals."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from fleet.motor import gen3_motors
from fleet.robot import Cooling
from fleet.thermal import gen3_network
from twin.logs.heat_log import CurrentSource
from twin.thermal.parameters import HeatModel

AMBIENT_C = 22.0
"""Default ambient temperature; that of the public Gen3 logs."""
INFORMED = 0.9
"""A parameter is informed if its standard deviation is below this share of the prior's."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One identified number."""

    name: str
    """As in `fleet/data/gen3_thermal.json`."""
    joint: int | None
    """1..7; None for the one conductance between neighbours."""
    value: float
    low: float
    """Lower end of the 95 % interval, given model, prior and logs."""
    high: float
    prior: float
    prior_sd: float
    """Of the logarithm, before the logs."""
    sd: float
    """Of the logarithm, after the logs."""

    @property
    def informed(self) -> bool:
        """Whether the logs informed it; if not, it is the prior."""
        return self.sd < INFORMED * self.prior_sd


@dataclass(frozen=True, kw_only=True, eq=False)
class Identified:
    """One arm's thermal network, identified from its logs."""

    arm: str
    heat_model: HeatModel
    """Motors and network with the identified values."""
    parameters: tuple[Parameter, ...]
    ambient_c: float
    """Assumed ambient temperature."""
    ambient_sd_k: float
    source: CurrentSource
    """Source of the current."""
    rms_k: dict[str, tuple[float, ...]]
    """Root mean square residual of each recording, per joint."""
    memory_s: tuple[float, ...]
    """Correlation time of the residuals, per joint; intervals count this much of a log as one observation."""
    seconds: float
    """Length of the recordings used."""
    data_hash: str

    @cached_property
    def version(self) -> str:
        """Hash of every number that a prediction depends on, and of the data."""
        sources = [self.arm, self.data_hash, self.ambient_c, self.source, self.parameters]
        digest = hashlib.sha256(msgspec.json.encode(sources))
        for value in vars(self.heat_model.motors).values():
            digest.update(np.asarray(value, dtype=float).tobytes())
        edges = self.heat_model.network.edges(data="conductance_w_per_k")
        for part in sorted((*sorted(ends), value) for *ends, value in edges):
            digest.update(msgspec.json.encode(part))
        digest.update(msgspec.json.encode(sorted(self.heat_model.network.nodes(data="capacity_j_per_k"))))
        return f"rc-{digest.hexdigest()[:13]}"

    def parameter(self, name: str, joint: int | None = None) -> Parameter:
        """One of the identified numbers, joint 1..7.

        Raises:
            KeyError: it was not free.
        """
        if named := [p for p in self.parameters if (p.name, p.joint) == (name, joint)]:
            return named[0]
        raise KeyError(f"{name} of joint {joint} was not free. Free: {sorted({p.name for p in self.parameters})}.")


def nominal_heat_model(cooling: Cooling = "still_air") -> HeatModel:
    """A Gen3 by the project's defaults."""
    return HeatModel(gen3_motors(), gen3_network(cooling=cooling))
