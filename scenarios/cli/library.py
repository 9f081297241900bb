"""`thermofleet list` and `thermofleet show`."""

from scenarios.cli.options import JsonOption, ScenarioArg
from scenarios.cli.terminal import out_console, plain_table, print_json, progress_bar
from scenarios.load import library, load


def list_command(as_json: JsonOption = False) -> None:
    """List the scenarios that come with thermofleet."""
    scenarios = {name: load(path) for name, path in library().items()}
    if as_json:
        print_json({name: s.description for name, s in scenarios.items()})
        return
    table = plain_table("scenario", "arms", "hours", "description", numbers=False)
    for name, s in scenarios.items():
        table.add_row(name, str(len(s.arms)), f"{s.horizon_s / 3600:g}", s.description)
    out_console.print(table)


def show_command(scenario: ScenarioArg, as_json: JsonOption = False) -> None:
    """Show a scenario: its arms, its jobs and its thermal load factor."""
    from scenarios.report.describe import describe

    chosen = load(scenario)
    if as_json:
        print_json(chosen)
        return
    with progress_bar() as progress:
        parts = describe(chosen, progress)
    for part in parts:
        out_console.print(part)
