"""The contract of the bus as one table: every key, the message that travels there, and how it is transported.

`fleet.bus.client` publishes, subscribes, queries and replies by this table alone. docs/bus/messages.md and
docs/contract are generated from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import msgspec

from fleet.bus.protocol import auction, cell, consensus, keys, messages, operator, policy
from fleet.bus.protocol.keys import Role

MessageType = type[msgspec.Struct]
Pattern = Literal["token", "publish", "query"]
Priority = Literal["REAL_TIME", "INTERACTIVE_HIGH", "INTERACTIVE_LOW", "DATA_HIGH", "DATA", "DATA_LOW", "BACKGROUND"]
"""As Zenoh names them."""
PATTERNS: Mapping[Pattern, str] = {
    "token": "a liveliness token without payload: present while the session is open",
    "publish": "an advanced publisher that caches the last messages for subscribers that join late or missed some",
    "query": "a complete queryable: the request is the payload of the query, the reply is a message or a Refusal",
}
HISTORY = 1024
"""Messages that a publisher of telemetry or events caches: at ten a second, 100 s of a router's absence."""
STATE_HZ = 10.0
"""States that an arm publishes a second, real time."""
SESSION_LEASE_S = 2.0
"""Real seconds without a sign of life after which Zenoh closes a session and withdraws its tokens."""


@dataclass(frozen=True)
class Channel:
    """One key of the bus."""

    role: Role
    topic: str
    pattern: Pattern
    message: MessageType | None = None
    """Published there, or the request of a query; None for a token."""
    reply: MessageType | None = None
    """Of a query; a `Refusal` may come instead."""
    receiver: str = "anybody"
    """Subscribes, or queries."""
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
    def sender(self) -> Literal["arm", "auctioneer", "policy"]:
        """Who publishes, replies or shows the token."""
        return self.role if self.role in ("arm", "policy") else "auctioneer"

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
        owner = {"arm": "/{arm}", "auction": "/{auctioneer}", "policy": "/{policy}"}.get(self.role, "")
        querier = "" if self.topic not in keys.ASKED else "/{peer}" if self.role == "arm" else "/{arm}"
        return f"{keys.PREFIX}/{{fleet}}/{self.role}{owner}/{self.topic}{querier}"

    @property
    def messages(self) -> tuple[MessageType, ...]:
        """What travels there: nothing, a message, or a request, its reply and the refusal that may come instead."""
        refusal = None if self.reply is None else messages.Refusal
        return tuple(message for message in (self.message, self.reply, refusal) if message is not None)


CHANNELS: tuple[Channel, ...] = (
    Channel("arm", "alive", "token", lease_s=SESSION_LEASE_S),
    Channel("arm", "state", "publish", messages.State, history=HISTORY, rate_hz=STATE_HZ, limit_hz=100.0),
    Channel("arm", "info", "publish", messages.Info, history=1),
    Channel("arm", "difficulty", "publish", messages.DifficultyScores, history=1),
    Channel("arm", "event", "publish", auction.ArmEvent, history=HISTORY),
    Channel(
        "arm", "quote", "query", auction.QuoteRequest, auction.Quote, receiver="auctioneer, or anybody for a dry run"
    ),
    Channel("arm", "award", "query", auction.Award, auction.Ack, receiver="auctioneer"),
    Channel("arm", "history", "query", consensus.HistoryRequest, consensus.History, receiver="auctioneer, or arm"),
    Channel("arm", "reset", "query", operator.ResetRequest, operator.ResetReply, receiver="operator"),
    Channel("arm", "bid", "publish", consensus.Bid, receiver="arm", history=1, rate_hz=1.0),
    Channel("arm", "claim", "query", consensus.Claim, consensus.ClaimReply, receiver="arm", lease_s=auction.LEASE_S),
    Channel("arm", "operation", "publish", operator.Operation, history=HISTORY),
    Channel("auction", "alive", "token", lease_s=SESSION_LEASE_S),
    Channel("auction", "announce", "publish", auction.Announcement, history=HISTORY),
    Channel("auction", "result", "publish", auction.Result, history=HISTORY),
    Channel("auction", "operation", "publish", operator.Operation, history=HISTORY),
    Channel("auction", "lease", "query", auction.LeaseRequest, auction.Lease, receiver="arm", lease_s=auction.LEASE_S),
    Channel("auction", "report", "query", auction.Report, auction.Receipt, receiver="arm"),
    Channel("jobs", "submit", "query", auction.Submission, auction.SubmissionReply),
    Channel("jobs", "status", "query", auction.StatusRequest, auction.Status),
    Channel("jobs", "clear", "query", operator.ClearRequest, operator.Cleared, receiver="operator"),
    Channel("jobs", "control", "query", operator.ControlRequest, operator.Controlled, receiver="operator"),
    Channel("jobs", "cell", "query", cell.CellRequest, cell.Cell),
    Channel("clock", "now", "query", auction.ClockRequest, auction.Clock),
    Channel("policy", "act", "query", policy.ActRequest, policy.ActReply, receiver="auctioneer, or simulated shift"),
)
CHANNEL: Mapping[tuple[str, str], Channel] = {(channel.role, channel.topic): channel for channel in CHANNELS}
"""By role and topic."""
PUBLISHED: Mapping[Channel, MessageType] = {
    channel: channel.message for channel in CHANNELS if channel.pattern == "publish" and channel.message is not None
}
"""Those that can be subscribed to, with their messages."""
MESSAGES: tuple[MessageType, ...] = tuple(dict.fromkeys(kind for channel in CHANNELS for kind in channel.messages))
"""Every message that travels by itself, in the order of the keys."""


def channel_of(expression: str) -> Channel:
    """The channel that a key, or a key expression with wildcards for names, belongs to.

    Raises:
        ValueError: it belongs to none.
    """
    parts = expression.split("/")
    role = parts[3] if len(parts) > 4 else ""
    place = 4 if role in keys.NAMELESS else 5
    channel = CHANNEL.get((role, parts[place] if len(parts) > place else ""))
    if channel is None:
        raise ValueError(f"'{expression}' is no key of this bus. Keys: {', '.join(c.address for c in CHANNELS)}.")
    return channel


def channel_for(expression: str, pattern: Pattern, message: MessageType | None = None) -> Channel:
    """The channel of a key or key expression, if it is used as the table says.

    Raises:
        ValueError: it has another pattern or message.
    """
    channel = channel_of(expression)
    if channel.pattern != pattern or channel.message is not message:
        expected = "nothing" if channel.message is None else channel.message.__name__
        raise ValueError(f"'{expression}' is for {expected} ({channel.pattern}), not for {message} ({pattern}).")
    return channel
