"""Ways of cooling: the motor of Zhu et al., a joint of a Gen3, and what a fleet finishes with each (`cooling`).

The motor is a two-node network, winding and housing, fitted to the published figures:
C_w Tw' = P (1 + a_cu (Tw − T0)) − G_i (Tw − Th) − G_d (Tw − T0);  C_h Th' = G_i (Tw − Th) − G_o (Th − T0).
The numbers fix ratios only: every conductance and the heat are relative to the winding's capacity C_w. The current is
constant; coolant and start are at T0 = 26 °C. Numbers: tables 1 and 2 of E. Guiffo Kaigom, arXiv 2509.12740, after
Zhu et al.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.optimize import brentq, least_squares

from benchmarks.paper.harness import (
    Experiment,
    Unit,
    content_key,
    names,
    one_row,
    scenarios_of,
    seed_options,
    seeds_of,
    table_of,
)  # fmt: skip
from benchmarks.result_tables import difference
from fleet.heat.motor import thermal_data
from fleet.heat.thermal import ThermalModel, gen3_network, housing, in_series, modal_model, winding
from fleet.robot import COOLING, Cooling
from scenarios.evaluate.comparison import figures_of_shifts
from scenarios.evaluate.rollout import Outcome, outcomes
from scenarios.json_rows import Row
from scenarios.motion.hold import hold
from scenarios.prepare.fleet import prepare
from scenarios.spec.options import DifficultyName
from scenarios.spec.parse import choose
from scenarios.spec.schema import Scenario
from scenarios.table import Table

Array = np.ndarray

Arrangement = Literal["no_interface", "forced_air", "forced_water", "immersion"]
ARRANGEMENTS: tuple[Arrangement, ...] = get_args(Arrangement)
"""Without thermal interface material; with it and forced air (40 mm fan); forced water; deionised water all around."""
_MEDIUM: dict[Arrangement, Cooling] = {
    "no_interface": "still_air",
    "forced_air": "forced_air",
    "forced_water": "liquid",
    "immersion": "immersion",
}
COOLANT_C, LIMIT_C = 26.0, 125.0
LONGEST_S = 1e5
"""Time after which a motor below its limit counts as never reaching it."""


PUBLISHED = {
    "no_interface_s": 3.6,
    "forced_air_s": 10.69,
    "forced_water_s": 11.59,
    "immersed_c": 85.0,
    "immersed_ratio": 3.7,
}
"""Times from 26 °C to 125 °C, the temperature at which the immersed winding settles, and the conductance from winding
to water of immersion relative to forced water."""


@dataclass(frozen=True, kw_only=True)
class CooledMotor:
    """One motor; conductances and heat divided by the winding's heat capacity."""

    heating_k_per_s: float
    """Copper loss at 26 °C."""
    housing_capacity: float
    """Heat capacity of the housing relative to the winding."""
    bare_per_s: float
    """Winding to housing without interface material."""
    interface_per_s: float
    """Winding to housing with it."""
    water_per_s: float
    """Housing to forced water; forced and still air have the ratios of `fleet.robot.COOLING`."""
    direct_per_s: float
    """Winding to the water around it in immersion."""

    def outer_per_s(self, arrangement: Arrangement) -> float:
        """Conductance from housing to coolant."""
        medium = COOLING[_MEDIUM[arrangement]]
        return self.water_per_s * medium.ambient_factor / COOLING["liquid"].ambient_factor

    def conductance_per_s(self, arrangement: Arrangement) -> float:
        """Whole conductance from winding to coolant at rest."""
        inner = self.bare_per_s if arrangement == "no_interface" else self.interface_per_s
        through = in_series(inner, self.outer_per_s(arrangement))
        return through + (self.direct_per_s if arrangement == "immersion" else 0.0)

    def model(self, arrangement: Arrangement) -> ThermalModel:
        """Exact steps of winding and housing, with the rise of copper loss as a negative conductance at the winding."""
        inner = self.bare_per_s if arrangement == "no_interface" else self.interface_per_s
        direct = self.direct_per_s if arrangement == "immersion" else 0.0
        outer = self.outer_per_s(arrangement)
        rise = self.heating_k_per_s * float(thermal_data()["alpha_cu_per_k"])
        laplacian = np.array([[inner + direct - rise, -inner], [-inner, inner + outer]])
        return modal_model(np.array([1.0, self.housing_capacity]), laplacian, np.array([direct, outer]))

    def temperatures(self, arrangement: Arrangement, time_s: float) -> Array:
        """Temperatures of winding and housing after a time under load from 26 °C, °C, [2]."""
        _, gamma = self.model(arrangement).step_matrices(time_s)
        return COOLANT_C + gamma @ np.array([self.heating_k_per_s, 0.0])

    def steady_c(self, arrangement: Arrangement) -> float:
        """Temperature at which the winding settles, °C; inf for a thermal runaway."""
        model = self.model(arrangement)
        if model.rates.min() <= 0:
            return np.inf
        return COOLANT_C + float(np.linalg.solve(model.laplacian, np.array([self.heating_k_per_s, 0.0]))[0])

    def limit_s(self, arrangement: Arrangement) -> float:
        """Time until the winding reaches 125 °C, s; inf if it never does."""

        def excess(time_s: float) -> float:
            return float(self.temperatures(arrangement, time_s)[0]) - LIMIT_C

        if self.steady_c(arrangement) <= LIMIT_C:
            return np.inf
        late_s = 1.0
        while excess(late_s) < 0:
            late_s *= 2
            if late_s > LONGEST_S:
                return np.inf
        return float(brentq(excess, 0.0, late_s))  # pyright: ignore[reportArgumentType]

    def figures(self) -> dict[str, float]:
        """The figures of this motor by the names of `PUBLISHED`."""
        ratio = self.conductance_per_s("immersion") / self.conductance_per_s("forced_water")
        times = {f"{each}_s": self.limit_s(each) for each in ARRANGEMENTS if each != "immersion"}
        return {**times, "immersed_c": self.steady_c("immersion"), "immersed_ratio": ratio}


ZHU_MOTOR = CooledMotor(
    heating_k_per_s=25.840,
    housing_capacity=3.4667,
    bare_per_s=0.068938,
    interface_per_s=0.77130,
    water_per_s=0.17979,
    direct_per_s=0.39368,
)
"""The result of `fit_motor`."""
CAPACITY_PRIOR, BARE_PRIOR = (3.0, 0.5), (0.1, 1.0)
"""Medians and standard deviations of the logarithm: stator core and shell weigh about three times the copper; a gap of
air with a few contact points conducts about a tenth of one that is filled. The five figures leave two numbers open."""
_FIGURE_SD = 0.01


class Fit(NamedTuple):
    """Result of `fit_motor`."""

    motor: CooledMotor
    relative_sd: dict[str, float]
    """Standard deviation of each parameter's logarithm, by name; about that of its prior where the figures do
    not determine it."""


def fit_motor() -> Fit:
    """The most probable motor given the published figures (1 %) and the two priors."""

    def residuals(x: Array) -> Array:
        motor = _motor(x)
        got = motor.figures()
        figures = [np.log(min(got[name], LONGEST_S) / wanted) / _FIGURE_SD for name, wanted in PUBLISHED.items()]
        (core, core_sd), (bare, bare_sd) = CAPACITY_PRIOR, BARE_PRIOR
        gap = np.log(motor.bare_per_s / motor.interface_per_s / bare) / bare_sd
        return np.array([*figures, np.log(motor.housing_capacity / core) / core_sd, gap])

    start = np.log([23.0, 3.0, 0.03, 0.3, 0.3, 0.35])
    solution = least_squares(residuals, start, xtol=1e-12, ftol=1e-12)
    sd = np.sqrt(np.diag(np.linalg.inv(solution.jac.T @ solution.jac)))
    names = [field.name for field in fields(CooledMotor)]
    return Fit(_motor(solution.x), dict(zip(names, sd.tolist(), strict=True)))


def _motor(x: Array) -> CooledMotor:
    """The motor with these logarithms, [parameter]."""
    names = (field.name for field in fields(CooledMotor))
    return CooledMotor(**dict(zip(names, np.exp(x).tolist(), strict=True)))


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
"""What the rows of the motor are: time from 26 to 125 °C, unless stated otherwise."""
CHANGES = {
    "still_air": "–",
    "heat_sink": "fins: 1.8 × conductance to ambient, 1.35 × capacity of the housing",
    "heat_spreader": "copper strip: 0.2 W/K more to the next housings, 1.1 × capacity",
    "forced_air": "2.5 × conductance from housing to air",
    "liquid": "6 ×",
    "immersion": "6 ×, and the liquid reaches the winding",
}
"""What each way of cooling changes in the network."""


def motor_rows() -> list[Row]:
    """The published figures beside those of the fitted motor."""
    modelled = ZHU_MOTOR.figures()
    return [{"figure": name, "published": value, "modelled": modelled[name]} for name, value in PUBLISHED.items()]


def joint_row(cooling: Cooling) -> Row:
    """Joint 2 of a nominal Gen3 with one way of cooling, and a cold start with 3 kg outstretched at 25 °C.

    Returns:
        `whole_w_per_k`: conductance from winding to ambient without neighbours, W/K. `warning_min`, `error_min`: time
        until 60 and 75 °C, None for never. `steady_c`: None for a thermal runaway.
    """
    network, (coil, shell) = gen3_network(cooling=cooling), (winding(JOINT), housing(JOINT))

    def conductance(one: str, other: str) -> float:
        return float(network.edges[one, other]["conductance_w_per_k"]) if network.has_edge(one, other) else 0.0

    course = hold(PAYLOAD_KG, "outstretched", AMBIENT_C, cooling=cooling).cold
    return {
        "cooling": cooling,
        "passive": cooling in PASSIVE,
        "whole_w_per_k": in_series(conductance(coil, shell), conductance(shell, "ambient"))
        + conductance(coil, "ambient"),
        "warning_min": course.t60_min[JOINT],
        "error_min": course.t75_min[JOINT],
        "steady_c": course.steady_c[JOINT],
    }


def law_row() -> Row:
    """Motor and joint, which follow from the laws alone."""
    return {"motor": motor_rows(), "joint": [joint_row(each) for each in STRATEGIES]}


def fleet_rows(
    scenario: Scenario,
    seeds: Sequence[int],
    policies: Sequence[str] = POLICIES,
    strategies: Sequence[Cooling] = STRATEGIES,
    difficulty: DifficultyName = "blind",
    cache_dir: Path | None = None,
) -> list[Row]:
    """Shifts of a fleet whose arms all have the same cooling, on the same seeds and with the same arms.

    Args:
        strategies: Differences refer to the first one, under the same policy.
    """
    shifts: dict[str, dict[str, list[Outcome]]] = {policy: {} for policy in policies}
    for cooling in strategies:
        arms = tuple(replace(arm, cooling=cooling) for arm in scenario.arms)
        fleet = prepare(replace(scenario, arms=arms), difficulty=difficulty, cache=cache_dir)
        for policy in policies:
            shifts[policy][cooling] = outcomes(fleet, policy, seeds)
    figures = {policy: figures_of_shifts(each, strategies[0]) for policy, each in shifts.items()}
    return [
        {
            "cooling": cooling,
            "policy": policy,
            "figures": {name: asdict(figure) for name, figure in figures[policy][cooling].items()},
        }
        for cooling in strategies
        for policy in policies
    ]


def fit_row() -> Row:
    """The motor fitted again."""
    found = fit_motor()
    return {"fit": {name: (getattr(found.motor, name), sd) for name, sd in found.relative_sd.items()}}


def shown_or(value: float | None, unit: str, digits: int = 1) -> str:
    """A number with its unit, `never` for None."""
    return "never" if value is None else f"{value:.{digits}f} {unit}"


def cooling_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Tables of the motor, the joint, the fit, and each fleet, as far as there are rows."""
    tables: dict[str, Table] = {}
    for row in rows:
        if "motor" in row:
            motor = [(MOTOR_FIGURES[e["figure"]], f"{e['published']:g}", f"{e['modelled']:.2f}") for e in row["motor"]]
            tables["cooling_motor"] = table_of(("time to 125 °C, or temperature", "published", "here"), motor)
            tables["cooling_joint"] = joint_table(row["joint"])
        if "fit" in row:
            parameters = [(name, f"{value:.4g}", f"{sd:.2f}") for name, (value, sd) in row["fit"].items()]
            tables["cooling_fit"] = table_of(("parameter, per J/K of the winding", "value", "relative sd"), parameters)
        if "fleet" in row:
            tables[f"cooling_{row['scenario']}"] = fleet_table(row)
    return tables


def joint_table(rows: Sequence[Row]) -> Table:
    """A line for each way of cooling."""
    lines = [
        (
            f"`{row['cooling']}`" + " (passive)" * row["passive"],
            CHANGES[row["cooling"]],
            f"{row['whole_w_per_k']:.2f}",
            shown_or(row["warning_min"], "min"),
            shown_or(row["error_min"], "min"),
            shown_or(row["steady_c"], "°C", 0),
        )
        for row in rows
    ]
    hold_heads = ("3 kg held outstretched: 60 °C after", "75 °C after", "settles at")
    return table_of(("`cooling`", "what changes", "winding to ambient, W/K", *hold_heads), lines)


def fleet_table(row: Row) -> Table:
    """A line for each way of cooling; differences of value to the first one, bold if the 95 % interval excludes 0."""
    found = {(each["cooling"], each["policy"]): each["figures"] for each in row["fleet"]}
    policies = dict.fromkeys(policy for _, policy in found)
    heads = [head for policy in policies for head in (f"`{policy}`: value", "faults", "min above warning")]
    lines: list[tuple[str, ...]] = []
    for n, cooling in enumerate(dict.fromkeys(cooling for cooling, _ in found)):
        cells = list[str]()
        for policy in policies:
            value, faults, warm = (found[cooling, policy][name] for name in ("value", "faults", "above_warning_min"))
            text = difference(value["difference"], value["difference_low"], value["difference_high"])
            cells += [f"{value['mean']:.1f}" + f"; {text}" * (n > 0), f"{faults['mean']:.2f}", f"{warm['mean']:.0f}"]
        lines.append((f"`{cooling}`", *cells))
    return table_of((f"`{row['scenario']}`", *heads), lines)


def cooling_options(parser: ArgumentParser) -> None:
    """Options of `cooling`."""
    parser.add_argument("--scenarios", type=names, default=[], help="fleets to simulate with each cooling [none]")
    parser.add_argument("--policies", type=names, default=list(POLICIES), help=f"policies [{','.join(POLICIES)}]")
    parser.add_argument("--difficulty", default="blind", help="as of `thermofleet run` [blind]")
    parser.add_argument("--fit", action="store_true", help="fit the motor of Zhu et al. again")
    seed_options(parser, 20, 100)


def cooling_units(given: Namespace) -> list[Unit]:
    """Motor and joint, the fit, and a unit for each fleet."""
    difficulty = choose("difficulty", given.difficulty, DifficultyName)
    units = [one_row("motor and joint", law_row)]
    if given.fit:
        units.append(one_row("fit", fit_row))
    basis = content_key([*seeds_of(given)], given.policies, given.difficulty)
    for scenario in scenarios_of(given.scenarios):

        def fleet(scenario: Scenario = scenario) -> Row:
            rows = fleet_rows(scenario, seeds_of(given), given.policies, difficulty=difficulty)
            return {"scenario": scenario.name, "fleet": rows}

        units.append(one_row(f"{scenario.name}/{basis}", fleet))
    return units


COOLING_STUDY = Experiment(
    help="Ways of cooling: the motor of Zhu et al., joint 2 of a Gen3, and the finished work of fleets.\n\n"
    "A second; with --scenarios some minutes for each fleet.",
    options=cooling_options,
    units=cooling_units,
    tables=cooling_tables,
)
