"""`thermofleet twin identify`, `generate`, `recover` and `export`: what a twin is good for besides its scores."""

import json
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from fleet.errors import FleetError, nearest
from fleet.robot import POSTURES
from scenarios.load import load
from scenarios.terminal import out_console, progress_bar, say
from scenarios.twin_options import DamagedOption, JsonOption, OverwriteOption, TwinsArg, WhichOption, recordings_of
from twin.identified import AMBIENT_C

FORMATS = ("parquet", "csv")

FleetArg = Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")]
ArmOfScenario = Annotated[str | None, typer.Option("--arm", help="Which arm; default the first.")]
TwinsOption = Annotated[
    Path | None, typer.Option("--twins", help="A folder of twins; default the scenario's own, from the cache.")
]
FormatOption = Annotated[str, typer.Option("--format", help="parquet or csv.")]
SeedOption = Annotated[int, typer.Option(help="0 or more; the same seed gives the same.")]


def identify_command(
    log: Annotated[Path, typer.Option("--log", help="A log with motor temperatures, or a folder of logs of one arm.")],
    out: Annotated[Path | None, typer.Option(help="Folder for rc.json, to be predicted with.")] = None,
    arm: Annotated[str, typer.Option(help="The arm's name.")] = "arm",
    ambient: Annotated[
        float | None, typer.Option(help=f"Air around the arm, °C; {AMBIENT_C:g} is assumed unless you say.")
    ] = None,
    skip_damaged: DamagedOption = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """The arm's thermal network from its own logs: values with 95 % intervals, and what stays unexplained.

    A day of logs takes half a minute to a minute.
    """
    from twin.identify import identify
    from twin.rc_checkpoint import CARD, save

    if out is not None and out.exists():
        if not out.is_dir():
            raise FleetError(f"Cannot write to '{out}': it is a file; --out needs a folder.")
        if (out / CARD).exists() and not overwrite:
            raise FleetError(f"'{out}' holds an identified arm; give another --out, or --overwrite to replace it.")
    air_c = AMBIENT_C if ambient is None else ambient
    recordings = recordings_of(log, skip_damaged)
    with progress_bar(kept="") as progress:
        progress("identifying", 0.0)
        found = identify(recordings, arm=arm, ambient_c=air_c)
    if out is not None:
        save(found, out)
    if as_json:
        parameters = [{**vars(p), "informed": p.informed} for p in found.parameters]
        told: dict[str, Any] = {"arm": arm, "version": found.version, "data_hash": found.data_hash}
        told |= {"out": None if out is None else str(out), "ambient_c": air_c, "rms_k": found.rms_k}
        typer.echo(json.dumps({**told, "parameters": parameters}, indent=1))
        return
    caption = f"version {found.version}, data {found.data_hash}; told: whether the logs say more than the prior"
    table = Table(box=None, pad_edge=False, caption=caption, caption_justify="left")
    for head in ("parameter", "joint", "value", "95 % from", "to", "prior", "told"):
        table.add_column(head, justify="left" if head == "parameter" else "right", no_wrap=head == "parameter")
    for p in found.parameters:
        numbers = (f"{v:.4g}" for v in (p.value, p.low, p.high, p.prior))
        table.add_row(p.name, "–" if p.joint is None else str(p.joint), *numbers, "yes" if p.informed else "no")
    out_console.print(table)
    worst = {name: max(rms) for name, rms in found.rms_k.items()}
    middle = sorted(worst.values())[len(worst) // 2]
    left = f"median {middle:.2f} K, most {max(worst.values()):.2f} K"
    say(f"Unexplained at the worst joint of a recording: {left}.", out_console)
    mend = "" if ambient is not None else "; if yours was another, give it with --ambient"
    say(f"Air of {air_c:g} °C was taken as given{mend}.", out_console)
    say("Nothing was written; --out FOLDER keeps it." if out is None else f"Written to {out}.", out_console)


def generate_command(
    scenario: FleetArg,
    out: Annotated[Path, typer.Option(help="Folder for the motions and generated.json.")] = Path("runs/generated"),
    arm: ArmOfScenario = None,
    twins: TwinsOption = None,
    count: Annotated[int, typer.Option(help="Motions to hand out.")] = 20,
    strength: Annotated[
        float, typer.Option("--s", help="Perturbation in posterior standard deviations; 0 reconstructs.")
    ] = 1.0,
    seed: SeedOption = 0,
    format_: FormatOption = "parquet",
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """New motion near what an arm knows: inside its limits, predicted to stay cool, performed in the simulator.

    Takes some 20 s once the arm's twin is in the cache.
    """
    check_choices(seed, format_)
    if count < 1 or not strength >= 0:
        raise FleetError(f"--count must be 1 or more and --s 0 or more (got {count}, {strength:g}).")
    from scenarios.folder import check_free
    from scenarios.generate import generate
    from scenarios.known_arm import known_arm
    from scenarios.motion_files import GENERATED, generated_summary, save_generated

    chosen = load(scenario)
    check_free(out, overwrite=overwrite, kind=GENERATED)
    with progress_bar() as progress:
        known = known_arm(chosen, arm, twin=twin_of(twins, arm or chosen.arms[0].name), progress=progress)
        some = {"s": strength, "count": count, "seed": seed, "verification": known.verification}
        made = generate(known.twin, known.arm, known.sources, **some, progress=partial(progress, "generating"))
    how: Any = format_
    save_generated(made, out, format=how, overwrite=overwrite)
    if as_json:
        typer.echo(json.dumps({"out": str(out), **generated_summary(made, how)}, indent=1))
        return
    reasons = ", ".join(f"{reason} {times}" for reason, times in made.rejected.items()) or "none"
    cool = f"{made.truly_cool:.1%} truly stay below {made.verification.cool_c:g} °C"
    say(f"{len(made.motions)} motions of {made.arm} in {out}; {cool}; rejected: {reasons}.", out_console)
    if len(made.motions) < count:
        say(f"Only {len(made.motions)} of {count} passed; lower --s or give lighter work.")


def recover_command(
    scenario: FleetArg,
    out: Annotated[Path, typer.Option(help="Folder for the temperatures and recovery.json.")] = Path("runs/recovery"),
    arm: ArmOfScenario = None,
    twins: TwinsOption = None,
    payload: Annotated[float, typer.Option(help="What it holds, kg.")] = 2.0,
    posture: Annotated[str, typer.Option(help=f"{', '.join(POSTURES)}, or seven angles in degrees.")] = "raised",
    warm: Annotated[float, typer.Option(help="The hottest motor's temperature when it is asked, °C.")] = 50.0,
    hold_s: Annotated[float, typer.Option("--hold", help="How long it has still to hold, s.")] = 600.0,
    seed: SeedOption = 0,
    format_: FormatOption = "parquet",
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """A nearby posture in which a warm arm holds its payload with less load, performed with and without.

    Takes some 20 s once the arm's twin is in the cache.
    """
    check_choices(seed, format_)
    if not hold_s > 0:
        raise FleetError(f"--hold must be > 0 (got {hold_s:g}).")
    from fleet.sim.models import ArmModel
    from scenarios.folder import check_free
    from scenarios.known_arm import known_arm
    from scenarios.motion_files import RECOVERY, recovery_summary, save_recovery
    from scenarios.recover import check_hold, recover, warmed

    chosen, q = load(scenario), posture_q(posture)
    check_free(out, overwrite=overwrite, kind=RECOVERY)
    for spec in chosen.arms:
        if arm in (None, spec.name):  # all that can be refused is refused before the training
            check_hold(ArmModel(spec.robot()), q, payload)
            break
    with progress_bar() as progress:
        known = known_arm(chosen, arm, twin=twin_of(twins, arm or chosen.arms[0].name), progress=progress)
        progress("recovering", 0.0)
        start_c = warmed(known.arm, q, payload, ambient_c=known.verification.ambient_c, until_c=warm)
        some = {"start_c": start_c, "verification": known.verification, "hold_s": hold_s, "seed": seed}
        found = recover(known.twin, known.arm, q, payload, **some)
    how: Any = format_
    save_recovery(found, out, format=how, overwrite=overwrite)
    if as_json:
        typer.echo(json.dumps({"out": str(out), **recovery_summary(found)}, indent=1))
        return
    hot = found.hottest
    say(
        f"Joint {hot + 1} goes from {found.with_c[0, hot]:.1f} °C to {found.with_c[-1, hot]:.1f} °C in {hold_s:g} s, "
        f"without the change of posture to {found.without_c[-1, hot]:.1f} °C; the tool moves {found.tool_m:.2f} m. "
        f"Written to {out}.",
        out_console,
    )


def export_command(
    twins: TwinsArg,
    out: Annotated[Path, typer.Option(help="A file that ends in .onnx.")] = Path("twin.onnx"),
    arm: WhichOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """The twin as ONNX, to be scored without Python; needs the extra onnx, which `make` installs."""
    if out.suffix != ".onnx":
        raise FleetError(f"--out must name a file that ends in .onnx (got '{out}').")
    if out.exists() and not overwrite:
        raise FleetError(f"'{out}' is there already; give another --out, or --overwrite to replace it.")
    from scenarios.twin_training import open_twin
    from twin.export import export_onnx

    twin = open_twin(twins, arm)
    say(f"Twin of {twin.arm}, version {twin.version}, written to {export_onnx(twin, out)}.", out_console)


def check_choices(seed: int, format_: str) -> None:
    """Refuse a seed or a format that cannot be."""
    if seed < 0:
        raise FleetError(f"--seed must be 0 or more (got {seed}).")
    if format_ not in FORMATS:
        raise FleetError(f"No format '{format_}'{nearest(format_, FORMATS)}")


def twin_of(folder: Path | None, arm: str) -> Any:
    """The stored twin of an arm, or None where the scenario's own is wanted."""
    from scenarios.twin_training import open_twin

    return None if folder is None else open_twin(folder, arm)


def posture_q(posture: str) -> Any:
    """A posture by name or by seven comma-separated angles in degrees, rad [joint]."""
    if posture in POSTURES:
        return np.array(POSTURES[posture])
    try:
        angles = [float(word) for word in posture.split(",")]
    except ValueError:
        angles = []
    if len(angles) != 7:
        raise FleetError(
            f"--posture '{posture}' is neither seven angles in degrees nor a name{nearest(posture, POSTURES)}"
        )
    return np.deg2rad(angles)
