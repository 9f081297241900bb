"""`thermofleet ros2`: publish a fleet in ROS 2, and add a real arm with a ROS 2 driver to a fleet."""

import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from fleet.errors import FleetError
from fleet.robot import ThermalLimits
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, check_name, number, split_names, the_fleet
from scenarios.cli.terminal import echo
from scenarios.extras import require_extra

if TYPE_CHECKING:
    from fleet.ros2.node import Node

ros2_app = typer.Typer(
    help="Connect a fleet and ROS 2 over Zenoh (rmw_zenoh), in both directions; needs the extra ros2.",
    no_args_is_help=True,
    add_completion=False,
)
TURN_S = 0.25
"""Real seconds between two checks for a stop request."""
DEFAULTS = ThermalLimits()

DomainOption = Annotated[int, number("The ROS 2 domain.", 0, 232, envvar="ROS_DOMAIN_ID")]
RouterOption = Annotated[
    str, typer.Option(help="Router of ROS 2 (rmw_zenohd), as tcp/127.0.0.1:7447; default: the fleet's router.")
]
WarningOption = Annotated[float, number("Motor temperature at which a warning begins, °C.", 0, 200)]


@ros2_app.command("bridge")
def bridge_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    domain: DomainOption = 0,
    router: RouterOption = "",
    humble: Annotated[bool, typer.Option("--humble", help="For ROS 2 Humble, whose keys have no type hash.")] = False,
    warning_c: WarningOption = DEFAULTS.warning_c,
    error_c: Annotated[float, number("Motor temperature at which an error begins, °C.", 0, 200)] = DEFAULTS.error_c,
) -> None:
    """Publish every arm of a fleet as JointState and DiagnosticArray, until Ctrl-C or SIGTERM."""
    where = ros2_router(router, endpoint)
    from fleet.bus.client.client import BusClient
    from fleet.ros2.bridge import Bridge
    from scenarios.cli.signals import until_stopped

    limits = limits_of(warning_c, error_c)
    with (
        until_stopped() as stop,
        node_at(where, "thermofleet", domain, stop.is_set) as node,
        BusClient(endpoint, the_fleet(fleet, endpoint), stopped=stop.is_set) as link,
    ):
        bridge = Bridge(link, node, limits=limits, humble=humble)
        echo(f"ready ros2 bridge {where} {os.getpid()}")
        while not stop.is_set():
            bridge.serve(time.monotonic() + TURN_S)
        stop.leave("The bridge was interrupted.")


@ros2_app.command("listen")
def listen_command(
    topic: Annotated[str, typer.Argument(help="Topic of the arm's sensor_msgs/JointState, as /joint_states.")],
    arm: Annotated[str, typer.Option(help="Name of the arm in the fleet.", callback=check_name)] = "real",
    temperatures: Annotated[
        str, typer.Option(help="Topic of the diagnostic_msgs/DiagnosticArray with its motor temperatures.")
    ] = "",
    hardware: Annotated[
        str, typer.Option(help="Text before /JOINT in the hardware_id of these diagnostics; default: none.")
    ] = "",
    joints: Annotated[str, typer.Option(help="Names of its joints in ROS 2, from joint 1 on.")] = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    domain: DomainOption = 0,
    router: RouterOption = "",
    rate_hz: Annotated[float, number("State messages per real second.", 0, 100, above=True)] = 10.0,
    warning_c: WarningOption = DEFAULTS.warning_c,
) -> None:
    """Show a real arm with a ROS 2 driver as an arm of the fleet that takes no jobs, until Ctrl-C or SIGTERM."""
    if not temperatures:
        raise FleetError(
            "A JointState has no motor temperatures, and a fleet needs them: name the topic of a DiagnosticArray that "
            "has them with --temperatures. docs/ros2.md describes its content."
        )
    names, where = names_of(joints), ros2_router(router, endpoint)
    from fleet.bus.client.client import BusClient
    from fleet.live.clock import FleetClock
    from fleet.ros2.bridge import ArmReadings, Follower
    from scenarios.cli.signals import until_stopped

    with (
        until_stopped() as stop,
        node_at(where, f"thermofleet_{arm}", domain, stop.is_set) as node,
        BusClient(endpoint, the_fleet(fleet, endpoint), stopped=stop.is_set) as link,
    ):
        clock = FleetClock(1.0, time.monotonic())
        limits = limits_of(warning_c, max(warning_c + 1.0, DEFAULTS.error_c))
        readings, topics = ArmReadings(names, hardware), (topic, temperatures)
        follower = Follower(link, node, arm, readings, topics, clock, limits=limits, rate_hz=rate_hz)
        echo(f"ready {arm} {topic} {os.getpid()}")
        while not stop.is_set():
            follower.serve(time.monotonic() + TURN_S)
        stop.leave(f"Stopped listening to {topic}.")


@ros2_app.command("jobs")
def jobs_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    domain: DomainOption = 0,
) -> None:
    """Serve the action thermofleet_msgs/action/DoJob: a goal is a job. Needs rclpy, with any middleware."""
    from fleet.bus.client.client import BusClient
    from scenarios.cli.signals import until_stopped

    try:
        from fleet.ros2.job_action import JobAction
    except ModuleNotFoundError as error:
        raise FleetError(
            f"This needs the Python module '{error.name}' of ROS 2: build fleet/ros2/thermofleet_msgs in a workspace, "
            "source its setup file, and use the Python of that ROS 2 (docs/ros2.md)."
        ) from error
    with (
        until_stopped() as stop,
        BusClient(endpoint, the_fleet(fleet, endpoint), stopped=stop.is_set) as link,
        JobAction(link, domain=domain) as jobs,
    ):
        typer.echo(f"ready {jobs.name} {os.getpid()}")
        while not stop.is_set():
            jobs.serve(time.monotonic() + TURN_S)
        stop.leave("The action server was stopped; submitted jobs go on.")


def ros2_router(router: str, endpoint: str) -> str:
    """Endpoint of the router of ROS 2: the given one, or the fleet's, but not with TLS, which excludes ROS 2."""
    if not router and endpoint.startswith("tls/"):
        raise FleetError(
            "With TLS the fleet's router forwards the fleet's own keys only: name the router of ROS 2 with --router, "
            "as tcp/127.0.0.1:7447."
        )
    return router or endpoint


def node_at(router: str, name: str, domain: int, stopped: Callable[[], bool]) -> "Node":
    """A ROS 2 node, not yet open, which waits for a router; after a check of the domain and of the installed extra."""
    require_extra("ros2")
    from fleet.ros2.node import DOMAINS, Node

    if domain not in DOMAINS:
        raise FleetError(f"--domain must be 0 to {DOMAINS[-1]} (got {domain}).")
    return Node(router, name, domain=domain, stopped=stopped)


def names_of(joints: str) -> tuple[str, ...]:
    """The given joint names, which must differ, or those of a Gen3."""
    from fleet.robot import JOINTS
    from fleet.ros2.conversion import joint_names

    if not joints:
        return joint_names(JOINTS)
    names = tuple(split_names(joints))
    if "" in names or len(set(names)) != len(names):
        raise FleetError(f"--joints needs different names, as joint_1,joint_2 (got {joints}).")
    return names


def limits_of(warning_c: float, error_c: float) -> ThermalLimits:
    """Limits at which diagnostics change their level."""
    if not warning_c < error_c < float("inf"):
        raise FleetError(f"--warning-c must be less than --error-c (got {warning_c:g} and {error_c:g}).")
    return ThermalLimits(warning_c=warning_c, error_c=error_c, restart_c=min(DEFAULTS.restart_c, warning_c - 1.0))
