"""`thermofleet doctor`: is the fleet well, and if not, what is wrong?"""

import re
import socket
import time
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from fleet.errors import BusError, FleetError
from scenarios.live_options import ENDPOINT, EndpointOption, FleetOption
from scenarios.load import load
from scenarios.terminal import out_console, say

if TYPE_CHECKING:
    from fleet.bus.answers import Answers
    from fleet.bus.link import Link
    from fleet.bus.trade import Clock
    from fleet.live.diagnosis import Diagnosis
    from fleet.live.overview import FleetNow

ILL = 1
"""Exit code beside 0 for a healthy fleet, and 2, as for every error that the user can mend, for one out of reach."""
ASK_EVERY_S, ANSWER_S = 0.3, 1.0
_COLORS = {"fault": "red", "warning": "yellow"}


def doctor_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    seconds: Annotated[float, typer.Option(help="How long to listen, real time.")] = 3.0,
    auctioneer: Annotated[
        bool, typer.Option(help="Whether the fleet should have one; none where arms only show themselves.")
    ] = True,
    scenario: Annotated[
        str, typer.Option(help="Every arm of this scenario should be there; without it, only who is there is known.")
    ] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print what was found as JSON.")] = False,
) -> None:
    """Say whether a fleet is well: exit code 0 healthy, 1 not, 2 out of reach."""
    from fleet.bus.discover import fleets_at

    if not 0 < seconds <= 600:
        raise FleetError(f"--seconds must be more than 0 and at most 600 (got {seconds:g}).")
    expected = tuple(arm.name for arm in load(scenario).arms) if scenario else ()
    try:
        there = fleets_at(endpoint)
    except BusError as error:
        raise BusError(f"{error} {why_unreachable(endpoint)}".strip()) from error
    if not fleet and len(there) != 1:
        say(f"The router at {endpoint} answers. " + (
            f"Several fleets meet there: {', '.join(there)}. Choose one with --fleet."
            if there else "Nobody is there: no arm and no auctioneer shows a token."
        ))  # fmt: skip
        raise typer.Exit(ILL)
    now, found = examine(endpoint, fleet or there[0], seconds, auctioneer=auctioneer, expected=expected)
    if as_json:
        told = {"healthy": found.healthy, **msgspec.to_builtins(found)}
        typer.echo(msgspec.json.format(msgspec.json.encode(told)).decode())
    else:
        show(endpoint, now, found)
        if there and fleet and fleet not in there:
            say(f"Fleets at {endpoint}: {', '.join(there)}.", out_console)
    raise typer.Exit(0 if found.healthy else ILL)


def examine(
    endpoint: str, fleet: str, seconds: float, *, auctioneer: bool = True, expected: tuple[str, ...] = ()
) -> "tuple[FleetNow, Diagnosis]":
    """A fleet after it was listened to for so many real seconds.

    Args:
        auctioneer: Whether it should have one.
        expected: Arms that should be there.

    Raises:
        BusError: no router answered.
    """
    from fleet.bus import keys
    from fleet.bus.link import Link
    from fleet.bus.security import identified
    from fleet.bus.trade import Clock, ClockRequest
    from fleet.live.diagnosis import Sounding, diagnosed
    from fleet.live.onlooker import Onlooker

    soundings: list[Sounding] = []

    def ask(link: "Link") -> None:
        asked_s = time.monotonic()

        def done(answers: "Answers[Clock]") -> None:
            word = next(iter(answers.words.values()), None)
            soundings.append(
                Sounding(asked_s, asked_s + answers.took_s, word.time_s, word.speed)
                if word
                else Sounding(asked_s, asked_s + answers.took_s)
            )

        link.ask(keys.of_clock(fleet), ClockRequest(), Clock, done, timeout_s=ANSWER_S)

    with Link(endpoint, fleet) as link:
        onlooker = Onlooker(link)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            ask(link)
            onlooker.serve(min(end_s, time.monotonic() + ASK_EVERY_S))
        now_s = time.monotonic()
        now = onlooker.overview.now(now_s)
        problems = {"malformed": link.malformed, "complaints": tuple(link.complaints), "overrun": link.overrun}
    secure = identified(endpoint)[1] is not None
    return now, diagnosed(now, now_s, soundings, auctioneer=auctioneer, secure=secure, expected=expected, **problems)


def show(endpoint: str, now: "FleetNow", found: "Diagnosis") -> None:
    """The findings on the terminal."""
    from scenarios.watch_screen import clock, jobs_line, table

    trip = "no answer" if found.round_trip_s is None else f"{1000 * found.round_trip_s:.1f} ms"
    out_console.print(f"router      {endpoint}, round trip {trip}", highlight=False)
    time_told = "nobody tells it" if found.time_s is None else clock(found.time_s)
    out_console.print(f"fleet       {found.fleet}, time {time_told}", highlight=False, markup=False)
    if found.offsets_s:
        worst = max(found.offsets_s, key=lambda arm: abs(found.offsets_s[arm]))
        told = f"clocks      {worst} is furthest off: {found.offsets_s[worst]:+.2f} s"
        out_console.print(told, highlight=False, markup=False)
    out_console.print(f"malformed   {found.malformed}", highlight=False)
    if now.arms:
        out_console.print(table(now.arms))
    out_console.print(jobs_line(now))
    for finding in found.findings:
        out_console.print(
            f"{finding.level}: {finding.what}", style=_COLORS.get(finding.level, ""), highlight=False, markup=False
        )
    out_console.print("The fleet is well." if found.healthy else "The fleet is not well.", highlight=False)


def why_unreachable(endpoint: str) -> str:
    """What a plain connection to the endpoint tells; "" for one with TLS, or that is none: the error says it all."""
    match = re.fullmatch(r"tcp/\[?([^\]/]+?)\]?:(\d{1,5})", endpoint)
    if match is None or int(match[2]) > 65535:
        return ""
    from fleet.bus.security import why_not

    host, port = match[1], int(match[2])
    try:
        with socket.create_connection((host, port), timeout=ANSWER_S):
            known = why_not(host, port, None)  # which the error tells
            return "" if known else f"Something listens at port {port}, but it does not speak as our router does."
    except ConnectionRefusedError:
        return f"Nothing listens at port {port} of {host}; start it with: thermofleet router --port {port}"
    except OSError as error:
        return f"A plain connection fails too: {error.strerror or error}."
