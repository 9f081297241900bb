"""A participant that is told to stop comes to its end, whichever signal and whichever thread takes it."""

import os
import signal
import threading

import pytest

from scenarios.cli.signals import until_stopped
from scenarios.cli.terminal import Interrupted
from tests.waiting import PATIENCE_S


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_asks_for_an_end_and_breaks_nothing_off(number):
    with until_stopped() as stop:
        assert not stop.is_set()
        assert not stop.wait(0.01)
        os.kill(os.getpid(), number)
        assert stop.wait(PATIENCE_S)
        assert stop.is_set()
    if number == signal.SIGTERM:
        stop.leave("said to nobody")
    else:
        with pytest.raises(Interrupted, match="the journal is whole"):
            stop.leave("the journal is whole")


def test_one_that_was_not_told_to_stop_leaves_without_a_word():
    with until_stopped() as stop:
        pass
    assert not stop.is_set()
    stop.leave("said to nobody")


def test_a_signal_that_comes_while_waiting_wakes():
    with until_stopped() as stop:
        threading.Timer(0.05, lambda: os.kill(os.getpid(), signal.SIGTERM)).start()
        assert stop.wait(PATIENCE_S)


def test_the_handlers_of_before_are_back_afterwards():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with until_stopped():
        assert signal.getsignal(signal.SIGINT) is not before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
