"""`thermofleet compare`."""

from typing import Annotated

import msgspec
import typer

from agents.registry import RULES
from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.run import channel_of
from scenarios.cli.terminal import out_console, progress_bar
from scenarios.load import load


def compare_command(
    scenario: options.ScenarioArg,
    policies: Annotated[
        str, typer.Option(help="Comma-separated; an own policy as FILE.py:CLASS, a trained one as its folder.")
    ] = ",".join(RULES),
    seeds: Annotated[int, typer.Option(help="Number of seeds; 2 or more.")] = 10,
    first_seed: Annotated[int, typer.Option(help="First seed; keep some seeds apart from those you tune on.")] = 0,
    baseline: Annotated[
        str | None,
        typer.Option(
            help="Policy that the paired differences refer to; default: round_robin, or else the first.",
            show_default=False,
        ),
    ] = None,
    difficulty: options.DifficultyOption = "twin",
    as_json: options.JsonOption = False,
    topology: options.TopologyOption = "complete",
    radius: options.RadiusOption = 0.5,
    topology_seed: options.TopologySeedOption = 0,
    delay_s: options.DelayOption = 0.0,
    jitter_s: options.JitterOption = 0.0,
    loss: options.LossOption = 0.0,
    partition: options.PartitionOption = None,
) -> None:
    """Compare policies on the same seeds, with confidence intervals."""
    from scenarios.prepare.fleet import DifficultyName, choose
    from scenarios.run.compare import compare, comparison_table

    chosen = load(scenario)
    if seeds < 2:
        raise FleetError(f"--seeds must be 2 or more, because intervals need several shifts (got {seeds}).")
    if first_seed < 0:
        raise FleetError(f"--first-seed must be 0 or more (got {first_seed}).")
    channel = channel_of(chosen, topology, radius, topology_seed, delay_s, jitter_s, loss, partition)
    names = [name.strip() for name in policies.split(",")]
    with progress_bar() as progress:
        result = compare(
            chosen,
            names,
            seeds=range(first_seed, first_seed + seeds),
            baseline=baseline or ("round_robin" if "round_robin" in names else names[0]),
            difficulty=choose("difficulty", difficulty, DifficultyName),
            channel=channel,
            progress=progress,
        )
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(result), indent=1).decode())
    else:
        out_console.print(comparison_table(result))
