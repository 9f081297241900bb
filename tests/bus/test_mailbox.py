"""A queue that comes back in time: what other threads put in is read in order, and no signal makes a wait longer."""

import math
import signal
import threading
import time
from queue import Empty

import pytest

from fleet.bus.client import BusClient
from fleet.bus.mailbox import Mailbox
from fleet.live.supervisor import Supervisor
from tests.waiting import PATIENCE_S

WAIT_S = 0.05


def get(mailbox, until_s):
    with pytest.raises(Empty):
        mailbox.get(until_s)


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
        lambda until_s, _: get(Mailbox(), until_s),
        lambda until_s, _: Mailbox().wait(4, until_s),
        lambda until_s, _: BusClient("tcp/127.0.0.1:1", "f").serve(until_s),
        lambda until_s, folder: Supervisor(folder).poll(until_s - time.monotonic()),
    ],
    ids=["Mailbox.get", "Mailbox.wait", "BusClient.serve", "Supervisor.look"],
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
    got = [mailbox.get(until_s) for _ in range(threads * each)]
    for talker in talkers:
        talker.join()
    assert len(mailbox) == 0
    assert [[number for name, number in got if name == one] for one in range(threads)] == [list(range(each))] * threads


def test_one_that_waits_is_woken_and_a_bell_left_over_is_not_taken_for_a_word():
    mailbox = Mailbox()
    mailbox.put("first")
    assert mailbox.get() == "first"  # without waiting: its bell still rings
    begun_s = time.monotonic()
    get(mailbox, begun_s + WAIT_S)
    assert time.monotonic() - begun_s >= WAIT_S
    threading.Timer(WAIT_S, lambda: mailbox.put("second")).start()
    assert mailbox.get(math.inf) == "second"
    get(mailbox, -math.inf)
