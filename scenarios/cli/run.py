"""`thermofleet run` and `thermofleet demo`."""

import gc
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet.bus.exchange.channel import Channel
from fleet.errors import FleetError
from fleet.fields import option
from scenarios.cli import options
from scenarios.cli.options import From, Given
from scenarios.spec.options import RunSpec
from scenarios.terminal import INTERRUPTED, Interrupted, out_console, print_json, progress_bar, say

if TYPE_CHECKING:  # slow to import
    from scenarios.prepare.fleet import Fleet
    from scenarios.progress import Progress
    from scenarios.run.log import RunLog
    from scenarios.spec.schema import Scenario

DEMO_POLICY = "wsept"
"""The policy that the demo compares with `round_robin`."""
PAIR = "index.html"
"""The page of the demo."""
ABOUT = (
    "The same jobs under two policies: round_robin gives the next job to the next arm, at any temperature. {policy} "
    "subtracts the expected cost of heat from the value of a job.",
    "Where the motions of two claims exclude each other, the arm with the lower difficulty d gets its job. So the "
    "figures depend on the predictions, here those of the arms' twins, also under round_robin. Messages between the "
    "arms go through memory (bus memory); over Zenoh the shift is the same.",
)
"""First sentences of the page."""


def run_command(
    scenario: str = options.SCENARIO,
    *,
    given: Annotated[Given, From(RunSpec, "policy", "seed", "plant", "bus", "difficulty", "risk")],
    channel: Annotated[Given, From(Channel)],
    out: Path | None = option("Folder of the recording; default: runs/SCENARIO-POLICY-SEED.", None),
    overwrite: bool = options.OVERWRITE,
    listen: int = option(
        "Loopback port on which other programs can subscribe. 0: a private router on a free port.",
        0,
        low=0,
        high=65535,
    ),
    as_json: bool = options.JSON,
) -> None:
    """Run one shift of a scenario and record it."""
    from scenarios.policy_loader import blaming, label, policy_of
    from scenarios.result_folder import check_free
    from scenarios.run.log import RUN
    from scenarios.show.late_jobs import standstill, standstill_text
    from scenarios.show.run_page import figure_table
    from scenarios.spec.jobs import check_some_jobs
    from scenarios.spec.load import load, own_seed

    chosen = load(scenario)
    given = {"seed": own_seed(scenario), **given}
    spec = RunSpec(**given, channel=options.channel_of(chosen, **channel))
    with blaming(spec.policy, "loading"):
        policy_of(spec.policy)
    if listen and spec.bus == "memory":
        raise FleetError(f"--listen needs --bus zenoh (got {listen} and {spec.bus}).")
    where = out or Path("runs") / f"{chosen.name}-{label(spec.policy).replace(':', '-')}-{spec.seed}"
    check_free(where, RUN, overwrite=overwrite)
    check_some_jobs(chosen, spec.seed)
    with ExitStack() as open_until_end:
        endpoint = None
        if listen:  # before the fleet connects, so that listeners miss no message
            from fleet.bus.router import Router

            endpoint = open_until_end.enter_context(Router(listen)).endpoint
        progress = open_until_end.enter_context(progress_bar())
        _, result = _run_into(chosen, spec, where, overwrite, progress, endpoint=endpoint)
    if as_json:
        keys = ("status", "policy", "seed", "plant", "bus", "difficulty", "reward", "metrics")
        print_json({"out": str(where), **{key: result.card[key] for key in keys}})
    else:
        say(f"{chosen.name}, seed {spec.seed}", out_console)
        figures = figure_table({label(spec.policy): result.card["metrics"]}, wholes=True)
        peaks = [(f"peak {arm}, °C", f"{peak_c:.1f}") for arm, peak_c in result.metrics.peak_c.items()]
        out_console.print(replace(figures, rows=(*figures.rows, *peaks)))
        if result.metrics.illegal_actions:
            say(f"The policy chose {result.metrics.illegal_actions} illegal actions; each counted as a wait.")
        if result.finished:
            say(f"Recorded in {where}; open {where / 'report.html'} in a browser.", out_console)
    if stood := standstill(result):
        say(standstill_text(result, stood))
    if not result.finished:
        say(
            f"Interrupted after {result.time_s:g} s of {chosen.horizon_s:g} s: the shift until then is kept in {where} "
            "(status 'interrupted'). The same command runs the whole shift again with the cached plans and twins."
        )
        raise typer.Exit(INTERRUPTED)


def demo_command(
    out: Path = option("Folder of the two recordings and of the page that compares them.", Path("out/demo")),
    *,
    given: Annotated[Given, From(RunSpec, "seed", seed=5)],
) -> None:
    """Run the quickstart shift under two policies, and compare them on one page."""
    from scenarios.result_folder import disk_errors
    from scenarios.show.run_page import figure_table, runs_page
    from scenarios.spec.load import load

    chosen, seed = load("quickstart"), given["seed"]
    results: dict[str, RunLog] = {}
    fleet = None
    with progress_bar() as progress:
        for policy in ("round_robin", DEMO_POLICY):
            fleet, result = _run_into(
                chosen, RunSpec(policy=policy, seed=seed, bus="memory"), out / policy, True, progress, fleet=fleet
            )
            if not result.finished:
                raise Interrupted(f"Interrupted while working; recordings are in {out}.")
            results[policy] = result
    with disk_errors(out):
        about = [sentence.format(policy=DEMO_POLICY) for sentence in ABOUT]
        model = results[DEMO_POLICY].cell_model()
        title = f"{chosen.name} · seed {seed} · two policies"
        reports = {policy: f"{policy}/report.html" for policy in results}
        page = runs_page(results, title=title, lead=about, reports=reports, model=model)
        (out / PAIR).write_text(page, encoding="utf-8")
    say(f"{chosen.name}, seed {seed}: {chosen.description}", out_console)
    out_console.print(figure_table({policy: result.card["metrics"] for policy, result in results.items()}))
    for result in sorted(results.values(), key=lambda each: -len(each.faults)):
        count = len(result.faults)
        of = ", ".join(dict.fromkeys(f"{fault.arm} (joint {fault.joint})" for fault in result.faults))
        how = f"{count} fault{'s' * (count > 1)}, of {of}" if count else "no fault"
        say(f"{result.policy}: {how}. {out / result.policy / 'report.html'}", out_console)
    say(f"Open {out / PAIR} in a browser to see both side by side.", out_console)


def _run_into(
    scenario: "Scenario",
    spec: RunSpec,
    out: Path,
    overwrite: bool,
    progress: "Progress",
    *,
    endpoint: str | None = None,
    fleet: "Fleet | None" = None,
) -> tuple["Fleet", "RunLog"]:
    """Run a shift and write it to `out`; the fleet is prepared unless it is given."""
    from scenarios.prepare.fleet import prepare
    from scenarios.result_folder import new_folder
    from scenarios.run.log import RUN
    from scenarios.run.shift import run

    with new_folder(out, RUN, overwrite=overwrite) as folder:
        fleet = fleet or prepare(scenario, difficulty=spec.difficulty, risk=spec.risk, progress=progress)
        with stop_on_interrupt() as stopped:
            result = run(fleet, spec, progress=progress, stopped=stopped, endpoint=endpoint)
            progress("writing", 0.0)
            gc.collect()  # the environment of a large fleet, which the page needs no more
            result.write(folder)
    return fleet, result


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """A function that returns True after Ctrl-C, so that a shift ends between two steps; a second Ctrl-C aborts it."""
    pressed = threading.Event()

    def note(_signal: int, _frame: object) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield pressed.is_set
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)
