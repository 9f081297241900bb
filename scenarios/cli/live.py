"""Commands that run a live fleet: up, `thermofleet arm run` and `thermofleet bus`."""

from dataclasses import MISSING, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from agents.registry import WRAPPERS_HELP, names_of
from fleet.errors import BusError, FleetError
from fleet.fields import MAX_SPEED, MIN_SPEED, argument, option
from scenarios.cli import options
from scenarios.cli.options import From, Given
from scenarios.spec.options import PAGE_PORT, PORT, LiveSpec
from scenarios.terminal import echo, out_console, say

if TYPE_CHECKING:
    from scenarios.spec.schema import Scenario

UNHEALTHY = 1
"""Exit code of `bus doctor`; 0 is a healthy fleet, and 2, as for every error of use, one that cannot be reached."""
LINK_S = 3.0
"""Real seconds between two checks of the links of a router."""
_TLS = "Mutual TLS"
_WEBHOOK = option(
    "URL that gets every change of an alarm; may be repeated. It is signed with THERMOFLEET_WEBHOOK_SECRET; beyond "
    "this machine it must be https.",
    None,
)


def up_command(
    scenario: str = options.SCENARIO,
    *,
    given: Annotated[
        Given,
        From(LiveSpec, "speed", "policy", "difficulty", "risk", "jobs", "seed", "fleet", "new_epoch", speed=60.0),
    ],
    out: Path | None = option("Folder for journals, recording and logs. Default: runs/live-FLEET.", None),
    port: int | None = option(
        "Loopback port of the router; 0 is any free one. Default: 7447, or any if taken.", None, low=0, high=65535
    ),
    tls: Path | None = option(
        "Folder that `thermofleet bus keys` made for this scenario: TLS and access control.", None
    ),
    arms: str = option("Start only these arms here, comma-separated; the others run on other machines.", ""),
    router: str = option(
        "--arms: endpoint of a running router, as tls/HOST:PORT. Only the arms are started; router, recorder "
        "and auctioneer run elsewhere.",
        "",
    ),
    host: str = option("--tls: address on which the router listens, as 0.0.0.0. Default: loopback only.", ""),
    page: bool = option(f"Also serve a live page (bus gateway --page), on port {PAGE_PORT} if free.", False),
    webhook: list[str] | None = _WEBHOOK,
) -> None:
    """Start a fleet, one process per participant, and run it until its shift ends or all its jobs are settled.

    With --jobs none it runs until Ctrl-C. A process that exits is restarted with back-off; Ctrl-C stops all in order.
    The same command with the same --out continues from the journals. With --arms it starts a part of the fleet.
    """
    from scenarios.live.fleet_processes import run_fleet
    from scenarios.result_folder import check_folder

    if out is not None:
        check_folder(out)
    if webhook and not page:
        raise FleetError("--webhook is sent by the gateway of the page: add --page.")
    place = {"port": port, "tls": tls, "arms": arms, "router": router, "host": host}
    run_fleet(scenario, LiveSpec(**given), out=out, **place, page=page, webhooks=webhook or ())


def arm_command(
    scenario: str = options.SCENARIO,
    name: str = argument("Arm of the scenario; with --source log any name.", is_name=True),
    file: Path | None = argument("--source log: a Gen3 log, a plain log, or the telemetry.parquet of a run.", None),
    *,
    given: Annotated[Given, From(LiveSpec, "difficulty", "risk", "seed", "journal", "jobs", "fleet", "new_epoch")],
    source: Literal["sim", "log"] = option("sim (the scenario's arm), or log FILE.", "sim"),
    twin: Path | None = option(
        "--source log: folder of the arm's twin, which scores the motion; the scores are in its states.", None
    ),
    network: Path | None = option(
        "--source log: folder of `thermofleet twin identify`; the temperatures that it yields are in the states.", None
    ),
    policy: str = option(
        f"Allocate jobs without an auctioneer, by a policy of scope arm: {names_of('arm')}, a user-defined one as "
        f"FILE.py:CLASS, or a folder of `thermofleet train`; {WRAPPERS_HELP}. Default: an auctioneer awards them.",
        "",
    ),
    speed: float | None = option(
        "Fleet seconds per real second. Default: the auctioneer's, else 1.", None, low=MIN_SPEED, high=MAX_SPEED
    ),
    rate_hz: float = option(
        "State messages per real second while it works; an idle arm publishes two.", 10.0, low=0, high=100, above=True
    ),
    capacity: int = option("Maximum concurrent jobs.", 1, low=1, high=256),
    endpoint: str = options.ENDPOINT,
) -> None:
    """Run one arm of a fleet until Ctrl-C or SIGTERM: publish its state, quote and execute jobs, report results."""
    from scenarios.spec.load import load

    chosen = load(scenario)
    if (source == "log") != (file is not None):
        words = f"{source} {file or ''}".strip()
        raise FleetError(f"--source must be sim, or log with a FILE after the arm's name (got {words}).")
    if source == "sim" and (twin or network):
        raise FleetError("--twin and --network are for --source log: a simulated arm has those of its scenario.")
    from scenarios.live.arm import run_arm

    spec = LiveSpec(**given)
    spec = replace(spec, policy=policy) if policy else spec
    alone = bool(policy)
    own = {"file": file, "twin": twin, "network": network}
    run_arm(chosen, name, spec, endpoint, alone=alone, **own, speed=speed, rate_hz=rate_hz, capacity=capacity)


def auctioneer_command(
    scenario: str = options.SCENARIO,
    *,
    given: Annotated[Given, From(LiveSpec, "policy", "speed", "journal", "jobs", "seed", "fleet", "new_epoch")],
    name: str = option("Name of the auctioneer; part of its keys.", "auctioneer", is_name=True),
    endpoint: str = options.ENDPOINT,
) -> None:
    """Auction jobs to the arms of a fleet, serve the fleet clock, and record awards in a journal."""
    from scenarios.live.auctioneer import run_auctioneer
    from scenarios.spec.load import load

    run_auctioneer(load(scenario), name, LiveSpec(**given), endpoint)


def router_command(
    port: int = option("TCP port; 0 is any free one.", PORT, low=0, high=65535),
    host: str = option("Address to listen on; beyond loopback only with --tls.", "127.0.0.1"),
    state_hz: float = option(
        "Telemetry messages forwarded per second and session; 0 is unlimited.", 100.0, low=0, high=1_000_000
    ),
    tls: Path | None = option(
        "Folder that `thermofleet bus keys` made: mutual TLS, and access by role.", None, panel=_TLS
    ),
    name: str = option("Participant whose certificate the router presents.", "router", is_name=True, panel=_TLS),
    connect: list[str] | None = option(
        "Another router of the fleet, tls/HOST:PORT, to link with; may be repeated.", None, panel=_TLS
    ),
    scenario: str | None = option(
        "Refuse to start unless every arm of this scenario has a certificate.", None, panel=_TLS
    ),
) -> None:
    """Run the Zenoh router of a fleet until Ctrl-C or SIGTERM; its endpoint is printed once it listens."""
    from fleet.bus.router import Router
    from fleet.bus.security.tls import Tls
    from scenarios.signals import until_stopped

    if scenario is not None:
        from scenarios.live.fleet_processes import check_roster

        check_roster(tls, scenario)
    own = Tls(tls, name) if tls else None
    router = Router(port, host=host, tls=own, state_hz=state_hz or None, connect=connect or ())
    with until_stopped() as stop, router:
        echo(router.endpoint)  # flushed: a supervisor reads this line
        while not stop.wait(LINK_S if connect else None):
            for sentence in router.link_changes():
                say(sentence)
        stop.leave("The router was interrupted; its clients keep trying to reconnect.")


def _load(scenario: str) -> "Scenario":
    from scenarios.spec.load import load  # loads the simulator, which most calls of these commands do not need

    return load(scenario)


def watch_command(
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
    as_json: bool = option("Print one snapshot as JSON.", False, flag="--json"),
    joints: bool = option("Show every joint.", False),
    scenario: str = option("Scenario of the fleet, to show the remaining time of the shift.", ""),
) -> None:
    """Watch temperatures, difficulty, jobs and the age of messages, until the fleet ends or Ctrl-C."""
    from scenarios.show.watch import watch

    end_s = _load(scenario).horizon_s if scenario else None
    watch(endpoint, fleet, as_json=as_json, joints=joints, end_s=end_s)


def doctor_command(
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
    seconds: float = option("Real seconds to listen.", 3.0, low=0, high=600, above=True),
    auctioneer: bool = option("Expect an auctioneer, or none.", True, flag="--auctioneer/--no-auctioneer"),
    scenario: str = option("Scenario whose arms must all be present. Default: check only the arms that are found.", ""),
    as_json: bool = options.JSON,
) -> None:
    """Check the health of a fleet: presence and clocks of its arms and auctioneer, and malformed messages.

    Exit code 0: healthy; 1: a fault was found, or no fleet; 2: the router cannot be reached.
    """
    from scenarios.live.doctor import diagnose

    expected = tuple(arm.name for arm in _load(scenario).arms) if scenario else ()
    healthy = diagnose(endpoint, fleet, seconds, auctioneer=auctioneer, expected=expected, as_json=as_json)
    raise typer.Exit(0 if healthy else UNHEALTHY)


def record_command(
    fleet: str = argument("Name of the fleet; `up` uses the name of the scenario.", is_name=True),
    out: Path = option("Folder of the recording; an interrupted one is continued.", MISSING),
    endpoint: str = options.ENDPOINT,
    rotate: float = option(
        "Real seconds between two parts; a message is durable once it is in a part.", 10.0, low=0.1, high=86_400
    ),
) -> None:
    """Record the messages of arms and auctioneer as Parquet parts, readable while the recording continues."""
    from fleet.bus.client import BusClient
    from fleet.live.policy_client import CONNECT_S
    from scenarios.live.recorder import BACKLOG, record
    from scenarios.result_folder import check_folder
    from scenarios.signals import until_stopped

    check_folder(out)
    with until_stopped() as stop, BusClient(endpoint, fleet, backlog=BACKLOG, stopped=stop.is_set) as link:
        connect = partial(BusClient, endpoint, fleet, timeout_s=CONNECT_S, backlog=BACKLOG)
        on_ready = partial(echo, f"ready record {endpoint}")
        recorder = record(link, out, rotate_s=rotate, stopped=stop.is_set, connect=connect, on_ready=on_ready)
    missed = sum(count.missed for count in recorder.counts.values())
    kept = sum(count.kept for count in recorder.counts.values())
    say(f"Recorded {kept} messages in {out}, {missed} missed.", out_console)
    if expiry := link.expiry:
        raise BusError(f"Nothing has been recorded since the certificate expired. {expiry} Then start it again.")
    stop.leave("All that was received is on disk; the same command continues the recording.")


def replay_command(
    path: Path = argument("Folder of a run or of a recording."),
    endpoint: str = options.ENDPOINT,
    fleet: str | None = option("Name of the fleet. Default: that of the recording.", None),
    speed: float = option("Recorded seconds per real second.", 1.0, low=0, high=MAX_SPEED, above=True),
) -> None:
    """Publish a run or a recording on the bus, in real time or at --speed; needs a router without TLS.

    It begins with the first state: messages of a time before it are published at once.
    """
    from fleet.bus.client import BusClient
    from fleet.bus.protocol.keys import STATE_GAP_S
    from scenarios.live.recording import open_messages, replay
    from scenarios.signals import until_stopped

    if endpoint.startswith("tls/"):
        raise FleetError("A replay publishes as every arm, which no certificate allows: give a router without TLS.")
    messages = open_messages(path)
    if not len(messages):
        raise FleetError(f"'{path}' holds no messages. Record longer.")
    connect = partial(BusClient, endpoint, fleet or messages.fleet)
    with until_stopped() as stop, connect() as link:
        echo(f"ready replay {endpoint}")
        count = replay(messages, link, connect=connect, speed=speed, stopped=stop.is_set)
    say(f"Published {count.published} of {len(messages)} messages.", out_console)
    if count.early:
        say(f"{count.early} of them were of a time before the first state and were published at once.", out_console)
    if count.left_out:
        say(
            f"Left out {count.left_out} states that were due less than {1000 * STATE_GAP_S:.0f} ms after the one "
            "before of their arm: a router limits their rate. A lower --speed publishes them.",
            out_console,
        )
    stop.leave("The replay was interrupted.")


def gateway_command(
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
    page: bool = option(
        "Also serve a live page: arms in 3-D, temperatures, jobs, offers, alerts, and the requests that the "
        "token's role permits.",
        False,
    ),
    scenario: str = option("--page: scenario of the cell. Default: the cell as the auctioneer describes it.", ""),
    port: int = option("TCP port of the gateway; 0 is any free one.", PAGE_PORT, low=0, high=65535),
    host: str = option("Listening address; beyond loopback only with a token.", "127.0.0.1"),
    token: str = option(
        "Bearer token for all requests, with TLS for those that the certificate permits. Prefer the variable: other "
        "users can read command lines.",
        "",
        env="THERMOFLEET_TOKEN",
    ),
    tokens: Path | None = option(
        "File with ROLE TOKEN in each line, readable by you alone. Roles: monitor, submitter, operator; each "
        "may do what the ones before it may. With TLS the certificate must permit it.",
        None,
    ),
    recording: Path | None = option("Recording of the fleet, whose alarms the gateway continues.", None),
    webhook: list[str] | None = _WEBHOOK,
) -> None:
    """Serve the fleet over HTTP until Ctrl-C or SIGTERM; with --page also a live page for browsers."""
    if scenario and not page:
        raise FleetError("--scenario is for --page: leave it out.")
    from scenarios.live.gateway import LivePage, run_gateway, scene_of

    shown = None
    if page:
        from scenarios.show.page import three_js
        from scenarios.spec.load import load

        three_js()  # if it is missing, say so at once
        shown = LivePage(scene_of(load(scenario)) if scenario else None)
    run_gateway(endpoint, fleet, port, host, token, tokens, shown, recording, webhook or ())


def ros2_command(
    mode: Literal["bridge", "listen", "jobs"] = argument(
        "bridge: publish every arm as JointState and DiagnosticArray. listen: show a real arm with a ROS 2 "
        "driver as an arm that takes no jobs. jobs: serve the action thermofleet_msgs/action/DoJob (needs rclpy)."
    ),
    topic: str = argument("listen: topic of the arm's sensor_msgs/JointState, as /joint_states.", ""),
    endpoint: str = options.ENDPOINT,
    fleet: str = options.FLEET,
    *,
    given: Annotated[Given, From(options.Ros2Spec)],
) -> None:
    """Connect a fleet to ROS 2 over Zenoh (rmw_zenoh), until Ctrl-C or SIGTERM; needs the extra `ros2`."""
    if mode == "listen" and not topic:
        raise FleetError("listen needs the TOPIC of the arm's sensor_msgs/JointState, as /joint_states.")
    if topic and mode != "listen":
        raise FleetError(f"{mode} takes no TOPIC (got '{topic}'); only listen does.")
    from scenarios.live.ros2 import run_bridge, run_jobs, run_listener

    run = {"bridge": run_bridge, "listen": partial(run_listener, topic), "jobs": run_jobs}[mode]
    run(endpoint, fleet, options.Ros2Spec(**given))
