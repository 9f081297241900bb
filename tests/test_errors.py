"""Lists of names in error messages."""

import pytest

from fleet.errors import MOST_LISTED, listed, nearest


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
