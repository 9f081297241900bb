"""`thermofleet compare`."""

import json
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from agents.registry import RULES, WRAPPERS_HELP
from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.terminal import KEPT, out_console, print_json, progress_bar, say
from scenarios.result_folder import disk_errors
from scenarios.schema_errors import choose

PAGE = "index.html"


def compare_command(
    ctx: typer.Context,
    scenario: Annotated[
        list[str] | None,
        typer.Argument(
            help="Library names (see `thermofleet show`) or .toml files; or use --suite.", show_default=False
        ),
    ] = None,
    policies: Annotated[
        str,
        typer.Option(
            help="Policies, separated by commas: names, FILE.py:CLASS, bus:NAME in another process, or folders of "
            "`thermofleet train` ('FOLDER-*': one policy with several trainings); POLICY@SOURCE for a policy with one "
            "source of predictions; "
            f"{WRAPPERS_HELP}. Default: {', '.join(RULES)}.",
            show_default=False,
        ),
    ] = ",".join(RULES),
    suite: Annotated[
        str | None,
        typer.Option(
            help="Instances that are judged together: train, validation, test or sizes; or instances of a split "
            "(test/0017), library names and .toml files, separated by commas.",
            show_default=False,
        ),
    ] = None,
    seeds: Annotated[
        int | None,
        options.number("Number of seeds of each instance; default: 10, with --suite 1.", 1, 10_000, show_default=False),
    ] = None,
    first_seed: Annotated[
        int,
        options.number("First seed of a scenario. Compare on seeds that you did not tune on.", 0, options.MAX_SEED),
    ] = 0,
    fleets: Annotated[
        int, options.number("Number of fleets: draws of the arms' deviations (spread.seed).", 1, 100)
    ] = 1,
    trainings: Annotated[int, options.number("Number of trainings of each fleet's twins.", 1, 20)] = 1,
    baseline: Annotated[
        str | None,
        typer.Option(
            help="Policy that the paired differences refer to; default: round_robin if it is compared, else the first.",
            show_default=False,
        ),
    ] = None,
    difficulty: Annotated[
        str,
        typer.Option(
            help="Sources of predictions, separated by commas: twin, oracle (simulator), blind (none), or models to "
            "compare: trained, untrained, unweighted, torque, weighted-torque, rc-nominal, rc, random, inverted, "
            "constant. With several, POLICY@SOURCE names a policy."
        ),
    ] = "twin",
    risk: options.RiskOption = "rc",
    randomise: options.RandomiseOption = None,
    decision_limit: Annotated[
        float, options.number("Longest time for one decision of a policy, s. A slower policy fails.", 0.001, 86_400)
    ] = 60.0,
    references: Annotated[
        Path | None,
        typer.Option(
            help="Rows of `thermofleet bounds`, for normalised scores; splits use those of the package, if any.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the results, one row per shift, and of their page, index.html. The same command continues "
            "after an interruption.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None, options.number("Number of processes; default: one per core.", 1, 1024, show_default=False)
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(help="Run on a Ray cluster: its address, `auto` for the one of this machine.", show_default=False),
    ] = None,
    marl_eval: Annotated[
        bool, typer.Option("--marl-eval", help="With --out: also write marl_eval.json, which marl-eval reads.")
    ] = False,
    as_json: options.JsonOption = False,
    topology: options.TopologyOption = "complete",
    radius: options.RadiusOption = 0.5,
    topology_seed: options.TopologySeedOption = 0,
    delay_s: options.DelayOption = 0.0,
    jitter_s: options.JitterOption = 0.0,
    loss: options.LossOption = 0.0,
    partition: options.PartitionOption = None,
) -> None:
    """Compare policies on the same seeds, with confidence intervals.

    With several scenarios each has its own table; with --suite one table covers all.
    The first failure of a policy is reported with instance, seed and traceback;
    the other policies and shifts continue.
    """
    from scenarios.evaluate.comparison import check_baseline, comparisons, rows_without_failures, scores_over_all
    from scenarios.evaluate.marl_eval import to_marl_eval
    from scenarios.evaluate.rollout import FIGURES
    from scenarios.evaluate.runner import run_study
    from scenarios.evaluate.scores import references_of
    from scenarios.evaluate.study import Study, cases_of, columns, suite_label, suite_of
    from scenarios.show.comparison_page import Judged, comparison_page, result_text, verdict
    from scenarios.specs import RiskName

    if bool(scenario) == bool(suite):
        raise FleetError("Give either scenarios or --suite.")
    if workers is not None and ray is not None:
        raise FleetError("Give either --workers or --ray.")
    if marl_eval and out is None:
        raise FleetError("--marl-eval needs --out, the folder that it writes to.")
    if references is not None and not references.is_file():
        raise FleetError(f"There is no file of references '{references}'; make it with `thermofleet bounds`.")
    varied = options.parse_randomisation(randomise)
    if references is not None and varied:
        raise FleetError("Give either --references or --randomise: references are of shifts without randomisation.")
    out = out and out.resolve()  # a policy may change the folder of the process
    cases = suite_of(suite, seeds or 1, first_seed) if suite else cases_of(scenario or [], seeds or 10, first_seed)
    channels = [
        options.channel_of(
            case.scenario, partition, topology=topology, radius=radius, topology_seed=topology_seed, delay_s=delay_s,
            jitter_s=jitter_s, loss=loss,
        )
        for case in cases
    ]  # fmt: skip
    study = Study(
        policies=options.split_names(policies),
        cases=cases,
        fleets=fleets,
        trainings=trainings,
        difficulties=options.split_names(difficulty),
        risk=choose("risk", risk, RiskName),
        randomise=varied,
        channel=channels[0],  # the same of all; each scenario has the arms that it names
        decision_limit_s=decision_limit,
    )
    names = study.competitors
    base = baseline or names.get(("round_robin", study.sources[0]), next(iter(names.values())))
    check_baseline(study, base)
    known = references_of(cases, references)
    with progress_bar(kept="Finished shifts are" if out else KEPT, file=out) as progress:
        rows = run_study(study, out=out, workers=workers or -1, ray=ray, progress=progress, tell=say)
    results = comparisons(study, rows, base, suite, known)
    values = scores_over_all(study, rows, known)
    title = f"Comparison of {len(names)} policies on {suite_label(suite or ','.join(case.name for case in cases))}"
    judged = Judged(title=title, results=results, values=values, card=study.card, command=options.command_line(ctx))
    if out:
        with disk_errors(out):
            (out / PAGE).write_text(comparison_page(judged), encoding="utf-8")
            if marl_eval:
                whole = chain.from_iterable(rows_without_failures(study, rows).values())
                table = to_marl_eval(map(columns, whole), FIGURES)
                (out / "marl_eval.json").write_text(json.dumps(table) + "\n", encoding="utf-8")
    if as_json:
        print_json(results[0] if len(results) == 1 else results)
        return
    for result in results:
        out_console.print(result_text(result))
    out_console.print("", *verdict(judged), sep="\n")
    if out:
        say(f"Written to {out}; open {out / PAGE}.")
