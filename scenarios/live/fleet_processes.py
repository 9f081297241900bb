"""The processes of a live fleet on one machine: router, arms, recorder, auctioneer and page, under one supervisor."""

import os
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import msgspec

from agents.policy import no_simulator
from fleet.bus.security.access_control import Role, file_of, read_roster
from fleet.bus.security.tls import Tls
from fleet.errors import FleetError, nearest
from fleet.files import atomic_path
from fleet.live.supervisor import Part, Supervisor, share_memory
from scenarios.cli.options import flags_of, split_names
from scenarios.extras import require_extra
from scenarios.live.auctioneer import folder_of, refuse_other_way
from scenarios.policy_loader import plans, scope_of
from scenarios.result_folder import disk_errors
from scenarios.signals import until_stopped
from scenarios.spec.load import load
from scenarios.spec.options import PAGE_PORT, PORT, LiveSpec
from scenarios.terminal import err_console, out_console, progress_bar, say

START_S = 60.0
"""Real seconds until a participant must be ready: an arm loads its twin."""
PAGE_READY = "ready page "
SHARED = (
    *("fleet.bus.router", "scenarios.cli.live", "scenarios.live.arm", "scenarios.live.auctioneer"),
    *("scenarios.prepare.fleet", "fleet.live.arm.body"),
)
"""Modules of the participants, which `up` imports once, before it forks them; none may start a thread, as pyarrow."""
SHARED_BY_PAGE = ("scenarios.live.gateway",)
PROGRAM = (sys.executable, "-c", "from scenarios.cli.main import main; main()")


WATCHERS: tuple[Role, ...] = ("monitor", "operator", "submitter", "recorder")
"""Roles that may watch a fleet with its jobs; the first with a certificate here is named."""
CARD = "fleet.json"


class FleetCard(msgspec.Struct, frozen=True):
    """Content of `fleet.json` in the folder of a fleet."""

    fleet: str
    seed: int


def parts_of(
    scenario: str,
    names: tuple[str, ...],
    spec: LiveSpec,
    *,
    port: int,
    folder: Path,
    tls: Path | None = None,
    host: str = "",
    at: str = "",
) -> tuple[Part, list[Part], Part, Part | None]:
    """Router, arms, recorder and auctioneer of a fleet, as `Supervisor` starts them.

    Args:
        scenario: A library name or a file.
        names: Names of the arms.
        spec: Of all processes; its journal is that of `folder`.
        folder: Folder of journals, recording and logs.
        tls: Folder with a certificate of every participant; None for plain TCP.
        host: Address on which the router listens; "" for loopback only.
        at: Endpoint of the router, if it is not the one returned.

    Returns:
        The auctioneer is None with a policy of scope `arm`.
    """
    from fleet.bus.router import reached_at

    own = f"{'tls' if tls else 'tcp'}/{reached_at(host or '127.0.0.1')}:{port}"
    address, spec = at or own, replace(spec, journal=folder / "journals")

    def part(name: str, *words: str, user: str, rank: int, essential: bool = False) -> Part:
        endpoint = address if tls is None else Tls(tls, user).endpoint(address)
        # What they compute now and then is not worth numba's 80 MB, and seconds to load.
        env = {"NUMBA_DISABLE_JIT": "1"}
        argv = (*PROGRAM, *words, "--endpoint", endpoint)
        return Part(name=name, argv=argv, rank=rank, essential=essential, env=env)

    shared, allocation = ("fleet", "speed", "journal", "seed"), ("policy", "jobs", "new_epoch")
    alone, ends = scope_of(spec.policy) == "arm", spec.jobs == "scenario"
    options = flags_of(spec, *shared, "difficulty", "risk", *(allocation if alone else ()))
    secure = () if tls is None else ("--tls", str(tls), "--scenario", scenario)
    listen = ("--port", str(port), *(("--host", host) if host else ()))
    router = Part(name="router", argv=(*PROGRAM, "bus", "router", *listen, *secure), ready=own)
    arms = [
        part(f"arm-{name}", "arm", "run", scenario, name, *options, user=name, rank=2, essential=alone and ends)
        for name in names
    ]
    recording = ("--out", str(folder / "recording"))
    record = part("record", "bus", "record", spec.fleet, *recording, user="recorder", rank=1)
    record = replace(record, env={"ARROW_DEFAULT_MEMORY_POOL": "system"})  # Arrow's own keeps 10 MB after each part
    if alone:
        return router, arms, record, None
    options = flags_of(spec, *shared, *allocation)
    auction = part("auction", "bus", "auctioneer", scenario, *options, user="auctioneer", rank=3, essential=ends)
    return router, arms, record, auction


def run_fleet(
    scenario: str,
    spec: LiveSpec,
    *,
    out: Path | None = None,
    port: int | None = None,
    tls: Path | None = None,
    arms: str = "",
    router: str = "",
    host: str = "",
    page: bool = False,
    webhooks: Sequence[str] = (),
) -> None:
    """Start a fleet, or a part of it, and keep it running until its shift ends, its jobs are settled, or it is stopped.

    With `jobs` "none" only Ctrl-C or SIGTERM ends it.

    Raises:
        FleetError: options contradict each other or the journals, or a process cannot be started.
    """
    from scenarios.prepare.fleet import prepare

    chosen = load(scenario)
    if page:
        _check_page(tls, webhooks)
    fleet, folder = folder_of(out, spec.fleet, chosen)
    card = FleetCard(fleet, spec.seed)
    refuse_other_fleet(folder, card, new_epoch=spec.new_epoch)
    if tls is not None and fleet != chosen.name:
        raise FleetError(f"The keys of --tls are for the fleet of their scenario; leave --fleet out (got '{fleet}').")
    names = chosen_arms(arms, tuple(arm.name for arm in chosen.arms))
    _check_place(arms, router, host, names[0], tls)
    if tls is not None:
        check_roster(tls, scenario)
    if plans(spec.policy):  # before anything is started
        raise no_simulator(spec.policy)
    refuse_other_way(folder / "journals", names, alone=scope_of(spec.policy) == "arm", new_epoch=spec.new_epoch)
    wanted = (0,) if router else (PORT, 0) if port is None else (port,)
    with hold_port(*wanted) as held, progress_bar() as progress:  # planning may take minutes: the port is taken first
        own_port = held.getsockname()[1]
        for module in (*SHARED, *(SHARED_BY_PAGE if page else ())):  # first, so that the memory of `prepare` is freed
            import_module(module)
        # Once, so that no arm has to plan or train by itself.
        prepare(chosen, difficulty=spec.difficulty, risk=spec.risk, progress=progress)
    own_router, parts, record, auction = parts_of(
        scenario,
        names,
        replace(spec, fleet=fleet),
        port=own_port,
        folder=folder,
        tls=tls,
        host=host,
        at=router,
    )
    at = router or own_router.ready
    shown = page_of(scenario, fleet, at, tls, folder / "recording", webhooks) if page else None
    count = f"{len(parts)} arm{'s' * (len(parts) > 1)}"
    central = f"{count}, which allocate the jobs" if auction is None else f"{count} and the auctioneer"
    say(f"Starting {count if router else f'the router, the recorder, {central}'} …", err_console)
    with disk_errors(folder), atomic_path(folder / CARD) as draft:
        draft.write_bytes(msgspec.json.encode(card))
    share_memory()
    from scenarios.cli.main import main

    # The module of a policy of others may have begun what a fork cannot share: random numbers, threads, open files.
    forked = None if ":" in spec.policy else main
    with until_stopped() as stop, Supervisor(folder / "logs", program=PROGRAM, main=forked) as supervisor:
        # The auctioneer starts late: its clock runs from its start, and the arms must be ready by then.
        own = () if router else ((own_router,), (record, *parts), () if auction is None else (auction,))
        for together in (*(own or (parts,)), () if shown is None else (shown,)):
            if stop.is_set():
                break
            for part in together:
                supervisor.start(part)
            for part in together:
                supervisor.await_ready(part.name, START_S, stop.is_set)
        if not stop.is_set():
            say(
                f"{fleet} is up: {count} at {at}, {spec.speed:g} times as fast as real time; logs in "
                f"{supervisor.folder}. {how_to_watch(scenario, at, tls)}",
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


def how_to_watch(scenario: str, at: str, tls: Path | None) -> str:
    """Sentence with the command that watches the fleet; with TLS by a certificate that is in the folder."""
    command = f"thermofleet bus watch --scenario {scenario} --endpoint"
    if tls is None:
        return f"To watch it: {command} {at}"
    roster = read_roster(tls)
    for role in WATCHERS:
        for name in roster.of_role(role):
            if (tls / f"{file_of(name)}.key").is_file():
                return f"To watch it: {command} {Tls(tls, name).endpoint(at)}"
    monitor = Tls(tls, next(iter(roster.of_role("monitor")), "monitor"))
    files = f"{monitor.file}.pem and {monitor.file}.key"
    return f"To watch it, copy {files} to {tls}: {command} {monitor.endpoint(at)}"


def refuse_other_fleet(folder: Path, card: FleetCard, *, new_epoch: bool = False) -> None:
    """Refuse the folder of another fleet or seed, whose jobs would be continued with those of this one.

    Args:
        new_epoch: Whether another seed may begin.

    Raises:
        FleetError: its card is of another fleet or seed.
    """
    known = card
    with suppress(OSError, msgspec.DecodeError):
        known = msgspec.json.decode((folder / CARD).read_bytes(), type=FleetCard)
    if known.fleet != card.fleet:
        raise FleetError(f"'{folder}' is of fleet '{known.fleet}', not of '{card.fleet}': give another --out.")
    if known.seed != card.seed and not new_epoch:
        remedy = f"give --seed {known.seed} to continue it, or another --out"
        raise FleetError(f"'{folder}' is of a fleet with --seed {known.seed} (got {card.seed}): {remedy}.")


def page_of(
    scenario: str, fleet: str, at: str, tls: Path | None, recording: Path, webhooks: Sequence[str] = ()
) -> Part:
    """The live page of a fleet, on a port that is free now; it keeps the port when it is restarted."""
    endpoint, port = at if tls is None else Tls(tls, "operator").endpoint(at), free_port(PAGE_PORT)
    words = ("bus", "gateway", "--page", "--scenario", scenario, "--endpoint", endpoint, "--fleet", fleet)
    targets = [word for url in webhooks for word in ("--webhook", url)]
    argv = (*PROGRAM, *words, "--recording", str(recording), "--port", str(port), *targets)
    return Part(name="page", argv=argv, rank=4, ready=f"{PAGE_READY}http://127.0.0.1:{port}/")


def _check_page(tls: Path | None, webhooks: Sequence[str]) -> None:
    """Check that the page can be served.

    Raises:
        MissingExtra: a library is missing.
        FleetError: a token or a certificate is missing, or a webhook cannot be used.
    """
    require_extra("gateway")
    require_extra("report")
    from scenarios.live.gateway import TOKEN
    from scenarios.live.webhooks import webhooks_of

    webhooks_of(webhooks)

    if tls is not None and not os.environ.get(TOKEN):
        raise FleetError(f"With --tls the page needs a token: set {TOKEN} to 16 or more random characters.")
    if tls is not None and not (tls / "operator.pem").is_file():
        raise FleetError(f"The page needs a certificate: thermofleet bus keys {tls} --add operator:operator")


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
    from fleet.bus.router import reachable

    if router and not arms:
        raise FleetError("--router is for a part of a fleet; name the arms to start here: --arms NAME,NAME.")
    if router and host:
        raise FleetError("--host is for a router that is started here; with --router leave it out.")
    if router:
        reachable(router, None if tls is None else Tls(tls, name))
    if host and tls is None:
        raise FleetError(f"--host {host} needs --tls: plain TCP does not authenticate, so it is limited to loopback.")


def hold_port(*wanted: int) -> socket.socket:
    """Socket that holds the first of these ports of 127.0.0.1 that is free, 0 for any; nothing listens there.

    Raises:
        FleetError: none is free.
    """
    held, reason = socket.socket(), ""
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as routers do: one that has just exited is free
    for port in wanted:
        try:
            held.bind(("127.0.0.1", port))
        except OSError as error:
            reason = error.strerror or str(error)
        else:
            return held
    held.close()
    raise FleetError(
        f"Port {wanted[-1]} of 127.0.0.1 cannot be used ({reason}). Give another --port; 0 is any free one."
    )


def free_port(wanted: int = 0) -> int:
    """Port of 127.0.0.1 that is free now: the wanted one if possible; the router keeps it when it is restarted."""
    with hold_port(wanted, 0) as held:
        return held.getsockname()[1]


def check_roster(folder: Path | None, scenario: str) -> None:
    """Check that a folder of keys has a certificate for every arm of a scenario.

    Raises:
        FleetError: it has not, or it is not a folder of keys of this scenario.
    """
    if folder is None:
        raise FleetError("--scenario needs --tls: without TLS there are no certificates to check.")
    chosen, roster = load(scenario), read_roster(folder)
    if roster.fleet != chosen.name:
        raise FleetError(f"The keys in '{folder}' are for the fleet '{roster.fleet}', not for '{chosen.name}'.")
    missing = [arm.name for arm in chosen.arms if arm.name not in roster.of_role("arm")]
    if missing:
        raise FleetError(
            f"No certificate in '{folder}' for {', '.join(missing)}; make one with: thermofleet bus keys {folder} "
            f"--add {missing[0]}:arm."
        )
