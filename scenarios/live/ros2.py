"""Processes between a fleet and ROS 2 over Zenoh (rmw_zenoh): states, jobs, and a real arm."""

import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from fleet.bus.client import BusClient
from fleet.errors import FleetError
from fleet.robot import JOINTS, ThermalLimits
from scenarios.cli.options import Ros2Spec, split_names, the_fleet
from scenarios.extras import require_extra
from scenarios.live.arm import fleet_clock, monitor_of
from scenarios.signals import StopRequest, until_stopped
from scenarios.terminal import echo

if TYPE_CHECKING:
    from fleet.ros2.node import Node

TURN_S = 0.25
"""Real seconds between two checks for a stop request."""
DEFAULTS = ThermalLimits()


def run_bridge(endpoint: str, fleet: str, spec: Ros2Spec) -> None:
    """Publish every arm of a fleet as JointState and DiagnosticArray, until Ctrl-C or SIGTERM."""
    where = ros2_router(spec.router, endpoint)
    from fleet.ros2.bridge import Bridge

    limits = limits_of(spec.warning_c, spec.error_c)
    with (
        until_stopped() as stop,
        node_at(where, "thermofleet", spec.domain, stop.is_set) as node,
        BusClient(endpoint, the_fleet(fleet, endpoint), stopped=stop.is_set) as link,
    ):
        bridge = Bridge(link, node, limits=limits, humble=spec.humble)
        echo(f"ready ros2 bridge {where} {os.getpid()}")
        _serve(bridge.serve, stop, "The bridge was interrupted.")


def run_listener(topic: str, endpoint: str, fleet: str, spec: Ros2Spec) -> None:
    """Show a real arm with a ROS 2 driver as an arm of the fleet that takes no jobs, until Ctrl-C or SIGTERM.

    Raises:
        FleetError: the topic of its temperatures is missing, or joints or limits are not allowed.
    """
    if not spec.temperatures:
        raise FleetError(
            "A JointState has no motor temperatures, and a fleet needs them: name the topic of a DiagnosticArray that "
            "has them with --temperatures. docs/ros2.md describes its content."
        )
    names, where = names_of(spec.joints), ros2_router(spec.router, endpoint)
    monitors = monitor_of(spec.twin, spec.network)
    monitor = monitors and monitors(1.0 / spec.rate_hz)
    if monitor and len(names) != JOINTS:
        raise FleetError(f"--twin and --network are for arms of {JOINTS} joints (got {len(names)} in --joints).")
    from fleet.ros2.bridge import ArmReadings, Follower

    with (
        until_stopped() as stop,
        node_at(where, f"thermofleet_{spec.arm}", spec.domain, stop.is_set) as node,
        BusClient(endpoint, the_fleet(fleet, endpoint), stopped=stop.is_set) as link,
    ):
        clock = fleet_clock(link, None)
        limits = limits_of(spec.warning_c, max(spec.warning_c + 1.0, DEFAULTS.error_c))
        readings, topics = ArmReadings(names, spec.hardware), (topic, spec.temperatures)
        how = {"limits": limits, "rate_hz": spec.rate_hz, "monitor": monitor}
        follower = Follower(link, node, spec.arm, readings, topics, clock, **how)
        echo(f"ready {spec.arm} {topic} {os.getpid()}")
        _serve(follower.serve, stop, f"Stopped listening to {topic}.")


def run_jobs(endpoint: str, fleet: str, spec: Ros2Spec) -> None:
    """Serve the action thermofleet_msgs/action/DoJob, until Ctrl-C or SIGTERM.

    Raises:
        FleetError: rclpy or the package of the action is missing.
    """
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
        JobAction(link, domain=spec.domain) as jobs,
    ):
        echo(f"ready {jobs.name} {os.getpid()}")
        _serve(jobs.serve, stop, "The action server was stopped; submitted jobs go on.")


def _serve(serve: Callable[[float], None], stop: StopRequest, farewell: str) -> None:
    while not stop.is_set():
        serve(time.monotonic() + TURN_S)
    stop.leave(farewell)


def ros2_router(router: str, endpoint: str) -> str:
    """Endpoint of the router of ROS 2: the given one, or the fleet's, but not with TLS, which excludes ROS 2."""
    if not router and endpoint.startswith("tls/"):
        raise FleetError(
            "With TLS the fleet's router forwards the fleet's own keys only: name the router of ROS 2 with --router, "
            "as tcp/127.0.0.1:7447."
        )
    return router or endpoint


def node_at(router: str, name: str, domain: int, stopped: Callable[[], bool]) -> "Node":
    """A ROS 2 node, not yet open, which waits for a router; raises MissingExtra if its libraries are missing."""
    require_extra("ros2")
    from fleet.ros2.node import Node

    return Node(router, name, domain=domain, stopped=stopped)


def names_of(joints: str) -> tuple[str, ...]:
    """The given joint names, which must differ, or those of a Gen3."""
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
