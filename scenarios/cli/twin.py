"""Commands of the digital twin: `thermofleet twin …`."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fleet.errors import FleetError, distinguish
from fleet.fields import MAX_SEED, argument, option
from fleet.job import BOUNDS
from fleet.robot import POSTURES, RATING
from scenarios.cli import options
from scenarios.cli.options import From, Given
from scenarios.result_folder import check_file, check_folder, check_free, check_overwrite, new_file, new_folder
from scenarios.table import Table
from scenarios.terminal import echo, out_console, print_json, print_wide, progress_bar, say
from twin.vae.config import TwinConfig

if TYPE_CHECKING:
    from fleet.job import Fixture
    from fleet.robot import Robot
    from scenarios.motion.recover import KnownArm
    from scenarios.progress import Progress
    from twin.logs.recording import Recording
    from twin.thermal.identify import Identified

KNOWN_TWINS = option("A folder of twins. Default: those of the scenario, from the cache.", None, flag="--twins")
SEED = option("Random seed.", 0, low=0, high=MAX_SEED)
_VERDICT = "Verdicts"
SHOWN_OF_LOG = {"hidden": "16; --log: 32", "window": "12; --log: 50", "rate_hz": "12.5; --log: 2"}
"""Defaults that differ for twins of logs, as the help shows them: `LOG_INPUT`, whose module takes long to load."""
FOLLOW_S = 0.1
"""Real seconds between two looks at a growing log."""


def identify_command(
    log: Path = option("A log with motor temperatures, or a folder of logs of one arm.", MISSING),
    out: Path | None = option("Folder of the result, rc.json.", None),
    arm: str | None = options.LOG_ARM,
    ambient: float | None = option("Ambient temperature, °C; default: 22 is assumed.", None, low=-40, high=60),
    skip_damaged: bool = options.SKIP_DAMAGED,
    overwrite: bool = options.OVERWRITE,
    as_json: bool = options.JSON,
) -> None:
    """Identify an arm's thermal network from its own logs: parameters with 95 % intervals, and the residual.

    A day of logs takes half a minute to a minute.
    """
    from scenarios.prepare.twins import arms_of
    from twin.thermal.checkpoint import CARD, save
    from twin.thermal.identify import AMBIENT_C, identify

    if out is not None:
        check_folder(out)
        check_overwrite(out / CARD, overwrite)
    ambient_c = AMBIENT_C if ambient is None else ambient
    recordings = options.arm_recordings(log, arm, skip_damaged)
    arm = arm or arms_of(recordings)[0]
    with progress_bar(kept="") as progress:
        progress("identifying", 0.0)
        network = identify(recordings, arm=arm, ambient_c=ambient_c)
    if out is not None:
        save(network, out)
    if as_json:
        card: dict[str, object] = {"arm": arm, "version": network.version, "data_hash": network.data_hash}
        card |= {"out": None if out is None else str(out), "ambient_c": ambient_c, "rms_k": network.rms_k}
        card["doubts"] = doubts_of(network)
        card["parameters"] = [{**vars(p), "informed": p.informed} for p in network.parameters]
        print_json(card)
        return
    out_console.print(parameter_table(network))
    worst = sorted(max(rms) for rms in network.rms_k.values())
    residual = f"median {worst[len(worst) // 2]:.2f} K, largest {worst[-1]:.2f} K"
    say(f"Residual at the worst joint of a recording: {residual}.", out_console)
    for sentence in doubts_of(network):
        say(sentence, out_console)
    advice = "" if ambient is not None else ", assumed; give another one with --ambient"
    say(f"Ambient temperature: {ambient_c:g} °C{advice}.", out_console)
    say("Nothing was written; --out FOLDER keeps it." if out is None else f"Written to {out}.", out_console)


def doubts_of(network: "Identified") -> list[str]:
    """What speaks against an identified network, in sentences."""
    from twin.thermal.forecast import MOST_RESIDUAL_K, MOST_SD

    doubts, worst_k = list[str](), max(map(max, network.rms_k.values()))
    far, sd = max(
        ((p, abs(math.log(p.value / p.prior)) / p.prior_sd) for p in network.parameters), key=lambda each: each[1]
    )
    if sd > MOST_SD:
        of = "" if far.joint is None else f" of joint {far.joint}"
        doubts.append(f"{far.name}{of} is {far.value / far.prior:.2g} times that of a nominal Gen3")
    unlike = network.unlike()
    doubts += unlike.doubts
    if worst_k > MOST_RESIDUAL_K:
        doubts.append(f"a residual of {worst_k:.1f} K, where public logs have up to 0.3 K")
    return [f"Do not trust this network: {', and '.join(doubts)}. {unlike.remedy}"] if doubts else []


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


def forecast_command(
    log: Path = option("A log with motor temperatures up to now; half an hour is better than minutes.", MISSING),
    plan: str = option(
        "One repetition of the motion to come: a log, of which temperatures are not read; or SCENARIO/JOB, a job of a "
        "scenario.",
        MISSING,
    ),
    network: Path | None = options.NETWORK,
    repeat: int | None = option(
        "Number of repetitions. Default: those of a job of a scenario, the most of them; 1 of a log.",
        None,
        low=1,
        high=1_000_000,
    ),
    ambient: float | None = option(
        "Ambient temperature, °C; default: as in the identification, or 22.", None, low=-40, high=60
    ),
    arm: str | None = option(
        "Arm, if the log or scenario has several. Default in a scenario: the first that can do the job.", None
    ),
    out: Path | None = option("HTML page to write, with a chart; its name ends in .html.", None),
    skip_damaged: bool = options.SKIP_DAMAGED,
    overwrite: bool = options.OVERWRITE,
    as_json: bool = options.JSON,
) -> None:
    """Predict the motor temperatures of a planned motion that begins when a log ends.

    Temperatures have 95 % intervals. The output also has the time to 40, 60 and
    75 °C, the longest safe run, and the highest safe start temperature.
    """
    if out is not None:
        check_file(out, (".html",), overwrite)
    from fleet.readings import mounts_differ
    from scenarios.prepare.planned_motion import motion_of
    from scenarios.show import forecast_page
    from twin.thermal.forecast import forecast

    identified = network_of(network)
    so_far = one_of(options.arm_recordings(log, arm, skip_damaged), log)
    path = Path(plan)
    if path.exists():
        motion, repeat = one_of(options.arm_recordings(path, arm, skip_damaged, measured=False), path), repeat or 1
        if mounts_differ(vars(so_far), vars(motion)):
            raise FleetError(
                f"No mount of one arm explains the torques of both '{log}' and '{plan}'. Does one of them have the "
                "other sign, or is it of another arm? Give the torque with which the motors drive the joints."
            )
    else:
        with progress_bar() as progress:
            motion, most = motion_of(plan, arm, progress)
        repeat = repeat or most
    found = forecast(so_far, motion, repeat, network=identified, ambient_c=ambient)
    origin = {
        "log": so_far.name,
        "plan": f"{motion.name}, {found.cycle_s:.4g} s",
        "network": "nominal Gen3" if identified is None else f"{identified.arm}, version {identified.version}",
        "ambient temperature": f"{found.ambient_c:g} °C",
    }
    if out is not None:
        with new_file(out) as draft:
            draft.write_text(forecast_page.page(found, so_far, repeat, origin), encoding="utf-8")
    if as_json:
        print_json({"out": None if out is None else str(out), **forecast_page.card(found, so_far, origin)})
        return
    say("; ".join(f"{name}: {value}" for name, value in origin.items()) + ".", out_console)
    for sentence in forecast_page.summary(found, so_far, repeat):
        say(sentence, out_console)
    print_wide(forecast_page.limit_table(found))
    print_wide(forecast_page.joint_table(found, so_far))
    if identified is None:
        say("For the arm's own network: thermofleet twin identify, then --network.", out_console)
    say("No page was written; --out FILE.html writes one." if out is None else f"Open {out} in a browser.", out_console)


def one_of(recordings: "list[Recording]", path: Path) -> "Recording":
    """The only recording; raises a FleetError if there are several."""
    if len(recordings) > 1:
        raise FleetError(f"'{path}' is a folder with {len(recordings)} logs: give one of its files.")
    return recordings[0]


_LOGGED = "An arm known by its logs: no scenario, but --twins and --network"
TILT = option("Roll, pitch, yaw of its base, degrees; 0,0,0 stands on the floor.", "0,0,0", panel=_LOGGED)
TOOL = option("Mass of its tool, kg.", 0.0, low=0, high=RATING.temporary_kg, panel=_LOGGED)
SCENARIO_OR_LOGGED = argument("A library name (see `thermofleet show`) or a .toml file; none for an arm of logs.", None)


def subject_of(
    scenario: str | None, arm: str | None, twins: Path | None, network: Path | None, tilt: str, tool_kg: float
) -> "tuple[Robot, Sequence[Fixture], Callable[[Progress], KnownArm]]":
    """An arm of a scenario or of logs, the fixtures around it, and how to make what is known of it."""
    from scenarios.motion.recover import known_arm, logged_arm
    from scenarios.prepare.twins import open_twin
    from scenarios.spec.load import load

    chosen = None if scenario is None else load(scenario)
    spec = None if chosen is None else chosen.arms[0 if arm is None else chosen.index_of(arm)]
    twin = None if twins is None else open_twin(twins, arm if spec is None else spec.name)
    identified = network_of(network)
    if chosen is None or spec is None:
        if twin is None or identified is None:
            raise FleetError("Give a SCENARIO, or --twins and --network of an arm that is known by its logs.")
        logged = logged_arm(twin, identified, tilt, tool_kg)
        return logged.arm.robot, (), lambda progress: logged
    if tilt != "0,0,0" or tool_kg:
        raise FleetError("--tilt and --tool are for an arm without a scenario; a scenario states them.")
    models = {"twin": twin, "network": identified}
    return spec.robot(), chosen.fixtures, lambda progress: known_arm(chosen, spec.name, **models, progress=progress)


def generate_command(
    scenario: str | None = SCENARIO_OR_LOGGED,
    out: Path = option("Folder of the motions and generated.json.", Path("runs/generated")),
    arm: str | None = options.SCENARIO_ARM,
    twins: Path | None = KNOWN_TWINS,
    network: Path | None = options.NETWORK,
    count: int = option("Number of motions.", 20, low=1, high=10_000),
    strength: float = option(
        "Perturbation in posterior standard deviations; 0 reconstructs.", 1.0, flag="--s", low=0, high=100
    ),
    posture: list[str] | None = option(
        "A stop of the known motion, at least twice: a name, or seven angles in degrees. Default: the scenario's jobs.",
        None,
    ),
    payload: float = option("--posture: payload, kg.", 0.0, low=0, high=RATING.temporary_kg),
    tilt: str = TILT,
    tool: float = TOOL,
    seed: int = SEED,
    overwrite: bool = options.OVERWRITE,
    as_json: bool = options.JSON,
) -> None:
    """Generate new motion near known motion: inside the limits, predicted to stay cool, executed in the simulator.

    Takes about 20 s once the arm's twin is in the cache.
    """
    from fleet.arm.model import ArmModel
    from scenarios.motion.generate import generate
    from scenarios.motion.recover import GENERATED, generated_summary, motion_through, save_generated

    robot, fixtures, make_known = subject_of(scenario, arm, twins, network, tilt, tool)
    if scenario is None and not posture:
        raise FleetError("Without a SCENARIO no motion is known: give --posture at least twice.")
    if payload and not posture:
        raise FleetError("--payload is for --posture; the scenario's jobs have their own: leave it out.")
    sources = motion_through(ArmModel(robot, fixtures), posture, payload) if posture else None
    check_free(out, GENERATED, overwrite=overwrite)
    with progress_bar() as progress:
        known = make_known(progress)
        how: Any = {"verification": known.verification, "fixtures": fixtures, "seed": seed}
        how |= {"s": strength, "count": count, "progress": partial(progress, "generating")}
        made = generate(known.twin, known.arm, sources or known.sources, **how)
    save_generated(made, out, overwrite=overwrite)
    if as_json:
        print_json({"out": str(out), **generated_summary(made)})
        return
    reasons = ", ".join(f"{reason} {times}" for reason, times in made.rejected.items()) or "none"
    cool = f"{made.truly_cool:.1%} truly stay below {made.verification.cool_c:g} °C"
    say(f"Motions of {made.arm} in {out}: {len(made.motions)}; {cool}; rejected: {reasons}.", out_console)
    if len(made.motions) < count:
        say(f"Only {len(made.motions)} of {count} passed; choose a smaller --s or a lighter task.")


def recover_command(
    scenario: str | None = SCENARIO_OR_LOGGED,
    out: Path = option("Folder of the temperatures and recovery.json.", Path("runs/recovery")),
    arm: str | None = options.SCENARIO_ARM,
    twins: Path | None = KNOWN_TWINS,
    network: Path | None = options.NETWORK,
    payload: float = option("Payload held, kg.", 2.0, low=0, high=100),
    posture: str = option(f"{', '.join(POSTURES)}, or seven angles in degrees.", "raised"),
    warm: float = option("Temperature of the hottest motor at the start, °C.", 50.0, low=-40, high=200),
    hold_s: float = option(
        "Remaining time to hold, s.", 600.0, flag="--hold", low=0, high=BOUNDS["dwell_s"].high, above=True
    ),
    tilt: str = TILT,
    tool: float = TOOL,
    seed: int = SEED,
    overwrite: bool = options.OVERWRITE,
    as_json: bool = options.JSON,
) -> None:
    """Find a nearby posture in which a warm arm holds its payload with less load; execute both in the simulator.

    Takes about 20 s once the arm's twin is in the cache.
    """
    from fleet.arm.model import ArmModel
    from scenarios.motion import recover

    robot, fixtures, make_known = subject_of(scenario, arm, twins, network, tilt, tool)
    model = ArmModel(robot)
    q = recover.parse_posture(posture, model.position_range)
    check_free(out, recover.RECOVERY, overwrite=overwrite)
    recover.check_hold(model, q, payload, hold_s, recover.Nearby())  # before the training
    with progress_bar() as progress:
        known = make_known(progress)
        progress("recovering", 0.0)
        start_c = recover.hold_until(known.arm, q, payload, ambient_c=known.verification.ambient_c, until_c=warm)
        how: Any = {"verification": known.verification, "fixtures": fixtures, "seed": seed}
        found = recover.recover(known.twin, known.arm, q, payload, start_c=start_c, hold_s=hold_s, **how)
    recover.save_recovery(found, out, overwrite=overwrite)
    if as_json:
        print_json({"out": str(out), **recover.recovery_summary(found)})
        return
    hot = found.hottest
    say(
        f"Joint {hot + 1} goes from {found.with_c[0, hot]:.1f} °C to {found.with_c[-1, hot]:.1f} °C in "
        f"{hold_s:g} s; without the new posture to {found.without_c[-1, hot]:.1f} °C. The tool moves "
        f"{found.found.tool_m:.2f} m. Written to {out}.",
        out_console,
    )


def export_command(
    twins: Path = options.TWINS,
    out: Path = option("A file that ends in .onnx.", Path("twin.onnx")),
    arm: str | None = options.TWIN_ARM,
    precision: Literal["float32", "float64"] = option("Type of the input: float32 or float64.", "float32"),
    overwrite: bool = options.OVERWRITE,
) -> None:
    """Export a twin as ONNX, for scoring without Python; needs the extra `onnx`."""
    if out.suffix != ".onnx":
        raise FleetError(f"--out must name a file that ends in .onnx (got '{out}').")
    check_overwrite(out, overwrite)
    from scenarios.prepare.twins import open_twin
    from twin.vae.onnx import export_onnx

    twin = open_twin(twins, arm)
    say(f"Twin of {twin.arm}, version {twin.version}, written to {export_onnx(twin, out, precision)}.", out_console)


def network_of(folder: Path | None) -> "Identified | None":
    """The thermal network of --network; None without a folder."""
    from twin.thermal.checkpoint import load

    return None if folder is None else load(folder)


def train_command(
    scenario: str | None = options.SCENARIO_OR_LOG,
    log: Path | None = options.LOG,
    out: Path = option("Folder of the twins.", Path("runs/twins")),
    arm: str | None = option(
        "Train only this arm; default: every arm of the scenario. --log: name of the arm; in a log of several arms, "
        "the one to choose.",
        None,
        is_name=True,
    ),
    *,
    given: Annotated[Given, From(TwinConfig, shown=SHOWN_OF_LOG)],
    size: Literal["quick", "full"] | None = option("quick or full. Default: as in the scenario; for logs quick.", None),
    cool: float = option("--log: temperature limit of joints 1 to 4 for training data, °C.", 40.0, low=0, high=200),
    hold_out: float = option(
        "--log: share of the cool recordings held out to calibrate verdicts; none if these are fewer than 4.",
        0.3,
        low=0,
        high=0.9,
    ),
    seed: int | None = option(
        "Seed of weights and training. Default: the scenario's, for logs 0.", None, low=0, high=MAX_SEED
    ),
    skip_damaged: bool = options.SKIP_DAMAGED,
    overwrite: bool = options.OVERWRITE,
    as_json: bool = options.JSON,
) -> None:
    """Train the twins of a scenario's arms, or the twin of the arm whose logs are given.

    The quick size takes up to a minute per arm and core, the full size four.
    Cached twins take seconds. A twin of logs is kept in --out only.
    """
    check_source(scenario, log)
    from scenarios.prepare.twins import FEWEST_RECORDINGS, TWINS, save_twins, train_arms, train_log
    from scenarios.spec.load import load

    check_free(out, TWINS, overwrite=overwrite)
    bar = progress_bar() if log is None else progress_bar(kept="")  # the twin of a log is not cached
    with explain_in_options(), bar as progress, new_folder(out, TWINS, overwrite=overwrite) as folder:
        if log is not None:
            config = config_of(size or "quick", given, of_log=True)
            recordings = options.arm_recordings(log, arm, skip_damaged, progress=progress)
            twin = train_log(recordings, config, seed or 0, cool_c=cool, hold_out=hold_out, progress=progress)
            twins = [twin if arm is None else replace(twin, arm=arm)]
            source = f"log {log}"
        else:
            of_scenario = load(str(scenario))
            config = config_of(size or of_scenario.twin.size, given)
            arms = range(len(of_scenario.arms)) if arm is None else [of_scenario.index_of(arm)]
            twins = train_arms(of_scenario, list(arms), config, seed, progress)
            source = f"scenario {of_scenario.name}"
        progress("writing", 0.0)
        card = save_twins(twins, folder, source)
    if as_json:
        print_json({"out": str(out), **card})
        return
    for twin in card["twins"]:
        out_console.print(quality_table(twin))
    if log is not None:
        count = card["twins"][0]["calibrated_on"]
        alpha = f"verdicts with --alpha {math.ceil(1e4 / (count + 1)) / 1e4:g} or more" if count else "no verdicts"
        few = f" (this share of the cool recordings is less than {FEWEST_RECORDINGS})" if hold_out and not count else ""
        say(f"Cool recordings held out (--hold-out): {count}{few}, {alpha}; --alpha 0.05 needs 19.", out_console)
    say(f"Written to {out}; score with: thermofleet twin score {out}", out_console)


def score_command(
    twins: Path = options.TWINS,
    scenario: str | None = argument("Score this scenario's jobs; or use --log.", None),
    log: Path | None = options.LOG,
    arm: str | None = options.TWIN_ARM,
    format_: Literal["table", "csv"] = option("table or csv.", "table", flag="--format"),
    follow: bool = option("--log: score a CSV file while it grows, a line per window, until Ctrl-C.", False),
    skip_damaged: bool = options.SKIP_DAMAGED,
    as_json: bool = options.JSON,
    verdict: bool = option(
        "Judge each job of a scenario, or each recording of a log: uncritical or anomalous.", False, panel=_VERDICT
    ),
    alpha: float | None = option(
        "Largest share of cool jobs that may be called anomalous; default: 0.05, which needs 19 held-out ones.",
        None,
        low=0,
        high=1,
        above=True,
        panel=_VERDICT,
    ),
    reading: Literal["load", "d", "latent"] | None = option(
        "Judge by load (torque above the reconstruction), d (novelty), or latent (distance from cool motion); default: "
        "load.",
        None,
        panel=_VERDICT,
    ),
    map_: Path | None = option(
        "Draw the latent plane with the verdicts in this PNG.", None, flag="--map", panel=_VERDICT
    ),
    overwrite: bool = options.OVERWRITE,
) -> None:
    """Score every job of a scenario, or a log window by window, with the version of the twin.

    With --verdict a recording is one row. Its worst stretch of two minutes is judged
    by conformal p-values of load and novelty: a new cool recording is called anomalous
    with probability alpha at most, if it is like the cool recordings that the twin
    held out of its training. Motion files of `twin generate` are recordings, too.
    Takes seconds, and half a minute if the jobs must be planned first.
    """
    check_source(scenario, log)
    given: Given = {name: value for name, value in (("alpha", alpha), ("reading", reading)) if value is not None}
    if not verdict and (given or map_ is not None):
        raise FleetError("--alpha, --reading and --map are for --verdict: leave them out.")
    if as_json and format_ != "table":
        raise FleetError(f"--json and --format {format_} name two formats: leave one out.")
    if follow:
        if log is None or verdict:
            raise FleetError("--follow needs --log FILE.csv, and does not go with --verdict, which judges a whole log.")
        follow_log(twins, arm, log, "json" if as_json else format_, skip_damaged)
        return
    if map_ is not None:
        check_file(map_, (".png",), overwrite, "--map")
    from scenarios.motion.verdict_map import verdict_png
    from scenarios.prepare.twins import open_twin
    from scenarios.show.twin_scores import job_rows, jobs_of_arm, log_rows, of_each, render, window_rows, with_verdicts
    from scenarios.spec.load import load
    from twin.verdict import Rule

    chosen, twin = load(scenario) if scenario else None, open_twin(twins, arm)
    rule = Rule(twin=twin, **given) if verdict else None
    features = None
    if chosen is not None:
        with progress_bar() as progress:
            jobs = jobs_of_arm(twin, chosen, progress)
            rows = job_rows(twin, jobs)
        features = twin.features([plan for plan, _ in jobs], [times for _, times in jobs])
    else:
        recordings = options.recordings_of(Path(str(log)), skip_damaged)
        if rule:
            rows, features = log_rows(rule, recordings)
        else:
            rows = [row for _, own in of_each(recordings, partial(window_rows, twin)) for row in own]
    caption = f"twin of {twin.arm}, version {twin.version}, data {twin.data_hash}"
    if rule and features is not None:
        rows = with_verdicts(rows, rule, features)
        caption = f"{rule.guarantee} Twin of {twin.arm}, version {twin.version}"
        if map_ is not None:
            png = verdict_png(rule, features)
            with new_file(map_) as draft:
                draft.write_bytes(png)
            say(f"Map written to {map_}.")
    shown = render(rows, "json" if as_json else format_, caption=caption)
    if isinstance(shown, str):
        echo(shown, nl=False)
    else:
        print_wide(shown)


def follow_log(twins: Path, arm: str | None, log: Path, how: str, skip_damaged: bool) -> None:
    """Print a line for each window of a growing log, until Ctrl-C or SIGTERM."""
    from scenarios.prepare.twins import open_twin
    from scenarios.show.twin_scores import score_windows, window_text
    from scenarios.signals import until_stopped
    from twin.log_windows import WindowFeed
    from twin.logs.reader import GrowingLog
    from twin.logs.recording import GAP_S

    twin, count = open_twin(twins, arm), 0
    feed, damaged = WindowFeed(twin), "skip" if skip_damaged else "refuse"
    first_s = twin.config.window / twin.config.rate_hz
    with (
        until_stopped() as stop,
        options.explain_damage(),
        GrowingLog(log, first_s=first_s, damaged=damaged) as growing,
    ):
        while not stop.is_set():
            recording = growing.read(feed.due_s)
            if recording is None:
                stop.wait(FOLLOW_S)
                continue
            parts = feed.add(recording)
            if not parts and (step_s := recording.duration_s / max(len(recording.time_s) - 1, 1)) > GAP_S:
                step, gap = distinguish(step_s, GAP_S, 3)
                raise FleetError(f"'{log}' has a sample every {step} s; windows need one at least every {gap} s.")
            for row in score_windows(twin, parts):
                text = window_text(row, how)
                echo(text if how != "csv" or count == 0 else text.splitlines()[1])
                count += 1
    stop.leave(f"Scored {count} window{'s' * (count != 1)} of {first_s:g} s.")


def check_source(scenario: str | None, log: Path | None) -> None:
    """Raise a FleetError unless either a scenario or a log is given."""
    if (scenario is None) == (log is None):
        given = "neither" if scenario is None else "both"
        raise FleetError(f"Give either a scenario or --log FILE_OR_FOLDER (got {given}).")


@contextmanager
def explain_in_options() -> Iterator[None]:
    """Reword training errors as FleetErrors that name the options of the command line."""
    from twin.vae.train import CollapsedPosterior

    try:
        yield
    except CollapsedPosterior as error:
        fields = r"\b(epochs|max_windows|allow_collapse|beta)\b"
        raise FleetError(re.sub(fields, lambda f: f"--{f[1].replace('_', '-')}", str(error))) from error


def report_command(
    scenario: str | None = options.SCENARIO_OR_LOG,
    log: Path | None = options.LOG,
    out: Path = option("Folder of report.html and report.json.", Path("runs/twin_report")),
    arm: str | None = options.SCENARIO_ARM,
    seeds: int = option(
        "Number of training seeds; the report gives the spread of their results. The chapter on epochs always has 3.",
        3,
        low=1,
        high=100,
    ),
    skip_damaged: bool = options.SKIP_DAMAGED,
    overwrite: bool = options.OVERWRITE,
    as_json: bool = options.JSON,
) -> None:
    """Write the paper's figures and tables as one offline HTML page, with all numbers in report.json.

    RMS torque and an untrained network are the baselines of each result. A
    scenario takes up to two minutes, a day of logs a minute for each seed. A failed
    section shows its reason; the exit code is then 1.
    """
    check_source(scenario, log)
    from fleet.files import cache_folder
    from scenarios.progress import Count
    from scenarios.show import twin_report
    from scenarios.spec.load import load

    check_free(out, twin_report.REPORT, overwrite=overwrite)
    bar = progress_bar(kept="Twins already trained are")
    with bar as progress, new_folder(out, twin_report.REPORT, overwrite=overwrite) as folder:
        how: Any = {"size": twin_report.SIZE, "folder": cache_folder()}  # arguments
        if log is not None:
            title, source = f"The twin of the logs in {log.name}", f"--log {log.name}"
            recordings = options.arm_recordings(log, arm, skip_damaged, progress=progress)
            if len(twin_report.cool_logs(recordings)) == len(recordings):
                hot = f"{twin_report.LOG_HOT_C:g} °C on joint {twin_report.LOADED_JOINT + 1}"
                say(f"No log reaches {hot}: the chapters that compare cool with hot motion will fail. Add hotter logs.")
            subjects = list[twin_report.Subject]()
            for seed in range(seeds):
                progress("training", Count(seed, seeds))
                subjects.append(twin_report.log_subject(recordings, seed, **how))
        else:
            chosen = load(str(scenario))
            index = 0 if arm is None else chosen.index_of(arm)
            name = chosen.arms[index].name
            title, source = f"The twin of {name} in {chosen.name}", f"{scenario} --arm {name}"
            subjects = twin_report.scenario_subjects(chosen, index, range(seeds), **how, progress=progress)
        chapters = twin_report.chapters_of(subjects, twin_report.SIZE, progress)
        origin = {"command": f"thermofleet twin report {source} --seeds {seeds}", **twin_report.origin_of(subjects)}
        progress("writing", 0.0)
        failed = twin_report.write(chapters, origin, folder, title)
    if as_json:
        echo((out / twin_report.CARD).read_text(encoding="utf-8"), nl=False)
    else:
        say(f"Open {out / twin_report.PAGE} in a browser.", out_console)
    if failed:
        reasons = "; ".join(f"{key}: {why}" for key, why in failed.items())
        say(f"{len(failed)} of {len(chapters)} chapters could not be computed ({reasons})")
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
    seed = twin["seed"].rstrip("/")
    note = f"data {twin['data_hash']}, seed {seed}, calibrated on {twin['calibrated_on']} held-out jobs"
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
