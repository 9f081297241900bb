"""`thermofleet up`: run a whole fleet, each participant as its own process: router, arms, recorder and auctioneer."""

import os
import socket
import sys
from pathlib import Path
from typing import Annotated

import typer

from agents.policy import no_simulator
from fleet.bus.security.tls import Tls
from fleet.errors import FleetError, nearest
from fleet.live.supervisor import Part, Supervisor
from scenarios.cli.live.journals import folder_of, refuse_other_way
from scenarios.cli.live.options import (
    JobsOption,
    ModelOption,
    NewEpochOption,
    ScenarioFleetOption,
    SeedOption,
    SpeedOption,
)
from scenarios.cli.options import PolicyOption, RiskOption, ScenarioArg, number, split_names
from scenarios.cli.router import PORT, check_roster
from scenarios.cli.signals import until_stopped
from scenarios.cli.terminal import err_console, out_console, progress_bar, say
from scenarios.extras import require_extra
from scenarios.load import load
from scenarios.policy_loader import plans, scope_of
from scenarios.schema_errors import choose

START_S = 60.0
"""Real seconds until a participant must be ready: an arm loads its twin."""
PAGE_PORT, PAGE_READY = 8080, "ready page "
PROGRAM = (sys.executable, "-c", "from scenarios.cli.main import main; main()")


def parts_of(
    scenario: str,
    names: tuple[str, ...],
    *,
    port: int,
    fleet: str,
    folder: Path,
    speed: float,
    policy: str,
    difficulty: str,
    risk: str = "rc",
    jobs: str,
    seed: int,
    tls: Path | None = None,
    new_epoch: bool = False,
    host: str = "",
    at: str = "",
) -> tuple[Part, list[Part], Part, Part | None]:
    """Router, arms, recorder and auctioneer of a fleet, as `Supervisor` starts them.

    Args:
        scenario: A library name or a file.
        names: Names of the arms.
        folder: Folder of journals, recording and logs.
        tls: Folder with a certificate of every participant; None for plain TCP.
        host: Address on which the router listens; "" for loopback only.
        at: Endpoint of the router, if it is not the one returned.

    Returns:
        The auctioneer is None with a policy of scope `arm`.
    """
    from fleet.bus.client.router import reached_at

    own = f"{'tls' if tls else 'tcp'}/{reached_at(host or '127.0.0.1')}:{port}"
    address = at or own

    def part(name: str, command: str, *options: str, user: str, rank: int, essential: bool = False) -> Part:
        endpoint = address if tls is None else Tls(tls, user).endpoint(address)
        argv = (*PROGRAM, command, *options, "--endpoint", endpoint)
        return Part(name=name, argv=argv, rank=rank, essential=essential)

    shared = ("--fleet", fleet, "--speed", f"{speed:g}", "--journal", str(folder / "journals"), "--seed", str(seed))
    allocation = ("--policy", policy, "--jobs", jobs)
    without_auctioneer, ends = scope_of(policy) == "arm", jobs == "scenario"
    begins = ("--new-epoch",) if new_epoch else ()
    alone = (*allocation, *begins) if without_auctioneer else ()
    options = (*shared, "--difficulty", difficulty, "--risk", risk, *alone)
    secure = () if tls is None else ("--tls", str(tls), "--scenario", scenario)
    listen = ("--port", str(port), *(("--host", host) if host else ()))
    router = Part(name="router", argv=(*PROGRAM, "router", *listen, *secure), ready=own)
    arms = [
        part(f"arm-{name}", "arm", scenario, name, *options, user=name, rank=2, essential=without_auctioneer and ends)
        for name in names
    ]
    record = part("record", "record", fleet, "--out", str(folder / "recording"), user="recorder", rank=1)
    if without_auctioneer:
        return router, arms, record, None
    auction = part(
        "auction", "auction", scenario, *shared, *allocation, *begins, user="auctioneer", rank=3, essential=ends
    )
    return router, arms, record, auction


def up_command(
    scenario: ScenarioArg,
    speed: SpeedOption = 60.0,
    policy: PolicyOption = "matching",
    difficulty: ModelOption = "twin",
    risk: RiskOption = "rc",
    jobs: JobsOption = "scenario",
    seed: SeedOption = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for journals, recording and logs. Default: runs/live-FLEET.")
    ] = None,
    port: Annotated[
        int | None,
        number("Loopback port of the router; 0 is any free one. Default: 7447, or any if taken.", 0, 65535),
    ] = None,
    fleet: ScenarioFleetOption = "",
    tls: Annotated[
        Path | None,
        typer.Option(help="Folder that thermofleet keys wrote for this scenario: mutual TLS and access control."),
    ] = None,
    new_epoch: NewEpochOption = False,
    arms: Annotated[
        str, typer.Option(help="Start only these arms here, comma-separated; the others run on other machines.")
    ] = "",
    router: Annotated[
        str,
        typer.Option(
            help="--arms: endpoint of a running router, as tls/HOST:PORT. Only the arms are started; router, recorder "
            "and auctioneer run elsewhere."
        ),
    ] = "",
    host: Annotated[
        str, typer.Option(help="--tls: address on which the router listens, as 0.0.0.0. Default: loopback only.")
    ] = "",
    page: Annotated[
        bool,
        typer.Option("--page", help=f"Also serve a live page (thermofleet dashboard), on port {PAGE_PORT} if free."),
    ] = False,
) -> None:
    """Start a whole fleet, each participant as its own process, and keep it running until its jobs are done.

    A process that exits is restarted with back-off; Ctrl-C stops all in order. The same command with the same --out
    continues from the journals. With --arms it starts a part of the fleet.
    """
    from scenarios.prepare.fleet import RiskName, prepare

    chosen = load(scenario)
    fleet, folder = folder_of(out, fleet, chosen)
    if tls is not None and fleet != chosen.name:
        raise FleetError(f"The keys of --tls are for the fleet of their scenario; leave --fleet out (got '{fleet}').")
    names = chosen_arms(arms, tuple(arm.name for arm in chosen.arms))
    _check_place(arms, router, host, names[0], tls)
    if page:
        _check_page(tls)
    if tls is not None:
        check_roster(tls, scenario)
    if plans(policy):  # before anything is started
        raise no_simulator(policy)
    refuse_other_way(folder / "journals", names, alone=scope_of(policy) == "arm", new_epoch=new_epoch)
    with progress_bar() as progress:  # once, so that no arm has to plan or train by itself
        prepare(chosen, difficulty=difficulty, risk=choose("risk", risk, RiskName), progress=progress)
    own_router, parts, record, auction = parts_of(
        scenario,
        names,
        port=PORT if router else port or free_port(PORT if port is None else 0),
        fleet=fleet,
        folder=folder,
        speed=speed,
        policy=policy,
        difficulty=difficulty,
        risk=risk,
        jobs=jobs,
        seed=seed,
        tls=tls,
        new_epoch=new_epoch,
        host=host,
        at=router,
    )
    shown = page_of(scenario, fleet, router or own_router.ready, tls) if page else None
    at, count = router or own_router.ready, f"{len(parts)} arm{'s' * (len(parts) > 1)}"
    central = f"{count}, which allocate the jobs" if auction is None else f"{count} and the auctioneer"
    say(f"Starting {count if router else f'the router, the recorder, {central}'} …", err_console)
    with until_stopped() as stop, Supervisor(folder / "logs") as supervisor:
        if not router:
            supervisor.start(own_router, ready_s=START_S)
        # The auctioneer starts last: its clock runs from its start, and the arms must be ready by then.
        for together in (parts,) if router else ((record, *parts), () if auction is None else (auction,)):
            for part in together:
                supervisor.start(part)
            for part in together:
                supervisor.await_ready(part.name, START_S, stop.is_set)
        if shown is not None:
            supervisor.start(shown, ready_s=START_S)
        watch = Tls(tls, "monitor").endpoint(at) if tls else at
        say(
            f"{fleet} is up: {count} at {at}, {speed:g} times as fast as real time; logs in "
            f"{supervisor.folder}. To watch it: thermofleet watch --scenario {scenario} --endpoint {watch}",
            out_console,
        )
        if shown is not None:
            say(f"Page: {shown.ready.removeprefix(PAGE_READY)}", out_console)
        if ended := supervisor.run(stop.is_set):
            for line in supervisor.log_since_ready(ended).splitlines():
                say(line, out_console)
        else:
            say("Stopping all processes in order …", err_console)
        restarts = ", ".join(f"{name} {count} time(s)" for name, count in supervisor.restarts().items() if count)
    if restarts:
        say(f"Restarted: {restarts}", out_console)
    if not router:
        say(f"Recorded in {folder / 'recording'}.", out_console)
    stop.leave(f"The fleet was stopped; journals, recording and logs are in {folder}; the same command continues.")


def page_of(scenario: str, fleet: str, at: str, tls: Path | None) -> Part:
    """The live page of a fleet, on a port that is free now; it keeps the port when it is restarted."""
    endpoint, port = at if tls is None else Tls(tls, "operator").endpoint(at), free_port(PAGE_PORT)
    argv = (*PROGRAM, "dashboard", scenario, "--endpoint", endpoint, "--fleet", fleet, "--port", str(port))
    return Part(name="page", argv=argv, rank=1, ready=f"{PAGE_READY}http://127.0.0.1:{port}/")


def _check_page(tls: Path | None) -> None:
    """Check that the page can be served.

    Raises:
        MissingExtra: a library is missing.
        FleetError: a token or a certificate is missing.
    """
    require_extra("gateway")
    require_extra("report")
    from scenarios.cli.live.gateway import TOKEN

    if tls is not None and not os.environ.get(TOKEN):
        raise FleetError(f"With --tls the page needs a token: set {TOKEN} to 16 or more random characters.")
    if tls is not None and not (tls / "operator.pem").is_file():
        raise FleetError(f"The page needs a certificate: thermofleet keys {tls} --add operator:operator")


def chosen_arms(text: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Arms of a comma-separated list, in the order of the scenario; all if it is empty.

    Raises:
        FleetError: the scenario has no such arm.
    """
    wanted = split_names(text) if text else list(names)
    if unknown := [name for name in wanted if name not in names]:
        raise FleetError(f"--arms: the scenario has no arm '{unknown[0]}'{nearest(unknown[0], names)}")
    return tuple(name for name in names if name in wanted)


def _check_place(arms: str, router: str, host: str, name: str, tls: Path | None) -> None:
    """Check the options for a fleet on several machines.

    Raises:
        FleetError: two options contradict each other, or the endpoint of the router may not be used.
    """
    from fleet.bus.client.router import reachable

    if router and not arms:
        raise FleetError("--router is for a part of a fleet; name the arms to start here: --arms NAME,NAME.")
    if router and host:
        raise FleetError("--host is for a router that is started here; with --router leave it out.")
    if router:
        reachable(router, None if tls is None else Tls(tls, name))
    if host and tls is None:
        raise FleetError(f"--host {host} needs --tls: plain TCP does not authenticate, so it is limited to loopback.")


def free_port(wanted: int = 0) -> int:
    """Port of 127.0.0.1 that is free now: the wanted one if possible; the router keeps it when it is restarted."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as routers do: one that has just exited is free
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
