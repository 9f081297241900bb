"""Keys of the bus and what travels under each: one table, and the functions that build and parse keys.

`thermofleet/v4/{fleet}/…` with `arm/{arm}/{topic}`, `auction/{auctioneer}/{topic}`, `jobs/{topic}`, `clock/now`,
`policy/{policy}/act` and `monitor/{monitor}/{topic}`. An arm queries an auctioneer under
`auction/{auctioneer}/{topic}/{arm}`, and another arm under `arm/{other}/{topic}/{arm}`: access control sees only keys,
so the querier must be part of the key.

`fleet.bus.client` publishes, subscribes, queries and replies by the table alone; docs/bus/messages.md and docs/contract
are generated from it. Names of fleets, arms and auctioneers are percent-encoded to one chunk, so no name can contain a
wildcard, a `/` or a leading `@` (no wildcard matches a chunk that begins with `@`, so its history would be lost).
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, cast, get_args
from urllib.parse import quote, unquote

import msgspec

from fleet.bus.protocol import auction, cell, consensus, messages, operator, policy
from fleet.errors import NAME_RULE, is_name, printable

Role = Literal["arm", "auction", "jobs", "clock", "policy", "monitor"]
MessageType = type[msgspec.Struct]
Pattern = Literal["token", "publish", "query"]
Priority = Literal["REAL_TIME", "INTERACTIVE_HIGH", "INTERACTIVE_LOW", "DATA_HIGH", "DATA", "DATA_LOW", "BACKGROUND"]
"""As Zenoh names them."""
PATTERNS: Mapping[Pattern, str] = {
    "token": "a liveliness token without payload: present while the session is open",
    "publish": "an advanced publisher that caches the last messages for subscribers that join late or missed some",
    "query": "a complete queryable: the request is the payload of the query, the reply is a message or a Refusal",
}
PREFIX = "thermofleet/v4"
NAMELESS: tuple[Role, ...] = ("jobs", "clock")
"""Roles whose keys name no participant."""
HISTORY = 1024
"""Messages that a publisher of telemetry or events caches: at ten a second, 100 s of a router's absence."""
STATE_HZ = 10.0
"""States that an arm publishes a second, real time."""
SESSION_LEASE_S = 2.0
"""Real seconds without a message after which Zenoh closes a session and withdraws its tokens."""


@dataclass(frozen=True)
class BusChannel:
    """One key of the bus."""

    role: Role
    topic: str
    pattern: Pattern
    message: MessageType | None = None
    """Published there, or the request of a query; None for a token."""
    reply: MessageType | None = None
    """Of a query; a `Refusal` may come instead."""
    receiver: str = "any"
    """Role that subscribes, or queries; "any" for all participants."""
    history: int = 0
    """Messages that the publisher caches; a subscriber that asks for history gets as many, and lost ones are resent."""
    heartbeat_s: float = 0.5
    """Of a publisher with history: within this its last sequence number is repeated, so that a loss is noticed."""
    rate_hz: float | None = None
    """Messages a second from one sender, real time; None: when something changes."""
    limit_hz: float | None = None
    """Messages a second that the router of `thermofleet bus router` forwards from one session; None: any number."""
    lease_s: float | None = None
    """Real seconds that the token, or the job that is granted, stays valid without renewal."""
    priority: Priority = "DATA"

    @property
    def sender(self) -> Literal["arm", "auctioneer", "policy", "monitor"]:
        """Role that publishes, replies or declares the token."""
        return self.role if self.role in ("arm", "policy", "monitor") else "auctioneer"

    @property
    def names_querier(self) -> bool:
        """Whether the key ends in the name of the querying arm: access control sees only keys."""
        return self.pattern == "query" and self.receiver == "arm"

    @property
    def congestion(self) -> Literal["DROP", "BLOCK"]:
        """What Zenoh does when a receiver does not keep up: publications are dropped (and resent where there is a
        history), a query waits for at most a second."""
        return "BLOCK" if self.pattern == "query" else "DROP"

    @property
    def name(self) -> str:
        """For example `arm_state`."""
        return f"{self.role}_{self.topic}"

    @property
    def address(self) -> str:
        """The key with its parameters in braces."""
        owner = "" if self.role in NAMELESS else f"/{{{self.sender}}}"
        querier = "" if not self.names_querier else "/{peer}" if self.role == "arm" else "/{arm}"
        return f"{PREFIX}/{{fleet}}/{self.role}{owner}/{self.topic}{querier}"

    @property
    def messages(self) -> tuple[MessageType, ...]:
        """Message types: none, a publication, or a request, its reply and the `Refusal`."""
        refusal = None if self.reply is None else messages.Refusal
        return tuple(message for message in (self.message, self.reply, refusal) if message is not None)


CHANNELS: tuple[BusChannel, ...] = (
    BusChannel("arm", "alive", "token", lease_s=SESSION_LEASE_S),
    BusChannel("arm", "state", "publish", messages.State, history=HISTORY, rate_hz=STATE_HZ, limit_hz=100.0),
    BusChannel("arm", "info", "publish", messages.Info, history=1),
    BusChannel("arm", "difficulty", "publish", messages.DifficultyScores, history=1),
    BusChannel("arm", "event", "publish", auction.ArmEvent, history=HISTORY),
    BusChannel("arm", "quote", "query", auction.QuoteRequest, auction.Quote, receiver="auctioneer; any for a dry run"),
    BusChannel("arm", "award", "query", auction.Award, auction.Ack, receiver="auctioneer"),
    BusChannel("arm", "history", "query", consensus.HistoryRequest, consensus.History, receiver="auctioneer, or arm"),
    BusChannel("arm", "reset", "query", operator.ResetRequest, operator.ResetReply, receiver="operator"),
    BusChannel("arm", "bid", "publish", consensus.Bid, receiver="arm", history=1, rate_hz=1.0),
    BusChannel("arm", "claim", "query", consensus.Claim, consensus.ClaimReply, receiver="arm", lease_s=auction.LEASE_S),
    BusChannel("arm", "operation", "publish", operator.Operation, history=HISTORY),
    BusChannel("auction", "alive", "token", lease_s=SESSION_LEASE_S),
    BusChannel("auction", "announce", "publish", auction.Announcement, history=HISTORY),
    BusChannel("auction", "result", "publish", auction.Result, history=HISTORY),
    BusChannel("auction", "operation", "publish", operator.Operation, history=HISTORY),
    BusChannel(
        "auction", "lease", "query", auction.LeaseRequest, auction.Lease, receiver="arm", lease_s=auction.LEASE_S
    ),
    BusChannel("auction", "report", "query", auction.Report, auction.Receipt, receiver="arm"),
    BusChannel("jobs", "submit", "query", auction.Submission, auction.SubmissionReply),
    BusChannel("jobs", "status", "query", auction.StatusRequest, auction.Status),
    BusChannel("jobs", "clear", "query", operator.ClearRequest, operator.Cleared, receiver="operator"),
    BusChannel("jobs", "control", "query", operator.ControlRequest, operator.Controlled, receiver="operator"),
    BusChannel("jobs", "cell", "query", cell.CellRequest, cell.Cell),
    BusChannel("clock", "now", "query", auction.ClockRequest, auction.Clock),
    BusChannel("policy", "act", "query", policy.ActRequest, policy.ActReply, receiver="auctioneer, or simulated shift"),
    BusChannel("monitor", "alive", "token", lease_s=SESSION_LEASE_S),
    BusChannel("monitor", "alarm", "publish", operator.Alarm, history=HISTORY),
)
CHANNEL: Mapping[tuple[str, str], BusChannel] = {(channel.role, channel.topic): channel for channel in CHANNELS}
"""By role and topic."""
STATE_GAP_S = 2.0 / (CHANNEL["arm", "state"].limit_hz or math.inf)
"""Real seconds between two states of which both shall arrive: a router drops one that comes within half of it."""
PUBLISHED: Mapping[BusChannel, MessageType] = {
    channel: channel.message for channel in CHANNELS if channel.pattern == "publish" and channel.message is not None
}
"""Those that can be subscribed to, with their messages."""
MESSAGES: tuple[MessageType, ...] = tuple(dict.fromkeys(kind for channel in CHANNELS for kind in channel.messages))
"""Every message that travels by itself, in the order of the keys."""
TOPICS: Mapping[Role, tuple[str, ...]] = {
    role: tuple(channel.topic for channel in CHANNELS if channel.role == role) for role in get_args(Role)
}
ASKED: Mapping[str, Role] = {channel.topic: channel.role for channel in CHANNELS if channel.names_querier}
"""Role of the replier, by topic, for keys that end in the name of the querying arm."""
STATES = f"{PREFIX}/*/arm/*/state"
"""Key expression of the telemetry of every arm of every fleet; for router rules, not for publications."""
MAX_CACHED, MAX_CACHED_CHARACTERS = 4096, 256
"""Parsed keys that are cached, and characters of the longest of them."""
_KEY = re.compile(
    rf"{PREFIX}/(?P<fleet>[^/]*)/((?P<nameless>jobs|clock)|(?P<role>arm|auction|policy|monitor)/(?P<name>[^/]*))"
    r"/(?P<topic>[^/]*)(/(?P<asker>[^/]*))?"
)


@dataclass(frozen=True)
class ParsedKey:
    """A parsed concrete key."""

    fleet: str
    role: Role
    name: str
    """Of the arm, the auctioneer, the policy or the monitor; "" for jobs and clock."""
    topic: str
    asker: str = ""
    """The querying arm, for the topics in `ASKED`; "" for all others."""

    def __str__(self) -> str:
        """The key as text; raises as `build`."""
        return build(self.fleet, self.role, self.topic, self.name, self.asker)


def build(fleet: str, role: Role, topic: str, name: str | None = "", querier: str | None = "") -> str:
    """A key, or with None for a name the key expression of every participant; that is not for publications.

    Raises:
        ValueError: a name is empty or no valid Unicode, or what is given does not belong together.
    """
    if (role, topic) not in CHANNEL:
        allowed = ", ".join(f"{role} {topic}" for role, topic in CHANNEL)
        raise ValueError(f"Unknown role and topic of a key '{role} {topic}'. Allowed: {allowed}.")
    parts = [PREFIX, chunk(fleet), role]
    if role not in NAMELESS:
        parts.append("*" if name is None else chunk(name))
    elif name:
        raise ValueError(f"Keys under '{role}' contain no participant's name (got {name!r}).")
    parts.append(topic)
    if topic in ASKED:
        parts.append("*" if querier is None else chunk(querier))
    elif querier:
        raise ValueError(f"Keys of '{topic}' do not end in a querier's name (got {querier!r}).")
    return "/".join(parts)


def of_arm(fleet: str, arm: str, topic: str) -> str:
    """Key of one arm: `thermofleet/v4/{fleet}/arm/{arm}/{topic}`."""
    return build(fleet, "arm", topic, arm)


def of_every(fleet: str, role: Role, topic: str) -> str:
    """Key expression that matches a topic of every participant of a role in one fleet; not for publications."""
    return build(fleet, role, topic, None)


def of_every_arm(fleet: str, topic: str) -> str:
    """Key expression that matches the topic of every arm of one fleet; for subscribers and queries alone."""
    return build(fleet, "arm", topic, None)


def of_auction(fleet: str, auctioneer: str, topic: str) -> str:
    """Key of one auctioneer: `thermofleet/v4/{fleet}/auction/{auctioneer}/{topic}`."""
    return build(fleet, "auction", topic, auctioneer)


def of_every_auction(fleet: str, topic: str) -> str:
    """Key expression that matches the topic of every auctioneer of one fleet; not for publications."""
    return build(fleet, "auction", topic, None)


def asked_by(fleet: str, asked: str, topic: str, arm: str) -> str:
    """Key under which an arm queries another participant: `thermofleet/v4/{fleet}/auction/{asked}/{topic}/{arm}`
    for an auctioneer, `…/arm/{asked}/…` for an arm.
    """
    return build(fleet, ASKED[topic], topic, asked, arm)


def asked_by_every_arm(fleet: str, asked: str, topic: str) -> str:
    """Key expression of the queryable of an auctioneer, or arm, for all arms; not for replies (see `answered`)."""
    return build(fleet, ASKED[topic], topic, asked, None)


def asked_of_all(fleet: str, topic: str, arm: str) -> str:
    """Key expression of the queries of one arm to any auctioneer, or any arm."""
    return build(fleet, ASKED[topic], topic, None, arm)


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


def of_jobs(fleet: str, topic: str) -> str:
    """Key at which outsiders submit jobs, query their status or free space: `thermofleet/v4/{fleet}/jobs/{topic}`."""
    return build(fleet, "jobs", topic)


def of_clock(fleet: str) -> str:
    """Key at which fleet time is queried: `thermofleet/v4/{fleet}/clock/now`."""
    return build(fleet, "clock", "now")


def of_policy(fleet: str, policy: str) -> str:
    """Key at which a policy in another process is queried: `thermofleet/v4/{fleet}/policy/{policy}/act`."""
    return build(fleet, "policy", "act", policy)


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


def parse(key: str) -> ParsedKey:
    """The parsed concrete key, the inverse of `str`.

    Raises:
        ValueError: not a key of this version, or not written as `str(ParsedKey(...))` writes it (wildcards, for one).
    """
    # The same few keys come with every message; longer ones than ours are not cached.
    return _parse_cached(key) if len(key) <= MAX_CACHED_CHARACTERS else _parse(key)


def _parse(key: str) -> ParsedKey:
    match = _KEY.fullmatch(key)
    if match is None:
        raise ValueError(
            f"'{key}' is no key of this bus: expected {PREFIX}/{{fleet}}/… with arm/{{arm}}/…, "
            "auction/{auctioneer}/…, policy/{policy}/…, jobs/… or clock/now."
        )
    try:
        fleet, name, asker = (unquote(match[part] or "", errors="strict") for part in ("fleet", "name", "asker"))
        parsed = ParsedKey(fleet, cast(Role, match["nameless"] or match["role"]), name, match["topic"], asker)
        written = str(parsed)
    except UnicodeDecodeError as error:
        raise ValueError(f"'{key}' holds a percent escape that is no UTF-8.") from error
    except ValueError as error:
        raise ValueError(f"'{key}' is no key of this bus: {error}") from error
    if written != key:
        raise ValueError(f"'{key}' is not written as one concrete key should be: expected '{written}'.")
    return parsed


_parse_cached = lru_cache(MAX_CACHED)(_parse)


def chunk(name: str) -> str:
    """The name as one chunk of a key.

    Raises:
        ValueError: it does not follow the rule for names.
    """
    if not is_name(name):
        raise ValueError(f"A name in a key must have {NAME_RULE} (got '{printable(name)}').")
    return quote(name, safe="")


def owner_of(expression: str) -> str:
    """Name of the participant in a key, or a key expression for any querier; "" for jobs and clock."""
    _, _, _, role, name, *_ = expression.split("/")
    return "" if role in NAMELESS else unquote(name)


def channel_of(expression: str) -> BusChannel:
    """The channel that a key, or a key expression with wildcards for names, belongs to.

    Raises:
        ValueError: it belongs to none.
    """
    parts = expression.split("/")
    role = parts[3] if len(parts) > 4 else ""
    place = 4 if role in NAMELESS else 5
    channel = CHANNEL.get((role, parts[place] if len(parts) > place else ""))
    if channel is None:
        raise ValueError(f"'{expression}' is no key of this bus. Keys: {', '.join(c.address for c in CHANNELS)}.")
    return channel


def channel_for(expression: str, pattern: Pattern, message: MessageType | None = None) -> BusChannel:
    """The channel of a key or key expression, if it is used as the table says.

    Raises:
        ValueError: it has another pattern or message.
    """
    channel = channel_of(expression)
    if channel.pattern != pattern or channel.message is not message:
        expected = "nothing" if channel.message is None else channel.message.__name__
        raise ValueError(f"'{expression}' is for {expected} ({channel.pattern}), not for {message} ({pattern}).")
    return channel
