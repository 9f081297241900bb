"""Messages of a process outside the fleet, over plain TCP: malformed ones, old awards, and odd numbers in every field.

Nobody may end, be silent, or grow.
"""

import json
import math
import random
import time
from collections.abc import Iterator
from copy import deepcopy

import msgspec

from benchmarks.chaos.fleet_under_test import Fleet, records_of
from docs.bus_contract import EXAMPLES
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Award,
    ClockRequest,
    JobSpec,
    LeaseEntry,
    LeaseRequest,
    QuoteRequest,
    Report,
    StatusRequest,
    Submission,
)
from fleet.bus.protocol.consensus import Bid, Claim
from fleet.bus.protocol.messages import MalformedMessage, State, decode, encode, encoding
from fleet.bus.protocol.operator import ClearRequest
from fleet.live.arm.awards import AwardAccepted

MALFORMED = 100_000


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
    for number in range(MALFORMED):
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
    arm = fleet.arms[0]
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
    records = records_of(fleet.folder / "journals" / f"{arm}.journal")
    return [record.award for record in records if isinstance(record, AwardAccepted)]


def _every_key(fleet: str, arms: tuple[str, ...]) -> list[keys.ParsedKey]:
    owners: list[tuple[keys.Role, str]] = [("arm", arm) for arm in (*arms, "nobody")]
    owners.append(("auction", "auctioneer"))
    named = [
        keys.ParsedKey(fleet, role, name, topic, arms[0] if topic in keys.ASKED else "")
        for role, name in owners
        for topic in keys.TOPICS[role]
    ]
    rest = [keys.ParsedKey(fleet, role, "", topic) for role in keys.NAMELESS for topic in keys.TOPICS[role]]
    return [*named, *rest]


MESSAGES, EACH_S = 4000, 0.01
"""Messages with odd numbers, and real seconds between two."""
SILENT_S, GROWN_MB = 1.0, 50.0
ODD = (
    *(0, -1, 1, 2, 5e-324, 0.02, 179.0, 1800.0, 3600.0, 60_000, 200_000, 1e12, 1e200, 1e308, -1e308, 2**53, 2**64),
    *(10**400, math.nan, math.inf, True, None, "", "\u202e", "a\0b", "x" * 5000, [], {}, [1e308] * 7),
)
PAGE_MB = 4096 / 1e6
HOLD = JobSpec("poison", "hold", ("clamp",), payload_kg=1.0)
CARRY = JobSpec("poison", "pick_place", ("rack_left", "tray_left"), payload_kg=0.5)


def poison(fleet: Fleet) -> float:
    """Ask for quotes of long and odd jobs, then send odd numbers in every field; note silence and memory."""
    for job in (HOLD, CARRY):
        _ask(fleet, *(msgspec.structs.replace(job, dwell_s=179.0, payload_kg=load) for load in (0.31, 0.32)))
    _listen(fleet, 8.0, {})  # the planner and the twin are loaded
    before, silent_s = _memory_mb(fleet), dict.fromkeys(fleet.arms, 0.0)
    for long in (1800.0, 3600.0):
        _ask(fleet, msgspec.structs.replace(HOLD, dwell_s=long), msgspec.structs.replace(CARRY, dwell_s=long / 20))
    rng, bodies = random.Random(0), _odd_bodies(fleet, random.Random(1))
    for _ in range(MESSAGES):
        key, kind, body = next(bodies)
        if kind in (State, Bid):
            fleet.session.put(key, body, encoding=encoding(kind))
        else:
            fleet.session.get(key, lambda _reply: None, payload=body, encoding=encoding(kind), timeout=1.0)
        _listen(fleet, EACH_S * rng.random() * 2, silent_s)
    _listen(fleet, 10.0, silent_s)
    after = _memory_mb(fleet)
    grown = {name: after[name] - before[name] for name in before if name in after}
    fleet.note(f"silent at most {max(silent_s.values()):.2f} s, grown at most {max(grown.values()):.0f} MB")
    fleet.violations += [f"{arm} was silent for {s:.1f} s" for arm, s in silent_s.items() if s > SILENT_S]
    fleet.violations += [f"{name} grew by {mb:.0f} MB" for name, mb in grown.items() if mb > GROWN_MB]
    fleet.violations += [f"{name} ended" for name in before if name not in after]
    return math.nan


def _ask(fleet: Fleet, *jobs: JobSpec) -> None:
    """Request a dry run of every arm, as `thermofleet job submit --quote` does."""
    named = tuple(msgspec.structs.replace(job, name=f"poison {i}") for i, job in enumerate(jobs))
    body = encode(QuoteRequest("dry run", named, dry_run=True))
    key = keys.of_every_arm(fleet.client.fleet, "quote")
    fleet.session.get(key, lambda _reply: None, payload=body, encoding=encoding(QuoteRequest), timeout=2.0)


def _listen(fleet: Fleet, for_s: float, silent_s: dict[str, float]) -> None:
    """Receive states for a time, and note how long each arm is silent."""
    until_s = time.monotonic() + for_s
    while True:
        fleet.step(max(0.0, min(until_s - time.monotonic(), 0.05)))
        now_s = time.monotonic()
        for arm in silent_s:
            silent_s[arm] = max(silent_s[arm], now_s - fleet.states[arm][0])
        if now_s >= until_s:
            return


def _memory_mb(fleet: Fleet) -> dict[str, float]:
    """Resident memory of every participant."""
    sizes: dict[str, float] = {}
    for name in fleet.supervisor.restarts():
        if pid := fleet.supervisor.pid(name):
            with open(f"/proc/{pid}/statm", encoding="ascii") as file:
                sizes[name] = int(file.read().split()[1]) * PAGE_MB
    return sizes


def _odd_bodies(fleet: Fleet, rng: random.Random) -> Iterator[tuple[str, type[msgspec.Struct], bytes]]:
    """Key, type and body of messages without end, each with one to three odd values."""
    name, nobody = fleet.client.fleet, "nobody"
    quote, award = keys.of_every_arm(name, "quote"), keys.of_arm(name, fleet.arms[0], "award")
    awarded = Award("w", "r", "auctioneer", "q", HOLD)
    entry = LeaseEntry("w", "j", 1, "working")
    messages: list[tuple[str, msgspec.Struct]] = [
        *((quote, QuoteRequest("r", (job,), dry_run=True, cycles={"poison": 1})) for job in (HOLD, CARRY)),
        *((quote, QuoteRequest("r", (job,), cycles={"poison": 1})) for job in (HOLD, CARRY)),
        (award, awarded),
        (keys.of_jobs(name, "submit"), Submission((HOLD,))),
        (keys.of_jobs(name, "status"), StatusRequest(("poison",))),
        (keys.of_jobs(name, "clear"), ClearRequest(nobody)),
        (keys.of_clock(name), ClockRequest()),
        (keys.asked_by(name, "auctioneer", "lease", nobody), LeaseRequest(nobody, (entry,))),
        (keys.asked_by(name, "auctioneer", "report", nobody), Report(nobody, "w", "j", "returned", 1, 0.0)),
        (keys.of_arm(name, nobody, "state"), msgspec.structs.replace(EXAMPLES[State], arm=nobody)),
        (keys.of_arm(name, nobody, "bid"), msgspec.structs.replace(EXAMPLES[Bid], arm=nobody)),
        (keys.asked_by(name, fleet.arms[0], "claim", nobody), msgspec.structs.replace(EXAMPLES[Claim], arm=nobody)),
    ]
    while True:
        key, message = rng.choice(messages)
        body = odd(message, rng)
        kind = type(message)
        if kind in (Submission, ClearRequest) and _is_valid(kind, body):
            continue  # would change the work of the campaign
        yield key, kind, body


def odd(message: msgspec.Struct, rng: random.Random) -> bytes:
    """The message as JSON with one to three odd values."""
    content = json.loads(encode(message))
    for _ in range(rng.randint(1, 3)):
        inner = content
        while inner:
            place = rng.choice(list(inner) if isinstance(inner, dict) else range(len(inner)))
            if isinstance(inner[place], dict | list) and inner[place] and rng.random() < 0.8:
                inner = inner[place]
                continue
            inner[place] = deepcopy(rng.choice(ODD))
            break
    return json.dumps(content).encode()


def _is_valid(kind: type[msgspec.Struct], body: bytes) -> bool:
    try:
        decode(kind, body)
    except MalformedMessage:
        return False
    return True
