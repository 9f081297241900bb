"""The roster of a fleet, and the access control that a router with TLS enforces.

Every participant may subscribe to everything in its own fleet, histories included. Beyond that it may publish, reply
and query as its role needs; everything else is denied.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec

from fleet.bus.protocol import keys
from fleet.errors import BusError, nearest

Role = Literal["router", "arm", "auctioneer", "submitter", "operator", "monitor", "recorder", "policy"]
ROLES: tuple[str, ...] = get_args(Role)
LONGEST_COMMON_NAME = 64
"""Characters (X.520, ub-common-name)."""
ROSTER = "roster.json"
"""File name of the roster in a folder of keys."""
_RESERVED = ("ca",)
"""File names that no participant may have."""

_PUBLISH = ("put", "liveliness_token", "declare_queryable", "reply")
_SUBSCRIBE = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
_RECEIVE = ("put", "liveliness_token", "declare_subscriber", "declare_queryable", "query", "reply")


class RosterEntry(msgspec.Struct, frozen=True):
    """A participant that may connect."""

    name: str
    """The name in the keys of an arm, an auctioneer or a policy."""
    role: Role

    def __post_init__(self) -> None:
        if self.file.casefold() in _RESERVED:
            raise ValueError(f"A participant cannot be named '{self.name}': that is the file name of the authority.")
        if len(self.common_name) > LONGEST_COMMON_NAME:
            raise ValueError(
                f"The name '{self.name}' is too long for a certificate: '{self.common_name}' has "
                f"{len(self.common_name)} characters, and {LONGEST_COMMON_NAME} are allowed."
            )

    @property
    def file(self) -> str:
        """Name of its files, without the ending; always inside the folder."""
        return file_of(self.name)

    @property
    def common_name(self) -> str:
        """Common name in its certificate, as `arm:arm_0`; access control identifies a participant by it."""
        return f"{self.role}:{self.file}"


class Roster(msgspec.Struct, frozen=True):
    """The participants of one fleet."""

    fleet: str
    participants: tuple[RosterEntry, ...]

    def __post_init__(self) -> None:
        keys.chunk(self.fleet)
        files = [participant.file.casefold() for participant in self.participants]
        for i, participant in enumerate(self.participants):
            if files[i] in files[:i]:
                raise ValueError(f"The name '{participant.name}' is taken; names of participants must be unique.")

    def named(self, name: str) -> RosterEntry:
        """The participant of a name.

        Raises:
            BusError: there is none.
        """
        for participant in self.participants:
            if participant.name == name:
                return participant
        hint = nearest(name, [participant.name for participant in self.participants])
        raise BusError(f"The fleet '{self.fleet}' has no participant '{name}'{hint}")

    @property
    def by_consensus(self) -> bool:
        """Whether the fleet has no auctioneer: its arms allocate jobs by consensus and reply to outsiders."""
        return not self.of_role("auctioneer")

    def of_role(self, role: Role) -> tuple[str, ...]:
        """Names of the participants of one role."""
        return tuple(participant.name for participant in self.participants if participant.role == role)


def of_arms(fleet: str, arms: Iterable[str], extra: Sequence[RosterEntry] = (), *, auctioneer: bool = True) -> Roster:
    """The roster of a fleet: these arms, one participant of every other role but `policy`, named like the role, and
    the extra ones.

    Args:
        auctioneer: Whether the fleet has one.

    Raises:
        ValueError: a name occurs twice, is empty, or is too long.
    """
    left_out = ("arm", "policy") if auctioneer else ("arm", "policy", "auctioneer")
    roles = [role for role in get_args(Role) if role not in left_out]
    others = tuple(RosterEntry(role, role) for role in roles)
    return Roster(fleet, (*others, *(RosterEntry(arm, "arm") for arm in arms), *extra))


def read_roster(folder: Path) -> Roster:
    """The roster of a folder of keys.

    Raises:
        BusError: it does not exist, or is damaged.
    """
    path = folder / ROSTER
    try:
        return msgspec.json.decode(path.read_bytes(), type=Roster)
    except FileNotFoundError as error:
        raise BusError(
            f"There is no '{path}': '{folder}' is not a folder of keys. thermofleet bus keys makes one."
        ) from error
    except OSError as error:
        raise BusError(f"Cannot read '{path}': {error.strerror}.") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BusError(f"'{path}' is not a roster: {error}.") from error


def file_of(name: str) -> str:
    """File name of a participant, without the ending: its name as in keys; `urllib.parse.unquote` is the inverse."""
    return keys.chunk(name)


@dataclass(frozen=True)
class Rights:
    """What one participant may do beyond subscribing, as key expressions."""

    publishes: tuple[str, ...] = ()
    """May publish (not delete), show tokens, declare queryables and reply under these."""
    queries: tuple[str, ...] = ()


def rights(fleet: str, participant: RosterEntry, *, by_consensus: bool = False) -> Rights:
    """The rights of a participant.

    Args:
        by_consensus: The fleet has no auctioneer, so its arms reply to outsiders.
    """
    time, status, cell = keys.of_clock(fleet), keys.of_jobs(fleet, "status"), keys.of_jobs(fleet, "cell")
    quotes, history = keys.of_every_arm(fleet, "quote"), keys.of_every_arm(fleet, "history")
    outsiders = keys.all_of(fleet, "jobs"), keys.all_of(fleet, "clock")
    submit, looks = keys.of_jobs(fleet, "submit"), (status, cell, quotes, time)
    match participant.role:
        case "arm":
            own = keys.all_of(fleet, "arm", participant.name)
            # The key names the querier, so only that arm may use it.
            asked = tuple(keys.asked_of_all(fleet, topic, participant.name) for topic in ("lease", "report", "claim"))
            if by_consensus:
                return Rights((own, *outsiders), (*asked, time, history))
            return Rights((own,), (*asked, time))
        case "auctioneer":
            own, policies = keys.all_of(fleet, "auction", participant.name), keys.of_every(fleet, "policy", "act")
            awards = keys.of_every_arm(fleet, "award")
            return Rights((own, *outsiders), (quotes, awards, history, time, status, policies))
        case "operator":
            steer = keys.of_jobs(fleet, "clear"), keys.of_jobs(fleet, "control"), keys.of_every_arm(fleet, "reset")
            return Rights((keys.all_of(fleet, "monitor", participant.name),), (submit, *steer, *looks))
        case "submitter":
            return Rights(queries=(submit, *looks))
        case "monitor" | "recorder":
            return Rights(queries=(status, cell, time))
        case "policy":
            return Rights(publishes=(keys.all_of(fleet, "policy", participant.name),))
        case "router":
            return Rights()


def rights_by_role(fleet: str, name: str) -> dict[Role, Rights]:
    """The rights that a participant of this name may have in each role, in a fleet with or without an auctioneer."""
    return {role: rights(fleet, RosterEntry(name, role), by_consensus=True) for role in get_args(Role)}


def access_control(roster: Roster, router: str = "router") -> dict[str, Any]:
    """The rules of a roster for Zenoh's configuration; everything that they do not allow is denied.

    Args:
        router: Name of the router that enforces them; other routers of the roster may link with it.

    ingress is what a participant sends to the router, egress what the router sends to it. A rule allows a message when
    a key expression of the rule includes the whole key expression of the message: `arm/*/state` is in no arm's rule.
    """
    fleet = roster.fleet
    everything = _with_caches([keys.all_of_fleet(fleet)])
    rules = [
        _rule("subscribe", "ingress", _SUBSCRIBE, everything),
        _rule("receive", "egress", _RECEIVE, everything),
        _rule("history", "ingress", ("query",), [keys.caches_of(keys.all_of_fleet(fleet))]),
    ]
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    others = [one.common_name for one in roster.participants if one.role == "router" and one.name != router]
    if others:  # what another router forwards has passed the rules of that router
        messages = sorted({*_RECEIVE, *_SUBSCRIBE})
        links = [_rule(f"link {flow}", flow, messages, everything) for flow in ("ingress", "egress")]
        rules += links
        policies.append({"subjects": ["routers"], "rules": [rule["id"] for rule in links]})
        subjects.append({"id": "routers", "cert_common_names": others})
    for participant in roster.participants:
        if participant.role == "router":
            continue
        name, granted = participant.common_name, rights(fleet, participant, by_consensus=roster.by_consensus)
        own: list[dict[str, Any]] = []
        if granted.publishes:
            own.append(_rule(f"{name} publishes", "ingress", _PUBLISH, _with_caches(granted.publishes)))
        if granted.queries:
            own.append(_rule(f"{name} queries", "ingress", ("query",), granted.queries))
        policies.append({"subjects": [name], "rules": [rule["id"] for rule in (*rules[:3], *own)]})
        rules += own
        subjects.append({"id": name, "cert_common_names": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _with_caches(expressions: Iterable[str]) -> list[str]:
    """The expressions, and those of the caches of advanced publishers."""
    return [both for expression in expressions for both in (expression, keys.caches_of(expression))]


def _rule(name: str, flow: str, messages: Sequence[str], expressions: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(expressions),
    }
