"""`thermofleet study`: studies of a twin over its life, each with a result file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.terminal import out_console, plain_table, print_json, progress_bar, say
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
    from scenarios.show.page import Table

Name = Literal["transfer", "features", "augmentation", "drift"]


def study_command(
    name: Annotated[str, typer.Argument(help="transfer, features, augmentation or drift.")],
    seeds: Annotated[int, options.number("Number of seeds; each draws its own arms and jobs.", 1, 1000)] = 3,
    first_seed: Annotated[int, options.number("First seed.", 0, options.MAX_SEED)] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Smaller networks and fewer jobs: minutes per seed.")] = False,
    log: options.LogOption = None,
    skip_damaged: options.DamagedOption = False,
    out: Annotated[
        Path | None, typer.Option(help="Result file; default: runs/study-NAME.json.", show_default=False)
    ] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Study a twin over its life, and write every measurement to a JSON file.

    transfer: one arm's twin as the start for another arm; with --log, for a real arm.
    features: its latent as input of regressions of temperature, payload and friction.
    augmentation: its synthetic cool motion as training data of a regressor.
    drift: when it notices wear or weaker cooling, and what retraining costs.

    With --quick a seed takes 10 s (features) to 60 s (transfer) of one core;
    without it, many times as long. An interruption keeps nothing.
    """
    from scenarios.extras import require_extra

    chosen = choose("study", name, Name)
    if log is not None and chosen != "transfer":
        raise FleetError(f"--log belongs to the study 'transfer' (got '{chosen}'); leave it out.")
    require_extra("twin")
    from scenarios.result_folder import check_writable
    from scenarios.studies.lifetime.results import study_result, write_result

    given, file = range(first_seed, first_seed + seeds), out or Path(f"runs/study-{chosen}.json")
    check_writable(file)
    recordings = None if log is None else options.recordings_of(log, skip_damaged)
    with progress_bar(kept="") as progress:
        size, rows, tables = _run(chosen, given, quick, recordings, progress)
    options_given = (f" --log {log.name}" if log else "") + " --quick" * quick
    command = f"thermofleet study {chosen}{options_given} --seeds {seeds} --first-seed {first_seed}"
    result = study_result(chosen, given, size, rows, command)
    write_result(result, file)
    if as_json:
        print_json(result)
        return
    for table in tables:
        shown = plain_table(*table.headings, title=table.caption)
        for row in table.rows:
            shown.add_row(*row)
        out_console.print(shown)
    say(f"Written to {file}.", out_console)


def _run(name: Name, seeds: range, quick: bool, recordings: Any, progress: Any) -> "tuple[Any, Any, tuple[Table, ...]]":
    """Size, rows and tables of a study (Any: those of each study have their own types)."""
    from scenarios.studies.lifetime import tables

    if name == "transfer":
        from scenarios.studies.lifetime.arm_transfer import TransferSize, arm_transfer

        size = TransferSize.quick() if quick else TransferSize()
        if recordings is not None:
            from scenarios.studies.lifetime.log_transfer import log_transfer

            cells = log_transfer(recordings, seeds, size, progress=progress)
        else:
            cells = arm_transfer(seeds, size, progress=progress)
        return size, cells, tables.transfer_tables(cells)
    if name == "features":
        from scenarios.studies.lifetime.latent_features import FeatureSize, latent_features

        size = FeatureSize.quick() if quick else FeatureSize()
        estimates = latent_features(seeds, size, progress=progress)
        return size, estimates, tables.feature_tables(estimates)
    if name == "augmentation":
        from scenarios.studies.lifetime.augmentation import AugmentationSize, augmentation

        size = AugmentationSize.quick() if quick else AugmentationSize()
        fitted = augmentation(seeds, size, progress=progress)
        return size, fitted, tables.augmentation_tables(fitted)
    from scenarios.studies.lifetime.drift import DriftSize, drift

    size = DriftSize.quick() if quick else DriftSize()
    lives = drift(seeds, size, progress=progress)
    return size, lives, tables.drift_tables(lives, size)
