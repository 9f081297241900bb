"""What commands and calls are asked to do, as plain values whose fields are options.

Nothing here is slow to import, so that the help of a command is fast.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from agents.registry import NAMES_HELP, WRAPPERS_HELP, names_of
from fleet.bus.exchange.channel import PERFECT, Channel, check_channel
from fleet.fields import MAX_SEED, MAX_SPEED, MIN_SPEED, check, option

DifficultyName = Literal["twin", "blind", "oracle"]
RiskName = Literal["rc", "rc-nominal"]
"""Model of P(saturation): from the peak predicted by the identified or by the nominal thermal network of the arm."""
RISK: RiskName = "rc"
PlantName = Literal["profile", "mujoco"]
BusName = Literal["zenoh", "memory"]
DIFFICULTY_HELP = "Source of the predictions: twin, oracle (simulator) or blind (none)."
RISK_HELP = (
    "With --difficulty twin, model of P(saturation): rc (peak predicted by the arm's own thermal network) or "
    "rc-nominal (peak predicted by that of a nominal arm)."
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
        shown="0; for a suite instance, its own seed",
    )
    plant: PlantName = option(
        "profile (arms follow their plans exactly) or mujoco (all arms in closed loop in MuJoCo).",
        "profile",
    )
    bus: BusName = option("Transport between the arms: zenoh (in-process router) or memory.", "zenoh")
    difficulty: DifficultyName = option(DIFFICULTY_HELP, "twin")
    risk: RiskName = option(RISK_HELP, RISK)
    channel: Channel = PERFECT
    """Topology, delay and loss of the arms' messages."""

    def __post_init__(self) -> None:
        check(self)
        check_channel(self.channel)


DECISION_LIMIT_S = 60.0
"""Longest time of a decision by default."""


@dataclass(frozen=True, kw_only=True)
class StudySpec:
    """How a study is run, without its policies and instances."""

    fleets: int = option("Number of fleets: draws of the arms' deviations (spread.seed).", 1, low=1, high=100)
    trainings: int = option("Number of trainings of each fleet's twins.", 1, low=1, high=20)
    """Of sources that are trained; the others have one."""
    risk: RiskName = option(RISK_HELP, RISK)
    decision_limit_s: float | None = option(
        "Longest time for one decision of a policy, s. A slower policy fails.",
        DECISION_LIMIT_S,
        low=0.001,
        high=86_400,
        flag="--decision-limit",
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, kw_only=True)
class Budget:
    """When the search for a bound ends, at the first of both, and the proof of the upper bound.

    Without a limit of seconds the result depends on nothing but the instance, the code and its libraries.
    """

    seconds: float = option(
        "CPU seconds of the search for each shift.", 30.0, low=0, high=86_400, above=True, flag="--budget"
    )
    """After the first simulation, which may compile the simulator; inf for no limit."""
    evaluations: int = option(
        "End the search after this number of simulated shifts; the file then does not depend on other load.",
        1_000_000,
        low=1,
        high=10**9,
        shown="",
    )
    nodes: int = option(
        "Maximum nodes of the upper bound's branch and bound; 0: only the linear program.", 2000, low=0, high=10**6
    )
    """Those that have proved something by then."""


PORT, PAGE_PORT = 7447, 8080
"""TCP ports of the router and of the gateway, unless they are taken."""
ENDPOINT = f"tcp/127.0.0.1:{PORT}"
"""Of the router, by default."""
LiveModel = Literal["twin", "blind"]
JobSource = Literal["scenario", "none"]


@dataclass(frozen=True, kw_only=True)
class LiveSpec:
    """How a live fleet works; each of its processes gets what concerns it."""

    policy: str = option(
        f"Allocation policy. Run by the auctioneer: {names_of('central')}. Run by each arm, without an auctioneer: "
        f"{names_of('arm')}, or a folder of `thermofleet train`. Your own as FILE.py:CLASS, run according to its "
        f"scope, or bus:NAME in another process. {WRAPPERS_HELP}.",
        "matching",
    )
    speed: float = option("Fleet seconds per real second.", 1.0, low=MIN_SPEED, high=MAX_SPEED)
    difficulty: LiveModel = option("Source of the predictions: twin or blind (none).", "twin")
    risk: RiskName = option(RISK_HELP, RISK)
    jobs: JobSource = option(
        "scenario: the scenario's job stream; none: submitted jobs only.",
        "scenario",
        noun="source of jobs",
    )
    seed: int = option("Random seed of the scenario's jobs, the sensor noise and the policy.", 0, low=0, high=MAX_SEED)
    fleet: str = option("Name of the fleet. Default: the scenario's name.", "", is_name=True)
    journal: Path | None = option("Folder of the journals; an existing journal is continued.", None)
    new_epoch: bool = option(
        "Start a new epoch with empty journals, even if other participants have state of an older epoch.", False
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, kw_only=True)
class Shot:
    """Part of a shift to show, and how."""

    speed: float = option("Shift seconds per second of the viewer or film.", 120.0, low=0.1, high=3600)
    fps: int = option("Pictures per second.", 30, low=1, high=60)
    width: int = 1280
    height: int = 720
    begin_s: float = option("First second of the shift.", 0.0, low=0, high=1e9, flag="--begin")
    end_s: float = option("Last second of the shift; by default its end.", 1e9, low=0, high=1e9, flag="--end", shown="")
    meshes: bool = option("Kinova's shells; needs the extra `meshes`.", False)

    def __post_init__(self) -> None:
        check(self)
