"""Keys of the bus: built and parsed here, and nowhere else.

`thermofleet/v4/{fleet}/…` with `arm/{arm}/{topic}`, `auction/{auctioneer}/{topic}`, `jobs/{topic}`, `clock/now` and
`policy/{policy}/act`.
An arm queries an auctioneer under `auction/{auctioneer}/{topic}/{arm}`, and another arm under
`arm/{other}/{topic}/{arm}`: access control sees only keys, so the querier must be part of the key.

Names of fleets, arms and auctioneers are percent-encoded to one chunk, so no name can smuggle a wildcard, a `/` or an
`@` into a key (a chunk that begins with `@` is matched by no wildcard, and its history is silently lost).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args
from urllib.parse import quote, unquote

from fleet.errors import NAME_RULE, is_name, printable

Role = Literal["arm", "auction", "jobs", "clock", "policy"]
ArmTopic = Literal[
    "alive", "state", "info", "difficulty", "event", "bid", "quote", "award", "history", "reset", "operation"
]
AuctionTopic = Literal["alive", "announce", "result", "operation"]
AskedTopic = Literal["lease", "report", "claim"]
JobsTopic = Literal["submit", "status", "clear", "control", "cell"]

PREFIX = "thermofleet/v4"
ENDPOINT = "tcp/127.0.0.1:7447"
"""Of the router, by default."""
STATES = f"{PREFIX}/*/arm/*/state"
"""Key expression of the telemetry of every arm of every fleet; for router rules, not for publications."""
TOPICS: dict[Role, tuple[str, ...]] = {
    "arm": (*get_args(ArmTopic), "claim"),
    "auction": (*get_args(AuctionTopic), "lease", "report"),
    "jobs": get_args(JobsTopic),
    "clock": ("now",),
    "policy": ("act",),
}
NAMELESS: tuple[Role, ...] = ("jobs", "clock")
"""Roles whose keys name no participant."""
MOST_KNOWN, LONGEST_KNOWN = 4096, 256
"""Parsed keys that are cached, and characters of the longest of them."""
ASKED: tuple[str, ...] = get_args(AskedTopic)
"""Topics of an auctioneer, or of an arm, whose keys end in the name of the querying arm."""
_ROLES: dict[str, Role] = {str(role): role for role in TOPICS}
_ASKED: dict[AskedTopic, Role] = {"lease": "auction", "report": "auction", "claim": "arm"}
"""Role of the replier, by topic."""


@dataclass(frozen=True)
class Key:
    """A parsed concrete key."""

    fleet: str
    role: Role
    name: str
    """Of the arm, the auctioneer or the policy; "" for jobs and clock."""
    topic: str
    asker: str = ""
    """The querying arm, for the topics in `ASKED`; "" for all others."""

    def __str__(self) -> str:
        """The key as text.

        Raises:
            ValueError: a name is empty or no valid Unicode, or what is given does not belong together.
        """
        if self.role not in TOPICS:
            raise ValueError(f"Unknown role '{self.role}' of a key. Allowed: {', '.join(TOPICS)}.")
        if self.topic not in TOPICS[self.role]:
            raise ValueError(f"Unknown topic '{self.topic}' of '{self.role}'. Allowed: {', '.join(TOPICS[self.role])}.")
        start = f"{PREFIX}/{chunk(self.fleet)}/{self.role}"
        if self.topic in ASKED:
            return f"{start}/{chunk(self.name)}/{self.topic}/{chunk(self.asker)}"
        if self.asker:
            raise ValueError(f"Keys of '{self.topic}' do not end in a querier's name (got {self.asker!r}).")
        if self.role not in NAMELESS:
            return f"{start}/{chunk(self.name)}/{self.topic}"
        if self.name:
            raise ValueError(f"Keys under '{self.role}' contain no participant's name (got {self.name!r}).")
        return f"{start}/{self.topic}"


def of_arm(fleet: str, arm: str, topic: ArmTopic) -> str:
    """Key of one arm: `thermofleet/v4/{fleet}/arm/{arm}/{topic}`."""
    return str(Key(fleet, "arm", arm, topic))


def of_every(fleet: str, role: Role, topic: str) -> str:
    """Key expression that matches a topic of every participant of a role in one fleet; not for publications."""
    return str(Key(fleet, role, "x", topic)).replace(f"/{role}/x/", f"/{role}/*/")


def of_every_arm(fleet: str, topic: ArmTopic) -> str:
    """Key expression that matches the topic of every arm of one fleet; for subscribers and queries alone."""
    return of_every(fleet, "arm", topic)


def of_auction(fleet: str, auctioneer: str, topic: AuctionTopic) -> str:
    """Key of one auctioneer: `thermofleet/v4/{fleet}/auction/{auctioneer}/{topic}`."""
    return str(Key(fleet, "auction", auctioneer, topic))


def of_every_auction(fleet: str, topic: AuctionTopic) -> str:
    """Key expression that matches the topic of every auctioneer of one fleet; not for publications."""
    return of_every(fleet, "auction", topic)


def asked_by(fleet: str, asked: str, topic: AskedTopic, arm: str) -> str:
    """Key under which an arm queries another participant: `thermofleet/v4/{fleet}/auction/{asked}/{topic}/{arm}`
    for an auctioneer, `…/arm/{asked}/…` for an arm.
    """
    return str(Key(fleet, _ASKED[topic], asked, topic, arm))


def asked_by_every_arm(fleet: str, asked: str, topic: AskedTopic) -> str:
    """Key expression of the queryable of an auctioneer, or arm, for all arms; not for replies (see `answered`)."""
    return asked_by(fleet, asked, topic, "x").removesuffix("x") + "*"


def asked_of_all(fleet: str, topic: AskedTopic, arm: str) -> str:
    """Key expression of the queries of one arm to any auctioneer, or any arm."""
    return asked_by(fleet, "x", topic, arm).replace(f"/{_ASKED[topic]}/x/", f"/{_ASKED[topic]}/*/")


def answered(expression: str, asked: str) -> str:
    """The concrete key of a reply, from the expression of the queryable and the key `asked` of the query.

    Where the expression ends in `*`, the querier of the query takes its place; other expressions are concrete.

    Raises:
        ValueError: the key of the query names no querier.
    """
    if not expression.endswith("/*"):
        return expression
    key = expression.removesuffix("*") + asked.rsplit("/", 1)[1]
    parse(key)
    return key


def of_jobs(fleet: str, topic: JobsTopic) -> str:
    """Key at which outsiders submit jobs, query their status or free space: `thermofleet/v4/{fleet}/jobs/{topic}`."""
    return str(Key(fleet, "jobs", "", topic))


def of_clock(fleet: str) -> str:
    """Key at which fleet time is queried: `thermofleet/v4/{fleet}/clock/now`."""
    return str(Key(fleet, "clock", "", "now"))


def of_policy(fleet: str, policy: str) -> str:
    """Key at which a policy in another process is queried: `thermofleet/v4/{fleet}/policy/{policy}/act`."""
    return str(Key(fleet, "policy", policy, "act"))


def of_every_policy(fleet: str) -> str:
    """Key expression that matches every policy of one fleet; for router rules."""
    return of_every(fleet, "policy", "act")


def all_of_fleet(fleet: str) -> str:
    """Key expression of everything in one fleet; for subscribers and router rules, not for publications."""
    return f"{PREFIX}/{chunk(fleet)}/**"


def all_of(fleet: str, role: Role, name: str = "") -> str:
    """Key expression of everything of one arm, auctioneer or policy, or of a role without names."""
    start = f"{PREFIX}/{chunk(fleet)}/{role}"
    return f"{start}/**" if role in NAMELESS else f"{start}/{chunk(name)}/**"


def tokens_of_all_versions(fleet: str) -> str:
    """Key expression of the tokens of all participants of a fleet, also of those that use another version."""
    return f"{PREFIX.rpartition('/')[0]}/*/{chunk(fleet)}/*/*/alive"


def other_version(key: str) -> tuple[str, str] | None:
    """Name and version of a participant by its token, if the version is not this one; else None."""
    parts = key.split("/")
    if len(parts) != 6 or "/".join(parts[:2]) == PREFIX:
        return None
    return unquote(parts[4]), parts[1]


def caches_of(expression: str) -> str:
    """Key expression that advanced publishers and subscribers use beside the keys of another expression.

    `**` matches no chunk that begins with `@`, so it does not cover these.
    """
    return f"{expression}/@adv/**"


def parse(key: str) -> Key:
    """The parsed concrete key, the inverse of `str`.

    Raises:
        ValueError: not a key of this version, or not written as `str(Key(...))` would write it (wildcards, for one).
    """
    # The same few keys come with every message; longer ones than ours are not cached.
    return _known(key) if len(key) <= LONGEST_KNOWN else _parse(key)


def _parse(key: str) -> Key:
    parts = key.split("/")
    asked = len(parts) == 7 and parts[5] in ASKED
    named = len(parts) == 6 or asked
    if "/".join(parts[:2]) != PREFIX or not (named or len(parts) == 5):
        raise ValueError(f"'{key}' is no key of this bus: expected {PREFIX}/{{fleet}}/{{{'|'.join(TOPICS)}}}/….")
    role = _ROLES.get(parts[3])
    if role is None or named == (role in NAMELESS):
        raise ValueError(
            f"'{key}' is not a key of this bus: expected arm/{{arm}}/…, auction/{{auctioneer}}/…, policy/{{policy}}/…, "
            "jobs/… or clock/now."
        )
    try:
        chunks = (parts[2], parts[4] if named else "", parts[6] if asked else "")
        names = [unquote(part, errors="strict") for part in chunks]
    except UnicodeDecodeError as error:
        raise ValueError(f"'{key}' holds a percent escape that is no UTF-8.") from error
    parsed = Key(names[0], role, names[1], parts[5] if named else parts[4], names[2])
    try:
        written = str(parsed)
    except ValueError as error:
        raise ValueError(f"'{key}' is no key of this bus: {error}") from error
    if written != key:
        raise ValueError(f"'{key}' is not written as one concrete key should be: expected '{written}'.")
    return parsed


_known = lru_cache(MOST_KNOWN)(_parse)


def chunk(name: str) -> str:
    """The name as one chunk of a key.

    Raises:
        ValueError: it does not follow the rule for names.
    """
    if not is_name(name):
        raise ValueError(f"A name in a key must have {NAME_RULE} (got '{printable(name)}').")
    return quote(name, safe="")
