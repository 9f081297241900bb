"""Lists of names, and numbers beside a bound, in error messages."""

from math import nextafter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.arm.kinematics import _out_of_reach
from fleet.errors import MOST_LISTED, distinguish, listed, nearest
from fleet.fields import Option


def test_few_names_are_all_named():
    names = [f"name_{number}" for number in range(MOST_LISTED)]
    assert nearest("?", names) == f". Allowed: {', '.join(sorted(names))}."
    assert listed(names) == ", ".join(names)
    assert listed(()) == "none"


@pytest.mark.parametrize(
    ("given", "hint"),
    [
        ("crate_7x", "; did you mean 'crate_7'? The most similar of 300: crate_7, "),
        ("?", ". The most similar of 300: "),
    ],
)
def test_of_many_names_only_the_most_similar_are_named(given, hint):
    told = nearest(given, [f"crate_{number}" for number in range(300)])
    assert told.startswith(hint)
    assert told.partition("300: ")[2].count("crate_") == 5


def test_a_long_list_says_how_many_more_there_are():
    assert listed(range(300)).endswith(f"{MOST_LISTED - 1}, and {300 - MOST_LISTED} more")


@pytest.mark.parametrize(
    ("one", "other", "texts"),
    [
        (144.13, 144.12, ("144.13", "144.12")),
        (80.0, 59.0, ("80", "59")),
        (2.0, 2.0, ("2", "2")),
        (144.1, nextafter(144.1, 145), ("144.1", "144.10000000000002")),
        (1e6, 691.19, ("1e+06", "691.2")),
    ],
)
def test_two_numbers_have_as_many_digits_as_they_need(one, other, texts):
    assert distinguish(one, other) == texts


numbers = st.floats(-1e300, 1e300)


@given(numbers, numbers)
def test_two_numbers_differ_as_texts_if_they_do(one, other):
    first, second = distinguish(one, other)
    assert first != second or one == other
    assert abs(float(first) - one) <= 1e-3 * abs(one)


def test_a_number_that_is_hardly_too_large_is_not_the_bound_in_words():
    assert _out_of_reach(0.902585, 0.0) == "reach: 0.902585 m from the shoulder, the arm has 0.902575 m"
    option = Option(help="", low=0.0, high=10.0, kind=float)
    assert option.problem("--lr", 10.0000001) == "--lr must be 0 to 10 (got 10.0000001)."
