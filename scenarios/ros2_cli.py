"""`thermofleet ros2`: tell ROS 2 how a fleet is, and take a real arm that speaks ROS 2 into a fleet."""

import os
import time
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated

import typer

from fleet.errors import FleetError
from fleet.robot import ThermalLimits
from scenarios.live_options import ENDPOINT, EndpointOption, FleetOption, the_fleet

if TYPE_CHECKING:
    from fleet.bus.ros2 import Node

ros2_app = typer.Typer(help="ROS 2 over Zenoh (rmw_zenoh), both ways; needs the extra ros2.", no_args_is_help=True)
TURN_S = 0.25
"""Real seconds between two looks at whether to stop."""
DEFAULTS = ThermalLimits()

DomainOption = Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", help="The ROS 2 domain.")]
RouterOption = Annotated[
    str, typer.Option(help="Router of the ROS 2 side (rmw_zenohd), as tcp/127.0.0.1:7447; default: the fleet's own.")
]
WarningOption = Annotated[float, typer.Option(help="Motor temperature from which it is a warning, °C.")]


@ros2_app.command("bridge")
def bridge_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    domain: DomainOption = 0,
    router: RouterOption = "",
    humble: Annotated[bool, typer.Option("--humble", help="For ROS 2 Humble, whose keys have no type hash.")] = False,
    warning_c: WarningOption = DEFAULTS.warning_c,
    error_c: Annotated[float, typer.Option(help="From which it is an error, °C.")] = DEFAULTS.error_c,
) -> None:
    """Publish every arm of a fleet as JointState and DiagnosticArray, until Ctrl-C or SIGTERM."""
    where = ros2_router(router, endpoint)
    node = node_at(where, "thermofleet", domain)
    from fleet.bus.link import Link
    from fleet.live.ros2_bridge import Bridge
    from scenarios.stopping import until_stopped

    limits = limits_of(warning_c, error_c)
    with until_stopped() as stop, Link(endpoint, the_fleet(fleet, endpoint)) as link, node:
        bridge = Bridge(link, node, limits=limits, humble=humble)
        typer.echo(f"ready ros2 bridge {where} {os.getpid()}")
        while not stop.is_set():
            bridge.serve(time.monotonic() + TURN_S)
        stop.leave("The bridge was interrupted.")


@ros2_app.command("listen")
def listen_command(
    topic: Annotated[str, typer.Argument(help="Of the arm's sensor_msgs/JointState, as /joint_states.")],
    arm: Annotated[str, typer.Option(help="The arm's name in the fleet.")] = "real",
    temperatures: Annotated[
        str, typer.Option(help="Topic of the diagnostic_msgs/DiagnosticArray that tells its motor temperatures.")
    ] = "",
    hardware: Annotated[
        str, typer.Option(help="What stands before /JOINT in the hardware_id of these diagnostics; default: nothing.")
    ] = "",
    joints: Annotated[str, typer.Option(help="Its joints' names in ROS 2, from joint 1 on.")] = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    domain: DomainOption = 0,
    router: RouterOption = "",
    rate_hz: Annotated[float, typer.Option(help="State words per real second.")] = 10.0,
    warning_c: WarningOption = DEFAULTS.warning_c,
) -> None:
    """Let a real arm that speaks ROS 2 be an arm of a fleet that takes no work, until Ctrl-C or SIGTERM."""
    if not temperatures:
        raise FleetError(
            "A JointState tells no motor temperatures, and a fleet of ours goes by them: name the topic of a "
            "DiagnosticArray that does with --temperatures. docs/ros2.md says what must be in it."
        )
    if not 0 < rate_hz <= 100:
        raise FleetError(f"--rate-hz must be > 0 and at most 100 (got {rate_hz:g}).")
    if not arm:
        raise FleetError("--arm needs a name.")
    names, where = names_of(joints), ros2_router(router, endpoint)
    node = node_at(where, f"thermofleet_{arm}", domain)
    from fleet.bus.link import Link
    from fleet.live.clock import FleetClock
    from fleet.live.ros2_follower import Follower, Reality
    from scenarios.stopping import until_stopped

    with until_stopped() as stop, Link(endpoint, the_fleet(fleet, endpoint)) as link, node:
        clock = FleetClock(1.0, time.monotonic())
        limits = limits_of(warning_c, max(warning_c + 1.0, DEFAULTS.error_c))
        reality, topics = Reality(names, hardware), (topic, temperatures)
        follower = Follower(link, node, arm, reality, topics, clock, limits=limits, rate_hz=rate_hz)
        typer.echo(f"ready {arm} {topic} {os.getpid()}")
        while not stop.is_set():
            follower.serve(time.monotonic() + TURN_S)
        stop.leave(f"Nobody listens to {topic} any more.")


def ros2_router(router: str, endpoint: str) -> str:
    """Where ROS 2 meets: the router named, or that of the fleet.

    Raises:
        FleetError: the fleet's router has rules, and they know no ROS 2.
    """
    if not router and endpoint.startswith("tls/"):
        raise FleetError(
            "With TLS the fleet's router lets through the fleet's own keys only: name the router of ROS 2 with "
            "--router, as tcp/127.0.0.1:7447."
        )
    return router or endpoint


def node_at(router: str, name: str, domain: int) -> "Node":
    """A ROS 2 node, not yet open.

    Raises:
        FleetError: the extra is not there, or the domain is none.
    """
    if find_spec("rosbags") is None:
        raise FleetError("ROS 2 needs the extra: pip install 'thermofleet[ros2]' (rosbags is missing).")
    from fleet.bus.ros2 import Node
    from fleet.bus.ros2_names import DOMAINS

    if domain not in DOMAINS:
        raise FleetError(f"--domain must be 0 to {DOMAINS[-1]} (got {domain}).")
    return Node(router, name, domain=domain)


def names_of(joints: str) -> tuple[str, ...]:
    """The joints named, or those of a Gen3.

    Raises:
        FleetError: one is named twice, or has no name.
    """
    from fleet.bus.ros2_words import joint_names
    from fleet.robot import JOINTS

    if not joints:
        return joint_names(JOINTS)
    names = tuple(name.strip() for name in joints.split(","))
    if "" in names or len(set(names)) != len(names):
        raise FleetError(f"--joints needs different names, as joint_1,joint_2 (got {joints}).")
    return names


def limits_of(warning_c: float, error_c: float) -> ThermalLimits:
    """Limits at which diagnostics change their level.

    Raises:
        FleetError: they are not in order.
    """
    if not warning_c < error_c < float("inf"):
        raise FleetError(f"--warning-c must be less than --error-c (got {warning_c:g} and {error_c:g}).")
    return ThermalLimits(warning_c=warning_c, error_c=error_c, restart_c=min(DEFAULTS.restart_c, warning_c - 1.0))
