"""Attempts to get past the access rules of a fleet with TLS, which must all fail.

The rogue is an arm with a valid certificate. Whether an attempt succeeded is observed at the receiver: by a subscriber,
by the replies to a query, or by the queries that reach a forged queryable. As a control, the rogue does the same where
it is permitted, and this must succeed.
"""

import json
import math
import queue
import tempfile
import time
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import zenoh

from benchmarks.chaos.fleet_under_test import Fleet
from benchmarks.chaos.messages import awards_of
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Award,
    Clock,
    ClockRequest,
    JobSpec,
    JobStatus,
    LeaseEntry,
    LeaseRequest,
    QuoteRequest,
    Report,
    StatusRequest,
    Submission,
)
from fleet.bus.protocol.messages import Refusal, State, encode, encoding
from fleet.bus.router import open_client
from fleet.bus.security.access_control import RosterEntry, of_arms
from fleet.bus.security.certificates import issue, make
from fleet.bus.security.tls import Tls

ROGUE = "rogue"
TIMEOUT_S = 10.0
Attempt = tuple[str, bool]
"""Description, and whether the attempt succeeded."""


def trespass(fleet: Fleet) -> float:
    """Make all attempts once, while the fleet works."""
    assert fleet.keys is not None
    with open_client(fleet.endpoint, timeout_s=TIMEOUT_S, tls=Tls(fleet.keys, ROGUE)) as rogue:
        attempts = [
            *queries(fleet, rogue),  # first, while arms have jobs
            *publications(fleet, rogue),
            *tokens(fleet, rogue),
            *replies(fleet, rogue),
            *connections(fleet.endpoint, fleet.keys, fleet.arms),
        ]
    fleet.violations += [what for what, through in attempts if through]
    fleet.note(f"{len(attempts)} attempts, {len(fleet.violations)} successful")
    return math.nan


def connections(endpoint: str, place: Path, arms: tuple[str, ...]) -> Iterator[Attempt]:
    """Connect without a valid certificate, and without the checks of our own client."""
    with tempfile.TemporaryDirectory() as folder:
        wrong, expired = Path(folder) / "wrong", Path(folder) / "expired"
        for here in (wrong, expired):
            make(here, of_arms("f", arms), days=30)
            (here / "ca.pem").write_bytes((place / "ca.pem").read_bytes())
        (expired / "ca.key").write_bytes((place / "ca.key").read_bytes())
        issue(expired, RosterEntry(arms[0], "arm"), days=1, now=datetime.now(UTC) - timedelta(days=2))
        nothing = {"root_ca_certificate": str(place / "ca.pem")}
        yield "no certificate", _opens(endpoint, nothing)
        yield "plain TCP", _opens(endpoint.replace("tls/", "tcp/"), {})
        yield "the certificate of another authority", _opens(endpoint, Tls(wrong, arms[0]).link(serves=False))
        yield "an expired certificate", _opens(endpoint, Tls(expired, arms[0]).link(serves=False))
    if not _opens(endpoint, Tls(place, ROGUE).link(serves=False)):
        raise RuntimeError("Control failed: a valid certificate opens no connection.")


def publications(fleet: Fleet, rogue: zenoh.Session) -> Iterator[Attempt]:
    """Publish and delete under the keys of others and under wildcards."""
    fleet_name, arm = fleet.client.fleet, fleet.arms[0]
    forged = State(arm, 10**9, 0.0, "idle", (0.0,) * 7, 60.0)
    received: queue.Queue[tuple[str, bool]] = queue.Queue()

    def receive(sample: zenoh.Sample) -> None:
        received.put((str(sample.key_expr), sample.payload.to_bytes() == encode(forged)))

    subscriber = fleet.session.declare_subscriber(
        keys.all_of_fleet(fleet_name), zenoh.handlers.Callback(receive, indirect=False)
    )
    targets = [
        keys.of_arm(fleet_name, arm, "state"),
        keys.of_arm(fleet_name, arm, "difficulty"),
        keys.of_arm(fleet_name, arm, "event"),
        keys.of_auction(fleet_name, "auctioneer", "result"),
        keys.of_every_arm(fleet_name, "state"),
        keys.all_of_fleet(fleet_name),
        "**",
    ]
    own = keys.of_arm(fleet_name, ROGUE, "event")
    for _ in range(1000):  # until the subscription has reached the router by its own connection
        rogue.put(own, b"?")
        if received.get(timeout=TIMEOUT_S) == (own, False):
            break
    for key in targets:
        rogue.put(key, encode(forged), encoding=encoding(State))
        rogue.delete(key)
    rogue.put(
        own, encode(forged), encoding=encoding(State)
    )  # its own key: a connection keeps the order, so this arrives last
    got, until_s = [received.get(timeout=TIMEOUT_S)], time.monotonic() + TIMEOUT_S
    while got[-1] != (own, True):
        if time.monotonic() > until_s:
            raise TimeoutError(
                f"Control failed: the rogue's message under its own key did not arrive in {TIMEOUT_S:g} s."
            )
        got.append(received.get(timeout=TIMEOUT_S))
    subscriber.undeclare()
    through = {key for key, is_forged in got if is_forged}
    yield from ((f"a message under {key}", key in through) for key in targets)


def tokens(fleet: Fleet, rogue: zenoh.Session) -> Iterator[Attempt]:
    """Declare tokens of others: a second auctioneer would stop all awards."""
    fleet_name = fleet.client.fleet
    fakes = [keys.of_arm(fleet_name, "ghost", "alive"), keys.of_auction(fleet_name, "boss", "alive")]
    own = keys.of_arm(fleet_name, ROGUE, "alive") + "/not"  # not watched by any participant
    held = [rogue.liveliness().declare_token(key) for key in (*fakes, own)]
    _settle(rogue, fleet_name)
    replies = fleet.session.liveliness().get(keys.all_of_fleet(fleet_name), timeout=TIMEOUT_S)
    there = {str(reply.ok.key_expr) for reply in replies if reply.ok}
    if own not in there:
        raise RuntimeError("Control failed: the rogue's own token is not present.")
    yield from ((f"a token under {key}", key in there) for key in fakes)
    for token in held:
        token.undeclare()


def replies(fleet: Fleet, rogue: zenoh.Session) -> Iterator[Attempt]:
    """Declare queryables under keys of others, and count the queries that reach them."""
    fleet_name, arm = fleet.client.fleet, fleet.arms[0]
    places = [
        keys.of_arm(fleet_name, arm, "quote"),
        keys.of_every_arm(fleet_name, "quote"),
        keys.of_arm(fleet_name, arm, "award"),
        keys.of_jobs(fleet_name, "submit"),
        keys.of_jobs(fleet_name, "status"),
        keys.of_clock(fleet_name),
        keys.asked_by_every_arm(fleet_name, "auctioneer", "report"),
        keys.all_of_fleet(fleet_name),
    ]
    counts: dict[str, int] = dict.fromkeys(places, 0)

    def count_queries(place: str) -> zenoh.handlers.Callback:
        def take(query: zenoh.Query) -> None:
            with query:
                counts[place] += 1

        return zenoh.handlers.Callback(take, indirect=False)

    held = [rogue.declare_queryable(place, count_queries(place), complete=True) for place in places]
    _settle(rogue, fleet_name)
    clock = fleet.client.query_and_wait(keys.of_clock(fleet_name), ClockRequest(), Clock, timeout_s=TIMEOUT_S)
    if not clock.messages or not fleet.status():
        raise RuntimeError("Control failed: the auctioneer does not reply.")
    fleet.wait_until(lambda: False, 3.0)  # rounds, leases and reports continue
    yield from ((f"a reply under {place}", count > 0) for place, count in counts.items())
    for queryable in held:
        queryable.undeclare()


def queries(fleet: Fleet, rogue: zenoh.Session) -> Iterator[Attempt]:
    """Query as another arm, query what the role may not, and repeat old awards."""
    fleet_name = fleet.client.fleet
    own = keys.asked_by(fleet_name, "auctioneer", "lease", ROGUE)
    if not _gets_reply(rogue, own, LeaseRequest(ROGUE, ())):
        raise RuntimeError("Control failed: no reply to the rogue's own lease request.")
    awarded: list[JobStatus] = []

    def working() -> bool:
        awarded[:] = [status for status in fleet.status().values() if status.state in ("awarded", "finishing")]
        return bool(awarded)

    fleet.wait_until(working, TIMEOUT_S)
    if not awarded:
        raise RuntimeError("No arm has a job; give the fleet more jobs.")
    for status in awarded:
        entry = LeaseEntry(status.award, status.job, 0, "finishing")
        lease = LeaseRequest(status.arm, (entry,))
        report = Report(status.arm, status.award, status.job, "finished", 1, 0.0)
        messages: tuple[tuple[msgspec.Struct, str], ...] = ((lease, "lease"), (report, "report"))
        for message, topic in messages:
            for querier in (status.arm, ROGUE):
                key = keys.asked_by(fleet_name, "auctioneer", topic, querier)
                yield f"a {topic} of {status.arm} under the key of {querier}", _gets_reply(rogue, key, message)
            key = keys.asked_of_all(fleet_name, topic, status.arm)
            yield f"a {topic} of {status.arm} to every auctioneer", _gets_reply(rogue, key, message)
        own = keys.asked_by(fleet_name, "auctioneer", "report", ROGUE)
        yield (
            f"a report on the award of {status.arm}",
            _gets_reply(rogue, own, msgspec.structs.replace(report, arm=ROGUE)),
        )
    awards = [(arm, award) for arm in fleet.arms for award in awards_of(fleet, arm)[:5]]
    if not awards:
        raise RuntimeError("There is no award to repeat.")
    for arm, award in awards:
        where = keys.of_arm(fleet_name, arm, "award")
        for who, session in ((ROGUE, rogue), ("the submitter", fleet.session)):
            yield f"award {award.award} repeated by {who}", _gets_reply(session, where, award)
    job = JobSpec(name="of the rogue", kind="hold", places=("clamp",))
    for key, message in (
        (keys.of_every_arm(fleet_name, "quote"), QuoteRequest("r", (job,))),
        (keys.of_jobs(fleet_name, "submit"), Submission((job,))),
        (keys.of_jobs(fleet_name, "status"), StatusRequest()),
    ):
        yield f"a query under {key}", _gets_reply(rogue, key, message)


def _gets_reply(session: zenoh.Session, key: str, message: msgspec.Struct) -> bool:
    """Whether a request gets a reply other than a refusal or a rejection."""
    replies = session.get(
        key, payload=encode(message), encoding=encoding(type(message)), target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE, timeout=TIMEOUT_S,
    )  # fmt: skip
    good = [reply.ok for reply in replies if reply.ok and str(reply.ok.encoding) != encoding(Refusal)]
    if isinstance(message, Award):
        return any(json.loads(one.payload.to_bytes()).get("accepted") for one in good)
    return bool(good)


def _opens(endpoint: str, tls: Mapping[str, object]) -> bool:
    """Whether a session opens, without the checks of our own client."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": 500, "exit_on_failure": True},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"tls": tls}},
    }
    try:
        zenoh.open(zenoh.Config.from_json5(json.dumps(config))).close()
    except zenoh.ZError:
        return False
    return True


def _settle(session: zenoh.Session, fleet_name: str) -> None:
    """Wait until the router knows what the session declared, by a query that every participant may make."""
    list(session.get(keys.caches_of(keys.of_arm(fleet_name, "nobody", "state")), timeout=TIMEOUT_S))
