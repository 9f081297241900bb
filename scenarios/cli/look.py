"""Commands that look at scenarios and results: show, layout, view and report."""

import os
import re
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Literal, get_args

import typer

from fleet.errors import FleetError, ScenarioError
from fleet.fields import argument, option
from fleet.job import BOUNDS
from fleet.robot import POSTURES, RATING, Cooling
from scenarios.cli import options
from scenarios.cli.options import From, Given
from scenarios.spec.options import Shot
from scenarios.table import Table
from scenarios.terminal import out_console, print_either, print_json, progress_bar, say

SMALLEST, LARGEST = 160, 3840
"""Width and height of a film, px."""
MOST_FRAMES = 100_000
MOST_GIF_PIXELS = 600_000_000
"""Of all frames of a GIF together: they stay in memory until the file is written."""
FILMS, SCENES = (".mp4", ".webm", ".gif"), (".mcap", ".glb")
"""Suffixes of the files that `view --out` writes."""
NO_DISPLAY = (
    "MuJoCo's viewer needs a display, and there is none (DISPLAY and WAYLAND_DISPLAY are not set). Write a file with "
    "--out, or open the run's report.html."
)
_FILM, _SCENE = "Films (.mp4, .webm, .gif)", "Scenes (.mcap, .glb)"
_HOLD = "Time that an arm can hold a payload"


def show_command(
    scenario: str | None = argument(
        "A library name, a .toml file, or an instance of the suite, as test/0017. Default: list the library.", None
    ),
    hold: float | None = option(
        "Show how long an arm can hold this payload, kg, instead of a scenario.",
        None,
        low=BOUNDS["payload_kg"].low,
        high=BOUNDS["payload_kg"].high,
        panel=_HOLD,
    ),
    posture: str = option(
        f"{', '.join(POSTURES)}, or seven comma-separated angles in degrees.", "outstretched", panel=_HOLD
    ),
    ambient: float = option("Ambient temperature, °C.", 25.0, low=-40, high=60, panel=_HOLD),
    cooling: str = option(f"Cooling of the arm: {', '.join(get_args(Cooling))}.", "still_air", panel=_HOLD),
    tool_kg: float = option(
        "Mass of the gripper at the flange, kg.", 0.0, low=0, high=RATING.temporary_kg, panel=_HOLD
    ),
    beyond_rating: bool = option("Accept a load beyond the rating of the arm.", False, panel=_HOLD),
    suite: Literal["cells", "train", "validation", "test"] | None = option(
        "List the benchmark's suite: its cells, or the instances of a split: train, validation or test.", None
    ),
    as_json: bool = options.JSON,
) -> None:
    """List the scenarios of the library, or show one: its arms, its jobs and its thermal load factor.

    The thermal load factor is the heat of all jobs relative to the capacity of
    the fleet. Above 1.2 no policy keeps all motors below the warning limit.
    With --hold it shows the time until the motors of an arm that holds a payload
    reach the warning and error limits. With --suite it lists benchmark instances:
    an instance is a cell (arms, stations and task types) with a seed.
    """
    if scenario is not None and (hold is not None or suite is not None):
        raise FleetError(f"--{'suite' if hold is None else 'hold'} takes no scenario; leave '{scenario}' out.")
    if hold is not None and suite is not None:
        raise FleetError(f"--hold and --suite exclude each other (got {hold:g} and {suite}). Leave one out.")
    if hold is not None:
        from scenarios.motion import hold as holding

        held = holding.hold(hold, posture, ambient, cooling=cooling, tool_kg=tool_kg, beyond_rating=beyond_rating)
        print_either(as_json, holding.as_json(held), holding.as_table(held))
    elif suite == "cells":
        _list_cells(as_json)
    elif suite is not None:
        _list_split(suite, as_json)
    elif scenario is None:
        _list_library(as_json)
    else:
        from scenarios.show.layout import describe
        from scenarios.spec.load import load

        chosen = load(scenario)
        if as_json:
            print_json(asdict(chosen))
            return
        with progress_bar() as progress:
            parts = describe(chosen, progress)
        out_console.print(*parts, sep="\n")


def new_command(
    file: Path = argument("File to write; its name ends in .toml."),
    source: str = option(
        "Scenario of the library to copy. Default: a small cell that explains its fields.", "", flag="--from"
    ),
) -> None:
    """Write a scenario file to change: a small cell with comments, or a copy of a scenario of the library."""
    from importlib.resources import files

    from fleet.errors import nearest
    from scenarios.spec.load import library

    known = library()
    if source and source not in known:
        raise FleetError(f"--from: no scenario '{source}'{nearest(source, known)}")
    if file.suffix != ".toml":
        raise FleetError(f"The name of a scenario file ends in .toml (got '{file.name}').")
    content = (known[source] if source else files("scenarios.spec").joinpath("new.toml")).read_bytes()
    try:
        with file.open("xb") as new:
            new.write(content)
    except FileExistsError as error:
        raise FleetError(f"'{file}' exists. Give another name, or remove it.") from error
    say(f"Wrote {file}. Change it, then check it with: thermofleet layout {shlex.quote(str(file))}", out_console)


def _list_cells(as_json: bool) -> None:
    from scenarios.suite.instances import CELLS

    head = ("split", "cell", "asks", "hours", "instances")
    rows = tuple((cell.split, cell.name, cell.asks, f"{cell.hours:g}", str(cell.instances)) for cell in CELLS)
    print_either(as_json, {cell.name: asdict(cell) for cell in CELLS}, Table(head=head, rows=rows, numbers=False))


def _list_split(split: str, as_json: bool) -> None:
    from scenarios.suite.splits import manifest

    instances = manifest(split)
    axes = [", ".join(f"{name} {value}" for name, value in asdict(each.axes).items()) for each in instances]
    rows = tuple((each.name, each.cell, text, str(each.count)) for each, text in zip(instances, axes, strict=True))
    table = Table(head=("instance", "cell", "axes", "jobs"), rows=rows, numbers=False)
    print_either(as_json, [asdict(each) for each in instances], table)


def _list_library(as_json: bool) -> None:
    from scenarios.spec.load import library, load

    scenarios = {name: load(path) for name, path in library().items()}
    rows = tuple((n, str(len(s.arms)), f"{s.horizon_s / 3600:g}", s.description) for n, s in scenarios.items())
    table = Table(head=("scenario", "arms", "hours", "description"), rows=rows, numbers=False)
    print_either(as_json, {name: s.description for name, s in scenarios.items()}, table)


def layout_command(
    scenario: str = options.SCENARIO,
    out: Path | None = option(
        "Draw the plan of the cell: reach, places out of reach and, as .png, exclusions; as .html, arms can be moved.",
        None,
    ),
    overwrite: bool = options.OVERWRITE,
    as_json: bool = options.JSON,
) -> None:
    """Show each arm's reach, jobs that exclude each other in space, and the number of arms that can work at once.

    All problems of the cell are listed, for example two arms that are too close
    at home. If the jobs are wrong, arms and places are shown with the error.
    Exit code 2: there are problems.
    """
    from scenarios.result_folder import check_file, new_file
    from scenarios.show.layout import layout_parts, layout_report
    from scenarios.spec.load import load
    from scenarios.spec.parse import parse_cell

    if out is not None:
        check_file(out, (".png", ".html"), overwrite)
    wrong = ""
    try:
        chosen = load(scenario)
    except ScenarioError as error:
        if not Path(scenario).is_file():
            raise
        wrong = f"{error} Only arms, places and fixtures are shown, with a hold at each place."
        try:
            chosen = parse_cell(Path(scenario).read_bytes(), Path(scenario))
        except ScenarioError:
            raise error from None
    with progress_bar() as progress:
        report = layout_report(chosen, progress)
    if wrong:
        own = f"{chosen.name}.toml: jobs["  # no jobs of the file
        report = replace(report, problems=(wrong, *(each for each in report.problems if not each.startswith(own))))
    print_either(as_json, report, *layout_parts(chosen, report))
    if out is not None:
        from scenarios.show.plan import draw_plan, plan_page

        with new_file(out) as file:
            if out.suffix.lower() == ".html":
                file.write_text(plan_page(chosen, report), encoding="utf-8")
            else:
                draw_plan(file, chosen, report)
        say(f"Drew the cell: {out}.")
    for problem in report.problems:
        say(f"Error: {problem}")
    if report.problems:
        raise typer.Exit(2)


def view_command(
    what: str = argument("Folder of `thermofleet run`, or a scenario."),
    *,
    out: Path | None = option(
        "Write a file instead of opening the viewer: a film (.mp4, .webm, .gif), ROS 2 messages for Foxglove, Rerun, "
        "RViz or PlotJuggler (.mcap; extra `mcap`), or an animation for augmented reality and the web (.glb).",
        None,
    ),
    given: Annotated[Given, From(Shot, "speed", "begin_s", "end_s", "fps", "meshes")],
    size: str = option("Width x height, px; even numbers.", "1280x720", panel=_FILM),
    every: float | None = option(
        "Time between two postures, s. Default: as recorded, up to 250,000 postures.",
        None,
        low=0.01,
        high=3600,
        panel=_SCENE,
    ),
    overwrite: bool = options.OVERWRITE,
) -> None:
    """Play a recorded shift in MuJoCo's viewer, or write it as a film or a scene; or show the cell of a scenario.

    Motors are coloured by temperature. Close the window of the viewer to end.
    """
    _check_subject(what)
    width, height = _size(size)
    shot = Shot(**given, width=width, height=height)
    suffix = "" if out is None else out.suffix.lower()
    if every is not None and suffix not in SCENES:
        raise FleetError("--every is for --out FILE.mcap and FILE.glb: leave it out.")
    if suffix in SCENES and (unread := sorted({"begin_s", "end_s", "fps", "meshes"} & set(given))):
        flag = unread[0].removesuffix("_s")
        raise FleetError(f"--{flag} is for the viewer and films; {suffix} files hold the whole shift: leave it out.")
    if out is None:
        _play(what, shot)
        return
    from scenarios.extras import require_extra
    from scenarios.result_folder import check_file

    check_file(out, (*FILMS, *SCENES), overwrite)
    for extra in {".mcap": ("mcap", "ros2"), ".glb": ("report",)}.get(suffix, ()):
        require_extra(extra)
    if not (Path(what) / "run.json").exists():
        raise FleetError(f"--out needs the folder of a `thermofleet run` (got '{what}').")
    if suffix in FILMS:
        _write_film(Path(what), out, shot)
    else:
        _write_scene(Path(what), out, every, shot.speed)


def _check_subject(what: str) -> None:
    """Raise a FleetError if there is neither a folder, a file nor a scenario of a name."""
    from fleet.errors import nearest
    from scenarios.spec.load import INSTANCE, library

    known = library()
    if not (Path(what).exists() or what in known or INSTANCE.fullmatch(what) or what.endswith(".toml")):
        raise FleetError(f"There is neither a folder nor a scenario '{what}'{nearest(what, known)}")


def _play(what: str, shot: Shot) -> None:
    """Play a run, or show the cell of a scenario, until the window is closed."""
    from scenarios.spec.load import load

    scenario = None if (Path(what) / "run.json").exists() else load(what)
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise FleetError(NO_DISPLAY)
    import numpy as np

    from fleet.arm.cell import CellPlayer
    from scenarios.run.log import open_run
    from scenarios.show.film import Film
    from scenarios.show.moments import motor_drums

    if scenario is None:
        run = open_run(Path(what))
        film, began_s = Film(run, meshes=shot.meshes), time.monotonic()
        last_s = min(shot.end_s, float(run.readings.time_s[-1]))
        player = film.player

        def update() -> object:
            return film.show(min(shot.begin_s + shot.speed * (time.monotonic() - began_s), last_s))

    else:
        robots = [arm.robot() for arm in scenario.arms]
        player = CellPlayer(robots, scenario.places, scenario.fixtures, meshes=shot.meshes)
        home = np.array([robot.home_q() for robot in robots])
        ambient_c = np.full(home.shape, 20.0)

        def update() -> object:
            return player.show(home, *motor_drums(ambient_c, scenario.limits), np.zeros(len(robots)))

    say(f"Showing '{what}'; close the window to end.", out_console)
    player.open_viewer(update)


def _write_scene(run: Path, out: Path, every_s: float | None, speed: float) -> None:
    """Write the moments of a run as MCAP or as glTF."""
    from scenarios.result_folder import new_file
    from scenarios.run.log import open_run
    from scenarios.show.moments import Moments

    moments = Moments(open_run(run), every_s)
    with progress_bar(kept="") as progress, new_file(out) as file:
        if out.suffix.lower() == ".mcap":
            from scenarios.show.mcap import write_mcap

            write_mcap(file, moments, progress)
            hint = f"open it in Foxglove, or: ros2 bag play {out}"
        else:
            from scenarios.show.gltf import write_gltf

            write_gltf(file, moments, speed, progress)
            hint = f"{speed:g} × real time; open it in Blender or a web viewer"
    count, megabytes = len(moments.poses), out.stat().st_size / 1e6
    say(f"Wrote {count} moment{'s' * (count > 1)}, {megabytes:.1f} MB: {out} ({hint}).", out_console)


def _write_film(run: Path, out: Path, shot: Shot) -> None:
    from scenarios.progress import Count
    from scenarios.result_folder import new_file

    if sys.platform.startswith("linux"):  # MuJoCo chooses its OpenGL when it is loaded, and the default needs a display
        os.environ.setdefault("MUJOCO_GL", "egl")
    from scenarios.run.log import open_run
    from scenarios.show.film import frames, times, write_film

    stored = open_run(run)
    at_s = times(stored, shot)
    in_memory = MOST_GIF_PIXELS // (shot.width * shot.height)
    most = min(MOST_FRAMES, in_memory) if out.suffix.lower() == ".gif" else MOST_FRAMES
    if len(at_s) > most:
        raise FleetError(
            f"The film would have {len(at_s)} pictures; at most {most} are possible in this size. Raise --speed (now "
            f"{shot.speed:g}), lower --fps (now {shot.fps}), or choose a part with --begin and --end."
        )
    with progress_bar() as progress, new_file(out) as file:

        def counted():
            for number, picture in enumerate(frames(stored, shot, at_s), 1):
                progress("filming", Count(number, len(at_s)))
                yield picture

        count = write_film(file, out.suffix[1:].lower(), counted(), shot)
    length_s, megabytes = count / shot.fps, out.stat().st_size / 1e6
    say(f"Filmed {count} picture{'s' * (count > 1)}, {length_s:.1f} s, {megabytes:.1f} MB: {out}.", out_console)


def _size(asked: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", asked)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(SMALLEST <= px <= LARGEST and px % 2 == 0 for px in size):
        raise FleetError(
            f"--size must be WIDTHxHEIGHT, even numbers from {SMALLEST} to {LARGEST} (got '{asked}'), as in 1280x720."
        )
    return size


def report_command(
    folders: list[Path] | None = argument(
        "Folder of a run or of a recording; several runs are compared on one page. Default: the newest one in runs/.",
        None,
    ),
    out: Path | None = option(
        "The HTML file; of several runs also their table of figures, .csv or .xlsx. Default: report.html in the folder "
        "of the run or recording, compared.html beside several runs.",
        None,
    ),
    scenario: str | None = option("Of a recording: scenario of the fleet, if no auctioneer described its cell.", None),
    meshes: bool = option("Of a run: Kinova's shells; needs the extra `meshes`.", False),
    trace: str | None = option(
        "Print the causes of an event instead of writing the page: its job, award, plan, offers, twin, training data, "
        "configuration and code. EVENT: a kind, as fault; a kind of one arm or job, as fault@arm_1; a job, for its "
        "award; or a row of the event log, from 0. If several events fit, the first one.",
        None,
        metavar="EVENT",
    ),
    as_json: bool = option("--trace: print JSON.", False, flag="--json"),
) -> None:
    """Write the page of a run or recording, finished or not, or of several runs; with --trace, explain an event."""
    from scenarios.evaluate.study import CARD
    from scenarios.live.recording_report import open_recording
    from scenarios.result_folder import check_file, new_file
    from scenarios.run.log import open_run
    from scenarios.spec.load import load

    if as_json and trace is None:
        raise FleetError("--json is for --trace: leave it out.")
    if missing := [folder for folder in folders or () if not folder.is_dir()]:
        raise FleetError(f"There is no folder '{missing[0]}'. Give the folder of a run or of a recording.")
    if folders and len(folders) > 1:
        if trace is not None or scenario is not None or meshes:
            raise FleetError("--trace, --scenario and --meshes are for one folder: leave them out, or give one folder.")
        _compare_runs(folders, out)
        return
    folder = folders[0] if folders else last_folder(Path("runs"))
    if out is not None:
        check_file(out, (".html",), overwrite=True)
    if (folder / CARD).exists():
        raise FleetError(f"'{folder}' is of `thermofleet compare`: open its index.html in a browser.")
    if (folder / "fleet.json").exists() and (folder / "recording").is_dir():
        raise FleetError(f"'{folder}' is of `thermofleet up`: give '{folder / 'recording'}'.")
    if trace is not None:
        from scenarios.live.trace import thread_of, thread_table

        thread = thread_of(folder, trace)
        print_either(as_json, thread.as_json(), thread_table(thread))
        return
    if (folder / "run.json").exists():
        html = open_run(folder).page(meshes=meshes)
    else:
        html = open_recording(folder, None if scenario is None else load(scenario)).page()
    path = out or folder / "report.html"
    with new_file(path) as draft:
        draft.write_text(html, encoding="utf-8")
    say(f"Open {path} in a browser.", out_console)


def _compare_runs(folders: Sequence[Path], out: Path | None) -> None:
    """Write the page of several runs, or their table."""
    from scenarios.result_folder import new_file
    from scenarios.run.log import open_run
    from scenarios.show.run_page import runs_page, runs_table

    path = out or folders[0].parent / "compared.html"
    options.check_table_file(path, (".html",))
    if strange := [folder for folder in folders if not (folder / "run.json").exists()]:
        raise FleetError(f"Of several folders each must be of `thermofleet run` (got '{strange[0]}'): leave it out.")
    names = [folder.resolve().name for folder in folders]
    logs = {
        name if names.count(name) == 1 else str(folder): open_run(folder)
        for name, folder in zip(names, folders, strict=True)
    }
    if len(logs) < len(folders):
        raise FleetError("A run is given twice. Give each folder once.")
    with new_file(path) as draft:
        if path.suffix.lower() == ".html":
            draft.write_text(runs_page(logs), encoding="utf-8")
        else:
            draft.write_bytes(runs_table(logs, in_file=True).content(path.suffix.lower()))
    say(f"Written to {path}.", out_console)


def last_folder(runs: Path) -> Path:
    """The folder of the run or recording that was written last.

    Raises:
        FleetError: there is none.
    """
    cards = [card for name in ("*/run.json", "*/recording.json", "*/*/recording.json") for card in runs.glob(name)]
    if not cards:
        raise FleetError(f"There is no run in '{runs}'. Give the folder of a run or of a recording.")
    return max(cards, key=lambda card: card.stat().st_mtime_ns).parent
