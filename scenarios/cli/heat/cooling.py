"""`thermofleet cooling`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.terminal import out_console, plain_table, print_json, progress_bar
from scenarios.load import load
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
    from fleet.heat.cooled_motor import Fit
    from scenarios.studies.heat.cooling import FleetRow, JointRow, MotorRow


def cooling_command(
    scenario: Annotated[
        str, typer.Argument(help="Fleet to compare: a library name or a .toml file.")
    ] = "active_waiting",
    seeds: Annotated[int, options.number("Number of seeds; intervals need several shifts.", 2, 10_000)] = 20,
    first_seed: Annotated[int, options.number("First seed.", 0, options.MAX_SEED)] = 100,
    policies: Annotated[
        str, typer.Option(help="Policies, separated by commas; with --difficulty twin also those that need a twin.")
    ] = "round_robin,thermometer",
    difficulty: options.DifficultyOption = "blind",
    fleet: Annotated[bool, typer.Option("--fleet/--no-fleet", help="Simulate the fleet with each cooling.")] = True,
    fit: Annotated[
        bool, typer.Option("--fit", help="Fit the motor of Zhu et al. again and show its parameters.")
    ] = False,
    as_json: options.JsonOption = False,
) -> None:
    """Compare ways of cooling: a published motor, a joint of a Gen3, and the finished work of a fleet.

    The motor of Zhu et al. is a two-node network fitted to the published times
    (tables 1 and 2 of arXiv 2509.12740). The fleet runs the same seeds with
    every cooling; differences are paired and refer to still air. 20 seeds take two
    minutes of one core and more; without the fleet, a second. TIM: thermal interface
    material.
    """
    from fleet.heat.cooled_motor import fit_motor
    from fleet.heat.limits import CORE, MOTOR
    from scenarios.prepare.fleet import DifficultyName
    from scenarios.studies.heat.cooling import fleet_rows, joint_rows, motor_rows

    chosen, names = load(scenario), tuple(options.split_names(policies))
    if len(set(names)) < len(names):
        raise FleetError(f"--policies must name each policy once (got '{policies}').")
    source = choose("difficulty", difficulty, DifficultyName)
    motors, joints, rows = motor_rows(), joint_rows(), []
    fitted = fit_motor() if fit else None
    if fleet:
        with progress_bar() as progress:
            rows = fleet_rows(
                chosen,
                seeds=range(first_seed, first_seed + seeds),
                policies=names,
                difficulty=source,
                progress=progress,
            )
    if as_json:
        print_json(
            {
                "motor": motors,
                "joint": joints,
                "limits": {"motor": MOTOR._asdict(), "core": CORE._asdict()},
                "scenario": chosen.name,
                "seeds": [first_seed, first_seed + seeds - 1] if fleet else [],
                "fleet": rows,
                **({} if fitted is None else {"fit": fitted._asdict()}),
            }
        )
        return
    tables = [_motor_table(motors), _joint_table(joints), _limit_table()]
    if fitted is not None:
        tables.insert(1, _fit_table(fitted))
    if rows:
        tables.append(_fleet_table(rows, f"{chosen.name}, seeds {first_seed} to {first_seed + seeds - 1}"))
    for table in tables:
        out_console.print(table)
        out_console.print()


def _motor_table(rows: "Sequence[MotorRow]") -> Table:
    from scenarios.studies.heat.cooling import MOTOR_FIGURES

    table = plain_table("motor of Zhu et al.", "published", "here", "deviation")
    for row in rows:
        table.add_row(MOTOR_FIGURES[row.figure], f"{row.published:g}", f"{row.modelled:.2f}", f"{row.deviation:+.2%}")
    return table


def _fit_table(found: "Fit") -> Table:
    table = plain_table("parameter, per J/K of the winding", "value", "relative sd")
    for name, sd in found.relative_sd.items():
        table.add_row(name, f"{getattr(found.motor, name):.4g}", f"{sd:.2f}")
    return table


def _joint_table(rows: "Sequence[JointRow]") -> Table:
    title = "Joint 2 of a Gen3: conductances W/K, capacity J/K; minutes with 3 kg outstretched from 25 °C"
    heads = ("to air", "J/K", "to next", "winding to air", "to 60 °C", "to 75 °C", "settles")
    table = plain_table("", *heads, title=title)
    for heading, passive in (("passive (table 1)", True), ("active (table 2)", False)):
        for row in rows[:1] if passive else ():
            table.add_row(*_joint_cells(row, row.cooling))
        table.add_row(f"[bold]{heading}[/bold]")
        for row in rows[1:]:
            if row.passive == passive:
                table.add_row(*_joint_cells(row, f"  {row.cooling}"))
    return table


def _joint_cells(row: "JointRow", name: str) -> list[str]:
    network = (row.shell_w_per_k, row.shell_j_per_k, row.neighbour_w_per_k, row.whole_w_per_k)
    course = (row.warning_min, row.error_min, row.steady_c)
    times = ["never" if value is None else f"{value:.1f}" for value in course]
    return [name, *(f"{value:.2f}" if value < 100 else f"{value:.0f}" for value in network), *times]


def _limit_table() -> Table:
    from fleet.heat.limits import CORE, MOTOR

    table = plain_table("limits of a Gen3, °C", "lower", "warning", "error", "upper")
    for name, bounds in (("motor", MOTOR), ("core (microcontroller), not modelled", CORE)):
        table.add_row(name, *(f"{value:g}" for value in bounds))
    return table


def _fleet_table(rows: "Sequence[FleetRow]", title: str) -> Table:
    from scenarios.evaluate.tables import LEGEND

    table = plain_table(
        "",
        *("value", "difference", "95 %", "", "faults", "min > warning"),
        title=f"{title}: mean, and paired difference of value to {rows[0].cooling}; {LEGEND}",
    )
    for policy in dict.fromkeys(row.policy for row in rows):
        table.add_row(f"[bold]{escape(policy)}[/bold]")
        for row in (each for each in rows if each.policy == policy):
            value, faults, warm = (row.figures[name] for name in ("value", "faults", "above_warning_min"))
            paired = ["", "", ""]
            if row.cooling != rows[0].cooling:
                span = f"{value.difference_low:+.1f} … {value.difference_high:+.1f}"
                paired = [f"{value.difference:+.1f}", span, value.stars]
            cells = [f"{value.mean:.1f}", *paired, f"{faults.mean:.1f}", f"{warm.mean:.0f}"]
            table.add_row(f"  {row.cooling}", *cells)
    return table
