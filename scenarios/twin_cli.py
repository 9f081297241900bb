"""`thermofleet twin …`: train the twin of an arm, score with it, export it, and report what it is worth."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from fleet.errors import FleetError, nearest
from scenarios.load import load
from scenarios.terminal import out_console, progress_bar, say
from scenarios.twin_commands import export_command, generate_command, identify_command, recover_command
from scenarios.twin_options import (
    ArmOption,
    DamagedOption,
    JsonOption,
    LogOption,
    OverwriteOption,
    ScenarioArg,
    TwinsArg,
    WhichOption,
    one_source,
    recordings_of,
)

twin_app = typer.Typer(
    help="The digital twin of an arm: an LSTM variational autoencoder of its cool motion, and what it tells.",
    no_args_is_help=True,
)


@twin_app.command("train")
def train_command(
    scenario: ScenarioArg = None,
    log: LogOption = None,
    out: Annotated[Path, typer.Option(help="Folder for the twins.")] = Path("runs/twins"),
    arm: ArmOption = None,
    size: Annotated[str | None, typer.Option(help="quick or full; default what the scenario says.")] = None,
    scope: Annotated[str | None, typer.Option(help="joint (a network per joint) or arm (one of 21 channels).")] = None,
    kind: Annotated[str | None, typer.Option(help="vae or ae (a plain autoencoder, as a baseline).")] = None,
    latent: Annotated[int | None, typer.Option(help="Units of the latent.")] = None,
    hidden: Annotated[int | None, typer.Option(help="Units of each LSTM.")] = None,
    layers: Annotated[int | None, typer.Option(help="Layers of each LSTM.")] = None,
    window: Annotated[int | None, typer.Option(help="Samples per window.")] = None,
    rate_hz: Annotated[float | None, typer.Option("--rate", help="Samples per second inside a window.")] = None,
    epochs: Annotated[int | None, typer.Option(help="Passes over the training windows.")] = None,
    restarts: Annotated[int | None, typer.Option(help="Trainings per network; the best ELBO stays.")] = None,
    beta: Annotated[float | None, typer.Option(help="Weight of the KL term.")] = None,
    max_windows: Annotated[int | None, typer.Option(help="Training uses at most so many windows.")] = None,
    cool: Annotated[
        float, typer.Option(help="--log: what motors 1 to 4 stay below is normal, °C; wrists do not count.")
    ] = 40.0,
    allow_collapse: Annotated[
        bool, typer.Option("--allow-collapse", help="Keep a twin whose latent says nothing, as a baseline.")
    ] = False,
    seed: Annotated[
        int | None, typer.Option(help="Of weights and training; 0 or more. By default the scenario's, for logs 0.")
    ] = None,
    skip_damaged: DamagedOption = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train the twins of a scenario's arms, or of the arm whose logs are given; arms are trained side by side.

    Quick takes up to a minute per arm and core, full some four minutes; what is in the cache, as the fleet's own
    twins after a run of the scenario, takes seconds. Of logs nothing is kept but what is written to --out.
    """
    chosen = one_source(scenario, log)
    if seed is not None and seed < 0:
        raise FleetError(f"--seed must be 0 or more (got {seed}).")
    if size not in (None, "quick", "full"):
        raise FleetError(f"No size '{size}'{nearest(size or '', ('quick', 'full'))}")
    if log is not None and arm is not None:
        raise FleetError("--arm chooses among a scenario's arms; a log has one arm, so leave it out with --log.")
    fields = {
        "scope": scope,
        "kind": kind,
        "latent": latent,
        "hidden": hidden,
        "layers": layers,
        "window": window,
        "rate_hz": rate_hz,
        "epochs": epochs,
        "restarts": restarts,
        "beta": beta,
        "max_windows": max_windows,
        "allow_collapse": allow_collapse or None,
    }
    given = {name: value for name, value in fields.items() if value is not None}
    from scenarios.folder import check_free, new_folder
    from scenarios.twin_training import TWINS, save_twins, train_arms, train_log

    check_free(out, overwrite=overwrite, kind=TWINS)
    # What is learned of a log is kept in --out alone.
    bar = progress_bar() if log is None else progress_bar(kept="")
    with in_options(), bar as progress, new_folder(out, overwrite=overwrite, kind=TWINS) as folder:
        if log is not None:
            config = config_of("quick" if size is None else size, given, of_log=True)
            twins = [train_log(recordings_of(log, skip_damaged), config, seed or 0, cool_c=cool, progress=progress)]
            source = f"log {log}"
        else:
            of_scenario = load(str(chosen))
            config = config_of(size or of_scenario.twin.size, given)
            arms = range(len(of_scenario.arms)) if arm is None else [of_scenario.index_of(arm)]
            twins = train_arms(of_scenario, list(arms), config, seed, progress)
            source = f"scenario {of_scenario.name}"
        card = save_twins(twins, folder, source)
    if as_json:
        typer.echo(json.dumps({"out": str(out), **card}, indent=1))
        return
    for twin in card["twins"]:
        out_console.print(quality_table(twin))
    say(f"Written to {out}; score with: thermofleet twin score {out}", out_console)


@twin_app.command("score")
def score_command(
    twins: TwinsArg,
    scenario: Annotated[str | None, typer.Argument(help="Score this scenario's jobs; or use --log.")] = None,
    log: LogOption = None,
    arm: WhichOption = None,
    format_: Annotated[str, typer.Option("--format", help="table, csv or json.")] = "table",
    skip_damaged: DamagedOption = False,
) -> None:
    """Score every job of a scenario, or a log window by window; every line can be traced to the twin's version.

    Takes seconds, and half a minute where the jobs have to be planned first.
    """
    one_source(scenario, log)
    if format_ not in ("table", "csv", "json"):
        raise FleetError(f"No format '{format_}'{nearest(format_, ('table', 'csv', 'json'))}")
    from scenarios.twin_scores import job_rows, render, window_rows
    from scenarios.twin_training import open_twin

    if log is not None:
        twin = open_twin(twins, arm)
        rows = [row for recording in recordings_of(log, skip_damaged) for row in window_rows(twin, recording)]
    else:
        chosen = load(str(scenario))
        twin = open_twin(twins, arm)
        with progress_bar() as progress:
            rows = job_rows(twin, chosen, progress)
    shown = render(rows, format_, caption=f"twin of {twin.arm}, version {twin.version}, data {twin.data_hash}")
    if isinstance(shown, str):
        typer.echo(shown, nl=False)
    else:
        out_console.print(shown)


twin_app.command("identify")(identify_command)
twin_app.command("generate")(generate_command)
twin_app.command("recover")(recover_command)
twin_app.command("export")(export_command)


@contextmanager
def in_options() -> Iterator[None]:
    """What a collapse or a log that teaches nothing says one may change, as options."""
    from twin.cool import NothingCool, TooShort
    from twin.train import CollapsedPosterior

    try:
        yield
    except TooShort as error:
        raise FleetError(f"{error.fact} Log for longer, or take a smaller --window.") from error
    except NothingCool as error:
        raise FleetError(f"{error.fact} Raise --cool, or log lighter work.") from error
    except CollapsedPosterior as error:
        names = r"\b(epochs|max_windows|allow_collapse|beta)\b"
        raise FleetError(re.sub(names, lambda n: f"--{n[1].replace('_', '-')}", str(error))) from error


@twin_app.command("report")
def report_command(
    scenario: ScenarioArg = None,
    log: LogOption = None,
    out: Annotated[Path, typer.Option(help="Folder for report.html, report.json and the pictures.")] = Path(
        "runs/twin_report"
    ),
    arm: Annotated[str | None, typer.Option(help="Which arm of the scenario; default the first.")] = None,
    seeds: Annotated[int, typer.Option(help="How many; figures with a spread are repeated under each.")] = 3,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer jobs, smaller trainings: some 20 min on two cores.")
    ] = False,
    skip_damaged: DamagedOption = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """The paper's pictures and tables as one HTML page that opens offline, with PNGs and report.json.

    From a scenario: one arm's study of 1 200 test jobs with every rival trained anew under each seed, which takes
    hours; --quick takes 200 jobs, small trainings and fewer rivals. The folder holds some MB. Twins and finished
    sections are kept in the cache, so the same command goes on where it was interrupted. A section that cannot be
    computed says why in the page, and the command leaves with code 1.
    """
    chosen = one_source(scenario, log)
    if seeds < 1:
        raise FleetError(f"--seeds must be 1 or more (got {seeds}).")
    if log is not None and arm is not None:
        raise FleetError("--arm chooses among a scenario's arms; a log has one arm, so leave it out with --log.")
    from scenarios.folder import check_free, new_folder
    from scenarios.twin_lab import QUICK, Size
    from scenarios.twin_report import REPORT, report_logs, report_scenario, write

    check_free(out, overwrite=overwrite, kind=REPORT)
    command = f"thermofleet twin report {f'--log {log.name}' if log else chosen} --seeds {seeds}{' --quick' * quick}"
    bar = progress_bar(kept="Twins and sections already made are")
    with bar as progress, new_folder(out, overwrite=overwrite, kind=REPORT) as folder:
        told: dict[str, Any] = {"seeds": range(seeds), "command": command, "progress": progress}
        if log is not None:
            sections = report_logs(recordings_of(log, skip_damaged), quick=quick, **told)
            title = f"What a twin makes of the logs in {log.name}"
        else:
            of_scenario = load(str(chosen))
            index = 0 if arm is None else of_scenario.index_of(arm)
            sections = report_scenario(of_scenario, index, size=QUICK if quick else Size(), **told)
            title = f"The twin of {of_scenario.arms[index].name} in {of_scenario.name}"
        card = write(sections, folder, title=title, lead=("Every section says what was found and how.",))
    if as_json:
        typer.echo((out / "report.json").read_text(encoding="utf-8"), nl=False)
    else:
        say(f"Open {out / 'report.html'} in a browser.", out_console)
    if card["failed"]:
        reasons = "; ".join(f"{key}: {why}" for key, why in card["failed"].items())
        say(f"{len(card['failed'])} of {len(sections)} sections could not be computed ({reasons})")
        raise typer.Exit(1)


def config_of(size: str, given: dict[str, Any], *, of_log: bool = False) -> Any:
    """The configuration of a size with what was given on the command line.

    Raises:
        FleetError: an option that cannot be, in its own name.
    """
    from dataclasses import replace

    from scenarios.twin_training import log_config
    from twin.model import TwinConfig

    base = TwinConfig.quick() if size == "quick" else TwinConfig()
    # Windows smaller than the usual step between them would leave out what lies between.
    window = max(1, given.get("window", base.window))
    base = replace(base, stride=min(base.stride, window), score_stride=min(base.score_stride, window))
    try:
        config = replace(log_config(base) if of_log else base, **given)
    except ValueError as error:
        option = re.sub(r"TwinConfig\.(\w+)", lambda found: f"--{found[1].replace('_', '-')}", str(error), count=1)
        raise FleetError(option.replace("--rate-hz", "--rate")) from error
    return config


def quality_table(twin: dict[str, Any]) -> Table:
    """How well each network of a twin knows its data, with what names it."""
    table = Table(
        title=f"Twin of {twin['arm']}: version {twin['version']}",
        caption=f"data {twin['data_hash']}, seed {twin['seed']}, calibrated on {twin['calibrated_on']} held-out jobs",
        caption_justify="left",
        box=None,
        pad_edge=False,
        title_justify="left",
    )
    for head in ("network", "ELBO, nat", "KL, nat", "active units", "MSE, σ²"):
        table.add_column(head, justify="left" if head == "network" else "right")
    for fit in twin["networks"]:
        table.add_row(
            fit["name"].replace("_", " "),
            f"{fit['elbo']:.1f}",
            f"{fit['kl']:.2f}",
            str(fit["active_units"]),
            f"{fit['mean_squared_error']:.3f}",
        )
    return table
