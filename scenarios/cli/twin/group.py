"""`thermofleet twin train`, `score` and `report`, and the list of the `twin` commands."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.table import Table

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.from_fields import From, Given
from scenarios.cli.terminal import echo, out_console, plain_table, print_json, print_wide, progress_bar, say
from scenarios.cli.twin.motion import export_command, generate_command, identify_command, recover_command
from scenarios.cli.twin.verdict import verdict_command
from scenarios.load import load
from scenarios.schema_errors import choose
from twin.vae.config import TwinConfig

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
    from scenarios.show.twin_scores import job_rows, jobs_of_arm, render, window_rows

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
twin_app.command("verdict")(verdict_command)


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
    out: Annotated[Path, typer.Option(help="Folder of report.html and report.json.")] = Path("runs/twin_report"),
    arm: Annotated[str | None, typer.Option(help="Arm of the scenario; default: the first.")] = None,
    seeds: Annotated[int, options.number("Number of trainings, whose results give the spread.", 1, 100)] = 3,
    skip_damaged: options.DamagedOption = False,
    overwrite: options.OverwriteOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Write the paper's figures and tables as one offline HTML page, with all numbers in report.json.

    RMS torque and an untrained network stand beside each result of the twin. A
    scenario takes up to two minutes, a day of logs a minute for each seed. A
    chapter that fails gives its reason in the page, and the exit code is 1.
    """
    check_source(scenario, log, arm)
    from fleet.files import cache_folder
    from scenarios.result_folder import check_free, new_folder
    from scenarios.show import twin_report

    check_free(out, twin_report.REPORT, overwrite=overwrite)
    bar = progress_bar(kept="Twins already trained are")
    with bar as progress, new_folder(out, twin_report.REPORT, overwrite=overwrite) as folder:
        how: Any = {"size": twin_report.SIZE, "folder": cache_folder(), "progress": progress}  # arguments
        if log is not None:
            title, source = f"The twin of the logs in {log.name}", f"--log {log.name}"
            subjects = twin_report.log_subjects(options.recordings_of(log, skip_damaged), range(seeds), **how)
        else:
            chosen = load(str(scenario))
            index = 0 if arm is None else chosen.index_of(arm)
            name = chosen.arms[index].name
            title, source = f"The twin of {name} in {chosen.name}", f"{scenario} --arm {name}"
            subjects = twin_report.scenario_subjects(chosen, index, range(seeds), **how)
        chapters = twin_report.chapters_of(subjects, twin_report.SIZE, progress)
        origin = {"command": f"thermofleet twin report {source} --seeds {seeds}", **twin_report.origin_of(subjects)}
        card = twin_report.write(chapters, origin, folder, title)
    if as_json:
        echo((out / twin_report.CARD).read_text(encoding="utf-8"), nl=False)
    else:
        say(f"Open {out / twin_report.PAGE} in a browser.", out_console)
    if card["failed"]:
        reasons = "; ".join(f"{key}: {why}" for key, why in card["failed"].items())
        say(f"{len(card['failed'])} of {len(chapters)} chapters could not be computed ({reasons})")
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
