"""`thermofleet bus keys`: the certificate authority of a fleet, and a certificate for each participant."""

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import get_args

import typer

from fleet.bus.security.access_control import ROLES, ROSTER, Role, Roster, RosterEntry, of_arms, read_roster, rights
from fleet.errors import FleetError, nearest
from fleet.fields import argument, option
from scenarios.cli import options
from scenarios.table import Table
from scenarios.terminal import out_console, print_json, say

DAYS, MAX_DAYS = 365, 3650
_ROLES = ", ".join(ROLES)


def keys_command(
    ctx: typer.Context,
    folder: Path = argument("Folder of one fleet's keys.", metavar="DIR"),
    scenario: str | None = argument(
        "Make new keys for the arms of this scenario. Default: show the present keys.", None
    ),
    extra: list[str] | None = option(f"NAME:ROLE, another participant; roles: {_ROLES}.", None),
    add: list[str] | None = option("NAME:ROLE, a new certificate from the present authority.", None),
    days: int = option("Lifetime of the new certificates, days.", DAYS, low=1, high=MAX_DAYS),
    host: list[str] | None = option(
        "Name or address of the router, besides localhost, 127.0.0.1 and ::1; may be repeated.", None
    ),
    overwrite: bool = option("With SCENARIO, replace all keys; with --add, replace certificates.", False),
    no_auctioneer: bool = option("Rights for arms that allocate jobs by consensus, without an auctioneer.", False),
    as_json: bool = options.JSON,
) -> None:
    """Make, extend and show keys and certificates for mutual TLS."""
    from fleet.bus.security.certificates import HERE, hosts_of, lifetimes, make, read
    from fleet.bus.security.certificates import add as add_to

    if add and (scenario or extra or no_auctioneer):
        raise FleetError("--add extends the present keys; leave SCENARIO, --extra and --no-auctioneer out.")
    needless = options.first_given(ctx, "extra", "days", "host", "overwrite", "no_auctioneer")
    if needless and not (scenario or add):
        raise FleetError(
            f"{needless} is for new keys. Give SCENARIO to make all keys (with --overwrite, to replace all), or "
            "--add NAME:ROLE to extend the present ones."
        )
    added = [participant_of(text) for text in add or ()]
    if host and added and not any(one.role == "router" for one in added):
        raise FleetError("--host is for the certificate of a router, and --add names none; leave --host out.")
    hosts = host or HERE
    if scenario:
        from scenarios.spec.load import load

        chosen = load(scenario)
        more = [participant_of(text) for text in extra or ()]
        try:
            roster = of_arms(chosen.name, [arm.name for arm in chosen.arms], more, auctioneer=not no_auctioneer)
        except ValueError as error:
            raise FleetError(str(error)) from error
        make(folder, roster, days=days, hosts=hosts, overwrite=overwrite)
    before = tuple[RosterEntry, ...]()
    if added:
        known = read_roster(folder)
        before = known.participants
        others = tuple(one for one in before if one not in added)
        lifetimes(folder, Roster(known.fleet, others))  # refuses what could not be shown afterwards
        add_to(folder, added, days=days, hosts=hosts, overwrite=overwrite)
    roster = read_roster(folder)
    spans = lifetimes(folder, roster)
    if as_json:
        print_json(_plain(roster, {name: end for name, (_, end) in spans.items()}))
        return
    out_console.print(_table(folder, roster, spans))
    if scenario or add:
        say(f"Keys of the fleet '{roster.fleet}' are in {folder}. Keep {folder / 'ca.key'} where no participant runs.")
    if any(one not in before or one.role == "router" for one in added):
        say(f"Copy {folder / ROSTER} to machines that have one and restart the routers: they read it when they start.")
    for one in roster.participants if scenario else added:
        if one.role == "router":
            valid = ", ".join(hosts_of(read(folder, one.file)))
            say(f"The certificate of the router '{one.name}' is valid only for {valid}; --host adds others.")


def participant_of(text: str) -> RosterEntry:
    """The participant of `NAME:ROLE`; a name may hold colons.

    Raises:
        FleetError: the text has another form, or the name or the role is not allowed.
    """
    name, colon, role = text.rpartition(":")
    if not colon or not name:
        raise FleetError(f"'{text}' is not NAME:ROLE, as in gateway:submitter.")
    known: Role | None = next((each for each in get_args(Role) if each == role), None)
    if known is None:
        raise FleetError(f"'{text}': no role '{role}'{nearest(role, ROLES)}")
    try:
        return RosterEntry(name, known)
    except ValueError as error:
        raise FleetError(str(error)) from error


def _table(folder: Path, roster: Roster, spans: dict[str, tuple[datetime, datetime]]) -> Table:
    from fleet.bus.security.certificates import CA, format_time, key_fault

    now = datetime.now(UTC)
    rows = list[tuple[str, str, str]]()
    held = [("(authority)", "", CA, spans[CA])]
    held += [(one.name, one.role, one.file, spans.get(one.name)) for one in roster.participants]
    for name, role, file, span in held:
        if span is None:
            rows.append((name, role, "not in this folder"))
            continue
        begin, end = span
        not_now = ", expired" if end < now else ", not yet valid" if begin > now else ""
        fault = key_fault(folder, file)
        rows.append((name, role, format_time(end) + not_now + (f", {fault}" if fault else "")))
    return Table(head=("participant", "role", "certificate ends"), rows=tuple(rows), numbers=False)


def _plain(roster: Roster, ends: dict[str, datetime]) -> dict[str, object]:
    from fleet.bus.security.certificates import CA

    def row(one: RosterEntry) -> dict[str, object]:
        end = ends[one.name].isoformat() if one.name in ends else None
        who = {"name": one.name, "role": one.role, "common_name": one.common_name, "ends": end}
        return {**who, **asdict(rights(roster.fleet, one, by_consensus=roster.by_consensus))}

    return {
        "fleet": roster.fleet,
        "authority_ends": ends[CA].isoformat(),
        "participants": [row(one) for one in roster.participants],
    }
