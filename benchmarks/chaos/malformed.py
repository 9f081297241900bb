"""Messages of a process outside the fleet, over plain TCP: malformed ones on every key, and old awards."""

import json
import math
import random

import msgspec

from benchmarks.chaos.fleet_under_test import Fleet
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Award, LeaseRequest, QuoteRequest, Report, Submission
from fleet.bus.protocol.consensus import Bid, Claim
from fleet.bus.protocol.messages import State, encode, encoding

MESSAGES = 100_000


def malformed(fleet: Fleet) -> float:
    """Send 100 000 malformed, oversized and extreme messages on all keys."""
    rng = random.Random(0)
    fleet_name, session = fleet.client.fleet, fleet.session
    all_keys = [str(key) for key in _every_key(fleet_name, fleet.arms)]
    kinds = [encoding(kind) for kind in (State, Award, Bid, Claim, QuoteRequest, LeaseRequest, Report, Submission)]
    bodies = [
        b"",
        b"{",
        b"null",
        b"[]",
        b"\xff\xfe\x00",
        b'{"arm":"arm_0"}',
        b'{"arm":1e999}',
        b"{" * 2000,
        b'{"arm":"arm_0","tick":-1}',
        b'"' + b"x" * 9000 + b'"',
        b"[" * 30000,
        b"x" * 70_000,
        json.dumps(
            {
                "arm": "arm_0",
                "tick": 10**18,
                "time_s": 1e300,
                "mode": "idle",
                "temp_c": [1e308] * 7,
                "headroom_k": -1e308,
            }
        ).encode(),
    ]
    for number in range(MESSAGES):
        key, body, kind = rng.choice(all_keys), rng.choice(bodies), rng.choice(kinds)
        if number % 50 == 0:
            session.get(key, lambda _reply: None, payload=body, encoding=kind, timeout=1.0)
        else:
            session.put(key, body, encoding=kind)
        if number % 500 == 0:
            fleet.step()
    return math.nan


def replayed_awards(fleet: Fleet) -> float:
    """Send the awards of an arm again, 50 times."""
    arm = fleet.target or fleet.arms[0]
    for award in awards_of(fleet, arm) * 50:
        fleet.session.get(
            keys.of_arm(fleet.client.fleet, arm, "award"),
            lambda _reply: None,
            payload=encode(award),
            encoding=encoding(Award),
            timeout=2.0,
        )
        fleet.step()
    return math.nan


def awards_of(fleet: Fleet, arm: str) -> list[Award]:
    """Return the awards of an arm, by its journal."""
    path = fleet.folder / "journals" / f"{arm}.journal"
    lines = [json.loads(line)["records"] for line in path.read_bytes().splitlines() if line.endswith(b"}")]
    return [
        msgspec.convert(record["award"], Award)
        for records in lines
        for record in records
        if record["type"] == "award_accepted"
    ]


def _every_key(fleet: str, arms: tuple[str, ...]) -> list[keys.Key]:
    owners: list[tuple[keys.Role, str]] = [("arm", arm) for arm in (*arms, "nobody")]
    owners.append(("auction", "auctioneer"))
    named = [
        keys.Key(fleet, role, name, topic, arms[0] if topic in keys.ASKED else "")
        for role, name in owners
        for topic in keys.TOPICS[role]
    ]
    rest = [keys.Key(fleet, role, "", topic) for role in keys.NAMELESS for topic in keys.TOPICS[role]]
    return [*named, *rest]
