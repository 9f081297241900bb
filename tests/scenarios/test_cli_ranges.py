"""Every number on the command line has a range, and every name a form."""

from collections.abc import Iterator

import pytest

from fleet.errors import MAX_NAME
from scenarios.cli.main import COMMANDS, load_command

HUGE = "9" * 30
WRONG = {int: (HUGE, f"-{HUGE}"), float: (HUGE, f"-{HUGE}", "nan", "inf", "-inf")}


def numbers() -> Iterator[tuple[tuple[str, ...], str, type]]:
    """Words of a command, one of its numeric options, and its type."""
    for name in COMMANDS:
        for option in load_command(name).params:
            kind = option.type_descriptor.annotation if option.param_type_name == "option" else None
            if kind in WRONG:
                yield tuple(name.split()), option.opts[0], kind


NUMBERS = list(numbers())


@pytest.mark.parametrize(("words", "option", "kind"), NUMBERS, ids=[" ".join((*w, o)) for w, o, _ in NUMBERS])
def test_a_number_out_of_range_is_refused_in_one_sentence(thermofleet, words, option, kind):
    for value in WRONG[kind]:
        said = thermofleet(*words, f"{option}={value}")
        assert said.code == 2, value
        assert said.err.startswith(f"Error: {option} must be ")
        assert said.err.count("\n") == 1
        assert said.out == ""


@pytest.mark.parametrize(
    "words",
    [
        ("bus", "auctioneer", "--name"),
        ("bus", "record"),
        ("arm", "run", "quickstart"),
        ("bus", "ros2", "listen", "--arm"),
    ],
)
@pytest.mark.parametrize("name", ["", "a/b", "a\nb", "x" * (MAX_NAME + 1), "\udcff"])
def test_a_name_of_another_form_is_refused(thermofleet, words, name):
    said = thermofleet(*words, name)
    assert said.code == 2
    assert f"1 to {MAX_NAME} printable characters" in said.err
    assert said.err.count("\n") == 1
