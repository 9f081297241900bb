"""`thermofleet twin identify`, `generate`, `recover` and `export`.

`thermofleet twin verdict`.

`thermofleet twin train`, `score` and `report`, and the list of the `twin` commands.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fleet.errors import FleetError
from fleet.job import BOUNDS
from fleet.robot import POSTURES
from scenarios.cli import options
from scenarios.cli.from_fields import From, Given
from scenarios.cli.terminal import echo, out_console, print_json, print_wide, progress_bar, say
from scenarios.result_folder import check_file, check_overwrite, disk_errors
from scenarios.show.table import Table
from scenarios.spec.load import load
from scenarios.spec.parse import choose
from twin.thermal.identify import AMBIENT_C
from twin.vae.config import TwinConfig

if TYPE_CHECKING:
    from twin.thermal.identify import Identified
    from twin.vae.measures import Features
    from twin.vae.twin import Twin
    from twin.verdict import Rule


ArmOfScenario = Annotated[str | None, typer.Option("--arm", help="Arm of the scenario; default: the first.")]
TwinsOption = Annotated[
    Path | None, typer.Option("--twins", help="A folder of twins; default: the scenario's own, from the cache.")
]
FormatOption = Annotated[str, typer.Option("--format", help="parquet or csv.")]
SeedOption = Annotated[int, options.number("Random seed.", 0, options.MAX_SEED)]


def identify_command(
    log: Annotated[Path, typer.Option("--log", help="A log with motor temperatures, or a folder of logs of one arm.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the result, rc.json.")] = None,
    arm: Annotated[str, typer.Option(help="Name of the arm.", callback=options.check_name)] = "arm",
    ambient: Annotated[
        float | None, options.number(f"Ambient temperature, °C; default: {AMBIENT_C:g} is assumed.", -40, 60)
    ] = None,
    skip_damaged: options.DamagedOption = False,
    overwrite: options.OverwriteOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Identify an arm's thermal network from its own logs: parameters with 95 % intervals, and the residual.

    A day of logs takes half a minute to a minute.
    """
    from twin.thermal.checkpoint import CARD, save
    from twin.thermal.identify import identify

    if out is not None and out.exists():
        if not out.is_dir():
            raise FleetError(f"Cannot write to '{out}': it is a file; --out needs a folder.")
        check_overwrite(out / CARD, overwrite)
    ambient_c = AMBIENT_C if ambient is None else ambient
    recordings = options.recordings_of(log, skip_damaged)
    with progress_bar(kept="") as progress:
        progress("identifying", 0.0)
        network = identify(recordings, arm=arm, ambient_c=ambient_c)
    if out is not None:
        save(network, out)
    if as_json:
        card: dict[str, object] = {"arm": arm, "version": network.version, "data_hash": network.data_hash}
        card |= {"out": None if out is None else str(out), "ambient_c": ambient_c, "rms_k": network.rms_k}
        card["parameters"] = [{**vars(p), "informed": p.informed} for p in network.parameters]
        print_json(card)
        return
    out_console.print(parameter_table(network))
    worst = sorted(max(rms) for rms in network.rms_k.values())
    residual = f"median {worst[len(worst) // 2]:.2f} K, largest {worst[-1]:.2f} K"
    say(f"Residual at the worst joint of a recording: {residual}.", out_console)
    advice = "" if ambient is not None else "; give another one with --ambient"
    say(f"Ambient temperature assumed: {ambient_c:g} °C{advice}.", out_console)
    say("Nothing was written; --out FOLDER keeps it." if out is None else f"Written to {out}.", out_console)


def parameter_table(network: "Identified") -> Table:
    """The parameters of an identified thermal network with their intervals."""
    caption = f"version {network.version}, data {network.data_hash}; informed: whether the logs say more than the prior"
    rows = tuple(
        (
            p.name,
            "–" if p.joint is None else str(p.joint),
            *(f"{v:.4g}" for v in (p.value, p.low, p.high, p.prior)),
            "yes" if p.informed else "no",
        )
        for p in network.parameters
    )
    head = ("parameter", "joint", "value", "95 % from", "to", "prior", "informed")
    return Table(head=head, rows=rows, notes=(caption,))


def generate_command(
    scenario: options.ScenarioArg,
    out: Annotated[Path, typer.Option(help="Folder of the motions and generated.json.")] = Path("runs/generated"),
    arm: ArmOfScenario = None,
    twins: TwinsOption = None,
    count: Annotated[int, options.number("Number of motions.", 1, 10_000)] = 20,
    strength: Annotated[
        float, options.number("Perturbation in posterior standard deviations; 0 reconstructs.", 0, 100, "--s")
    ] = 1.0,
    seed: SeedOption = 0,
    format_: FormatOption = "parquet",
    overwrite: options.OverwriteOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Generate new motion near known motion: inside the limits, predicted to stay cool, executed in the simulator.

    Takes about 20 s once the arm's twin is in the cache.
    """
    from scenarios.motion.generate import generate
    from scenarios.motion.recover import GENERATED, Format, generated_summary, known_arm, save_generated
    from scenarios.result_folder import check_free

    chosen, format_name = load(scenario), choose("format", format_, Format)
    check_free(out, GENERATED, overwrite=overwrite)
    with progress_bar() as progress:
        known = known_arm(chosen, arm, twin=twin_of(twins, arm or chosen.arms[0].name), progress=progress)
        how = {
            "s": strength,
            "count": count,
            "seed": seed,
            "verification": known.verification,
            "fixtures": chosen.fixtures,
        }
        made = generate(known.twin, known.arm, known.sources, **how, progress=partial(progress, "generating"))
    save_generated(made, out, format=format_name, overwrite=overwrite)
    if as_json:
        print_json({"out": str(out), **generated_summary(made, format_name)})
        return
    reasons = ", ".join(f"{reason} {times}" for reason, times in made.rejected.items()) or "none"
    cool = f"{made.truly_cool:.1%} truly stay below {made.verification.cool_c:g} °C"
    say(f"{len(made.motions)} motions of {made.arm} in {out}; {cool}; rejected: {reasons}.", out_console)
    if len(made.motions) < count:
        say(f"Only {len(made.motions)} of {count} passed; choose a smaller --s or lighter work.")


def recover_command(
    scenario: options.ScenarioArg,
    out: Annotated[Path, typer.Option(help="Folder of the temperatures and recovery.json.")] = Path("runs/recovery"),
    arm: ArmOfScenario = None,
    twins: TwinsOption = None,
    payload: Annotated[float, options.number("Payload held, kg.", 0, 100)] = 2.0,
    posture: Annotated[str, typer.Option(help=f"{', '.join(POSTURES)}, or seven angles in degrees.")] = "raised",
    warm: Annotated[float, options.number("Temperature of the hottest motor at the start, °C.", -40, 200)] = 50.0,
    hold_s: Annotated[
        float, options.number("Remaining time to hold, s.", 0, BOUNDS["dwell_s"].high, "--hold", above=True)
    ] = 600.0,
    seed: SeedOption = 0,
    format_: FormatOption = "parquet",
    overwrite: options.OverwriteOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Find a nearby posture in which a warm arm holds its payload with less load; execute both in the simulator.

    Takes about 20 s once the arm's twin is in the cache.
    """
    from fleet.arm.model import ArmModel
    from scenarios.motion.recover import (
        RECOVERY,
        Format,
        Nearby,
        check_hold,
        check_hold_time,
        hold_until,
        known_arm,
        parse_posture,
        recover,
        recovery_summary,
        save_recovery,
    )
    from scenarios.result_folder import check_free

    chosen, format_name = load(scenario), choose("format", format_, Format)
    spec = chosen.arms[0 if arm is None else chosen.index_of(arm)]
    model = ArmModel(spec.robot())
    q = parse_posture(posture, model.position_range)
    check_free(out, RECOVERY, overwrite=overwrite)
    check_hold(model, q, payload)  # before the training
    check_hold_time(hold_s, Nearby())
    with progress_bar() as progress:
        known = known_arm(chosen, spec.name, twin=twin_of(twins, spec.name), progress=progress)
        progress("recovering", 0.0)
        start_c = hold_until(known.arm, q, payload, ambient_c=known.verification.ambient_c, until_c=warm)
        how = {
            "start_c": start_c,
            "verification": known.verification,
            "hold_s": hold_s,
            "fixtures": chosen.fixtures,
            "seed": seed,
        }
        recovery = recover(known.twin, known.arm, q, payload, **how)
    save_recovery(recovery, out, format=format_name, overwrite=overwrite)
    if as_json:
        print_json({"out": str(out), **recovery_summary(recovery)})
        return
    hot = recovery.hottest
    say(
        f"Joint {hot + 1} goes from {recovery.with_c[0, hot]:.1f} °C to {recovery.with_c[-1, hot]:.1f} °C in "
        f"{hold_s:g} s; without the new posture to {recovery.without_c[-1, hot]:.1f} °C. The tool moves "
        f"{recovery.tool_m:.2f} m. Written to {out}.",
        out_console,
    )


def export_command(
    twins: options.TwinsArg,
    out: Annotated[Path, typer.Option(help="A file that ends in .onnx.")] = Path("twin.onnx"),
    arm: options.WhichOption = None,
    overwrite: options.OverwriteOption = False,
) -> None:
    """Export a twin as ONNX, for scoring without Python; needs the extra onnx, which `make` installs."""
    if out.suffix != ".onnx":
        raise FleetError(f"--out must name a file that ends in .onnx (got '{out}').")
    check_overwrite(out, overwrite)
    from scenarios.prepare.twins import open_twin
    from twin.vae.onnx import export_onnx

    twin = open_twin(twins, arm)
    say(f"Twin of {twin.arm}, version {twin.version}, written to {export_onnx(twin, out)}.", out_console)


def twin_of(folder: Path | None, arm: str) -> "Twin | None":
    """The stored twin of an arm; None without a folder."""
    from scenarios.prepare.twins import open_twin

    return None if folder is None else open_twin(folder, arm)


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

    from scenarios.prepare.twins import open_twin
    from scenarios.show.twin_scores import job_rows, jobs_of_arm, log_rows, render, with_verdicts
    from twin.vae.measures import Features
    from twin.verdict import Rule, log_features

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
    from scenarios.motion.latent_map import verdict_png

    png = verdict_png(rule, features)
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as draft:
            draft.write_bytes(png)


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
    from scenarios.prepare.twins import TWINS, save_twins, train_arms, train_log
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
    from scenarios.prepare.twins import open_twin
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
    from scenarios.prepare.twins import LOG_INPUT

    base = TwinConfig.quick() if size == "quick" else TwinConfig()
    try:
        return base.changed(**(LOG_INPUT if of_log else {}) | given)
    except ValueError as error:
        option = re.sub(r"TwinConfig\.(\w+)", lambda field: f"--{field[1].replace('_', '-')}", str(error), count=1)
        raise FleetError(option.replace("--rate-hz", "--rate")) from error


def quality_table(twin: dict[str, Any]) -> Table:  # JSON of twins.json
    """Fit of each network of a twin, with the version and the data of the twin."""
    note = f"data {twin['data_hash']}, seed {twin['seed']}, calibrated on {twin['calibrated_on']} held-out jobs"
    title = f"Twin of {twin['arm']}: version {twin['version']}"
    rows = tuple(
        (
            fit["name"].replace("_", " "),
            f"{fit['elbo']:.1f}",
            f"{fit['kl']:.2f}",
            str(fit["active_units"]),
            f"{fit['mean_squared_error']:.3f}",
        )
        for fit in twin["networks"]
    )
    head = ("network", "ELBO, nat", "KL, nat", "active units", "MSE, σ²")
    return Table(head=head, rows=rows, caption=title, notes=(note,))
