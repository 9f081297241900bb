"""What a long command says where there is no terminal to draw a bar on, and when it is interrupted."""

from scenarios.cli.terminal import LONG_STAGES, Interrupted, SafeConsole, echo, plain_table, progress_bar


def interrupted(stage: str, **bar: str) -> str:
    """What is said of Ctrl-C in this stage."""
    try:
        with progress_bar(**bar) as progress:
            progress(stage, 0.5)
            raise KeyboardInterrupt
    except Interrupted as error:
        return str(error)


def test_without_a_terminal_every_long_stage_and_every_section_is_a_line_of_its_own(capsys):
    with progress_bar() as progress:
        progress("planning", 0.5)
        progress("training", 0.0)
        progress("training", 0.5)
        progress("computing section 1 of 2: Latent map", 0.0)
        progress("drawing jobs", 0.0)
        progress("computing sections, 2 of 2 done: Epochs", 1.0)
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.splitlines() == [
        LONG_STAGES["training"],
        "Computing section 1 of 2: Latent map",
        "Computing sections, 2 of 2 done: Epochs",
    ]


def test_what_comes_from_the_cache_is_not_announced(capsys):
    with progress_bar() as progress:
        progress("training", 1.0)
    assert capsys.readouterr().err == ""


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
    table = plain_table("name")
    table.add_row(odd)
    SafeConsole(width=200).print(table)
    echo(odd)
    for line in capsys.readouterr().out.splitlines()[1:]:
        assert line.strip() == r"a\u001b[2Jb\u202ec\u009bd"
