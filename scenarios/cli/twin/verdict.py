"""`thermofleet twin verdict`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.terminal import echo, print_wide, progress_bar, say
from scenarios.load import load
from scenarios.result_folder import check_file, disk_errors
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
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
    from scenarios.show.twin_scores import job_rows, jobs_of_arm, log_rows, render, with_verdicts
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
    from scenarios.motion.latent_map import verdict_png

    png = verdict_png(rule, features)
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as draft:
            draft.write_bytes(png)
