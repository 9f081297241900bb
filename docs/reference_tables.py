"""Reference tables of the pages, from the code: messages and keys of the bus, the environment, policies, commands."""

import json
import re
from collections.abc import Callable, Mapping
from math import prod
from typing import Any

from agents.registry import RULES, WRAPPERS
from docs.bus_contract import EXAMPLES, Schema, descriptions, schemas
from fleet.bus.protocol import messages
from fleet.bus.protocol.auction import MOST_JOBS, ArmEvent
from fleet.bus.protocol.keys import CHANNEL, CHANNELS, PATTERNS, SESSION_LEASE_S, BusChannel, MessageType
from fleet.bus.protocol.policy import MOST_REQUEST_BYTES
from fleet.engine.batch import RewardWeights
from fleet.events import MEANINGS
from fleet.job import BOUNDS, LONGEST_GRASP_S, LONGEST_JOB_S
from fleet.live.arm.awards import COMMIT_RETRY_S, RENEWALS, REPORT_RETRY_S, ExecutorConfig
from fleet.live.arm.node import IDLE_PERIOD_S
from fleet.live.clock import CLOCK_DRIFT
from fleet.live.job_rules import MAX_OPEN_JOBS
from fleet.live.leases import Timing
from fleet.live.monitor.snapshot import FRESH_S
from fleet.observation import FIELDS, Layout
from scenarios.cli.main import COMMANDS, load_command
from scenarios.live.metrics import METRICS
from scenarios.spec.schema import RewardSpec
from scenarios.table import markdown_table as table


def _key_table() -> str:
    rows = [
        (f"`{_short(channel)}`", channel.sender, channel.receiver, channel.pattern, _links(channel))
        for channel in CHANNELS
    ]
    return table(("key", "declared by", "used by", "pattern", "message"), rows)


def _transport_table() -> str:
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


def _message_tables() -> str:
    """Each message by field, with its encoding and an example; nested structs after the messages."""
    parts = schemas()
    kinds = {kind.__name__: kind for kind in EXAMPLES}
    order = [*kinds, *(name for name in parts if name not in kinds)]
    return "\n\n".join(_message(name, parts[name], kinds.get(name)) for name in order if name in parts)


def _message(name: str, part: Schema, message: MessageType | None) -> str:
    parts = [f"### {name}", str(part.get("description", ""))]
    if message is not None:
        where = "".join(f"Key `{_short(channel)}`. " for channel in CHANNELS if message in _own(channel))
        parts.append(f"{where}Encoding `{messages.encoding(message)}`.")
    if part.get("properties"):
        required = part.get("required", ())
        rows: list[tuple[str, ...]] = []
        for field, kind in part["properties"].items():
            default = f"`{json.dumps(kind['default'])}`" if "default" in kind else ""
            if_absent = "required" if field in required else default
            unit = (BOUNDS[field].unit if field in BOUNDS else "",) if name == "JobSpec" else ()
            rows.append((f"`{field}`", _type(kind), *unit, if_absent, kind.get("description", "")))
        unit = ("unit",) if name == "JobSpec" else ()
        parts.append(table(("field", "type and bounds" if unit else "type", *unit, "default", "meaning"), rows))
    else:
        parts.append("No fields: the payload is `{}`.")
    if message is ArmEvent:
        parts += ["Kinds; those that no live arm reports come from simulated shifts (`run --listen`):", _event_table()]
    if message is not None:
        parts.append(f"```json\n{messages.encode(EXAMPLES[message]).decode()}\n```")
    return "\n\n".join(parts)


def _event_table() -> str:
    rows = [(f"`{kind}`", each.text, each.value, "yes" if each.live else "") for kind, each in MEANINGS.items()]
    return table(("kind", "meaning", "`value`", "live arm"), rows)


def _short(channel: BusChannel) -> str:
    """The key without the prefix that all keys share."""
    return f"…/{channel.address.split('/{fleet}/')[1]}"


def _own(channel: BusChannel) -> list[MessageType]:
    """The messages of a key, without the refusal, which can replace any reply."""
    return [kind for kind in (channel.message, channel.reply) if kind is not None]


def _links(channel: BusChannel) -> str:
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
        if name in kind and kind[name] not in _COMMON
    ]
    return f"{kind['type']}{' ' if limits else ''}{', '.join(limits)}"


_COMMON = (messages.LEAST, messages.MOST, messages.MOST_COUNT)
"""Bounds of numbers that are only in the table of limits."""


def _span(kind: Schema, low: str, high: str) -> str:
    if high in kind:
        return f" ({kind.get(low, 0)}..{kind[high]})"
    return ", not empty" if low in kind else ""


def _metric_table() -> str:
    rows = [(f"`thermofleet_{name}`", kind, text) for name, (kind, text) in METRICS.items()]
    return table(("metric", "type", "meaning"), rows)


def _time_table() -> str:
    timing, terms = Timing(), ExecutorConfig()
    again_s, most_s = REPORT_RETRY_S
    short_s, margin_s, attempts = timing.lease_s * (1 - CLOCK_DRIFT), timing.margin_s, timing.attempts
    state = CHANNEL["arm", "state"]
    rows = [
        (
            f"{SESSION_LEASE_S:g}",
            "all",
            "session lease: without messages for this long, Zenoh closes the session and withdraws its token",
        ),
        (f"{FRESH_S:g}", "all", "an arm whose last state is older is absent, even with a token"),
        (f"{1.0 / (state.rate_hz or 1.0):g}", "arm", "between two `state` messages, unless the arm is idle"),
        (f"{IDLE_PERIOD_S:g}", "arm", "between two `state` messages of an idle arm"),
        (f"{state.heartbeat_s:g}", "all", "heartbeat: the last sequence number is repeated within this time"),
        (
            f"{timing.window_s:g}",
            "auctioneer",
            "quote timeout; a round closes earlier if all present arms have replied",
        ),
        (f"{terms.valid_s:g}", "arm", "`valid_s`: how long it accepts an award on its quote"),
        (f"{timing.ack_s:g}", "auctioneer", f"retry period of an award without an `Ack`, {attempts} attempts in all"),
        (f"{timing.lease_s:g}", "auctioneer", "`lease_s`: length of a lease"),
        (
            f"{short_s:.2f}",
            "arm",
            f"the same lease as measured by the arm: {CLOCK_DRIFT:.0%} shorter, to allow for clock drift",
        ),
        (
            f"{timing.counted_lease_s:.2f}",
            "auctioneer",
            f"the same lease as measured by the auctioneer: {CLOCK_DRIFT:.0%} and {margin_s:g} s longer",
        ),
        (f"{timing.lease_s / RENEWALS:g}", "arm", "between two requests to renew the lease"),
        (f"{terms.commit_lead_s:g}", "arm", "lead time of its request for permission to commit, before the last cycle"),
        (f"{COMMIT_RETRY_S:g}", "arm", "retry period of that request"),
        (f"{again_s:g} to {most_s:g}", "arm", "retry period of a report, with back-off"),
        (f"{terms.return_after_s:g}", "arm", "time from the end of a lease until it returns the job"),
    ]
    return table(("real s", "participant", "meaning"), rows)


def _limit_table() -> str:
    state = CHANNEL["arm", "state"]
    longest = schemas()["JobSpec"]["properties"]["name"]["maxLength"]
    rows = [
        (
            f"{messages.MOST_BYTES:,} bytes",
            "any other message with its attachment; the router drops larger ones silently",
        ),
        (f"{MOST_REQUEST_BYTES:,} bytes", "a request to `policy/{policy}/act`"),
        (f"{state.limit_hz:g} a second", "`state` messages of one session; the router drops more (`--state-hz`)"),
        (f"{MOST_JOBS}", "jobs in one message; more come in several pages of a `Status`"),
        (f"{MAX_OPEN_JOBS:,}", "open jobs of one auctioneer"),
        (f"{longest}", "characters of a job's name"),
        (f"{LONGEST_GRASP_S:g} s", "`dwell_s` of a pick_place or sort"),
        (f"{LONGEST_JOB_S:g} s", "`repetitions` times `dwell_s`, and the whole duration of a job"),
        (f"{messages.MOST:g}", f"any other number, positive or negative; {messages.MOST_COUNT:g} if it is whole"),
    ]
    return table(("limit", "applies to"), rows)


_SHAPES = {
    (): "1",
    ("joint",): "7",
    ("slot",): "K",
    ("option",): "K P",
    ("member",): "n",
    ("member", "slot"): "n K",
    ("member", "option"): "n K P",
}
_EXAMPLE = Layout(arms=4, slots=16, plans=2)


def _observation_table() -> str:
    rows: list[tuple[str, ...]] = []
    start = 0
    for field in FIELDS:
        last = start + prod(_EXAMPLE.shape(field)) - 1
        place = "with bids" if last < start else str(start) if last == start else f"{start}–{last}"
        span = f"{_number(field.low)} … {_number(field.high)}"
        row = (field.part, place, _SHAPES[field.axes], field.unit, span, _number(field.scale), field.text)
        rows.append((f"`{field.name}`", *row))
        start = last + 1
    return table(("field", "part", "columns", "shape", "unit", "range", "scale", "meaning"), rows)


def _reward_table() -> str:
    text = descriptions(RewardWeights)
    rows: list[tuple[str, ...]] = []
    for name, weight in vars(RewardSpec()).items():
        shown = "−price of a fault" if weight is None else _number(weight)
        rows.append((f"`reward_{name}`", shown, text[name]))
    return table(("info", "weight", "what for"), rows)


def _number(value: float) -> str:
    return f"{value:.15g}".replace("-", "−")


def _policies() -> str:
    rows = [(f"`{name}`", rule.scope, rule.cost, rule.source) for name, rule in RULES.items()]
    return table(("policy", "scope", "allocates by", "source"), rows)


def _wrappers() -> str:
    rows = [(f"`{name}:POLICY`", wrapper.effect, wrapper.source) for name, wrapper in WRAPPERS.items()]
    return table(("wrapper", "effect", "source"), rows)


def _command_tables() -> str:
    """Each command by group, with its text, arguments and options."""
    panels = dict.fromkeys(entry.panel for entry in COMMANDS.values())
    groups = {panel: [name for name, entry in COMMANDS.items() if entry.panel == panel] for panel in panels}
    return "\n\n".join(
        f"## {panel}\n\n" + "\n\n".join(_command(f"thermofleet {name}", load_command(name)) for name in names)
        for panel, names in groups.items()
    )


def _command(name: str, command: Any) -> str:
    """Any: typer keeps the class of commands private."""
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join((name, *command.collect_usage_pieces(context)))
    parts = [f"### {name}", _plain(command.help or ""), f"```\n{usage}\n```"]
    shown = [option.get_help_record(context) for option in command.get_params(context)]
    rows = [
        (f"`{names}`".replace("|", "\\|"), _plain(text)) for names, text in filter(None, shown) if names != "--help"
    ]
    if rows:
        parts.append(table(("argument or option", "meaning"), rows))
    parts += [_command(f"{name} {part}", command.commands[part]) for part in getattr(command, "commands", ())]
    return "\n\n".join(parts)


def _plain(text: str) -> str:
    """Text of the command line as Markdown, with no sign that ends a cell or begins markup."""
    spaced = re.sub(r" {2,}", " ", text)
    return re.sub(r"(`[^`]*`)|([|*<])", lambda match: match[1] or f"\\{match[2]}", spaced)


TABLES: Mapping[str, Callable[[], str]] = {
    "keys": _key_table,
    "patterns": lambda: table(("pattern", "meaning"), PATTERNS.items()),
    "transport": _transport_table,
    "messages": _message_tables,
    "metrics": _metric_table,
    "times": _time_table,
    "limits": _limit_table,
    "observation": _observation_table,
    "rewards": _reward_table,
    "policies": _policies,
    "wrappers": _wrappers,
    "commands": _command_tables,
}
"""Text of each table by the name in its mark."""
