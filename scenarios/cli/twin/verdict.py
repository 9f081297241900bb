"""`thermofleet twin verdict`, `twin readings`, `twin sides` and `twin questions`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.table import Table

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.terminal import echo, out_console, plain_table, print_json, print_wide, progress_bar, say
from scenarios.load import load
from scenarios.result_folder import check_file, disk_errors
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
    from scenarios.evaluate.statistics import Interval
    from twin.vae.measures import Features
    from twin.verdict.rule import Rule


def verdict_command(
    twins: options.TwinsArg,
    scenario: Annotated[str | None, typer.Argument(help="Judge this scenario's jobs; or use --log.")] = None,
    log: options.LogOption = None,
    arm: options.WhichOption = None,
    alpha: Annotated[
        float, options.number("Largest share of cool jobs that may be called anomalous.", 0, 1, above=True)
    ] = 0.05,
    reading: Annotated[
        str, typer.Option(help="load (torque above the reconstruction), d, or latent (distance from cool motion).")
    ] = "load",
    map_: Annotated[
        Path | None, typer.Option("--map", help="Draw the latent plane with the verdicts in this PNG.")
    ] = None,
    format_: Annotated[str, typer.Option("--format", help="table, csv or json.")] = "table",
    skip_damaged: options.DamagedOption = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier map.")] = False,
) -> None:
    """Call each job of a scenario, or each recording of a log, uncritical or anomalous.

    The threshold is a conformal p-value: a new cool job is called anomalous with
    probability alpha at most, if it is like the cool jobs that the twin held out
    of its training. Motion files of `twin generate` are recordings, too. Takes
    seconds; the first time for a scenario, half a minute for planning.
    """
    check_one_source(scenario, log)
    choose("format", format_, Literal["table", "csv", "json"])
    if map_ is not None:
        check_file(map_, (".png",), overwrite, "--map")
    import numpy as np

    from scenarios.prepare.twin_folder import open_twin
    from scenarios.report.score_table import job_rows, jobs_of_arm, log_rows, render, with_verdicts
    from twin.vae.measures import Features
    from twin.verdict.log_features import log_features
    from twin.verdict.rule import Rule

    chosen, twin = load(scenario) if scenario else None, open_twin(twins, arm)
    rule = Rule(twin=twin, alpha=alpha, reading=reading)
    if chosen is not None:
        with progress_bar() as progress:
            jobs = jobs_of_arm(twin, chosen, progress)
        features = twin.features([plan for plan, _ in jobs], [times for _, times in jobs])
        rows = job_rows(twin, jobs)
    else:
        recordings = options.recordings_of(Path(str(log)), skip_damaged)
        features = Features(np.stack([log_features(twin, recording).packed for recording in recordings]))
        rows = log_rows(twin, recordings)
    judged = with_verdicts(rows, rule, features)
    shown = render(judged, format_, caption=f"{rule.guarantee} Twin of {twin.arm}, version {twin.version}")
    if isinstance(shown, str):
        echo(shown, nl=False)
    else:
        print_wide(shown)
    if map_ is not None:
        draw_map(map_, rule, features)
        say(f"Map written to {map_}.")


def check_one_source(scenario: str | None, log: Path | None) -> None:
    """Raise a FleetError unless either a scenario or a log is given."""
    if (scenario is None) == (log is None):
        given = "neither" if scenario is None else "both"
        raise FleetError(f"Give either a scenario or --log FILE_OR_FOLDER (got {given}).")


def draw_map(path: Path, rule: "Rule", features: "Features") -> None:
    """Write the latent plane with the verdicts."""
    from fleet.files import atomic_path
    from scenarios.studies.report.figures import picture
    from scenarios.studies.verdict.latent_map import verdict_map

    png = picture("verdict", verdict_map(rule, features), "Latent plane with verdicts.").png
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as draft:
            draft.write_bytes(png)


def readings_command(
    scenarios: Annotated[
        str, typer.Argument(help="Scenarios whose arms are studied, separated by commas.")
    ] = "quickstart,active_waiting,heat_wave",
    seeds: Annotated[int, options.number("Number of seeds: 1, 2, …", 1, 100)] = 1,
    out: Annotated[Path, typer.Option(help="JSON of all numbers; a later call continues it.")] = Path(
        "runs/readings.json"
    ),
    size: Annotated[str, typer.Option(help="Training of the twins: quick or full.")] = "quick",
    as_json: options.JsonOption = False,
) -> None:
    """Compare readings of a twin's errors on all arms of some scenarios: ranking of jobs, and verdicts.

    Each arm gets random jobs with true outcomes and a twin trained on its cool
    ones: half a minute for each arm and seed.
    """
    from fleet.files import cache_folder
    from scenarios.studies.verdict.readings import study_arms
    from twin.vae.config import TwinConfig

    choose("size", size, Literal["quick", "full"])
    config = TwinConfig.quick() if size == "quick" else TwinConfig()
    chosen = [load(name) for name in dict.fromkeys(options.split_names(scenarios))]
    with disk_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar(kept="Finished arms are", file=out) as progress:
        card = study_arms(chosen, range(1, seeds + 1), out, config=config, folder=cache_folder(), progress=progress)
    if as_json:
        print_json(card)
        return
    for question, title in (
        ("any", "Does any joint overheat? By the score of the job"),
        ("joint", "Does the joint that carries the load overheat? By its own score"),
    ):
        out_console.print(readings_table(card, question, title))
    say(f"Written to {out}.", out_console)


def sides_command(
    scenario: options.ScenarioArg,
    arm: Annotated[str | None, typer.Option("--arm", help="Arm of the scenario; default: the first.")] = None,
    count: Annotated[int, options.number("Motions from each side.", 2, 10_000)] = 40,
    strength: Annotated[
        float, options.number("Perturbation in posterior standard deviations; 0 reconstructs.", 0, 100, "--s")
    ] = 1.0,
    seed: Annotated[int, options.number("Random seed.", 0, options.MAX_SEED)] = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Generate motion from the hot and from the cool side of the latent space, and tell how much of it gets hot.

    The arm gets random jobs with true outcomes and a twin trained on its cool
    ones, as in `twin readings`. Takes some minutes.
    """
    from dataclasses import asdict

    import numpy as np

    from fleet.files import cache_folder
    from scenarios.evaluate.statistics import Interval
    from scenarios.prepare.train_twins import train_or_load
    from scenarios.studies.setup import make_study
    from scenarios.studies.verdict.readings import SIZES
    from scenarios.studies.verdict.sides import COMMON_KG, sides
    from twin.vae.config import TwinConfig

    chosen = load(scenario)
    index = 0 if arm is None else chosen.index_of(arm)
    draw = np.random.SeedSequence([seed, index + 1])
    with progress_bar() as progress:
        progress("drawing jobs", 0.0)
        make: Any = make_study  # sizes by name
        study = make(draw, **SIZES, robot=chosen.arms[index].robot())
        config = TwinConfig.quick()
        twin = train_or_load(study.train.records(), config, draw, arm="arm", folder=cache_folder())
        result = sides(study, twin, count=count, s=strength, seed=seed, progress=progress)
    if as_json:
        print_json({"scenario": chosen.name, "arm": chosen.arms[index].name, "seed": seed, **asdict(result)})
        return
    title = f"Motion generated from each side of the latent space: {chosen.arms[index].name} of {chosen.name}"
    caption = f"Shares with 95 % intervals; warm: above {study.cool_c:g} °C, critical: {study.warning_c:g} °C or more"
    table = plain_table("payload", "side", "motions", "warm", "critical", "median °C", title=title, caption=caption)
    for name, by_side in (("as the source", result.own), (f"{COMMON_KG:g} kg for all", result.common)):
        for side, share in by_side.items():
            shares = (interval_text(Interval(*each)) for each in (share.warm, share.critical))
            table.add_row(name, side, str(share.motions), *shares, f"{share.peak_c:.1f}")
    out_console.print(table)


def questions_command(
    log: Annotated[Path, typer.Option("--log", help="A folder of logs of one arm, with motor temperatures.")],
    seeds: Annotated[int, options.number("Number of seeds: 0, 1, …", 1, 100)] = 3,
    window: Annotated[int, options.number("Samples per window, 2 in a second.", 10, 10_000)] = 50,
    skip_damaged: options.DamagedOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Tell on which questions about an arm's heat d of joint 2 is ahead of RMS torque, cross-validated by file.

    A twin for each fold and seed: some minutes.
    """
    from dataclasses import asdict

    from fleet.files import cache_folder
    from scenarios.studies.real_logs import CONFIG
    from scenarios.studies.verdict.log_questions import QUESTIONS, answers, judged_windows

    config = CONFIG.changed(window=window)
    recordings = options.recordings_of(log, skip_damaged)
    found = {}
    with progress_bar() as progress:
        for seed in range(seeds):
            windows = judged_windows(recordings, seed, config=config, folder=cache_folder(), progress=progress)
            found[seed] = answers(windows)
    if not found[0]:
        raise FleetError("No question has an answer: each needs windows of both kinds, also in two files. Add logs.")
    if as_json:
        print_json({str(s): {q: asdict(answer) for q, answer in by.items()} for s, by in found.items()})
        return
    caption = "[95 % interval, bootstrap over files]; lead: AUROC minus that of RMS torque"
    for question in QUESTIONS:
        if question not in found[0]:
            say(f"Left out: {question}; it needs windows of both kinds, also in two files.")
    for question, first in found[0].items():
        title = f"{question}: {first.events} of {first.windows} windows, in {first.files_with} of {first.files} files"
        table = plain_table("seed", "score", "AUROC", "lead", title=title, caption=caption)
        for seed, by_question in found.items():
            answer = by_question[question]
            for name, auroc in answer.auroc.items():
                lead = interval_text(answer.lead[name]) if name in answer.lead else ""
                table.add_row(str(seed), name, interval_text(auroc), lead)
        out_console.print(table)


def readings_table(card: dict[str, Any], question: str, title: str) -> Table:  # JSON
    """Mean over arms and seeds, with intervals of AUROC and of the false alarms."""
    from scenarios.studies.verdict.readings import ALPHA, summary

    caption = (
        f"{len(card['arms'])} arms and seeds. Hits and false alarms (new work, new light motion) of a verdict at "
        f"{ALPHA:.0%}, calibrated on held-out jobs. [95 % interval over the arms]"
    )
    table = plain_table("score", "AUROC", "AUPRC", "ρ", "hits", "work", "light", title=title, caption=caption)
    for reading, measured in summary(card, question):
        first, *others = (measured[m] for m in ("auroc", "auprc", "spearman", "hits", "false_work", "false_light"))
        table.add_row(reading, interval_text(first), *(_short(each.mean) for each in others))
    return table


def interval_text(found: "Interval") -> str:
    """`.997 [.995, .999]`."""
    return _short(found.mean) + ("" if found.low != found.low else f" [{_short(found.low)}, {_short(found.high)}]")


def _short(value: float) -> str:
    return f"{value:.3f}".replace("0.", ".", 1)
