"""Strangers and an arm that tries what is not its own, on a fleet with certificates: each try is refused, work goes on.

The rogue is an arm of the roster with a good certificate. Whether a try got through is seen at the other end: by a
listener who would hear it, by the answers that come, by the questions that reach what only another should answer. That
a try would be seen is shown beside it, by what the rogue may do.
"""

import json
import math
import queue
import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import zenoh
from rubbish import awards_of
from struck import Fleet

from fleet.bus.client.router import open_client
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Award,
    Clock,
    ClockRequest,
    JobSpec,
    LeaseEntry,
    LeaseRequest,
    QuoteRequest,
    Report,
    StatusRequest,
    Submission,
)
from fleet.bus.protocol.messages import Refusal, State, encode, encoding
from fleet.bus.security.access_control import Participant, of_arms
from fleet.bus.security.certificates import issue
from fleet.bus.security.keyring import make
from fleet.bus.security.tls import Tls

ROGUE = "rogue"
PATIENT_S = 10.0
Try = tuple[str, bool]
"""What was tried, and whether it got through."""


def trespass(fleet: Fleet) -> float:
    """Everything that strangers and a rogue arm may try, once each, while the fleet works."""
    assert fleet.keys is not None
    with open_client(fleet.endpoint, timeout_s=PATIENT_S, tls=Tls(fleet.keys, ROGUE)) as rogue:
        tries = [
            *questions(fleet, rogue),  # first, as there are jobs in hand now
            *words(fleet, rogue),
            *tokens(fleet, rogue),
            *answers(fleet, rogue),
            *doors(fleet.endpoint, fleet.keys, fleet.arms),
        ]
    fleet.wrong += [what for what, through in tries if through]
    fleet.note(f"{len(tries)} ways in tried, {len(fleet.wrong)} open")
    return math.nan


def doors(endpoint: str, place: Path, arms: tuple[str, ...]) -> Iterator[Try]:
    """Lines without a certificate that is good, opened without our own checks."""
    with tempfile.TemporaryDirectory() as folder:
        wrong, expired = Path(folder) / "wrong", Path(folder) / "expired"
        for here in (wrong, expired):
            make(here, of_arms("f", arms), days=30)
            (here / "ca.pem").write_bytes((place / "ca.pem").read_bytes())
        (expired / "ca.key").write_bytes((place / "ca.key").read_bytes())
        issue(expired, Participant(arms[0], "arm"), days=1, now=datetime.now(UTC) - timedelta(days=2))
        nothing = {"root_ca_certificate": str(place / "ca.pem")}
        yield "no certificate", _opens(endpoint, nothing)
        yield "plain TCP", _opens(endpoint.replace("tls/", "tcp/"), {})
        yield "the certificate of another authority", _opens(endpoint, Tls(wrong, arms[0]).link(serves=False))
        yield "an expired certificate", _opens(endpoint, Tls(expired, arms[0]).link(serves=False))
    if not _opens(endpoint, Tls(place, ROGUE).link(serves=False)):
        raise RuntimeError("Not even a good certificate opens a line.")


def words(fleet: Fleet, rogue: zenoh.Session) -> Iterator[Try]:
    """Words and deletions under the keys of others, and under wildcards."""
    of_fleet, arm = fleet.link.fleet, fleet.arms[0]
    forged = State(arm, 10**9, 0.0, "idle", (0.0,) * 7, 60.0)
    heard: queue.Queue[tuple[str, bool]] = queue.Queue()
    ear = fleet.session.declare_subscriber(
        keys.all_of_fleet(of_fleet),
        zenoh.handlers.Callback(
            lambda sample: heard.put((str(sample.key_expr), sample.payload.to_bytes() == encode(forged))),
            indirect=False,
        ),
    )
    targets = [
        keys.of_arm(of_fleet, arm, "state"),
        keys.of_arm(of_fleet, arm, "difficulty"),
        keys.of_arm(of_fleet, arm, "event"),
        keys.of_auction(of_fleet, "auctioneer", "result"),
        keys.of_every_arm(of_fleet, "state"),
        keys.all_of_fleet(of_fleet),
        "**",
    ]
    own = keys.of_arm(of_fleet, ROGUE, "event")
    for _ in range(1000):  # until the router knows the ear, whose line is another
        rogue.put(own, b"?")
        if heard.get(timeout=PATIENT_S) == (own, False):
            break
    for key in targets:
        rogue.put(key, encode(forged), encoding=encoding(State))
        rogue.delete(key)
    rogue.put(own, encode(forged), encoding=encoding(State))  # its own key: lines keep their order, so this is the last
    got, until_s = [heard.get(timeout=PATIENT_S)], time.monotonic() + PATIENT_S
    while got[-1] != (own, True):
        if time.monotonic() > until_s:
            raise TimeoutError(f"Nobody heard the rogue's own word in {PATIENT_S:g} s.")
        got.append(heard.get(timeout=PATIENT_S))
    ear.undeclare()
    through = {key for key, is_forged in got if is_forged}
    yield from ((f"a word under {key}", key in through) for key in targets)


def tokens(fleet: Fleet, rogue: zenoh.Session) -> Iterator[Try]:
    """Pretending that another is there: a second auctioneer would stop all awards."""
    of_fleet = fleet.link.fleet
    fakes = [keys.of_arm(of_fleet, "ghost", "alive"), keys.of_auction(of_fleet, "boss", "alive")]
    own = keys.of_arm(of_fleet, ROGUE, "alive") + "/not"  # one that nobody watches
    held = [rogue.liveliness().declare_token(key) for key in (*fakes, own)]
    _settle(rogue, of_fleet)
    replies = fleet.session.liveliness().get(keys.all_of_fleet(of_fleet), timeout=PATIENT_S)
    there = {str(reply.ok.key_expr) for reply in replies if reply.ok}
    if own not in there:
        raise RuntimeError("Not even its own token of the rogue is seen.")
    yield from ((f"a token under {key}", key in there) for key in fakes)
    for token in held:
        token.undeclare()


def answers(fleet: Fleet, rogue: zenoh.Session) -> Iterator[Try]:
    """Answering in the place of arms and of the auctioneer, while they are asked."""
    of_fleet, arm = fleet.link.fleet, fleet.arms[0]
    places = [
        keys.of_arm(of_fleet, arm, "quote"),
        keys.of_every_arm(of_fleet, "quote"),
        keys.of_arm(of_fleet, arm, "award"),
        keys.of_jobs(of_fleet, "submit"),
        keys.of_jobs(of_fleet, "status"),
        keys.of_clock(of_fleet),
        keys.asked_by_every_arm(of_fleet, "auctioneer", "report"),
        keys.all_of_fleet(of_fleet),
    ]
    asked: dict[str, int] = dict.fromkeys(places, 0)

    def lie(place: str) -> zenoh.handlers.Callback:
        def take(query: zenoh.Query) -> None:
            with query:
                asked[place] += 1

        return zenoh.handlers.Callback(take, indirect=False)

    held = [rogue.declare_queryable(place, lie(place), complete=True) for place in places]
    _settle(rogue, of_fleet)
    clock = fleet.link.query_and_wait(keys.of_clock(of_fleet), ClockRequest(), Clock, timeout_s=PATIENT_S)
    if not clock.messages or not fleet.status():
        raise RuntimeError("Nobody answers where the rogue tried to.")
    fleet.until(lambda: False, 3.0)  # rounds, leases and reports go on meanwhile
    yield from ((f"an answer under {place}", count > 0) for place, count in asked.items())
    for queryable in held:
        queryable.undeclare()


def questions(fleet: Fleet, rogue: zenoh.Session) -> Iterator[Try]:
    """Asking as another, asking what the role does not need, and awards that were made before."""
    of_fleet = fleet.link.fleet
    mine = keys.asked_by(of_fleet, "auctioneer", "lease", ROGUE)
    if not _answered(rogue, mine, LeaseRequest(ROGUE, ())):
        raise RuntimeError("Not even its own lease is answered to the rogue.")
    in_hand = [status for status in fleet.status().values() if status.state in ("awarded", "finishing")]
    if not in_hand:
        raise RuntimeError("No arm has a job in hand that could be stolen; give the fleet more jobs.")
    for status in in_hand:
        hold = LeaseEntry(status.award, status.job, 0, "finishing")
        lease = LeaseRequest(status.arm, (hold,))
        report = Report(status.arm, status.award, status.job, "finished", 1, 0.0)
        for word, topic in ((lease, "lease"), (report, "report")):
            for asker in (status.arm, ROGUE):
                key = keys.asked_by(of_fleet, "auctioneer", topic, asker)
                yield f"a {topic} of {status.arm} under the key of {asker}", _answered(rogue, key, word)
            key = keys.asked_of_all(of_fleet, topic, status.arm)
            yield f"a {topic} of {status.arm} to every auctioneer", _answered(rogue, key, word)
        own = keys.asked_by(of_fleet, "auctioneer", "report", ROGUE)
        yield (
            f"a report on the award of {status.arm}",
            _answered(rogue, own, msgspec.structs.replace(report, arm=ROGUE)),
        )
    made = [(arm, award) for arm in fleet.arms for award in awards_of(fleet, arm)[:5]]
    if not made:
        raise RuntimeError("There is no award to send again.")
    for arm, award in made:
        where = keys.of_arm(of_fleet, arm, "award")
        for who, session in ((ROGUE, rogue), ("the submitter", fleet.session)):
            yield f"award {award.award} again by {who}", _answered(session, where, award)
    job = JobSpec(name="of the rogue", kind="hold", places=("clamp",))
    for key, word in (
        (keys.of_every_arm(of_fleet, "quote"), QuoteRequest("r", (job,))),
        (keys.of_jobs(of_fleet, "submit"), Submission((job,))),
        (keys.of_jobs(of_fleet, "status"), StatusRequest()),
    ):
        yield f"a question under {key}", _answered(rogue, key, word)


def _answered(session: zenoh.Session, key: str, word: msgspec.Struct) -> bool:
    """Whether a question gets an answer that is no refusal; an award that is not accepted is refused too."""
    replies = session.get(
        key, payload=encode(word), encoding=encoding(type(word)), target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE, timeout=PATIENT_S,
    )  # fmt: skip
    good = [reply.ok for reply in replies if reply.ok and str(reply.ok.encoding) != encoding(Refusal)]
    if isinstance(word, Award):
        return any(json.loads(one.payload.to_bytes()).get("accepted") for one in good)
    return bool(good)


def _opens(endpoint: str, tls: dict[str, object]) -> bool:
    """Whether a session of somebody without our checks gets a line."""
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


def _settle(session: zenoh.Session, of_fleet: str) -> None:
    """Wait until the router has taken what the session declared: everybody may ask the caches."""
    list(session.get(keys.caches_of(keys.of_arm(of_fleet, "nobody", "state")), timeout=PATIENT_S))
