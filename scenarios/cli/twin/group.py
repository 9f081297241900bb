"""`thermofleet twin train`, `score` and `report`, and the list of the `twin` commands."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.table import Table

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.from_fields import From, Given
from scenarios.cli.studies.sweep import parsimony_command, sweep_command
from scenarios.cli.terminal import echo, out_console, plain_table, print_json, print_wide, progress_bar, say
from scenarios.cli.twin.motion import export_command, generate_command, identify_command, recover_command
from scenarios.cli.twin.verdict import questions_command, readings_command, sides_command, verdict_command
from scenarios.load import load
from scenarios.schema_errors import choose
from twin.vae.config import TwinConfig

if TYPE_CHECKING:  # slow to import
    from scenarios.studies.shift_reliability import Awards

twin_app = typer.Typer(
    help="Train, score and use the digital twin of an arm: an LSTM variational autoencoder of its cool motion.",
    no_args_is_help=True,
    add_completion=False,
)


@twin_app.command("train")
def train_command(
    given: Annotated[Given, From(TwinConfig)],
    scenario: options.ScenarioOrLog = None,
    log: options.LogOption = None,
    out: Annotated[Path, typer.Option(help="Folder of the twins.")] = Path("runs/twins"),
    arm: options.ArmOption = None,
    size: Annotated[str | None, typer.Option(help="quick or full; default: as the scenario says.")] = None,
    cool: Annotated[
        float,
        options.number("--log: temperature limit of joints 1 to 4 for training data, °C.", 0, 200),
    ] = 40.0,
    hold_out: Annotated[
        float, options.number("--log: share of the cool recordings held out to calibrate verdicts.", 0, 0.9)
    ] = 0.3,
    seed: Annotated[
        int | None,
        options.number("Seed of weights and training. Default: the scenario's, for logs 0.", 0, options.MAX_SEED),
    ] = None,
    skip_damaged: options.DamagedOption = False,
    overwrite: options.OverwriteOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Train the twins of a scenario's arms, or the twin of the arm whose logs are given.

    The quick size takes up to a minute per arm and core, the full size four.
    Cached twins take seconds. A twin of logs is kept in --out only.
    """
    check_source(scenario, log, arm)
    if size is not None:
        choose("size", size, Literal["quick", "full"])
    from scenarios.prepare.twin_folder import TWINS, save_twins, train_arms, train_log
    from scenarios.result_folder import check_free, new_folder

    check_free(out, TWINS, overwrite=overwrite)
    bar = progress_bar() if log is None else progress_bar(kept="")  # the twin of a log is not cached
    with explain_in_options(), bar as progress, new_folder(out, TWINS, overwrite=overwrite) as folder:
        if log is not None:
            config = config_of(size or "quick", given, of_log=True)
            recordings = options.recordings_of(log, skip_damaged)
            twins = [train_log(recordings, config, seed or 0, cool_c=cool, hold_out=hold_out, progress=progress)]
            source = f"log {log}"
        else:
            of_scenario = load(str(scenario))
            config = config_of(size or of_scenario.twin.size, given)
            arms = range(len(of_scenario.arms)) if arm is None else [of_scenario.index_of(arm)]
            twins = train_arms(of_scenario, list(arms), config, seed, progress)
            source = f"scenario {of_scenario.name}"
        card = save_twins(twins, folder, source)
    if as_json:
        print_json({"out": str(out), **card})
        return
    for twin in card["twins"]:
        out_console.print(quality_table(twin))
    say(f"Written to {out}; score with: thermofleet twin score {out}", out_console)


@twin_app.command("score")
def score_command(
    twins: options.TwinsArg,
    scenario: Annotated[str | None, typer.Argument(help="Score this scenario's jobs; or use --log.")] = None,
    log: options.LogOption = None,
    arm: options.WhichOption = None,
    format_: Annotated[str, typer.Option("--format", help="table, csv or json.")] = "table",
    skip_damaged: options.DamagedOption = False,
) -> None:
    """Score every job of a scenario, or a log window by window, with the version of the twin.

    Takes seconds, and half a minute if the jobs must be planned first.
    """
    check_source(scenario, log)
    choose("format", format_, Literal["table", "csv", "json"])
    from scenarios.prepare.twin_folder import open_twin
    from scenarios.report.score_table import job_rows, jobs_of_arm, render, window_rows

    chosen, twin = load(scenario) if scenario else None, open_twin(twins, arm)
    if chosen is not None:
        with progress_bar() as progress:
            rows = job_rows(twin, jobs_of_arm(twin, chosen, progress))
    else:
        recordings = options.recordings_of(Path(str(log)), skip_damaged)
        rows = [row for recording in recordings for row in window_rows(twin, recording)]
    shown = render(rows, format_, caption=f"twin of {twin.arm}, version {twin.version}, data {twin.data_hash}")
    if isinstance(shown, str):
        echo(shown, nl=False)
    else:
        print_wide(shown)


twin_app.command("identify")(identify_command)
twin_app.command("generate")(generate_command)
twin_app.command("recover")(recover_command)
twin_app.command("export")(export_command)
twin_app.command("sweep")(sweep_command)
twin_app.command("parsimony")(parsimony_command)
twin_app.command("verdict")(verdict_command)
twin_app.command("readings")(readings_command)
twin_app.command("sides")(sides_command)
twin_app.command("questions")(questions_command)


@twin_app.command("reliability")
def reliability_command(
    scenario: options.ScenarioArg,
    policies: Annotated[str, typer.Option(help="Policies, separated by commas.")] = "wspt,wspt_cool,least_difficulty",
    risk: Annotated[
        list[str] | None,
        typer.Option(help="Models of P, as in `thermofleet run`; may be repeated. Default: rc.", show_default=False),
    ] = None,
    seeds: Annotated[int, options.number("Number of seeds.", 1, 1000)] = 4,
    first_seed: Annotated[
        int, options.number("First seed; those from 10000 on were not used for tuning.", 0, options.MAX_SEED)
    ] = 10_000,
    fleets: Annotated[
        int, options.number("Number of fleets: draws of the arms' deviations (spread.seed).", 1, 100)
    ] = 3,
    as_json: options.JsonOption = False,
) -> None:
    """Compare P(saturation) and predicted peaks with the outcomes in simulated shifts.

    P is the probability that a motor is at or above the warning limit from two
    minutes after the start of a plan until its end, or that a fault ends the plan.
    A shift takes some seconds, training for each fleet up to a minute per arm.
    """
    from scenarios.prepare.fleet import RISK, RiskName
    from scenarios.studies.shift_reliability import awards_as_json, shift_reliability

    chosen, names = load(scenario), options.split_names(policies)
    found = {}
    with progress_bar() as progress:
        for kind in risk or [RISK]:
            found[kind] = shift_reliability(
                chosen,
                policies=names,
                seeds=range(first_seed, first_seed + seeds),
                fleets=fleets,
                risk=choose("risk", kind, RiskName),
                progress=progress,
            )
    if as_json:
        print_json(
            {kind: {name: awards_as_json(awards) for name, awards in rows.items()} for kind, rows in found.items()}
        )
        return
    shifts = f"{chosen.name}, {seeds} seeds from {first_seed}, {fleets} draws of the arms"
    for kind, rows in found.items():
        out_console.print(reliability_table(rows, f"P(saturation) by {kind} in the shift: {shifts}"))
        for name, awards in rows.items():
            if len(awards):
                out_console.print(reliability_diagram(awards, f"{kind}, {name}: stated and observed"))


def check_source(scenario: str | None, log: Path | None, arm: str | None = None) -> None:
    """Raise a FleetError unless either a scenario or a log is given, and --arm only with a scenario."""
    if (scenario is None) == (log is None):
        given = "neither" if scenario is None else "both"
        raise FleetError(f"Give either a scenario or --log FILE_OR_FOLDER (got {given}).")
    if log is not None and arm is not None:
        raise FleetError("--arm chooses among a scenario's arms; a log has one arm, so leave it out with --log.")


@contextmanager
def explain_in_options() -> Iterator[None]:
    """Reword training errors as FleetErrors that name the options of the command line."""
    from twin.vae.train import CollapsedPosterior

    try:
        yield
    except CollapsedPosterior as error:
        fields = r"\b(epochs|max_windows|allow_collapse|beta)\b"
        raise FleetError(re.sub(fields, lambda f: f"--{f[1].replace('_', '-')}", str(error))) from error


@twin_app.command("report")
def report_command(
    scenario: options.ScenarioOrLog = None,
    log: options.LogOption = None,
    out: Annotated[Path, typer.Option(help="Folder of report.html, report.json and the pictures.")] = Path(
        "runs/twin_report"
    ),
    arm: Annotated[str | None, typer.Option(help="Arm of the scenario; default: the first.")] = None,
    seeds: Annotated[int, options.number("Number of seeds; figures with a spread are repeated for each.", 1, 100)] = 3,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer jobs, smaller trainings: about 20 min on two cores.")
    ] = False,
    skip_damaged: options.DamagedOption = False,
    overwrite: options.OverwriteOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Write the paper's pictures and tables as one offline HTML page, with PNGs and report.json.

    For a scenario, one arm is studied on 1 200 test jobs, and every baseline is
    trained for each seed: hours. --quick uses 200 jobs and fewer, smaller trainings.
    After an interruption the same command continues from the cache.
    A section that fails gives its reason in the page, and the exit code is 1.
    """
    check_source(scenario, log, arm)
    from scenarios.result_folder import check_free, new_folder
    from scenarios.studies.report.build import REPORT, report_logs, report_scenario, write
    from scenarios.studies.report.context import QUICK, Size

    check_free(out, REPORT, overwrite=overwrite)
    command = f"thermofleet twin report {f'--log {log.name}' if log else scenario} --seeds {seeds}{' --quick' * quick}"
    bar = progress_bar(kept="Twins and sections already made are")
    with bar as progress, new_folder(out, REPORT, overwrite=overwrite) as folder:
        common: dict[str, Any] = {"seeds": range(seeds), "command": command, "progress": progress}  # arguments
        if log is not None:
            sections = report_logs(options.recordings_of(log, skip_damaged), quick=quick, **common)
            title = f"The twin of the logs in {log.name}"
        else:
            of_scenario = load(str(scenario))
            index = 0 if arm is None else of_scenario.index_of(arm)
            sections = report_scenario(of_scenario, index, size=QUICK if quick else Size(), **common)
            title = f"The twin of {of_scenario.arms[index].name} in {of_scenario.name}"
        card = write(sections, folder, title=title, lead=("Every section gives a result and the method.",))
    if as_json:
        echo((out / "report.json").read_text(encoding="utf-8"), nl=False)
    else:
        say(f"Open {out / 'report.html'} in a browser.", out_console)
    if card["failed"]:
        reasons = "; ".join(f"{key}: {why}" for key, why in card["failed"].items())
        say(f"{len(card['failed'])} of {len(sections)} sections could not be computed ({reasons})")
        raise typer.Exit(1)


def config_of(size: str, given: dict[str, Any], *, of_log: bool = False) -> TwinConfig:
    """The configuration of a size, with the options given on the command line (Any: one per field)."""
    from scenarios.prepare.twin_folder import LOG_INPUT

    base = TwinConfig.quick() if size == "quick" else TwinConfig()
    try:
        return base.changed(**(LOG_INPUT if of_log else {}) | given)
    except ValueError as error:
        option = re.sub(r"TwinConfig\.(\w+)", lambda field: f"--{field[1].replace('_', '-')}", str(error), count=1)
        raise FleetError(option.replace("--rate-hz", "--rate")) from error


def quality_table(twin: dict[str, Any]) -> Table:  # JSON of twins.json
    """Fit of each network of a twin, with the version and the data of the twin."""
    caption = f"data {twin['data_hash']}, seed {twin['seed']}, calibrated on {twin['calibrated_on']} held-out jobs"
    title = f"Twin of {twin['arm']}: version {twin['version']}"
    table = plain_table("network", "ELBO, nat", "KL, nat", "active units", "MSE, σ²", title=title, caption=caption)
    for fit in twin["networks"]:
        numbers = (
            f"{fit['elbo']:.1f}",
            f"{fit['kl']:.2f}",
            str(fit["active_units"]),
            f"{fit['mean_squared_error']:.3f}",
        )
        table.add_row(fit["name"].replace("_", " "), *numbers)
    return table


def reliability_table(rows: "dict[str, Awards]", title: str) -> Table:
    """Accuracy of P and peaks, one row for each policy and group of arms."""
    from scenarios.studies.shift_reliability import WARM_K, groups, verdict

    caption = f"warm: a motor within {WARM_K:g} K of the warning limit, or beyond it, at the award"
    columns = ("policy", "arms", "awards", "passed", "unknown", "ECE", "Brier", "AUROC", "peak RMS, K", "peak bias, K")
    table = plain_table(*columns, title=title, caption=caption)
    for policy, awards in rows.items():
        for group, part in groups(awards).items():
            v = verdict(part)
            if v is None:
                continue
            unknown = str(awards.unknown) if group == "all" else ""
            numbers = (
                f"{v.ece:.3f}",
                f"{v.brier:.3f}",
                f"{v.auroc:.3f}",
                f"{v.peak_rms_k:.2f}",
                f"{v.peak_bias_k:+.2f}",
            )
            table.add_row(policy, group, str(v.awards), str(v.passed), unknown, *numbers)
    return table


def reliability_diagram(awards: "Awards", title: str) -> Table:
    """The reliability diagram as a table, with Wilson intervals."""
    from twin.saturation.reliability import reliability

    bins = reliability(awards.p, awards.passed)
    table = plain_table("mean P", "share passed", "95 % interval", "awards", title=title)
    for p, share, low, high, count in zip(bins.mean_p, bins.share, bins.low, bins.high, bins.count, strict=True):
        table.add_row(f"{p:.3f}", f"{share:.3f}", f"{low:.3f} to {high:.3f}", str(count))
    return table
