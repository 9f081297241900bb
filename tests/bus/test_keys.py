"""Keys: what is built is parsed back, and no name can leave its chunk."""

import re

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol import keys
from fleet.bus.protocol.keys import ASKED, NAMELESS, TOPICS, Key
from fleet.errors import is_name

names = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cf"]), min_size=1, max_size=30).filter(is_name)
wild = st.sampled_from(["*", "**", "@", "@v1", "a b", "$*", "?", "#", "%", "%2F", "ä", "机", "a.b", "a.."])
PLACES = [(role, topic) for role, topics in TOPICS.items() for topic in topics]


def keys_at(places: list[tuple[str, str]]) -> st.SearchStrategy[Key]:
    """Keys of some roles and topics."""
    return st.sampled_from(places).flatmap(
        lambda place: st.builds(
            Key,
            fleet=names | wild,
            role=st.just(place[0]),
            name=st.just("") if place[0] in NAMELESS else names | wild,
            topic=st.just(place[1]),
            asker=names | wild if place[1] in ASKED else st.just(""),
        )
    )


concrete = keys_at(PLACES)


@given(concrete)
def test_a_parsed_key_is_the_key_that_was_built(key):
    assert keys.parse(str(key)) == key


@given(concrete)
def test_every_chunk_is_legal_and_visible_to_wildcards(key):
    chunks = str(key).split("/")
    assert all(chunks)
    assert not any(chunk.startswith("@") for chunk in chunks)
    assert not set("*$?#@ ") & set(str(key))
    assert str(key).isascii()


@given(concrete, concrete)
def test_different_names_have_different_keys(one, other):
    assert (str(one) == str(other)) == (one == other)


@given(concrete, concrete)
def test_all_of_one_is_what_it_says_and_no_word_of_another(one, other):
    """Zenoh itself is asked what the key expressions include."""
    own = zenoh.KeyExpr(keys.all_of(one.fleet, one.role, one.name))
    assert own.includes(str(one))
    assert own.includes(str(other)) == ((one.fleet, one.role, one.name) == (other.fleet, other.role, other.name))
    assert zenoh.KeyExpr(keys.all_of_fleet(one.fleet)).includes(str(other)) == (one.fleet == other.fleet)
    assert zenoh.KeyExpr(keys.STATES).includes(str(one)) == ((one.role, one.topic) == ("arm", "state"))
    cache = f"{one}/@adv/pub/1/2"
    assert not own.includes(cache)
    assert zenoh.KeyExpr(keys.caches_of(str(own))).includes(cache)


@pytest.mark.parametrize(
    ("built", "written"),
    [
        (keys.of_arm("f", "arm_0", "state"), "thermofleet/v4/f/arm/arm_0/state"),
        (keys.of_arm("hall 2", "a+b", "alive"), "thermofleet/v4/hall%202/arm/a%2Bb/alive"),
        (keys.of_every_arm("x", "difficulty"), "thermofleet/v4/x/arm/*/difficulty"),
        (keys.of_auction("f", "@boss", "announce"), "thermofleet/v4/f/auction/%40boss/announce"),
        (keys.of_jobs("f", "submit"), "thermofleet/v4/f/jobs/submit"),
        (keys.of_clock("f"), "thermofleet/v4/f/clock/now"),
        (keys.of_every_auction("f", "result"), "thermofleet/v4/f/auction/*/result"),
        (keys.asked_by("f", "a", "lease", "arm 1&b"), "thermofleet/v4/f/auction/a/lease/arm%201%26b"),
        (keys.asked_by_every_arm("f", "x", "report"), "thermofleet/v4/f/auction/x/report/*"),
        (keys.asked_of_all("f", "report", "x"), "thermofleet/v4/f/auction/*/report/x"),
        (keys.asked_by("f", "a", "claim", "arm 1&b"), "thermofleet/v4/f/arm/a/claim/arm%201%26b"),
        (keys.asked_by_every_arm("f", "x", "claim"), "thermofleet/v4/f/arm/x/claim/*"),
        (keys.asked_of_all("f", "claim", "x"), "thermofleet/v4/f/arm/*/claim/x"),
    ],
)
def test_keys_are_written_as_the_design_says(built, written):
    assert built == written


@pytest.mark.parametrize(
    "text",
    [
        "",
        "thermofleet/v4",
        "thermofleet/v1/f/arm/a/state",
        "other/v4/f/arm/a/state",
        "thermofleet/v4/f/arm/*/state",
        "thermofleet/v4/**",
        "thermofleet/v4/f/arm//state",
        "thermofleet/v4//arm/a/state",
        "thermofleet/v4/f/arm/a/state/x",
        "thermofleet/v4/f/arm/a/announce",
        "thermofleet/v4/f/auction/a/state",
        "thermofleet/v4/f/auction/a/lease",
        "thermofleet/v4/f/auction/a/lease/",
        "thermofleet/v4/f/auction/a/lease/*",
        "thermofleet/v4/f/auction/a/lease/%61",
        "thermofleet/v4/f/auction/a/lease/x/y",
        "thermofleet/v4/f/auction/a/result/x",
        "thermofleet/v4/f/arm/a/lease/x",
        "thermofleet/v4/f/arm/a/claim",
        "thermofleet/v4/f/auction/a/claim/x",
        "thermofleet/v4/f/jobs/a/lease/x",
        "thermofleet/v4/f/jobs/a/submit",
        "thermofleet/v4/f/arm/state",
        "thermofleet/v4/f/robot/a/state",
        "thermofleet/v4/f/arm/a%zz/state",
        "thermofleet/v4/f/arm/%ff/state",
        "thermofleet/v4/f/arm/a b/state",
        "thermofleet/v4/f/arm/%61/state",
        "thermofleet/v4/f/arm/a%2f/state",
        "thermofleet/v4/@f/arm/a/state",
    ],
)
def test_what_is_no_concrete_key_is_refused(text):
    with pytest.raises(ValueError, match=re.escape(f"'{text}'")):
        keys.parse(text)


@given(keys_at([place for place in PLACES if place[1] in ASKED]))
def test_an_answer_goes_under_the_key_of_the_one_who_asked(key):
    everybody = keys.asked_by_every_arm(key.fleet, key.name, key.topic)
    assert zenoh.KeyExpr(everybody).includes(str(key))
    assert keys.answered(everybody, str(key)) == str(key)
    assert keys.answered(everybody, keys.asked_of_all(key.fleet, key.topic, key.asker)) == str(key)
    assert keys.answered("any/concrete/key", str(key)) == "any/concrete/key"


@pytest.mark.parametrize(
    "asked", ["auction/a/lease/*", "auction/a/lease/%61", "auction/a/**", "**", "auction/a/lease/$*"]
)
def test_who_asks_as_nobody_is_not_answered(asked):
    with pytest.raises(ValueError, match=r"no key of this bus|not written|no such place"):
        keys.answered(keys.asked_by_every_arm("f", "a", "lease"), f"thermofleet/v4/f/{asked}")


def test_only_what_an_arm_asks_as_itself_ends_in_a_name():
    with pytest.raises(ValueError, match=r"Keys of 'result' do not end in a querier's name \(got 'x'\)"):
        str(Key("f", "auction", "a", "result", "x"))
    with pytest.raises(ValueError, match="must have 1 to 128"):
        str(Key("f", "auction", "a", "lease"))


@given(st.text(max_size=60))
def test_any_text_is_parsed_or_refused(text):
    try:
        key = keys.parse(text)
    except ValueError:
        return
    assert str(key) == text


@pytest.mark.parametrize("name", ["", "\ud800", "a/b", "..", "a\u202eb", "a\nb", "x" * 129])
def test_names_that_cannot_be_written_are_refused(name):
    with pytest.raises(ValueError, match="name"):
        keys.of_arm("f", name, "state")
    with pytest.raises(ValueError, match="name"):
        keys.of_auction(name, "a", "result")


def test_a_key_that_was_read_before_is_not_taken_apart_again_unless_it_is_very_long():
    short, long = (keys.of_arm("f", name, "state") for name in ("arm_0", "机" * 100))
    assert keys.parse(short) is keys.parse(short)
    assert keys.parse(long) == keys.parse(long)
    assert keys.parse(long) is not keys.parse(long)


def test_many_keys_fill_no_memory():
    for i in range(2 * keys.MAX_CACHED):
        keys.parse(keys.of_arm("f", f"arm_{i}", "state"))
    assert keys._parse_cached.cache_info().currsize == keys.MAX_CACHED
