"""What commands and calls are asked to do, as plain values whose fields are options.

Nothing here is slow to import, so that the help of a command is fast.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from agents.registry import NAMES_HELP
from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.fields import MAX_SEED, check, option

DifficultyName = Literal["twin", "blind", "oracle"]
RiskName = Literal["rc", "rc-nominal", "excess", "load", "errors", "torque"]
"""Model of P(saturation): from the peak predicted by the identified or by the nominal thermal network of the arm, or
a regression on features of the learned twin (`twin.saturation.model.evidence_of`)."""
RISK: RiskName = "rc"
PlantName = Literal["profile", "mujoco"]
BusName = Literal["zenoh", "memory"]
DIFFICULTY_HELP = "Source of the difficulty scores: twin, oracle (simulator) or blind (none)."
RISK_HELP = (
    "With --difficulty twin, model of P(saturation): rc (peak predicted by the arm's own thermal network), rc-nominal "
    "(peak predicted by that of a nominal arm), excess, load, errors (regression on errors of the learned twin), or "
    "torque (regression on mean squared torque)."
)


@dataclass(frozen=True, kw_only=True)
class RunSpec:
    """What to run, without the fleet."""

    policy: str = option(NAMES_HELP, "least_difficulty")
    seed: int = option(
        "Random seed of jobs, sensor noise and policy.",
        0,
        low=0,
        high=MAX_SEED,
        shown="0, or of an instance of the suite its own",
    )
    plant: PlantName = option(
        "profile (arms follow their plans exactly) or mujoco (all arms in closed loop in MuJoCo).",
        "profile",
        choices=get_args(PlantName),
    )
    bus: BusName = option(
        "Transport between the arms: zenoh (in-process router) or memory.", "zenoh", choices=get_args(BusName)
    )
    difficulty: DifficultyName = option(DIFFICULTY_HELP, "twin", choices=get_args(DifficultyName))
    risk: RiskName = option(RISK_HELP, RISK, choices=get_args(RiskName))
    channel: Channel = PERFECT
    """Topology, delay and loss of the arms' messages."""

    def __post_init__(self) -> None:
        check(self)
