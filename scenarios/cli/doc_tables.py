"""Tables for docs/bus.md and docs/env.md, from the same source as the schemas and the environment."""

import json
import re
from collections.abc import Sequence
from dataclasses import fields
from math import prod

from fleet.bus.client.rate_limits import Limits
from fleet.bus.protocol import messages
from fleet.bus.protocol.auction import MOST_JOBS
from fleet.bus.protocol.examples import EXAMPLES
from fleet.bus.protocol.registry import CHANNEL, CHANNELS, PATTERNS, SESSION_LEASE_S, Channel, MessageType
from fleet.bus.protocol.schemas import Schema, descriptions, schemas
from fleet.engine.reward import RewardWeights
from fleet.errors import FleetError
from fleet.live.arm.award_executor import COMMIT_RETRY_S, RENEWALS, REPORT_RETRY_S, ExecutorConfig
from fleet.live.auction.job_rules import MAX_KEPT_JOBS
from fleet.live.auction.round import Timing
from fleet.live.clock import CLOCK_DRIFT
from fleet.live.monitor.snapshot import FRESH_S
from fleet.observation import FIELDS, Layout

_PART = re.compile(r"(<!-- made by thermofleet contract: (?P<name>\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(page: str) -> str:
    """The page with every marked part made anew.

    Raises:
        FleetError: a part is asked for that is not made here.
    """
    parts = {
        "keys": key_table,
        "patterns": pattern_table,
        "transport": transport_table,
        "messages": message_tables,
        "times": time_table,
        "limits": limit_table,
        "observation": observation_table,
        "rewards": reward_table,
    }

    def part(match: re.Match[str]) -> str:
        if match["name"] not in parts:
            raise FleetError(f"The page asks for '{match['name']}'. There are: {', '.join(parts)}.")
        return f"{match[1]}\n{parts[match['name']]()}\n\n{match[3]}"

    return _PART.sub(part, page)


def key_table() -> str:
    """Every key: who sends what there to whom, and how."""
    rows = [
        (f"`{_short(channel)}`", channel.sender, channel.receiver, channel.pattern, _links(channel))
        for channel in CHANNELS
    ]
    return table(("key", "from", "to", "pattern", "message"), rows)


def transport_table() -> str:
    """Every key: history, heartbeat, rates, lease, priority and congestion control."""

    def number(value: float | None) -> str:
        return "" if value is None else f"{value:g}"

    rows = [
        (
            f"`{_short(channel)}`",
            str(channel.history or ""),
            number(channel.heartbeat_s if channel.history else None),
            number(channel.rate_hz),
            number(channel.limit_hz),
            number(channel.lease_s),
            "" if channel.pattern == "token" else f"{channel.priority}, {channel.congestion}",
        )
        for channel in CHANNELS
    ]
    return table(("key", "history", "heartbeat s", "rate Hz", "limit Hz", "lease s", "priority, congestion"), rows)


def pattern_table() -> str:
    """What the patterns mean."""
    return table(("pattern", "meaning"), list(PATTERNS.items()))


def message_tables() -> str:
    """Every message field by field, with its encoding and an example; nested structs after the messages."""
    parts = schemas()
    kinds = {kind.__name__: kind for kind in EXAMPLES}
    order = [*kinds, *(name for name in parts if name not in kinds)]
    return "\n\n".join(_message(name, parts[name], kinds.get(name)) for name in order if name in parts)


def observation_table() -> str:
    """What an arm knows, field by field."""
    return table(("field", "of 4 arms, 8 slots", "shape", "unit", "range", "meaning"), field_rows())


def reward_table() -> str:
    """What the reward is made of."""
    return table(("info", "weight", "what for"), reward_rows())


def _message(name: str, part: Schema, message: MessageType | None) -> str:
    parts = [f"### {name}", str(part.get("description", ""))]
    if message is not None:
        where = "".join(f"Key `{_short(channel)}`. " for channel in CHANNELS if message in _own(channel))
        parts.append(f"{where}Encoding `{messages.encoding(message)}`.")
    if part.get("properties"):
        required = part.get("required", ())
        rows = [
            (
                f"`{field}`",
                _type(kind),
                "required" if field in required else _default(kind),
                kind.get("description", ""),
            )
            for field, kind in part["properties"].items()
        ]
        parts.append(table(("field", "type", "if left out", "meaning"), rows))
    else:
        parts.append("No fields: the payload is `{}`.")
    if message is not None:
        parts.append(f"```json\n{messages.encode(EXAMPLES[message]).decode()}\n```")
    return "\n\n".join(parts)


def _short(channel: Channel) -> str:
    """The key without its first chunks, which are the same everywhere."""
    return f"…/{channel.address.split('/{fleet}/')[1]}"


def _own(channel: Channel) -> list[MessageType]:
    """The messages of a key, without the refusal that may come instead of any reply."""
    return [kind for kind in (channel.message, channel.reply) if kind is not None]


def _links(channel: Channel) -> str:
    return " → ".join(f"[{kind.__name__}](#{kind.__name__.lower()})" for kind in _own(channel)) or "no payload"


def _type(kind: Schema) -> str:
    """The type in a schema as text, for example `list (1..2) of string, not empty`."""
    if "$ref" in kind:
        name = str(kind["$ref"]).rsplit("/", 1)[1]
        return f"[{name}](#{name.lower()})"
    if "allOf" in kind:
        return _type(kind["allOf"][0])
    if "anyOf" in kind:
        return " or ".join(_type(choice) for choice in kind["anyOf"])
    if "enum" in kind:
        return " \\| ".join(f"`{json.dumps(value)}`" for value in kind["enum"])
    if kind["type"] == "array":
        return f"list{_span(kind, 'minItems', 'maxItems')} of {_type(kind['items'])}"
    if kind["type"] == "string":
        return f"string{_span(kind, 'minLength', 'maxLength')}"
    limits = [
        f"{sign} {kind[name]:g}"
        for name, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"))
        if name in kind
    ]
    return f"{kind['type']}{' ' if limits else ''}{', '.join(limits)}"


def _span(kind: Schema, low: str, high: str) -> str:
    if high in kind:
        return f" ({kind.get(low, 0)}..{kind[high]})"
    return ", not empty" if low in kind else ""


def _default(kind: Schema) -> str:
    return f"`{json.dumps(kind['default'])}`" if "default" in kind else ""


def table(head: tuple[str, ...], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def time_table() -> str:
    """Durations in real seconds."""
    timing, terms = Timing(), ExecutorConfig()
    again_s, most_s = REPORT_RETRY_S
    short_s, attempts = timing.lease_s * (1 - CLOCK_DRIFT), timing.attempts
    state = CHANNEL["arm", "state"]
    rows = [
        (f"{SESSION_LEASE_S:g}", "all", "without a sign of life Zenoh closes a session and withdraws its token"),
        (f"{FRESH_S:g}", "all", "an arm whose state is older is not present, whatever its token says"),
        (f"{1.0 / (state.rate_hz or 1.0):g}", "arm", "between two `state` messages"),
        (f"{state.heartbeat_s:g}", "all", "after a publication its number is repeated, so that a loss is noticed"),
        (f"{timing.window_s:g}", "auctioneer", "a round closes, unless every present arm has replied before"),
        (f"{terms.valid_s:g}", "arm", "`valid_s`: it accepts an award on its quote"),
        (f"{timing.ack_s:g}", "auctioneer", f"without an `Ack` the same award is sent again, {attempts} times in all"),
        (f"{timing.lease_s:g}", "auctioneer", "`lease_s`: length of a lease"),
        (f"{short_s:.2f}", "arm", f"how it counts that lease: {CLOCK_DRIFT:.0%} shorter, as clocks differ in rate"),
        (
            f"{timing.counted_lease_s:.2f}",
            "auctioneer",
            f"how it counts it: {CLOCK_DRIFT:.0%} and {timing.margin_s:g} s longer",
        ),
        (f"{timing.lease_s / RENEWALS:g}", "arm", "between two requests to renew the lease"),
        (f"{terms.commit_lead_s:g}", "arm", "before its last cycle could begin it requests permission to commit"),
        (f"{COMMIT_RETRY_S:g}", "arm", "until it requests that permission again"),
        (f"{again_s:g} to {most_s:g}", "arm", "between two reports of one outcome, longer each time"),
        (f"{terms.return_after_s:g}", "arm", "after the end of a lease it returns the job by itself"),
    ]
    return table(("real s", "of", "what"), rows)


def limit_table() -> str:
    """How large, how many, how often."""
    state = CHANNEL["arm", "state"]
    longest = schemas()["JobSpec"]["properties"]["name"]["maxLength"]
    rows = [
        (f"{Limits().message_bytes:,} bytes", "any message with its attachment; the router silently drops larger ones"),
        (
            f"{state.limit_hz:g} a second",
            "`state` messages of one session; the router drops more (`--state-hz`)",
        ),
        (f"{MOST_JOBS}", "jobs in one message; of more, a `Status` holds those that may still change first"),
        (f"{MAX_KEPT_JOBS:,}", "jobs that one auctioneer keeps, finished ones included"),
        (f"{longest}", "characters of a job's name"),
    ]
    return table(("limit", "of"), rows)


_SHAPES = {(): "1", ("joint",): "7", ("slot",): "K", ("peer",): "n − 1", ("peer", "slot"): "(n − 1) × K"}
_EXAMPLE = Layout(arms=4, slots=8)


def field_rows() -> list[tuple[str, ...]]:
    """Every field in its order: name, its places in the vector of four arms and eight slots, shape, unit, range,
    meaning."""
    rows: list[tuple[str, ...]] = []
    for field, start in zip(FIELDS, _EXAMPLE.offsets, strict=True):
        last = start + prod(_EXAMPLE.shape(field)) - 1
        rows.append(
            (
                f"`{field.name}`",
                str(start) if last == start else f"{start}–{last}",
                _SHAPES[field.axes],
                field.unit,
                f"{_number(field.low)} … {_number(field.high)}",
                field.text,
            )
        )
    return rows


def reward_rows() -> list[tuple[str, ...]]:
    """Every term: its name in the infos, its weight where the scenario names none, and what it is for."""
    told = descriptions(RewardWeights)
    return [
        (f"`reward_{f.name}`", _number(getattr(RewardWeights, f.name)), told[f.name]) for f in fields(RewardWeights)
    ]


def _number(value: float) -> str:
    return f"{value:.15g}".replace("-", "−")
