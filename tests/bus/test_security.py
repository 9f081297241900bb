"""A router with TLS lets nobody in whom it does not know, and nobody do what is not theirs."""

import itertools
import queue
import re
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec
import pytest
import zenoh

from fleet.bus.client import BusClient, Refused, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Award,
    Clock,
    ClockRequest,
    JobSpec,
    Lease,
    LeaseEntry,
    LeaseRequest,
    Receipt,
    Report,
)
from fleet.bus.protocol.consensus import Claim, ClaimEntry, ClaimReply, GrantedEntry
from fleet.bus.protocol.messages import Info, State, encode, encoding
from fleet.bus.protocol.operator import Cleared, ClearRequest
from fleet.bus.router import Router, open_client
from fleet.bus.security.access_control import ROSTER, RosterEntry, of_arms
from fleet.bus.security.certificates import issue
from fleet.bus.security.tls import Tls
from fleet.errors import BusError
from tests.waiting import PATIENCE_S, serve_until

ARMS = ("arm_0", "arm_1", "arm 2+*@")
HERE = "thermofleet/v4/f"


def settled(session: zenoh.Session) -> None:
    """Wait until the router has taken all that the session said or declared before.

    A question travels with the priority of what is said, so it cannot overtake it; everybody may ask the caches.
    """
    assert list(session.get(keys.caches_of(f"{HERE}/arm/nobody"), timeout=PATIENCE_S)) == []


def ask(session: zenoh.Session, key: str) -> list[str]:
    """The answers to a question to all, sorted."""
    replies = session.get(
        key, payload=b"?", target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, timeout=PATIENCE_S
    )
    return sorted(reply.ok.payload.to_string() for reply in replies if reply.ok)


def answer(session: zenoh.Session, key: str, *replies: tuple[str, str]) -> tuple[zenoh.Queryable, list[str]]:
    """A queryable, and the questions that reach it."""
    asked: list[str] = []

    def reply(query: zenoh.Query) -> None:
        with query:
            asked.append(str(query.key_expr))
            for under, text in replies:
                query.reply(under, text)

    return session.declare_queryable(key, reply), asked


OF_OTHERS = [
    keys.of_arm("f", "arm_0", "state"),
    keys.of_arm("f", "arm_0", "difficulty"),
    keys.of_arm("f", ARMS[2], "event"),
    keys.of_every_arm("f", "state"),
    f"{HERE}/arm/**",
    f"{HERE}/**",
    "**",
    f"{HERE}/arm/arm_$*/state",
    keys.of_arm("g", "arm_1", "state"),
    keys.of_auction("f", "auctioneer", "announce"),
    keys.of_jobs("f", "submit"),
    keys.of_clock("f"),
    f"{HERE}/arm/arm_0/difficulty/@adv/pub/1/2",
    f"{HERE}/arm/arm_10/state",
    "somewhere/else",
]

NOBODYS = [("delete", keys.of_arm("f", "arm_1", "difficulty"))]
"""What nobody needs, and nobody may: a deletion, even of what is one's own."""


@pytest.mark.parametrize(("what", "key"), [*itertools.product(["put", "delete"], OF_OTHERS), *NOBODYS])
def test_an_arm_says_nothing_under_the_key_of_another(router, side, connect, what, key, inside):
    heard: queue.Queue[str] = queue.Queue()
    # On the receiving thread itself: threads of two subscribers between would mix the order up.
    note = zenoh.handlers.Callback(lambda sample: heard.put(str(sample.key_expr)), indirect=False)
    ears = [inside(router).declare_subscriber(where, note) for where in ("**", "**/@adv/**")]
    arm, mine = connect("arm_1"), keys.of_arm("f", "arm_1", "state")
    getattr(arm, what)(key, *([b"not mine"] if what == "put" else []))
    arm.put(mine, b"mine")
    assert [heard.get(timeout=PATIENCE_S) for _ in range(1 + (side == "open"))] == [key, mine][side == "guarded" :]
    for ear in ears:
        ear.undeclare()


FAKES = [keys.of_arm("f", "arm_0", "quote"), keys.of_every_arm("f", "quote"), f"{HERE}/**", "**"]


@pytest.mark.parametrize("fake", FAKES)
def test_nobody_answers_in_the_place_of_an_arm(side, connect, fake):
    arm, rogue, auctioneer = connect("arm_0"), connect("arm_1"), connect("auctioneer")
    mine, own = keys.of_arm("f", "arm_0", "quote"), keys.of_arm("f", "arm_1", "quote")
    kept = [answer(arm, mine, (mine, "arm_0")), answer(rogue, fake, (mine, "fake")), answer(rogue, own, (own, "arm_1"))]
    settled(arm)
    settled(rogue)
    said = ask(auctioneer, keys.of_every_arm("f", "quote"))
    assert [text for text in said if text != "fake"] == ["arm_0", "arm_1"]
    assert ("fake" in said) == (side == "open")
    # A question to every arm reaches this session, by its own right; one to that arm alone does not.
    kept[1][1].clear()
    assert [text for text in ask(auctioneer, mine) if text != "fake"] == ["arm_0"]
    assert bool(kept[1][1]) == (side == "open")


def test_an_answer_under_the_key_of_another_does_not_arrive(side, connect):
    rogue, auctioneer = connect("arm_1"), connect("auctioneer")
    own, other = keys.of_arm("f", "arm_1", "quote"), keys.of_arm("f", "arm_0", "quote")
    kept = answer(rogue, own, (other, "fake"), (own, "true"))
    settled(rogue)
    assert ask(auctioneer, keys.of_every_arm("f", "quote")) == (["true"] if side == "guarded" else ["fake", "true"])
    assert kept[1] == [keys.of_every_arm("f", "quote")]


ASKERS = {
    keys.of_arm("f", "arm_0", "quote"): {"auctioneer", "submitter", "operator"},
    keys.of_arm("f", "arm_0", "award"): {"auctioneer"},
    keys.of_arm("f", "arm_0", "reset"): {"operator"},
    keys.asked_by("f", "auctioneer", "lease", "arm_0"): {"arm_0"},
    keys.asked_by("f", "auctioneer", "report", "arm_1"): {"arm_1"},
    keys.asked_by("f", "arm_0", "claim", "arm_1"): {"arm_1"},
    keys.of_jobs("f", "submit"): {"submitter", "operator"},
    keys.of_jobs("f", "clear"): {"operator"},
    keys.of_jobs("f", "cell"): {"submitter", "operator", "monitor", "recorder"},
    keys.of_jobs("f", "control"): {"operator"},
    keys.of_jobs("f", "status"): {"submitter", "operator", "monitor", "recorder", "auctioneer"},
    keys.of_clock("f"): {"arm_0", "arm_1", "submitter", "operator", "monitor", "recorder", "auctioneer"},
}


@pytest.mark.parametrize("key", ASKERS)
def test_each_asks_what_its_role_needs(side, connect, key):
    answerer = connect("arm_0" if "/arm/" in key else "auctioneer")
    kept, asked = answer(answerer, key, (key, "answer"))
    settled(answerer)
    wild = key.replace("/arm/arm_0/", "/arm/*/").replace("/auctioneer/", "/*/")
    everybody = ("arm_0", "arm_1", "submitter", "operator", "monitor", "recorder", "auctioneer")
    answered = {name: [ask(connect(name), question) for question in {key, wild}] for name in everybody}
    for name, said in answered.items():
        may = side == "open" or name in ASKERS[key]
        assert all(texts == (["answer"] if may else []) for texts in said), name
    assert len(asked) == sum(len(texts) for said in answered.values() for texts in said)
    kept.undeclare()


def test_a_refusal_arrives_also_under_a_wildcard(endpoint_of):
    """An error of Zenoh's does not: a wildcard is in no arm's own rule, so the router drops it."""
    key, everywhere = keys.of_arm("f", "arm_0", "award"), keys.of_every_arm("f", "award")

    def too_warm(_: Award) -> Ack:
        raise Refused("too warm")

    award = Award("w", "r", "auctioneer", "q", JobSpec("j", "hold", ("p",)))
    with BusClient(endpoint_of("arm_0"), "f") as answers, BusClient(endpoint_of("auctioneer"), "f") as asks:
        answers.reply_to(key, Award, too_warm)
        settled(raw(answers))
        for where in (key, everywhere):
            got: list[Replies[Ack]] = []
            asks.query(where, award, Ack, got.append, timeout_s=PATIENCE_S)
            serve_until(lambda got=got: bool(got), answers, asks)
            assert got[0].refused == {key: "too warm"}


@pytest.fixture
def endpoint_of(router: Router, side: str, folder: Path) -> Callable[[str], str]:
    """Endpoint of the router for a participant."""
    return lambda name: Tls(folder, name).endpoint(router.endpoint) if side == "guarded" else router.endpoint


def raw(link: BusClient) -> zenoh.Session:
    """The session beneath."""
    assert link._session is not None
    return link._session


@pytest.mark.parametrize("topic", keys.ASKED)
def test_an_arm_neither_renews_nor_reports_nor_claims_for_another(side, connect, endpoint_of, topic):
    """Neither under its own key with the other's name in the word, nor under the other's; for itself it does."""
    words = {
        "lease": lambda arm: LeaseRequest(arm, (LeaseEntry("w", "j", 0, "working"),)),
        "report": lambda arm: Report(arm, "w", "j", "finished", 1, 0.0),
        "claim": lambda arm: Claim(arm, 1, (ClaimEntry("w", "j", ("p",), 0, "requested"),)),
    }
    answers = {
        "lease": Lease("auctioneer", 6.0, ("w",), ()),
        "report": Receipt("auctioneer", "w"),
        "claim": ClaimReply("arm_0", 1, 6.0, (GrantedEntry("w", 0),)),
    }
    taken: list[str] = []

    def take(word: LeaseRequest | Report | Claim) -> Lease | Receipt | ClaimReply:
        taken.append(word.arm)
        return answers[topic]

    owner, role = ("arm_0", "arm") if topic == "claim" else ("auctioneer", "auction")
    with BusClient(endpoint_of(owner), "f") as auctioneer:
        auctioneer.reply_to(keys.asked_by_every_arm("f", owner, topic), type(words[topic]("x")), take)
        settled(raw(auctioneer))
        rogue = connect("arm_1")

        def ask_under(key: str, arm: str) -> list[str]:
            """The answers that the certificate of arm_1 gets under a key for a word of `arm`."""
            over, got = threading.Event(), []
            word = words[topic](arm)
            handler = zenoh.handlers.Callback(got.append, drop=over.set, indirect=False)
            rogue.get(
                key, handler, payload=encode(word), encoding=encoding(type(word)), target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE, timeout=PATIENCE_S,
            )  # fmt: skip
            serve_until(over.is_set, auctioneer)
            return [str(reply.ok.encoding).split(".")[1] for reply in got]

        def ask_as(asker: str, arm: str) -> list[str]:
            one, every = keys.asked_by("f", owner, topic, asker), keys.asked_of_all("f", topic, asker)
            return ask_under(one, arm) + ask_under(every, arm)

        answer = type(answers[topic]).__name__
        assert ask_as("arm_1", "arm_0") == ["Refusal"] * 2
        assert taken == []
        assert auctioneer.malformed == 2
        assert "under the key of 'arm_1' claims to be by 'arm_0'" in list(auctioneer.complaints().values())[-1]
        assert ask_as("arm_0", "arm_0") == ([] if side == "guarded" else [answer] * 2)
        assert ask_as("arm_1", "arm_1") == [answer] * 2
        assert taken == ([] if side == "guarded" else ["arm_0"] * 2) + ["arm_1"] * 2
        for nobody in (keys.asked_by_every_arm("f", owner, topic), keys.all_of("f", role, owner)):
            assert ask_under(nobody, "arm_0") == []
        assert len(taken) == (2 if side == "guarded" else 4)


DENIED = {
    "recorder": (
        lambda link: link.publisher(keys.of_arm("f", "arm_0", "state"), State),
        "'recorder:recorder' may not publish 'thermofleet/v4/f/arm/arm_0/state'; that takes a certificate of the role "
        "arm and the name 'arm_0'.",
    ),
    "arm_1": (
        lambda link: link.declare_token(keys.of_arm("f", "arm_0", "alive")),
        "'arm:arm_1' may not show the token 'thermofleet/v4/f/arm/arm_0/alive'; that takes a certificate of the role "
        "arm and the name 'arm_0'.",
    ),
    "monitor": (
        lambda link: link.publish(keys.of_arm("f", "arm_0", "info"), Info("arm_0", 7, "t")),
        "'monitor:monitor' may not publish 'thermofleet/v4/f/arm/arm_0/info'; that takes a certificate of the role arm "
        "and the name 'arm_0'.",
    ),
    "submitter": (
        lambda link: link.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(1.0, 1.0)),
        "'submitter:submitter' may not reply to 'thermofleet/v4/f/clock/now'; that takes a certificate of the role arm "
        "or auctioneer.",
    ),
    "auctioneer": (
        lambda link: link.query(keys.of_jobs("f", "clear"), ClearRequest("a", "b"), Cleared, print, timeout_s=1.0),
        "'auctioneer:auctioneer' may not query 'thermofleet/v4/f/jobs/clear'; that takes a certificate of the role "
        "operator.",
    ),
}


@pytest.mark.parametrize("name", DENIED)
def test_a_client_states_what_its_certificate_does_not_allow(guarded, open_router, folder, name):
    act, sentence = DENIED[name]
    with (
        BusClient(Tls(folder, name).endpoint(guarded.endpoint), "f") as link,
        pytest.raises(BusError, match=f"^{re.escape(sentence)}$"),
    ):
        act(link)
    with BusClient(open_router.endpoint, "f") as link:
        act(link)


def test_a_client_that_the_roster_of_its_folder_does_not_allow_is_not_opened(guarded, folder, tmp_path):
    for name in ("ca.pem", "arm_0.pem", "arm_0.key"):
        shutil.copy(folder / name, tmp_path / name)
    endpoint = Tls(tmp_path, "arm_0").endpoint(guarded.endpoint)
    BusClient(endpoint, "f").open().close()  # without a roster nothing is known
    (tmp_path / ROSTER).write_bytes(msgspec.json.encode(of_arms("f", ["arm_1"])))
    with pytest.raises(BusError, match=r"'arm:arm_0' is not in '.*roster\.json'.* bus keys --add"):
        BusClient(endpoint, "f").open()
    (tmp_path / ROSTER).write_bytes(msgspec.json.encode(of_arms("f", ["arm_0"])))
    with pytest.raises(BusError, match="are for the fleet 'f', so a router forwards nothing of the fleet 'g'"):
        BusClient(endpoint, "g").open()
    BusClient(endpoint, "f").open().close()


def test_a_late_joiner_gets_the_last_words_also_of_a_later_publisher(endpoint_of):
    """Caches and their detection live under `@adv`, which needs rules of its own."""
    with ExitStack() as stack:
        monitor, *arms = (
            stack.enter_context(BusClient(endpoint_of(name), "f")) for name in ("monitor", "arm_0", "arm_1")
        )
        heard: list[str] = []
        publish = arms[0].publisher(keys.of_arm("f", "arm_0", "info"), Info)
        for twin in ("a", "b"):
            publish(Info("arm_0", 7, twin))
        settled(raw(arms[0]))
        monitor.subscribe(keys.of_every_arm("f", "info"), Info, lambda _, info: heard.append(info.twin), history=True)
        serve_until(lambda: heard == ["b"], monitor)
        publish_late = arms[1].publisher(keys.of_arm("f", "arm_1", "info"), Info)
        publish_late(Info("arm_1", 7, "c"))
        serve_until(lambda: heard == ["b", "c"], monitor)


def test_the_router_tells_a_guest_nothing_of_itself(side, connect):
    assert bool(ask(connect("monitor"), "@/*/router")) == (side == "open")


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
def test_a_certificate_gives_no_more_rights_in_another_mode(open_stranger, guarded, folder, mode, inside):
    heard: queue.Queue[str] = queue.Queue()
    with (
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "monitor")) as monitor,
        open_stranger(guarded.endpoint, Tls(folder, "arm_1").link(serves=False), mode) as rogue,
    ):
        ears = [
            session.declare_subscriber(f"{HERE}/**", lambda sample: heard.put(str(sample.key_expr)))
            for session in (monitor, inside(guarded))
        ]
        got: list[str] = []
        end_s = time.monotonic() + PATIENCE_S
        # A peer or a router sends nothing before it has learnt who listens.
        while len(got) < 2 and time.monotonic() < end_s:
            rogue.put(keys.of_arm("f", "arm_0", "state"), b"not mine")
            rogue.put(keys.of_arm("f", "arm_1", "state"), b"mine")
            with suppress(queue.Empty):
                got.append(heard.get(timeout=0.1))
        assert got == [keys.of_arm("f", "arm_1", "state")] * 2
        for ear in ears:
            ear.undeclare()


def test_somebody_whom_the_authority_knows_and_the_roster_does_not_may_do_nothing(guarded, folder, tmp_path, inside):
    """Such as one that was added after the router started."""
    stranger = tmp_path / "copy"
    stranger.mkdir()
    for name in ("ca.pem", "ca.key"):
        (stranger / name).write_bytes((folder / name).read_bytes())
    issue(stranger, RosterEntry("arm_9", "arm"), days=1)
    heard: queue.Queue[str] = queue.Queue()
    ear = inside(guarded).declare_subscriber("**", lambda sample: heard.put(str(sample.key_expr)))
    with (
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(stranger, "arm_9")) as rogue,
        open_client(guarded.endpoint, timeout_s=PATIENCE_S, tls=Tls(folder, "arm_0")) as arm,
    ):
        deaf: list[zenoh.Sample] = []
        subscriber = rogue.declare_subscriber(f"{HERE}/**", deaf.append, allowed_origin=zenoh.Locality.REMOTE)
        rogue.put(keys.of_arm("f", "arm_9", "state"), b"not in the roster")
        assert list(rogue.get(f"{HERE}/**", timeout=PATIENCE_S)) == []
        arm.put(keys.of_arm("f", "arm_0", "state"), b"mine")
        assert heard.get(timeout=PATIENCE_S) == keys.of_arm("f", "arm_0", "state")
        assert list(rogue.get(f"{HERE}/**", timeout=PATIENCE_S)) == []
        assert deaf == []
        subscriber.undeclare()
    ear.undeclare()
