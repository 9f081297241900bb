"""`thermofleet compare` and `thermofleet ablate`."""

from pathlib import Path
from typing import Annotated

import typer

from agents.registry import RULES, WRAPPERS_HELP
from scenarios.cli import options
from scenarios.cli.terminal import out_console, print_json, progress_bar, say
from scenarios.load import load
from scenarios.schema_errors import choose


def compare_command(
    scenario: options.ScenarioArg,
    policies: Annotated[
        str,
        typer.Option(
            help="Policies, separated by commas: names, FILE.py:CLASS, or folders of `thermofleet train`; "
            f"{WRAPPERS_HELP}. Default: {', '.join(RULES)}.",
            show_default=False,
        ),
    ] = ",".join(RULES),
    seeds: Annotated[int, options.number("Number of seeds; intervals need several shifts.", 2, 10_000)] = 10,
    first_seed: Annotated[
        int, options.number("First seed. Compare on seeds that you did not tune on.", 0, options.MAX_SEED)
    ] = 0,
    baseline: Annotated[
        str | None,
        typer.Option(
            help="Policy that the paired differences refer to; default: round_robin if it is compared, else the first.",
            show_default=False,
        ),
    ] = None,
    difficulty: options.DifficultyOption = "twin",
    risk: options.RiskOption = "rc",
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
    from scenarios.prepare.fleet import DifficultyName, RiskName
    from scenarios.run.compare import compare, comparison_table

    chosen = load(scenario)
    channel = options.channel_of(
        chosen, partition, topology=topology, radius=radius, topology_seed=topology_seed, delay_s=delay_s,
        jitter_s=jitter_s, loss=loss,
    )  # fmt: skip
    names = [name.strip() for name in policies.split(",")]
    with progress_bar() as progress:
        result = compare(
            chosen,
            names,
            seeds=range(first_seed, first_seed + seeds),
            baseline=baseline or ("round_robin" if "round_robin" in names else names[0]),
            difficulty=choose("difficulty", difficulty, DifficultyName),
            risk=choose("risk", risk, RiskName),
            channel=channel,
            progress=progress,
        )
    if as_json:
        print_json(result)
    else:
        out_console.print(comparison_table(result))


def ablate_command(
    scenario: options.ScenarioArg,
    policy: Annotated[
        str,
        typer.Option(
            help="Policy that runs with each source: a name, FILE.py:CLASS, or a folder of `thermofleet train`."
        ),
    ] = "least_difficulty",
    scores: Annotated[
        str | None,
        typer.Option(
            help="Sources, separated by commas: trained, untrained, torque, rc-nominal, rc, random, inverted, "
            "constant, blind, oracle; or POLICY@SOURCE for another policy. Differences refer to the first one. "
            "Default: all sources.",
            show_default=False,
        ),
    ] = None,
    fleets: Annotated[
        int, options.number("Number of fleets: draws of the arms' deviations (spread.seed).", 2, 100)
    ] = 3,
    trainings: Annotated[int, options.number("Number of trainings of the twins of each fleet.", 1, 20)] = 2,
    seeds: Annotated[int, options.number("Number of seeds.", 2, 10_000)] = 20,
    first_seed: Annotated[int, options.number("First seed.", 0, options.MAX_SEED)] = 10_000,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the results; default: runs/ablate-SCENARIO-POLICY.", show_default=False),
    ] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Compare the results of one policy with scores from different sources.

    Scores are difficulty, P(saturation) and predicted peak. Every shift is written
    to ablation.csv, the intervals to ablation.json. The same command resumes an
    interrupted comparison. A training takes up to a minute per arm.
    """
    from scenarios.extras import require_extra

    require_extra("twin")
    from scenarios.policy_loader import label
    from scenarios.studies.ablation import AblationPlan, ablate, ablation_table

    chosen = load(scenario)
    given = {} if scores is None else {"scores": tuple(name.strip() for name in scores.split(","))}
    plan = AblationPlan(policy=policy, fleets=fleets, trainings=trainings, seeds=seeds, first_seed=first_seed, **given)
    folder = out or Path(f"runs/ablate-{chosen.name}-{label(policy).replace(':', '-')}")
    with progress_bar(kept="Finished shifts, plans and twins are") as progress:
        result = ablate(chosen, plan, folder, progress=progress)
    if as_json:
        print_json(result)
    else:
        out_console.print(ablation_table(result))
        say(f"Written to {folder}.")
