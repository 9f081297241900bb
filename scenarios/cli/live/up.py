"""`thermofleet up`: a whole fleet as processes of its own, supervised: router, arms, recorder, maybe an auctioneer."""

import socket
import sys
from pathlib import Path
from typing import Annotated

import typer

from fleet.bus.security.tls import Tls
from fleet.errors import FleetError
from fleet.live.supervisor import Part, Supervisor
from scenarios.cli.options import PolicyOption
from scenarios.cli.terminal import err_console, out_console, progress_bar, say
from scenarios.load import load
from scenarios.policy_loader import scope_of

START_S = 60.0
"""Real seconds that a participant has to say that it is ready: an arm loads its twin."""
PORT = 7447
"""Where every command looks for the router unless it is told."""
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
    jobs: str,
    seed: int,
    tls: Path | None = None,
) -> tuple[Part, list[Part], Part, Part | None]:
    """Router, arms, recorder and auctioneer, if it has one, of a fleet, as `Supervisor` starts them.

    Args:
        scenario: A library name or a file.
        names: Of the arms.
        folder: Holds journals, recording and logs.
        tls: Folder with a certificate of everybody; None for plain TCP.
    """
    address = f"{'tls' if tls else 'tcp'}/127.0.0.1:{port}"
    secure = () if tls is None else ("--tls", str(tls), "--scenario", scenario)

    def reach(name: str) -> tuple[str, str]:
        return "--endpoint", address if tls is None else Tls(tls, name).endpoint(address)

    of_fleet = ("--fleet", fleet, "--speed", f"{speed:g}", "--journal", str(folder / "journals"))
    router = Part(name="router", argv=(*PROGRAM, "router", "--port", str(port), *secure), ready=address)
    scored = ("--difficulty", difficulty, "--seed", str(seed))
    how = ("--policy", policy, "--jobs", jobs)
    alone, ends = scope_of(policy) == "arm", jobs == "scenario"
    if alone:
        scored = (*scored, *how)
    arms = [
        Part(
            name=f"arm-{name}",
            argv=(*PROGRAM, "arm", scenario, name, *reach(name), *of_fleet, *scored),
            essential=alone and ends,
            rank=2,
        )
        for name in names
    ]
    kept = (*reach("recorder"), "--out", str(folder / "recording"))
    record = Part(name="record", argv=(*PROGRAM, "record", fleet, *kept), rank=1)
    if alone:
        return router, arms, record, None
    argv = (*PROGRAM, "auction", scenario, *reach("auctioneer"), *of_fleet, *how, "--seed", str(seed))
    return router, arms, record, Part(name="auction", argv=argv, essential=ends, rank=3)


def up_command(
    scenario: Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")],
    speed: Annotated[float, typer.Option(help="Fleet seconds per real second.")] = 60.0,
    policy: PolicyOption = "matching",
    difficulty: Annotated[str, typer.Option(help="What scores the plans: twin or blind.")] = "twin",
    jobs: Annotated[
        str, typer.Option(help="scenario: its own stream, until it is done; none: what others submit, until Ctrl-C.")
    ] = "scenario",
    seed: Annotated[int, typer.Option(help="Draws the scenario's jobs and the sensors' noise; 0 or more.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for journals, recording and logs; default runs/live-FLEET.")
    ] = None,
    port: Annotated[
        int | None, typer.Option(help="Loopback port of the router; 0 is any free one. Default: 7447, or any if taken.")
    ] = None,
    fleet: Annotated[str, typer.Option(help="Name of the fleet; default: the scenario's name.")] = "",
    tls: Annotated[
        Path | None, typer.Option(help="Folder that thermofleet keys made for this scenario: mutual TLS and its rules.")
    ] = None,
) -> None:
    """Start a whole fleet, each participant a process of its own, and keep it running until its work is done.

    What ends is started again with back-off; Ctrl-C ends all in order. The same command with the same --out goes on
    where the journals stop.
    """
    from scenarios.cli.live.consensus import refuse_other_way
    from scenarios.cli.signals import until_stopped
    from scenarios.prepare.fleet import prepare

    chosen = load(scenario)
    if not 0 < speed < float("inf") or seed < 0 or not 0 <= (port or 0) <= 65535:
        raise FleetError(f"--speed must be > 0, --seed >= 0, --port 0 to 65535 (got {speed:g}, {seed}, {port or 0}).")
    if difficulty not in ("twin", "blind") or jobs not in ("scenario", "none"):
        raise FleetError(f"--difficulty is twin or blind, --jobs scenario or none (got {difficulty}, {jobs}).")
    fleet = fleet or chosen.name
    if tls is not None and fleet != chosen.name:
        raise FleetError(f"The keys of --tls are for the fleet of their scenario; leave --fleet out (got '{fleet}').")
    folder = out or Path("runs") / f"live-{fleet}"
    refuse_other_way(folder / "journals", (arm.name for arm in chosen.arms), alone=scope_of(policy) == "arm")
    with progress_bar() as progress:  # once, so that no arm has to plan or train by itself
        prepare(chosen, difficulty="twin" if difficulty == "twin" else "blind", progress=progress)
    router, arms, record, auction = parts_of(
        scenario,
        tuple(arm.name for arm in chosen.arms),
        port=port or free_port(PORT if port is None else 0),
        fleet=fleet,
        folder=folder,
        speed=speed,
        policy=policy,
        difficulty=difficulty,
        jobs=jobs,
        seed=seed,
        tls=tls,
    )
    look = Tls(tls, "monitor").endpoint(router.ready) if tls else router.ready
    who = f"{len(arms)} arms, which share the jobs out" if auction is None else f"{len(arms)} arms and the auctioneer"
    say(f"Starting the router, the recorder, {who} …", err_console)
    with until_stopped() as stop, Supervisor(folder / "logs") as supervisor:
        supervisor.start(router, ready_s=START_S)
        for part in (record, *arms):
            supervisor.start(part)
        for part in (record, *arms):
            supervisor.await_ready(part.name, START_S, stop.is_set)
        if auction is not None:
            supervisor.start(auction)
            supervisor.await_ready(auction.name, START_S, stop.is_set)
        say(
            f"{fleet} is up: {len(arms)} arms at {router.ready}, {speed:g} times as fast as real time; logs in "
            f"{supervisor.folder}. Look: thermofleet watch --endpoint {look}",
            out_console,
        )
        ended = supervisor.run(stop.is_set)
        if ended:
            for line in supervisor.log_since_ready(ended).splitlines():
                say(line, out_console)
        else:
            say("Stopping; every participant ends in order …", err_console)
        again = {name: count for name, count in supervisor.restarts().items() if count}
    if again:
        say("Started again: " + ", ".join(f"{name} {count} time(s)" for name, count in again.items()), out_console)
    say(f"Recorded in {folder / 'recording'}.", out_console)
    stop.leave(f"The fleet was stopped; journals, recording and logs are in {folder}, and the same command goes on.")


def free_port(wanted: int = 0) -> int:
    """A port of 127.0.0.1 that nobody listens on now: the router needs the same one when it is started again.

    Args:
        wanted: Taken if it is free; 0 for any.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as routers do: one that has just ended is free
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
