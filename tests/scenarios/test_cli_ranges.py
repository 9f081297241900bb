"""Every number on the command line has a range, and every name a form."""

from collections.abc import Callable, Iterator
from typing import Annotated, get_args, get_origin, get_type_hints

import pytest
import typer

from fleet.errors import MAX_NAME
from scenarios.cli.main import COMMANDS, target_of

HUGE = "9" * 30
WRONG = {int: (HUGE, f"-{HUGE}"), float: (HUGE, f"-{HUGE}", "nan", "inf", "-inf")}


def functions() -> Iterator[tuple[tuple[str, ...], Callable[..., None]]]:
    """Words of every command, and its function."""
    for name in COMMANDS:
        target = target_of(name)
        if isinstance(target, typer.Typer):
            yield from (((name, str(each.name)), each.callback) for each in target.registered_commands if each.callback)
        else:
            yield (name,), target


def numbers() -> Iterator[tuple[tuple[str, ...], str, type]]:
    """Words of a command, one of its numeric options, and its type."""
    for words, function in functions():
        for name, hint in get_type_hints(function, include_extras=True).items():
            if get_origin(hint) is not Annotated:
                continue
            kind, option, *_ = get_args(hint)
            for number in (int, float):
                if kind is number or number in get_args(kind):
                    given = isinstance(option.default, str)  # typer keeps the name of an option in `default`
                    yield words, option.default if given else f"--{name.replace('_', '-')}", number


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
    "words", [("auction", "--name"), ("record",), ("arm", "quickstart"), ("ros2", "listen", "--arm")]
)
@pytest.mark.parametrize("name", ["", "a/b", "a\nb", "x" * (MAX_NAME + 1), "\udcff"])
def test_a_name_of_another_form_is_refused(thermofleet, words, name):
    said = thermofleet(*words, name)
    assert said.code == 2
    assert f"1 to {MAX_NAME} printable characters" in said.err
    assert said.err.count("\n") == 1
