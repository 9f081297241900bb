"""What a long command says where there is no terminal to draw a bar on, and when it is interrupted."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.cli.terminal import Interrupted, SafeConsole, echo, progress_bar
from scenarios.progress import HINTS, Count, StageClock
from scenarios.show.table import Table
from tests.waiting import wait_until


def interrupted(stage: str, **bar: str) -> str:
    """What is said of Ctrl-C in this stage."""
    try:
        with progress_bar(**bar) as progress:
            progress(stage, 0.5)
            raise KeyboardInterrupt
    except Interrupted as error:
        return str(error)


def test_without_a_terminal_a_long_stage_says_what_goes_on_how_many_and_how_long(capsys):
    """The lines come while a step reports nothing, as one that trains for a quarter of an hour."""
    lines: list[str] = []

    def has_said(count: int) -> bool:
        said = capsys.readouterr()
        assert said.out == ""
        lines.extend(said.err.splitlines())
        return len(lines) >= count

    with progress_bar(after_s=1.0, every_s=0.1) as progress:
        progress("planning", 0.5)  # over at once: no line
        progress("training", Count(1, 4))
        wait_until(lambda: has_said(3))
        progress("computing section 1 of 2: Latent map", 0.0)
        progress("computing section 2 of 2: Epochs", 0.5)
        progress("filming", 1.0)
    has_said(0)
    first, *again, one, two = lines
    assert first == f"Training the twins 1/4 ({HINTS['training']}) …"
    assert all(re.fullmatch(r"Training the twins 1/4: 25%, for \d+ s\.", line) for line in again)
    assert (one, two) == ("Computing section 1 of 2: Latent map", "Computing section 2 of 2: Epochs")


@given(
    first=st.floats(0, 0.5), pace=st.floats(1e-4, 0.01), spent_s=st.floats(10, 40), began_s=st.floats(0, 1e6)
)  # fmt: skip
def test_at_a_constant_pace_the_time_left_is_exact(first, pace, spent_s, began_s):
    clock = StageClock()
    assert clock.update("comparing", first, began_s)
    assert clock.left_s(began_s) is None
    now = first + pace * spent_s
    assert not clock.update("comparing", now, began_s + spent_s)
    assert clock.left_s(began_s + spent_s) == pytest.approx((1.0 - now) / pace, rel=1e-3)


def test_a_stage_whose_name_counts_is_one_stage():
    clock = StageClock()
    assert [clock.update(f"iteration {n}, best {n / 7:.1f}", n / 9, n) for n in range(3)] == [True, False, False]
    assert clock.line(2.0) == "Iteration 2, best 0.3: 22%, for 2 s."
    assert clock.line(8.0) == "Iteration 2, best 0.3: 22%, about 28 s left."


def test_an_interruption_says_what_is_kept_and_where(monkeypatch, tmp_path):
    monkeypatch.setenv("THERMOFLEET_CACHE", str(tmp_path))
    assert interrupted("training") == (
        "Interrupted while training: nothing was written. Plans and twins already made are kept in "
        f"{tmp_path}, and the same command continues from there."
    )


def test_an_interruption_that_keeps_nothing_does_not_promise_it():
    assert interrupted("learning the log", kept="") == "Interrupted while learning the log: nothing was written."


def test_text_from_others_cannot_move_the_cursor_or_reorder_a_line(capsys):
    odd = "a\x1b[2Jb\u202ec\x9bd"
    SafeConsole(width=200).print(Table(head=("name",), rows=((odd,),)))
    echo(odd)
    for line in capsys.readouterr().out.splitlines()[1:]:
        assert line.strip() == r"a\u001b[2Jb\u202ec\u009bd"
