"""`thermofleet twin identify`, `generate`, `recover` and `export`."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from fleet.errors import FleetError
from fleet.job import BOUNDS
from fleet.robot import POSTURES
from scenarios.cli import options
from scenarios.cli.terminal import out_console, plain_table, print_json, progress_bar, say
from scenarios.load import load
from scenarios.result_folder import check_overwrite
from scenarios.schema_errors import choose
from twin.thermal.result import AMBIENT_C

if TYPE_CHECKING:  # slow to import
    from twin.thermal.result import Identified
    from twin.vae.twin import Twin

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
    table = plain_table("parameter", "joint", "value", "95 % from", "to", "prior", "informed", caption=caption)
    for p in network.parameters:
        numbers = (f"{v:.4g}" for v in (p.value, p.low, p.high, p.prior))
        table.add_row(p.name, "–" if p.joint is None else str(p.joint), *numbers, "yes" if p.informed else "no")
    return table


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
    from scenarios.motion.known_arm import known_arm
    from scenarios.motion.motion_files import GENERATED, Format, generated_summary, save_generated
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
    from fleet.physics.models import ArmModel
    from scenarios.motion.known_arm import known_arm
    from scenarios.motion.motion_files import RECOVERY, Format, recovery_summary, save_recovery
    from scenarios.motion.posture import parse_posture
    from scenarios.motion.posture_search import Nearby
    from scenarios.motion.recover import check_hold, check_hold_time, hold_until, recover
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
    from scenarios.prepare.twin_folder import open_twin
    from twin.vae.onnx import export_onnx

    twin = open_twin(twins, arm)
    say(f"Twin of {twin.arm}, version {twin.version}, written to {export_onnx(twin, out)}.", out_console)


def twin_of(folder: Path | None, arm: str) -> "Twin | None":
    """The stored twin of an arm; None without a folder."""
    from scenarios.prepare.twin_folder import open_twin

    return None if folder is None else open_twin(folder, arm)
