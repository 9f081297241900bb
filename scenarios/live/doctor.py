"""The health of a live fleet, as a report on the terminal."""

import os
import re
import socket
import time
from collections import Counter
from dataclasses import replace
from shlex import quote

import msgspec

from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest
from fleet.bus.router import fleets_at, other_versions
from fleet.bus.security.tls import identified, try_connection
from fleet.errors import BusError, visible
from fleet.live.monitor.health import MOST_REASONS, ClockProbe, HealthReport, check_health
from fleet.live.monitor.snapshot import FleetListener, FleetSnapshot
from scenarios.cli.options import ENDPOINT_VARIABLE, FLEET_VARIABLE, the_fleet
from scenarios.show.watch import arm_table, jobs_line, space_line
from scenarios.show.words import clock
from scenarios.spec.options import ENDPOINT
from scenarios.terminal import echo, out_console, say

PROBE_EVERY_S, REPLY_S = 0.3, 1.0
BETWEEN = 5
"""Snapshots between the first and the last of two in which a job waits in vain."""
_COLORS = {"fault": "red", "warning": "yellow"}


def diagnose(
    endpoint: str, fleet: str, seconds: float, *, auctioneer: bool, expected: tuple[str, ...], as_json: bool
) -> bool:
    """Print the health of a fleet; return whether it is healthy.

    Args:
        fleet: Its name; "" for the only one at the endpoint.
        seconds: Real seconds to listen.
        auctioneer: Whether it should have one.
        expected: Arms that should be present.

    Raises:
        BusError: the router cannot be reached.
    """
    try:
        fleets = fleets_at(endpoint)
    except BusError as error:
        raise BusError(f"{error} {why_unreachable(endpoint)}".strip()) from error
    if not fleet and not fleets and endpoint.startswith("tls/"):
        the_fleet(fleet, endpoint)  # refuses: nobody may list them
    if not fleet and len(fleets) != 1:
        several = f"There are several fleets: {', '.join(fleets)}. Choose one with --fleet."
        none = "No fleet found: no arm or auctioneer has a liveliness token."
        say(f"The router at {endpoint} replies. {several if fleets else none}")
        return False
    named = fleet or fleets[0]
    reach = reach_of(endpoint, fleet)
    snapshot, report = examine(endpoint, named, seconds, auctioneer=auctioneer, expected=expected, reach=reach)
    if as_json:
        fields = {"healthy": report.healthy, **msgspec.to_builtins(report)}
        echo(msgspec.json.format(msgspec.json.encode(fields)).decode())
    else:
        show(endpoint, snapshot, report)
        if fleets and fleet and fleet not in fleets:
            say(f"Fleets at {endpoint}: {', '.join(fleets)}.", out_console)
    return report.healthy


def reach_of(endpoint: str, fleet: str) -> str:
    """Options of a command for this fleet that differ from their defaults in this shell."""
    given = (("--endpoint", endpoint, ENDPOINT_VARIABLE, ENDPOINT), ("--fleet", fleet, FLEET_VARIABLE, ""))
    return " ".join(
        f"{flag} {quote(value)}"
        for flag, value, variable, default in given
        if value and value != os.environ.get(variable, default)
    )


def examine(
    endpoint: str,
    fleet: str,
    seconds: float,
    *,
    auctioneer: bool = True,
    expected: tuple[str, ...] = (),
    reach: str = "",
) -> tuple[FleetSnapshot, HealthReport]:
    """Listen to a fleet for some real seconds; return its last snapshot and its health.

    Args:
        auctioneer: Whether it should have one.
        expected: Arms that should be present.
        reach: Options with which a command reaches the fleet.

    Raises:
        BusError: no router answered.
    """
    probes: list[ClockProbe] = []

    def probe_clock(link: BusClient) -> None:
        asked_s = time.monotonic()

        def done(answers: Replies[Clock]) -> None:
            reply = next(iter(answers.messages.values()), None)
            probe = ClockProbe(asked_s, asked_s + answers.took_s)
            probes.append(replace(probe, time_s=reply.time_s, speed=reply.speed) if reply else probe)

        link.query(keys.of_clock(fleet), ClockRequest(), Clock, done, timeout_s=REPLY_S)

    with BusClient(endpoint, fleet) as link:
        listener = FleetListener(link)
        end_s = time.monotonic() + seconds
        snapshots: list[FleetSnapshot] = []
        while time.monotonic() < end_s:
            probe_clock(link)
            listener.serve(min(end_s, time.monotonic() + PROBE_EVERY_S))
            snapshots.append(listener.view.snapshot(time.monotonic()))
        now_s = time.monotonic()
        snapshot = listener.view.snapshot(now_s)
        problems = {"malformed": link.malformed, "complaints": link.complaints(), "overrun": link.overrun}
    secure = identified(endpoint)[1] is not None
    others = other_versions(endpoint, fleet)
    report = check_health(
        snapshot,
        now_s,
        probes,
        auctioneer=auctioneer,
        secure=secure,
        expected=expected,
        other_versions=others,
        reach=reach,
        earlier=snapshots[-BETWEEN] if len(snapshots) >= BETWEEN else None,
        **problems,
    )
    return snapshot, report


def show(endpoint: str, fleet: FleetSnapshot, report: HealthReport) -> None:
    """Print the report on the terminal."""
    trip = "no answer" if report.round_trip_s is None else f"{1000 * report.round_trip_s:.1f} ms"
    out_console.print(f"router      {endpoint}, round trip {trip}", highlight=False)
    fleet_time = "unknown" if report.time_s is None else clock(report.time_s)
    out_console.print(f"fleet       {report.fleet}, time {fleet_time}", highlight=False, markup=False)
    if report.offsets_s:
        worst = max(report.offsets_s, key=lambda arm: abs(report.offsets_s[arm]))
        line = f"clocks      {worst} is furthest off: {report.offsets_s[worst]:+.2f} s"
        out_console.print(line, highlight=False, markup=False)
    out_console.print(f"malformed   {report.malformed}", highlight=False)
    if fleet.arms:
        out_console.print(arm_table(fleet.arms))
    out_console.print(jobs_line(fleet))
    out_console.print(space_line(fleet))
    shown: Counter[str] = Counter()
    for finding in report.findings:
        shown[finding.kind] += bool(finding.kind)
        if shown[finding.kind] > MOST_REASONS:
            continue
        line = f"{finding.level}: {visible(finding.what)}"
        out_console.print(line, style=_COLORS.get(finding.level, ""), highlight=False, markup=False)
    for kind, count in shown.items():
        if count > MOST_REASONS:
            say(f"… and {count - MOST_REASONS} more of the kind {kind}; --json has all.", out_console)
    out_console.print("The fleet is healthy." if report.healthy else "The fleet is not healthy.", highlight=False)


def why_unreachable(endpoint: str) -> str:
    """Result of a plain connection to the endpoint; "" for TLS or an invalid endpoint, whose error names the reason."""
    match = re.fullmatch(r"tcp/\[?([^\]/]+?)\]?:(\d{1,5})", endpoint)
    if match is None or int(match[2]) > 65535:
        return ""

    host, port = match[1], int(match[2])
    try:
        with socket.create_connection((host, port), timeout=REPLY_S):
            known = try_connection(host, port, None).reason  # the error names this reason already
            return "" if known else f"Port {port} is open, but no thermofleet router listens on it."
    except ConnectionRefusedError:
        return f"Nothing listens at port {port} of {host}; start it with: thermofleet bus router --port {port}"
    except OSError as error:
        return f"A plain connection fails too: {error.strerror or error}."
