"""Who may do what, as rules and as the documentation has it."""

import re
from itertools import product
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol import keys
from fleet.bus.protocol.keys import ASKED, NAMELESS, TOPICS
from fleet.bus.security.access_control import ROLES, Participant, access_control, of_arms, rights
from fleet.errors import BusError

DOCS = (Path(__file__).parents[2] / "docs" / "security.md").read_text(encoding="utf-8")
ARMS = ("arm_0", "arm_1", "arm 2+*@", "arm_10")
NAMES = {"auction": ("auctioneer", "other"), "policy": ("mine", "other")}
EVERY_KEY = [
    str(keys.Key("f", role, name, topic, asker))
    for role, topics in TOPICS.items()
    for topic in topics
    for name in ([""] if role in NAMELESS else NAMES.get(role, ARMS))
    for asker in (ARMS if topic in ASKED else [""])
]


def documented() -> dict[str, tuple[list[str], list[str]]]:
    """The table of roles: what each says, and what it asks."""
    rows = re.findall(rf"^\| ({'|'.join(ROLES)}) \|(.*)\|(.*)\|$", DOCS, flags=re.MULTILINE)
    return {role: (re.findall("`(.*?)`", says), re.findall("`(.*?)`", asks)) for role, says, asks in rows}


def test_the_documentation_has_the_rules_that_are_kept():
    start = keys.all_of_fleet("f").removesuffix("**")
    kept = {role: rights("f", Participant("NAME", role)) for role in ROLES if role != "router"}
    assert documented() == {
        role: ([key.removeprefix(start) for key in may.publishes], [key.removeprefix(start) for key in may.queries])
        for role, may in kept.items()
    }


def allowed(rules: dict, who: str, flow: str, message: str, key: str) -> bool:
    """What the rules say of a message, as Zenoh documents them: a rule's key expression includes the message's."""
    policies = [policy for policy in rules["policies"] if who in policy["subjects"]]
    return any(
        message in rule["messages"] and zenoh.KeyExpr(expression).includes(key)
        for policy in policies
        for rule in rules["rules"]
        if rule["id"] in policy["rules"] and flow in rule["flows"]
        for expression in rule["key_exprs"]
    )


@pytest.mark.parametrize("message", ["put", "liveliness_token", "declare_queryable", "reply"])
def test_every_key_has_the_speakers_that_it_should_have(message):
    """Of all keys there are: those of an arm belong to that arm, those of a policy to that policy, all others to the
    auctioneer they name, or to any."""
    roster = of_arms("f", ARMS, [Participant("mine", "policy")])
    rules = access_control(roster)
    for key, participant in product(EVERY_KEY, roster.participants):
        place = keys.parse(key)
        owner = "auctioneer" if place.role in NAMELESS else place.name
        may = allowed(rules, participant.common_name, "ingress", message, key)
        assert may == (participant.name == owner), (participant, key)
        cache = f"{key}/@adv/pub/1/2"
        assert allowed(rules, participant.common_name, "ingress", message, cache) == may, (participant, cache)


def test_arms_without_an_auctioneer_answer_outsiders_and_nobody_else_does():
    roster = of_arms("f", ARMS, auctioneer=False)
    assert roster.by_consensus
    assert not of_arms("f", ARMS).by_consensus
    rules = access_control(roster)
    for key, participant in product(EVERY_KEY, roster.participants):
        place = keys.parse(key)
        owner = participant.role == "arm" and (
            place.role in NAMELESS or (place.role, place.name) == ("arm", participant.name)
        )
        for message in ("reply", "declare_queryable", "put"):
            assert allowed(rules, participant.common_name, "ingress", message, key) == owner, (participant, key)


def test_what_ends_in_the_name_of_an_arm_is_asked_by_that_arm_alone():
    rules = access_control(of_arms("f", ARMS))
    asked = [key for key in EVERY_KEY if keys.parse(key).asker]
    assert len(asked) == (2 * 2 + len(ARMS)) * len(ARMS)
    for key, participant in product(asked, of_arms("f", ARMS).participants):
        may = allowed(rules, participant.common_name, "ingress", "query", key)
        assert may == (participant.name == keys.parse(key).asker), (participant, key)
        for wild in (f"{key.rpartition('/')[0]}/*", key.rpartition("/")[0] + "/**", keys.all_of_fleet("f"), "**"):
            assert not allowed(rules, participant.common_name, "ingress", "query", wild), (participant, wild)


def test_nobody_deletes_and_everybody_but_the_router_hears_its_own_fleet_alone():
    roster = of_arms("f", ARMS)
    rules = access_control(roster)
    assert rules["default_permission"] == "deny"
    assert not [rule for rule in rules["rules"] if "delete" in rule["messages"] or rule["permission"] != "allow"]
    elsewhere = [keys.of_arm("g", "arm_0", "state"), "**", "thermofleet/v4/**", "@/*/router", "other"]
    for one in roster.participants:
        who, hears = one.common_name, one.role != "router"
        for key in EVERY_KEY:
            assert allowed(rules, who, "ingress", "declare_subscriber", key) == hears
            assert allowed(rules, who, "egress", "put", key) == hears
        for key, message in product(elsewhere, ("declare_subscriber", "query", "put", "liveliness_query")):
            assert not allowed(rules, who, "ingress", message, key)
            assert not allowed(rules, who, "egress", message, key)


@given(st.lists(st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12), min_size=2, max_size=5))
def test_no_name_of_an_arm_reaches_into_another(arms):
    try:
        roster = of_arms("f", arms)
    except ValueError:
        return
    owned = [zenoh.KeyExpr(key) for arm in arms for key in rights("f", roster.named(arm)).publishes]
    assert not [1 for one, other in product(owned, owned) if one is not other and one.intersects(other)]
    assert len(access_control(roster)["subjects"]) == len(arms) + 5


def test_a_name_that_is_not_there_is_told_with_those_that_are():
    with pytest.raises(BusError, match=r"The fleet 'f' has no participant 'arm_3'; did you mean 'arm_\d'\? Allowed: "):
        of_arms("f", ["arm_0", "arm_1"]).named("arm_3")
