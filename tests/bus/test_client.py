"""A client of the bus over a real router, and its queue: what is said arrives, what is asked is answered."""

import json
import math
import os
import signal
import socket
import threading
import time
from contextlib import ExitStack

import pytest

from fleet.bus.client import MOST_COUNTED, MOST_REJECTIONS, MOST_REPLIES, BusClient, Refused, _PendingQuery, under
from fleet.bus.mailbox import Mailbox
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Admission,
    ArmEvent,
    Clock,
    ClockRequest,
    JobSpec,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.messages import MOST_BYTES, MalformedMessage, Refusal, State, decode, encode, encoding
from fleet.bus.protocol.operator import ResetReply, ResetRequest
from fleet.bus.router import Router, other_versions
from fleet.errors import ArgumentError, BusError
from fleet.live.supervisor import Supervisor
from tests import commands
from tests.waiting import PATIENCE_S, serve_until, wait_until

WAIT_S = 0.05


@pytest.fixture
def late_signal():
    """A signal amid a wait, whose handler returns when the time of the wait is over; the next one ends it."""
    rung = []

    def ring(*_):
        rung.append(time.monotonic())
        assert len(rung) == 1, "still waiting ten seconds after the time was up"
        until_s = rung[0] + WAIT_S
        while time.monotonic() < until_s:
            pass

    before = signal.signal(signal.SIGALRM, ring)
    yield lambda: signal.setitimer(signal.ITIMER_REAL, WAIT_S / 2, 10.0)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize(
    "wait",
    [
        lambda until_s, _: list(Mailbox().take(until_s, count=4)),
        lambda until_s, _: BusClient("tcp/127.0.0.1:1", "f").serve(until_s),
        lambda until_s, folder: Supervisor(folder).poll(until_s - time.monotonic()),
    ],
    ids=["Mailbox.take", "BusClient.serve", "Supervisor.poll"],
)
def test_a_signal_that_takes_as_long_as_the_wait_does_not_make_it_endless(late_signal, wait, tmp_path):
    until_s = time.monotonic() + WAIT_S
    late_signal()
    wait(until_s, tmp_path)
    assert WAIT_S / 2 <= time.monotonic() - until_s + WAIT_S < 10.0


def test_what_several_threads_put_in_comes_out_once_and_in_the_order_of_each():
    mailbox, threads, each = Mailbox(), 4, 2000

    def talk(name):
        for number in range(each):
            mailbox.put((name, number))

    talkers = [threading.Thread(target=talk, args=(name,)) for name in range(threads)]
    for talker in talkers:
        talker.start()
    until_s = time.monotonic() + PATIENCE_S
    got = []
    while len(got) < threads * each and time.monotonic() < until_s:
        got += mailbox.take(until_s)
    for talker in talkers:
        talker.join()
    assert [[number for name, number in got if name == one] for one in range(threads)] == [list(range(each))] * threads


def test_one_that_waits_is_woken_and_a_bell_left_over_is_not_taken_for_a_word():
    mailbox = Mailbox()
    mailbox.put("first")
    assert list(mailbox.take()) == ["first"]  # without waiting: its bell still rings
    begun_s = time.monotonic()
    assert list(mailbox.take(begun_s + WAIT_S)) == []
    assert time.monotonic() - begun_s >= WAIT_S
    threading.Timer(WAIT_S, lambda: mailbox.put("second")).start()
    assert list(mailbox.take(math.inf)) == ["second"]
    assert list(mailbox.take()) == []


def test_items_that_the_reader_did_not_reach_stay_in_the_queue():
    mailbox = Mailbox(2)
    assert [mailbox.put(number) for number in range(3)] == [False, False, True]
    assert next(mailbox.take()) == 1
    assert list(mailbox.take()) == [2]


@pytest.fixture
def bus():
    """A router, and what makes lines to it."""
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        yield lambda **options: stack.enter_context(BusClient(router.endpoint, "f", **options))


def meet(*links):
    """What each has declared is known to all: a token is declared last, and seen after the rest."""
    seen = [set() for _ in links]
    for number, (link, names) in enumerate(zip(links, seen, strict=True)):
        link.declare_token(keys.of_arm("f", f"guest_{number}", "alive"))
        link.watch_tokens(keys.of_every_arm("f", "alive"), lambda arm, _, names=names: names.add(arm))
    serve_until(lambda: all(len(names) >= len(links) for names in seen), *links)


def raw(link):
    """The session beneath, to speak rubbish with."""
    return link._session


def refuse(_):
    raise Refused("No clock here.")


@pytest.mark.parametrize(
    ("handle", "messages", "refused"),
    [(lambda _: Clock(12.5, 60.0), [Clock(12.5, 60.0)], []), (refuse, [], ["No clock here."])],
    ids=["reply", "refusal"],
)
def test_an_answer_reaches_the_one_who_asked(bus, handle, messages, refused):
    asker, teller = bus(), bus()
    teller.reply_to(keys.of_clock("f"), ClockRequest, handle)
    meet(asker, teller)
    got = []
    asker.query(keys.of_clock("f"), ClockRequest(), Clock, got.append, timeout_s=PATIENCE_S)
    serve_until(lambda: got, asker, teller)
    assert ([*got[0].messages.values()], [*got[0].refused.values()]) == (messages, refused)
    assert got[0].took_s < PATIENCE_S


def test_a_question_to_nobody_is_over_at_once(bus):
    asker = bus()
    answers = asker.query_and_wait(keys.of_clock("f"), ClockRequest(), Clock, timeout_s=PATIENCE_S)
    assert not answers.messages
    assert answers.took_s < PATIENCE_S


@pytest.mark.parametrize("part", ["payload", "attachment", "parameters"])
def test_a_large_question_is_refused_before_it_waits(bus, part):
    """To a key with a wildcard, as the router lets it through; nobody serves the one who is asked."""
    asker, teller = bus(), bus()
    asked = []
    teller.reply_to(keys.of_clock("f"), ClockRequest, asked.append)
    meet(asker, teller)
    key, large = "thermofleet/v4/f/*/now", "x" * (MOST_BYTES + 1)
    options = {} if part == "parameters" else {part: large}
    (reply,) = raw(asker).get(f"{key}?{large}" if part == "parameters" else key, **options, timeout=PATIENCE_S)
    assert str(reply.ok.encoding) == encoding(Refusal)
    assert decode(Refusal, reply.ok.payload.to_bytes()).reason == (
        "The request has 65,537 bytes, and at most 65,536 are allowed."
    )
    teller.serve()
    assert (teller.malformed, asked) == (1, [])


def test_a_request_larger_than_a_message_is_refused_where_it_is_sent(bus):
    with pytest.raises(Refused, match=r"The request has 65,5\d\d bytes, and at most 65,536 are allowed"):
        bus().ask(keys.of_jobs("f", "status"), StatusRequest(("x" * MOST_BYTES,)), Status, timeout_s=PATIENCE_S)


def test_a_request_of_a_person_without_a_printable_name_is_refused(bus):
    asker, teller, requests = bus(), bus(), []
    key = keys.of_arm("f", "a", "reset")
    teller.reply_to(key, ResetRequest, lambda request: requests.append(request) or ResetReply("a", True))
    meet(asker, teller)
    got = []
    for by in ("ann\nfault: arm_0", ""):
        asker.query(key, ResetRequest(by), ResetReply, got.append, timeout_s=PATIENCE_S)
    serve_until(lambda: len(got) == 2, asker, teller)
    refused = next(replies for replies in got if replies.refusals)
    assert refused.refusals[0].startswith("ResetRequest.by must have 1 to 128 printable characters")
    assert requests == [ResetRequest("")]


@pytest.mark.parametrize("most", [2, MOST_REPLIES])
def test_a_flood_of_answers_ends_the_question(bus, most):
    asker, flooder = bus(), bus()
    held = []

    def flood(query):
        held.append(query)  # so that it does not end
        for _ in range(most + 1):
            query.reply(keys.of_clock("f"), encode(Clock(1.0, 1.0)), encoding=encoding(Clock))

    raw(flooder).declare_queryable(keys.of_clock("f"), flood, complete=True)
    meet(asker, flooder)
    got = asker.query_and_wait(keys.of_clock("f"), ClockRequest(), Clock, timeout_s=PATIENCE_S, most=most)
    assert len(got.messages) == most
    assert got.refused == {"?": f"More than {most} replies to one query; no more are read."}


def test_a_large_answer_is_not_decoded():
    with pytest.raises(MalformedMessage, match="It has 65,537 bytes, and at most 65,536 are allowed"):
        decode(Clock, encode(Clock(1.0, 1.0)).ljust(MOST_BYTES + 1), encoding(Clock))


def test_two_that_ask_each_other_do_not_block(bus):
    one, other = bus(), bus()
    job = JobSpec(name="j", kind="hold", places=("rack",))
    got = []

    def answered(jobs):
        other.query(keys.of_clock("f"), ClockRequest(), Clock, got.append, timeout_s=PATIENCE_S)
        return SubmissionReply(auctioneer="a", jobs=tuple(Admission(j.name, True) for j in jobs.jobs))

    other.reply_to(keys.of_jobs("f", "submit"), Submission, answered)
    one.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(time_s=1.0, speed=1.0))
    meet(one, other)
    one.query(keys.of_jobs("f", "submit"), Submission((job,)), SubmissionReply, got.append, timeout_s=PATIENCE_S)
    serve_until(lambda: len(got) == 2, one, other)
    assert all(len(answers.messages) == 1 for answers in got)


@pytest.mark.parametrize(
    ("payload", "said", "complaint"),
    [
        (b"{", encoding(ClockRequest), "Not a thermofleet.ClockRequest.v4"),
        (b"{}", "application/json;thermofleet.ClockRequest.v9", "encoded as"),
    ],
)
def test_a_malformed_question_is_answered_with_what_is_wrong(bus, payload, said, complaint):
    asker, teller = bus(), bus()
    teller.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(time_s=1.0, speed=1.0))
    meet(asker, teller)
    replies = []
    raw(asker).get(keys.of_clock("f"), replies.append, payload=payload, encoding=said, timeout=PATIENCE_S)
    serve_until(lambda: replies, teller)
    assert str(replies[0].ok.encoding) == encoding(Refusal)
    assert complaint in json.loads(replies[0].ok.payload.to_bytes())["reason"]
    assert teller.malformed == 1


def test_words_that_speak_for_another_are_left_out(bus):
    listener, stranger, heard = bus(), bus(), []
    listener.subscribe(keys.of_every_arm("f", "event"), ArmEvent, lambda arm, word: heard.append(arm))
    meet(listener, stranger)
    lie = ArmEvent(arm="arm_1", number=0, time_s=1.0, kind="finish")
    truth = ArmEvent(arm="arm_2", number=0, time_s=1.0, kind="finish")
    stranger.publish(keys.of_arm("f", "arm_0", "event"), lie)
    raw(stranger).put("thermofleet/v4/f/arm/*/event", json.dumps({"arm": "arm_0"}), encoding=encoding(ArmEvent))
    stranger.publish(keys.of_arm("f", "arm_2", "event"), truth)
    serve_until(lambda: heard, listener)
    assert heard == ["arm_2"]
    assert listener.malformed == 2


def test_the_last_malformed_message_of_each_sender_is_kept(bus):
    listener, stranger = bus(), bus()
    listener.subscribe(keys.of_every_arm("f", "state"), State, lambda arm, word: None)
    meet(listener, stranger)
    places = [keys.of_arm("f", f"arm_{number}", "state") for number in range(20)]
    for place in [*places, places[0]]:
        raw(stranger).put(place, b"{", encoding=encoding(State))
    serve_until(lambda: listener.malformed == 21, listener)
    assert list(listener.complaints()) == [under(place) for place in (*places[1:], places[0])]
    assert "Not a thermofleet.State.v4" in listener.complaints()[under(places[7])]
    assert listener.complaints(math.inf) == {}
    for number in range(MOST_REJECTIONS):
        listener.reject(f"flood {number}", "x" * MOST_BYTES)
    assert len(listener.rejections) == MOST_REJECTIONS
    assert max(map(len, listener.complaints().values())) < MOST_BYTES


def test_a_new_fault_is_logged_after_many_of_another_and_a_flood_is_not(bus, caplog):
    listener = bus()
    for number in range(1000):
        listener.reject("of /joint_states", f"A JointState has {number / 8:.3f} for position of joint_1.")
    assert len(caplog.records) == 10  # 1, 2, 4, … 512
    listener.reject("of /diagnostics", "The temperature_c of joint_1 is no number: 'warm'.")
    listener.reject("of /joint_states", "A JointState names joint_2 twice.")
    assert ["joint_1 is no number" in caplog.text, "names joint_2 twice" in caplog.text] == [True, True]
    caplog.clear()
    for number in range(100 * MOST_COUNTED):
        listener.reject(f"token {number}", "not a key")
    assert len(caplog.records) < MOST_COUNTED + 20


def test_who_comes_and_goes_is_seen(bus):
    watcher, seen = bus(), []
    watcher.watch_tokens(keys.of_every_arm("f", "alive"), lambda arm, there: seen.append((arm, there)))
    arm = bus()
    arm.declare_token(keys.of_arm("f", "arm_0", "alive"))
    serve_until(lambda: ("arm_0", True) in seen, watcher)
    arm.close()
    serve_until(lambda: ("arm_0", False) in seen, watcher)
    assert seen.index(("arm_0", True)) < seen.index(("arm_0", False))


def test_an_arm_of_an_older_version_is_named_with_its_version(bus):
    arm = bus()
    arm.declare_token(keys.of_arm("f", "arm 2", "alive"))
    token = raw(arm).liveliness().declare_token("thermofleet/v2/f/arm/arm%201/alive")
    (sentence,) = other_versions(arm._endpoint, "f")
    token.undeclare()
    assert sentence.startswith("'arm 1' uses version v2 of the bus, and this program v4")


def test_what_nobody_handles_pushes_out_the_oldest(bus):
    listener, sender, heard = bus(backlog=10), bus(), []
    listener.subscribe(keys.of_every_arm("f", "event"), ArmEvent, lambda arm, word: heard.append(word.number))
    meet(listener, sender)
    for number in range(51):
        sender.publish(keys.of_arm("f", "a", "event"), ArmEvent(arm="a", number=number, time_s=0.0, kind="finish"))
    wait_until(lambda: listener.overrun >= 41)
    listener.serve()
    assert heard == list(range(41, 51))
    assert listener.overrun == 41


@pytest.mark.parametrize(
    ("endpoint", "fleet", "more", "said"),
    [
        (None, "f", {}, r"endpoint must be of type str, for example tcp/127\.0\.0\.1:7447 \(got None\)"),
        ("tcp/127.0.0.1:1", 3, {}, r"fleet must be of type str, for example quickstart \(got 3\)"),
        ("tcp/127.0.0.1:1", "a/b", {}, r"fleet must have 1 to 128 .* \(got 'a/b'\)"),
        ("tcp/127.0.0.1:1", "f", {"timeout_s": math.nan}, r"timeout_s must be 0 to 86400 \(got nan\)"),
        ("tcp/127.0.0.1:1", "f", {"backlog": -3}, r"backlog must be 1 to 16777216 \(got -3\)"),
    ],
)
def test_wrong_arguments_are_refused_before_connecting(endpoint, fleet, more, said) -> None:
    with pytest.raises(ArgumentError, match=said):
        BusClient(endpoint, fleet, **more)


def test_a_closed_line_says_so(bus):
    link = bus()
    link.close()
    with pytest.raises(BusError, match="not open"):
        link.publish(keys.of_arm("f", "a", "event"), ArmEvent(arm="a", number=0, time_s=0.0, kind="finish"))


def test_nobody_counts_as_absent_while_the_router_is_silent(monkeypatch):
    """Or a second auctioneer, or a second arm of one name, would start."""
    with ExitStack() as stack:
        router = stack.enter_context(commands.start("bus", "router", "--port", 0))
        stack.callback(router.kill)
        asker = stack.enter_context(BusClient(router.stdout.readline().strip(), "f", timeout_s=PATIENCE_S))
        os.kill(router.pid, signal.SIGSTOP)
        stack.callback(os.kill, router.pid, signal.SIGCONT)
        monkeypatch.setattr(asker, "_timeout_s", WAIT_S)
        with pytest.raises(BusError, match="it is unknown who is present"):
            asker.tokens(keys.of_every_arm("f", "alive"))
        monkeypatch.setattr(_PendingQuery, "finish", lambda _: None)  # as if Zenoh's own timeout came too late
        assert asker.query_and_wait(keys.of_clock("f"), ClockRequest(), Clock, timeout_s=WAIT_S).refused


@pytest.mark.ci_slow
def test_a_line_closes_soon_though_a_router_that_stands_still_has_taken_its_call():
    """In place of the router is somebody who accepts and never says a word; Zenoh itself would wait for ten seconds."""

    def seconds_to_close() -> float:
        router = Router().open()
        port = int(router.endpoint.rpartition(":")[2])
        line = BusClient(router.endpoint, "f").open()
        router.close()
        with socket.create_server(("127.0.0.1", port)) as silent:
            silent.settimeout(PATIENCE_S)
            with silent.accept()[0]:
                begun_s = time.monotonic()
                line.close()
                return time.monotonic() - begun_s

    assert any(seconds_to_close() < 9.0 for _ in range(3))  # a busy machine delays one attempt, a defect all
