"""Tables of docs/concepts/cooling.md, from `thermofleet cooling SCENARIO --json`."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from scenarios.doc_tables import table
from scenarios.studies.heat.cooling import MOTOR_FIGURES
from scenarios.studies.page_tables.cells import difference, read_json

CHANGES = {
    "still_air": "–",
    "heat_sink": "fins: 1.8 × conductance to air, 1.35 × capacity of the housing",
    "heat_spreader": "copper strip: 0.2 W/K more to the next housings, 1.1 × capacity",
    "forced_air": "2.5 × conductance from housing to air",
    "liquid": "6 ×",
    "immersion": "6 ×, and the liquid reaches the winding",
}
"""What each way of cooling changes in the network."""


def cooling_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of each table by the name in its mark.

    Args:
        results: With `cooling_SCENARIO.json` of some scenarios.
    """
    files = {path.stem: path for path in sorted(results.glob("cooling_*.json"))}
    first = next(iter(files.values()), None)
    more = {"cooling_motor": partial(_motor, first), "cooling_joint": partial(_joint, first)} if first else {}
    return {name: partial(_fleet, path) for name, path in files.items()} | more


def _motor(path: Path) -> str:
    rows = [
        (MOTOR_FIGURES[row["figure"]], f"{row['published']:g}", f"{row['modelled']:.2f}")
        for row in read_json(path)["motor"]
    ]
    return table(("time to 125 °C, or temperature", "published", "here"), rows)


def _joint(path: Path) -> str:
    def shown(value: float | None, unit: str, digits: int = 1) -> str:
        return "never" if value is None else f"{value:.{digits}f} {unit}"

    rows = [
        (
            f"`{row['cooling']}`" + " (passive)" * row["passive"],
            CHANGES[row["cooling"]],
            f"{row['whole_w_per_k']:.2f}",
            shown(row["warning_min"], "min"),
            shown(row["error_min"], "min"),
            shown(row["steady_c"], "°C", 0),
        )
        for row in read_json(path)["joint"]
    ]
    hold = "3 kg held outstretched: 60 °C after"
    return table(("`cooling`", "what changes", "winding to air, W/K", hold, "75 °C after", "settles at"), rows)


def _fleet(path: Path) -> str:
    """A line for each way of cooling; differences of value to the first one."""
    measured = read_json(path)
    policies = dict.fromkeys(row["policy"] for row in measured["fleet"])
    found = {(row["cooling"], row["policy"]): row["figures"] for row in measured["fleet"]}
    coolings = dict.fromkeys(cooling for cooling, _ in found)
    heads = [head for policy in policies for head in (f"`{policy}`: value", "faults", "min above warning")]
    rows: list[tuple[str, ...]] = []
    for n, cooling in enumerate(coolings):
        cells = list[str]()
        for policy in policies:
            value, faults, warm = (found[cooling, policy][name] for name in ("value", "faults", "above_warning_min"))
            text = difference(value["difference"], value["difference_low"], value["difference_high"])
            cells += [f"{value['mean']:.1f}" + f"; {text}" * (n > 0), f"{faults['mean']:.2f}", f"{warm['mean']:.0f}"]
        rows.append((f"`{cooling}`", *cells))
    return table((f"`{measured['scenario']}`", *heads), rows)
