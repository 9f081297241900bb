"""The documents of the bus say what the structs say: checked with a validator that is not ours."""

import ast
import copy
import json
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from docs.tables import fill_tables, main
from fleet.bus.client import BusClient
from fleet.bus.protocol import auction as trade
from fleet.bus.protocol import keys, messages
from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.contract import EXAMPLES, asyncapi, descriptions, schema_document
from fleet.bus.protocol.keys import CHANNELS, MESSAGES, channel_of
from fleet.bus.protocol.messages import MalformedMessage
from fleet.events import EVENT_KINDS, MEANINGS
from fleet.live.arm.body import _REPORTED

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


def test_every_key_of_the_bus_is_in_the_contract():
    topics = {(role, topic) for role, all_topics in keys.TOPICS.items() for topic in all_topics}
    assert {(channel.role, channel.topic) for channel in CHANNELS} == topics
    assert len(CHANNELS) == len(topics)


@pytest.mark.parametrize("channel", CHANNELS, ids=lambda channel: channel.name)
def test_an_address_filled_in_is_a_key(channel):
    key = channel.address.format(fleet="f", arm="a", auctioneer="a", policy="a", peer="b")
    parsed = keys.parse(key)
    assert (parsed.role, parsed.topic) == (channel.role, channel.topic)


def test_every_word_has_an_example():
    assert set(EXAMPLES) == set(MESSAGES)


def test_the_schemas_are_schemas():
    Draft202012Validator.check_schema(DOCUMENT)


@pytest.mark.parametrize("word", NAMED)
def test_an_example_is_accepted_by_struct_and_schema(word):
    for value in (example(word), {**example(word), "from a later version": 1}):
        VALIDATORS[word].validate(value)
        assert refused(word, value) == ""
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


@pytest.mark.parametrize(
    ("nodes", "role"),
    [
        (("arm/node", "consensus/node"), "arm"),
        (("auction/node",), "auction"),
    ],
)
def test_the_participants_publish_and_answer_as_the_contract_says(nodes, role):
    """Read from their source: `link.publisher(keys.of_…(…, "topic"), Kind)` and `link.reply_to(…)`."""
    source = "\n".join((ROOT / "fleet" / "live" / f"{node}.py").read_text(encoding="utf-8") for node in nodes)
    found = {}
    for call in ast.walk(ast.parse(source)):
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and len(call.args) > 1):
            continue
        if call.func.attr in ("publisher", "reply_to") and isinstance(call.args[0], ast.Call):
            key = ast.unparse(call.args[0])
            topic = re.search(r"'(\w+)'\)$", key)
            place = {"asked_by_every_arm": role}.get(key.split(".")[1].split("(")[0]) or key.split("of_")[1]
            found[place.split("(")[0], topic[1] if topic else "now"] = ast.unparse(call.args[1])
    expected = {
        (channel.role, channel.topic): channel.message.__name__
        for channel in CHANNELS
        if channel.message is not None
        # Where there is no auctioneer, arms reply to outsiders.
        and (channel.sender == {"arm": "arm", "auction": "auctioneer"}[role] or channel.role in keys.NAMELESS)
    }
    assert found == expected


@pytest.mark.parametrize("channel", CHANNELS, ids=lambda channel: channel.name)
def test_a_key_is_used_as_the_registry_says_or_not_at_all(channel):
    key = channel.address.format(fleet="f", arm="a", auctioneer="a", policy="a", peer="b")
    assert channel_of(key) is channel
    assert channel_of(key.replace("/a/", "/*/")) is channel
    client = BusClient("tcp/127.0.0.1:1", "f")
    with pytest.raises(ValueError, match="is for"):
        client.publisher(key, messages.Refusal)
    with pytest.raises(ValueError, match="is for"):
        client.subscribe(key, messages.Refusal, print)
    with pytest.raises(ValueError, match="is for"):
        client.reply_to(key, messages.Refusal, print)


def test_no_binding_is_claimed_that_asyncapi_does_not_know():
    assert '"bindings"' not in json.dumps(asyncapi())


def test_the_committed_documents_are_current(capsys):
    assert main(["--check"]) == 0
    names = (
        "schemas.json",
        "asyncapi.json",
        "messages.md",
        "cli.md",
        "env.md",
        "leaderboard.md",
        "paper.md",
        "policies.md",
    )
    printed = capsys.readouterr().out
    assert all(name in printed for name in names)


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
    assert live == {*_REPORTED, "award", "finish", "return"}
    page = Path("docs/bus/messages.md").read_text(encoding="utf-8")
    assert all(f"| `{kind}` | {meaning.text} | {meaning.value} |" in page for kind, meaning in MEANINGS.items())


def test_the_table_of_a_job_has_the_unit_of_every_bounded_field():
    page = Path("docs/bus/messages.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in page.partition("### JobSpec")[2].partition("### ")[0].splitlines()]
    units = {row[0].strip("| `"): row[2] for row in rows if len(row) == 5}
    assert {name: units[name].strip() for name in ("payload_kg", "force_n", "dwell_s", "due_s", "value")} == {
        "payload_kg": "kg",
        "force_n": "N",
        "dwell_s": "s",
        "due_s": "s",
        "value": "",
    }
