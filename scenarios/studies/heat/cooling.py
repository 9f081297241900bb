"""Ways of cooling: the motor of Zhu et al., a joint of a Gen3, and what a fleet finishes with each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fleet.heat.cooled_motor import ZHU_MOTOR, published
from fleet.robot import Cooling
from fleet.thermal import gen3_network, housing, in_series, winding
from scenarios.evaluate.comparison import figures_of_shifts
from scenarios.evaluate.rollout import Outcome, outcomes
from scenarios.evaluate.tables import Figure
from scenarios.motion.hold import hold
from scenarios.prepare.fleet import RISK, DifficultyName, RiskName, prepare
from scenarios.progress import Count, Progress, quiet
from scenarios.schema import Scenario

STRATEGIES: tuple[Cooling, ...] = ("still_air", "heat_sink", "heat_spreader", "forced_air", "liquid", "immersion")
"""Ways of cooling on Earth, the first of which the others are compared with; two passive, three active."""
PASSIVE = ("heat_sink", "heat_spreader")
POLICIES = ("round_robin", "thermometer")
"""One that ignores heat and one that reads only the motor temperatures: neither needs a twin of the cooled arm."""
JOINT, PAYLOAD_KG, AMBIENT_C = 1, 3.0, 25.0
"""The hold that is compared: joint 2 of an outstretched arm."""


MOTOR_FIGURES = {
    "no_interface_s": "without thermal interface material (TIM), s",
    "forced_air_s": "with TIM and forced air, s",
    "forced_water_s": "with TIM and forced water, s",
    "immersed_c": "immersed: never; settles at, °C",
    "immersed_ratio": "conductance of immersion / forced water",
}
"""What the rows of the motor are: time from 26 to 125 °C, unless said otherwise."""


@dataclass(frozen=True, kw_only=True)
class MotorRow:
    """One published figure of the motor of Zhu et al."""

    figure: str
    published: float
    modelled: float

    @property
    def deviation(self) -> float:
        """Relative deviation of the model."""
        return self.modelled / self.published - 1.0


@dataclass(frozen=True, kw_only=True)
class JointRow:
    """Joint 2 of a Gen3 with one way of cooling, nominal."""

    cooling: Cooling
    passive: bool
    shell_w_per_k: float
    """From housing to ambient."""
    shell_j_per_k: float
    neighbour_w_per_k: float
    whole_w_per_k: float
    """From winding to ambient, without neighbours."""
    warning_min: float | None
    """Cold start, 3 kg, outstretched, 25 °C: time until 60 °C; None: never."""
    error_min: float | None
    """Until 75 °C."""
    steady_c: float | None
    """None: thermal runaway."""


@dataclass(frozen=True, kw_only=True)
class FleetRow:
    """A fleet with one way of cooling under one policy."""

    cooling: Cooling
    policy: str
    figures: dict[str, Figure]
    """By name; differences are paired by seed, to still air under the same policy."""


def motor_rows() -> list[MotorRow]:
    """The published figures beside those of the fitted motor."""
    modelled = ZHU_MOTOR.figures()
    return [MotorRow(figure=name, published=value, modelled=modelled[name]) for name, value in published().items()]


def joint_rows() -> list[JointRow]:
    """Every way of cooling on joint 2 of a nominal Gen3."""
    return [_joint_row(name) for name in STRATEGIES]


def _joint_row(cooling: Cooling) -> JointRow:
    network, (coil, shell) = gen3_network(cooling=cooling), (winding(JOINT), housing(JOINT))

    def conductance(one: str, other: str) -> float:
        return float(network.edges[one, other]["conductance_w_per_k"]) if network.has_edge(one, other) else 0.0

    outer = conductance(shell, "ambient")
    course = hold(PAYLOAD_KG, "outstretched", AMBIENT_C, cooling=cooling).cold
    return JointRow(
        cooling=cooling,
        passive=cooling in PASSIVE,
        shell_w_per_k=outer,
        shell_j_per_k=float(network.nodes[shell]["capacity_j_per_k"]),
        neighbour_w_per_k=conductance(shell, housing(JOINT + 1)),
        whole_w_per_k=in_series(conductance(coil, shell), outer) + conductance(coil, "ambient"),
        warning_min=course.t60_min[JOINT],
        error_min=course.t75_min[JOINT],
        steady_c=course.steady_c[JOINT],
    )


def fleet_rows(
    scenario: Scenario,
    *,
    seeds: Sequence[int],
    policies: Sequence[str] = POLICIES,
    strategies: Sequence[Cooling] = STRATEGIES,
    difficulty: DifficultyName = "blind",
    risk: RiskName = RISK,
    cache_dir: Path | None = None,
    progress: Progress = quiet,
) -> list[FleetRow]:
    """Shifts of a fleet whose arms all have the same cooling, on the same seeds and with the same arms.

    Args:
        strategies: Differences refer to the first one.
    """
    shifts: dict[str, dict[str, list[Outcome]]] = {policy: {} for policy in policies}
    for n, cooling in enumerate(strategies):
        arms = tuple(replace(arm, cooling=cooling) for arm in scenario.arms)
        fleet = prepare(replace(scenario, arms=arms), difficulty=difficulty, risk=risk, cache=cache_dir)
        for policy in policies:
            shifts[policy][cooling] = outcomes(fleet, policy, seeds)
        progress("comparing", Count(n + 1, len(strategies)))
    figures = {policy: figures_of_shifts(each, strategies[0]) for policy, each in shifts.items()}
    return [
        FleetRow(cooling=cooling, policy=policy, figures=figures[policy][cooling])
        for cooling in strategies
        for policy in policies
    ]
