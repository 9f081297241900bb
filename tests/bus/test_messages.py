"""Keys, messages and their documents: what is built is parsed back to the last bit, and rubbish is refused."""

import copy
import json
import math
import re
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from msgspec.structs import replace

from docs.bus_contract import EXAMPLES, asyncapi, descriptions, schema_document
from docs.tables import fill_tables, main
from fleet.bus.client import BusClient
from fleet.bus.protocol import auction as trade
from fleet.bus.protocol import keys, messages
from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.keys import ASKED, CHANNELS, MESSAGES, NAMELESS, TOPICS, ParsedKey, channel_of
from fleet.bus.protocol.messages import (
    DifficultyScores,
    Info,
    MalformedMessage,
    PersonRequest,
    State,
    check_name,
    decode,
    encode,
    encoding,
)
from fleet.bus.protocol.operator import (
    Change,
    ClearRequest,
    ControlRequest,
    Operation,
    ResetRequest,
    check_request,
)
from fleet.errors import is_name
from fleet.events import EVENT_KINDS, MEANINGS
from fleet.live.arm.body import _REPORTED

chunks = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cf"]), min_size=1, max_size=30).filter(is_name)
wild = st.sampled_from(["*", "**", "@", "@v1", "a b", "$*", "?", "#", "%", "%2F", "ä", "机", "a.b", "a.."])
PLACES = [(role, topic) for role, topics in TOPICS.items() for topic in topics]


def keys_at(places: list[tuple[str, str]]) -> st.SearchStrategy[ParsedKey]:
    """Keys of some roles and topics."""
    return st.sampled_from(places).flatmap(
        lambda place: st.builds(
            ParsedKey,
            fleet=chunks | wild,
            role=st.just(place[0]),
            name=st.just("") if place[0] in NAMELESS else chunks | wild,
            topic=st.just(place[1]),
            asker=chunks | wild if place[1] in ASKED else st.just(""),
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
        "thermofleet/v1/f/arm/a/state",
        "thermofleet/v4/f/arm/*/state",
        "thermofleet/v4/**",
        "thermofleet/v4/f/arm//state",
        "thermofleet/v4/f/arm/a/announce",
        "thermofleet/v4/f/auction/a/lease",
        "thermofleet/v4/f/auction/a/lease/*",
        "thermofleet/v4/f/auction/a/result/x",
        "thermofleet/v4/f/arm/a/claim",
        "thermofleet/v4/f/jobs/a/submit",
        "thermofleet/v4/f/arm/state",
        "thermofleet/v4/f/arm/a%zz/state",
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


def test_nobody_speaks_for_another_arm_and_only_what_an_arm_asks_as_itself_ends_in_its_name():
    with pytest.raises(ValueError, match=r"Keys of 'result' do not end in a querier's name \(got 'x'\)"):
        str(ParsedKey("f", "auction", "a", "result", "x"))
    with pytest.raises(ValueError, match="must have 1 to 128"):
        str(ParsedKey("f", "auction", "a", "lease"))
    with pytest.raises(MalformedMessage, match="'arm_1' claims to be by 'arm_0'"):
        received(State, encode(STATE), "arm_1")


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


def test_neither_many_nor_long_keys_fill_the_memory():
    for i in range(2 * keys.MAX_CACHED):
        keys.parse(keys.of_arm("f", f"arm_{i}", "state"))
    assert keys._parse_cached.cache_info().currsize == keys.MAX_CACHED
    long = keys.of_arm("f", "机" * 100, "state")
    assert keys.parse(long) is not keys.parse(long)


numbers = st.floats(-1e12, 1e12)
names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12)
ticks = st.integers(0, 2**40)
states = st.builds(
    State,
    arm=names,
    tick=ticks,
    time_s=numbers,
    mode=st.sampled_from(["idle", "working", "faulted"]),
    temp_c=st.lists(numbers, max_size=8).map(tuple),
    headroom_k=numbers,
)


@st.composite
def difficulty_words(draw):
    jobs = tuple(draw(st.lists(names, max_size=5, unique=True)))

    def columns(most):
        return draw(st.lists(st.none() | st.floats(0, most), min_size=len(jobs), max_size=len(jobs)).map(tuple))

    plans = draw(st.integers(0, 3)) * len(jobs)

    def bids(values):
        return draw(st.lists(st.none() | values, min_size=plans, max_size=plans).map(tuple))

    return DifficultyScores(
        *(draw(names), draw(ticks), draw(numbers), draw(names), jobs, columns(1e6), columns(1)),
        bid_duration_s=bids(st.floats(0, 1e6)),
        bid_peak_c=bids(st.floats(-50, 200)),
        bid_p_saturation=bids(st.floats(0, 1)) if draw(st.booleans()) else (),
    )


infos = st.builds(Info, arm=names, joints=st.integers(1, 9), twin=names)
STATE = State("arm_0", 3, 30.0, "working", (41.5, 40.0), 18.5)


def received(kind, payload, arm):
    """The message that came under the key of an arm."""
    message = decode(kind, payload)
    check_name(message, arm, "arm")
    return message


@given(states | difficulty_words() | infos)
def test_what_is_said_arrives_to_the_last_bit(message):
    assert received(type(message), encode(message), message.arm) == message


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("message", "field", "value"),
    [
        (STATE, "time_s", lambda bad: bad),
        (STATE, "temp_c", lambda bad: (20.0, bad)),
        (EXAMPLES[DifficultyScores], "difficulty", lambda bad: (bad,)),
    ],
    ids=["number", "list", "unknown or a number"],
)
def test_no_number_is_said_that_is_none(message, field, value, bad):
    with pytest.raises(ValueError, match=rf"\.{field} must be finite"):
        replace(message, **{field: value(bad)})


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"null",
        b"[]",
        b"{",
        b"\xff\xfe",
        b"[" * 100_000,
        encode(STATE).replace(b"working", b"asleep"),
        encode(STATE).replace(b"18.5", b"NaN"),
        encode(STATE).replace(b"18.5", b"1e999"),
    ],
)
def test_a_malformed_state_is_refused_with_words(payload):
    with pytest.raises(MalformedMessage, match=r"thermofleet\.State\.v4"):
        received(State, payload, "arm_0")


@pytest.mark.parametrize("number", ["NaN", "nan", "Infinity", "-Infinity", "-inf"])
@pytest.mark.parametrize(("before", "field"), [(b"18.5", "'headroom_k'"), (b"21.25", "'temp_c'")])
def test_a_number_that_json_does_not_have_is_named_with_its_field(number, before, field):
    state = replace(STATE, headroom_k=18.5, temp_c=(20.0, 21.25))
    payload = encode(state).replace(before, number.encode())
    at = payload.index(number.encode())
    says = rf"State\.v4: {field} is {number} \(byte \d+\), which JSON does not have; send a finite number$"
    with pytest.raises(MalformedMessage, match=says) as raised:
        received(State, payload, "arm_0")
    named = int(re.search(r"byte (\d+)", str(raised.value))[1])
    assert at <= named <= at + len(number) + 1


def test_a_name_that_reads_as_no_number_is_not_taken_for_one():
    payload = encode(replace(STATE, job="NaN")).replace(b'"NaN"', b'"NaN"?')
    with pytest.raises(MalformedMessage, match="JSON is malformed: ") as raised:
        received(State, payload, "arm_0")
    assert "finite" not in str(raised.value)


QUOTE = trade.Quote("a", "r", "q", 3.0, "t", 1.0, "idle", 20.0, 1, (trade.JobEstimate("j", (trade.PlanQuote(),)),))


@pytest.mark.parametrize(
    "change",
    [
        {"difficulty": -9.0},
        {"joint_difficulty": (0.1, -0.1)},
        {"peak_c": 1001.0},
        {"peak_c": -300.0},
        {"valid_s": -5.0},
    ],
    ids=str,
)
def test_a_quote_with_impossible_numbers_is_refused(change):
    def quote(**change):
        plan = replace(trade.PlanQuote(), **{name: value for name, value in change.items() if name != "valid_s"})
        valid_s = change.get("valid_s", 0.0)
        return replace(QUOTE, valid_s=valid_s, estimates=(trade.JobEstimate("j", (plan,)),))

    assert received(trade.Quote, encode(quote(difficulty=0.0, peak_c=59.9)), "a").estimates[0].plans[0].peak_c == 59.9
    with pytest.raises(MalformedMessage, match=r"thermofleet\.Quote\.v4"):
        received(trade.Quote, encode(quote(**change)), "a")


def test_a_state_whose_work_ends_in_the_past_is_refused():
    with pytest.raises(MalformedMessage, match="busy_s"):
        received(State, encode(replace(STATE, busy_s=-50.0)), "arm_0")


def test_an_integer_is_a_number_and_an_encoding_has_a_version():
    assert received(State, encode(STATE).replace(b"18.5", b"18"), "arm_0").headroom_k == 18.0
    assert encoding(State) == "application/json;thermofleet.State.v4"


ROOT = Path(__file__).parents[2]
DOCUMENT = schema_document()
VALIDATORS = {
    word: Draft202012Validator({"$ref": f"#/$defs/{word.__name__}", "$defs": DOCUMENT["$defs"]}) for word in MESSAGES
}

NAMED = [pytest.param(word, id=word.__name__) for word in MESSAGES]
JUNK = st.sampled_from([None, True, -1, 0, 2.5, "", "x", [], [0.5], [""], {}, 10**9, "idle"])


def example(word):
    """The specimen of a word as plain JSON values."""
    return json.loads(messages.encode(EXAMPLES[word]))


def refused(word, value) -> str:
    """Why the struct refuses a value: "" if it does not, "schema" for its types and bounds, "rule" for any other."""
    try:
        messages.decode(word, json.dumps(value).encode())
    except MalformedMessage as error:
        by_rule = isinstance(error.__cause__, BaseException) and isinstance(error.__cause__.__cause__, ValueError)
        return "rule" if by_rule and " must be between " not in str(error) else "schema"
    return ""


def places(value, path=()):
    """Paths to every field and item of a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, part in items:
        yield (*path, name)
        yield from places(part, (*path, name))


def test_the_schemas_are_schemas_and_every_word_has_an_example():
    Draft202012Validator.check_schema(DOCUMENT)
    assert set(EXAMPLES) == set(MESSAGES)


@pytest.mark.parametrize("word", NAMED)
def test_an_example_is_accepted_by_struct_and_schema(word):
    later = {**example(word), "from a later version": 1}
    for value in (example(word), later):
        VALIDATORS[word].validate(value)
        assert (refused(word, value) == "") == (value is not later or not issubclass(word, PersonRequest))
    assert messages.decode(word, messages.encode(EXAMPLES[word])) == EXAMPLES[word]


@pytest.mark.parametrize("word", NAMED)
@given(data=st.data())
def test_struct_and_schema_refuse_the_same(word, data):
    value = copy.deepcopy(example(word))
    changes = data.draw(st.integers(1, 2))
    for _ in range(changes):
        all_places = list(places(value))
        if not all_places:
            break
        *path, last = data.draw(st.sampled_from(all_places))
        where = value
        for name in path:
            where = where[name]
        if data.draw(st.booleans()):
            where[last] = copy.deepcopy(data.draw(JUNK))
        else:
            del where[last]
    why = refused(word, value)
    if why != "rule":
        assert VALIDATORS[word].is_valid(value) == (why == ""), (why, value)
    elif changes == 1:  # two could break a rule and the schema
        assert VALIDATORS[word].is_valid(value)


@pytest.mark.parametrize(
    ("word", "change"),
    [
        (messages.State, {"q": [0.0]}),
        (messages.DifficultyScores, {"difficulty": [0.1]}),
        (messages.DifficultyScores, {"jobs": ["twice", "twice"]}),
        (messages.DifficultyScores, {"bid_duration_s": [60.0, 70.0, 80.0], "bid_peak_c": [50.0, 51.0, 52.0]}),
        (messages.DifficultyScores, {"bid_duration_s": [60.0, 70.0], "bid_peak_c": [50.0]}),
        (messages.DifficultyScores, {"bid_duration_s": [60.0, 70.0], "bid_peak_c": [], "bid_p_saturation": []}),
        (messages.DifficultyScores, {"bid_p_saturation": [0.5]}),
        (JobSpec, {"places": ["one"]}),
        (JobSpec, {"kind": "hold"}),
        (JobSpec, {"release_s": 10.0, "due_s": 9.0}),
    ],
)
def test_what_only_the_structs_refuse(word, change):
    whole = example(trade.Submission)["jobs"][0] if word is JobSpec else example(word)
    value = {**whole, **change}
    assert Draft202012Validator({"$ref": f"#/$defs/{word.__name__}", "$defs": DOCUMENT["$defs"]}).is_valid(value)
    assert refused(word, value) == "rule"


HOLD = {"name": "a", "kind": "hold", "places": ["rack"]}


@pytest.mark.parametrize(
    ("word", "value", "says"),
    [
        (
            trade.Submission,
            {"jobs": [HOLD], "bye": "ann"},
            "Unknown field 'bye'; did you mean 'by'? Allowed: by, jobs.",
        ),
        (
            trade.Submission,
            {"jobs": [HOLD, {**HOLD, "payloadkg": 1}]},
            "Unknown field 'payloadkg' in jobs[1]; did you mean 'payload_kg'? Allowed: after, alternatives, ",
        ),
        (
            ControlRequest,
            {"request": "1", "action": {"action": "resume", "arms": "arm_0"}},
            "Unknown field 'arms' in action; did you mean 'arm'? Allowed: action, arm.",
        ),
        (
            ControlRequest,
            {"request": "1", "action": {"job": "a", "action": "change", "due": 5}},
            "Unknown field 'due' in action; did you mean 'due_s'? Allowed: action, due_s, job, value.",
        ),
        (ClearRequest, {"arm": "a", "force": True}, "Unknown field 'force'. Allowed: arm, by."),
        (ResetRequest, {"name": "ann"}, "Unknown field 'name'. Allowed: by."),
    ],
)
def test_people_are_told_of_a_field_that_is_mistyped(word, value, says):
    with pytest.raises(MalformedMessage, match=re.escape(says)):
        decode(word, json.dumps(value).encode())


def test_participants_may_send_fields_of_a_later_version():
    value = {"auction": "1", "jobs": [{**HOLD, "colour": "red"}]}
    assert decode(trade.QuoteRequest, json.dumps(value).encode()).jobs[0].name == "a"
    operation = json.loads(encode(EXAMPLES[Operation]))
    operation["request"]["later"] = operation["request"]["action"]["later"] = 1
    assert decode(Operation, json.dumps(operation).encode()) == EXAMPLES[Operation]


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        (ControlRequest("1", Change("a")), "Change needs due_s, value or both (got neither)."),
        (
            trade.Submission((JobSpec("a", "hold", ("rack",), expires=True),)),
            "Job 'a': JobSpec.due_s is missing: a hard due date needs a time.",
        ),
        (
            trade.Submission((JobSpec("a", "hold", ("rack",), force_n=10.0),)),
            "Job 'a': JobSpec.force_n must be 0 or left out: only a press has a contact force (got 10 N for a hold).",
        ),
    ],
)
def test_a_request_without_effect_is_refused(request_, says):
    with pytest.raises(MalformedMessage, match=re.escape(says)):
        check_request(decode(type(request_), encode(request_)))


@pytest.mark.parametrize("word", NAMED)
def test_every_required_field_is_required_by_both(word):
    for name in DOCUMENT["$defs"][word.__name__].get("required", ()):
        value = {field: part for field, part in example(word).items() if field != name}
        assert not VALIDATORS[word].is_valid(value)
        assert refused(word, value) == "schema"


def test_a_whole_number_written_with_a_point_is_the_one_known_difference():
    """JSON schema takes 3.0 for an integer, the structs do not; docs/bus/messages.md says so."""
    value = {**example(messages.State), "tick": 3.0}
    assert VALIDATORS[messages.State].is_valid(value)
    assert refused(messages.State, value) == "schema"
    assert "`3`, not `3.0`" in (ROOT / "docs" / "bus" / "messages.md").read_text(encoding="utf-8")


def test_fields_are_described_by_the_text_under_them():
    assert descriptions(messages.State)["tau"] == "N·m at the joint output, [joint]."
    assert descriptions(JobSpec)["payload_kg"].startswith("Carried from grasp to release")
    assert descriptions(JobSpec)["release_s"] == "Earliest start, fleet time."


def test_asyncapi_has_every_key_and_no_loose_end():
    document = asyncapi()
    assert [channel["address"] for channel in document["channels"].values()] == [c.address for c in CHANNELS]
    for action in ("send", "receive"):  # both sides of every key with messages
        done = [each["channel"]["$ref"] for each in document["operations"].values() if each["action"] == action]
        assert done == [f"#/channels/{c.name}" for c in CHANNELS if c.message is not None]
    assert "security" in document["servers"]["routerTls"]
    assert '"bindings"' not in json.dumps(document)  # AsyncAPI knows none of Zenoh

    def references(value):
        if isinstance(value, dict):
            if isinstance(value.get("$ref"), str):
                yield value["$ref"]
            for part in value.values():
                yield from references(part)
        elif isinstance(value, list):
            for part in value:
                yield from references(part)

    for reference in set(references(document)):
        where = document
        for name in reference.removeprefix("#/").split("/"):
            where = where[name]
    for message in document["components"]["messages"].values():
        schema = {"$ref": message["payload"]["$ref"], "components": document["components"]}
        Draft202012Validator(schema).validate(message["examples"][0]["payload"])


@pytest.mark.parametrize("channel", CHANNELS, ids=lambda channel: channel.name)
def test_a_key_is_used_as_the_registry_says_or_not_at_all(channel):
    key = channel.address.format(fleet="f", arm="a", auctioneer="a", policy="a", monitor="a", peer="b")
    assert channel_of(key) is channel
    parsed = keys.parse(key)
    assert (parsed.role, parsed.topic) == (channel.role, channel.topic)
    assert channel_of(key.replace("/a/", "/*/")) is channel
    client = BusClient("tcp/127.0.0.1:1", "f")
    with pytest.raises(ValueError, match="is for"):
        client.publisher(key, messages.Refusal)
    with pytest.raises(ValueError, match="is for"):
        client.subscribe(key, messages.Refusal, print)
    with pytest.raises(ValueError, match="is for"):
        client.reply_to(key, messages.Refusal, print)


@pytest.mark.ci_slow
def test_the_committed_documents_are_current(capsys):
    assert main(["--check"]) == 0
    printed = capsys.readouterr().out
    for name in ("schemas.json", "asyncapi.json", *(f"{page}.md" for page in ("messages", "cli", "env", "policies"))):
        assert name in printed


def test_stale_documents_are_named_and_made_anew(tmp_path, capsys):
    docs = ["--docs", str(tmp_path)]
    assert main([*docs, "--check"]) == 1
    assert "schemas.json" in capsys.readouterr().out
    assert not (tmp_path / "contract").exists()
    (tmp_path / "bus.md").write_text("a\n<!-- made by docs/tables.py: patterns -->\nold\n<!-- end -->\nz\n")
    assert main(docs) == 0
    page = (tmp_path / "bus.md").read_text()
    assert "old" not in page
    assert page.startswith("a\n")
    assert page.endswith("<!-- end -->\nz\n")
    assert fill_tables(page) == page
    assert main([*docs, "--check"]) == 0


def test_every_kind_of_event_has_a_meaning_and_live_ones_are_those_that_arms_report():
    live = {kind for kind, meaning in MEANINGS.items() if meaning.live}
    assert tuple(MEANINGS) == EVENT_KINDS
    assert live == {*_REPORTED, "award", "finish", "return", "break", "break_end"}
    page = Path("docs/bus/messages.md").read_text(encoding="utf-8")
    assert all(f"| `{kind}` | {meaning.text} | {meaning.value} |" in page for kind, meaning in MEANINGS.items())
