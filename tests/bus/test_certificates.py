"""Certificates, the folder of keys and the roster: what OpenSSL and the documentation say of them."""

import os
import re
import shutil
import stat
import subprocess
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from itertools import product
from pathlib import Path
from typing import get_args

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol import keys
from fleet.bus.protocol.keys import ASKED, NAMELESS, TOPICS
from fleet.bus.security import certificates
from fleet.bus.security.access_control import (
    ROLES,
    ROSTER,
    Role,
    Roster,
    RosterEntry,
    access_control,
    of_arms,
    read_roster,
    rights,
)
from fleet.bus.security.certificates import LONGEST_DAYS, add, check, issue, lifetimes, make, new_authority, read
from fleet.errors import BusError

DOCS = (Path(__file__).parents[2] / "docs" / "security.md").read_text(encoding="utf-8")
ROSTER_ARMS = ("arm_0", "arm_1", "arm 2+*@", "arm_10")
NAMES = {"auction": ("auctioneer", "other"), "policy": ("mine", "other"), "monitor": ("operator", "other")}
EVERY_KEY = [
    str(keys.ParsedKey("f", role, name, topic, asker))
    for role, topics in TOPICS.items()
    for topic in topics
    for name in ([""] if role in NAMELESS else NAMES.get(role, ROSTER_ARMS))
    for asker in (ROSTER_ARMS if topic in ASKED else [""])
]


def documented() -> dict[str, tuple[list[str], list[str]]]:
    """The table of roles: what each says, and what it asks."""
    rows = re.findall(rf"^\| ({'|'.join(ROLES)}) \|(.*)\|(.*)\|$", DOCS, flags=re.MULTILINE)
    return {role: (re.findall("`(.*?)`", says), re.findall("`(.*?)`", asks)) for role, says, asks in rows}


def test_the_documentation_has_the_rules_that_are_kept():
    start = keys.all_of_fleet("f").removesuffix("**")
    kept = {role: rights("f", RosterEntry("NAME", role)) for role in ROLES if role != "router"}
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
@pytest.mark.parametrize("auctioneer", [True, False])
def test_every_key_has_the_speakers_that_it_should_have(message, auctioneer):
    """Of all keys there are: those with a name belong to it, the others to the auctioneer; without one, to all arms."""
    roster = of_arms("f", ROSTER_ARMS, [RosterEntry("mine", "policy")], auctioneer=auctioneer)
    assert roster.by_consensus != auctioneer
    rules = access_control(roster)
    for key, participant in product(EVERY_KEY, roster.participants):
        place = keys.parse(key)
        speaks = participant.role == ("auctioneer" if auctioneer else "arm")
        may = speaks if place.role in NAMELESS else participant.name == place.name
        for each in (key, f"{key}/@adv/pub/1/2"):
            assert allowed(rules, participant.common_name, "ingress", message, each) == may, (participant, each)


def test_what_ends_in_the_name_of_an_arm_is_asked_by_that_arm_alone():
    rules = access_control(of_arms("f", ROSTER_ARMS))
    asked = [key for key in EVERY_KEY if keys.parse(key).asker]
    assert len(asked) == (2 * 2 + len(ROSTER_ARMS)) * len(ROSTER_ARMS)
    for key, participant in product(asked, of_arms("f", ROSTER_ARMS).participants):
        may = allowed(rules, participant.common_name, "ingress", "query", key)
        assert may == (participant.name == keys.parse(key).asker), (participant, key)
        for wild in (f"{key.rpartition('/')[0]}/*", key.rpartition("/")[0] + "/**", keys.all_of_fleet("f"), "**"):
            assert not allowed(rules, participant.common_name, "ingress", "query", wild), (participant, wild)


def test_nobody_deletes_and_everybody_but_the_router_hears_its_own_fleet_alone():
    roster = of_arms("f", ROSTER_ARMS)
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


ARMS = ("arm_0", "arm 2+*@")
needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("keys") / "f"
    make(place, of_arms("f", ARMS), days=30, hosts=["fleet.example", "192.0.2.7"])
    return place


def openssl(*words: object) -> str:
    done = subprocess.run(["openssl", *map(str, words)], capture_output=True, text=True, timeout=300, check=False)
    return done.stdout + done.stderr


def text_of(path: Path) -> str:
    return re.sub(r"\s+", " ", openssl("x509", "-in", path, "-noout", "-text", "-nameopt", "RFC2253,utf8"))


@needs_openssl
@pytest.mark.parametrize("file", ["router", "operator", "arm%202%2B%2A%40"])
def test_openssl_finds_each_certificate_good_for_its_own_end_alone(folder, file):
    """The second method: another implementation of X.509 reads and judges what ours has written."""
    path = folder / f"{file}.pem"
    own, other = ("sslserver", "sslclient") if file == "router" else ("sslclient", "sslserver")
    verify = ("verify", "-x509_strict", "-CAfile", folder / "ca.pem", "-purpose")
    assert openssl(*verify, own, path) == f"{path}: OK\n"
    if file == "router":  # it opens links to other routers
        assert openssl(*verify, other, path) == f"{path}: OK\n"
    else:
        assert "unsuitable certificate purpose" in openssl(*verify, other, path)
    text = text_of(path)
    role = "arm" if file.startswith("arm") else file
    assert f"Subject: CN={role}:{file},O=thermofleet" in text
    assert "Issuer: CN=f certificate authority,O=thermofleet" in text
    assert "ASN1 OID: prime256v1" in text
    assert "Signature Algorithm: ecdsa-with-SHA256" in text
    assert "X509v3 Basic Constraints: critical CA:FALSE" in text
    assert "X509v3 Key Usage: critical Digital Signature X509v3" in text
    names = "DNS:localhost, IP Address:127.0.0.1, IP Address:0:0:0:0:0:0:0:1, DNS:fleet.example, IP Address:192.0.2.7"
    assert (f"Subject Alternative Name: {names} " in text) == (file == "router")
    assert ("Subject Alternative Name" in text) == (file == "router")
    key = folder / f"{file}.key"
    assert openssl("pkey", "-in", key, "-pubout") == openssl("x509", "-in", path, "-noout", "-pubkey")


@needs_openssl
def test_openssl_agrees_about_dates_and_authorities(folder, tmp_path):
    text = text_of(folder / "ca.pem")
    assert "X509v3 Basic Constraints: critical CA:TRUE, pathlen:0" in text
    assert "X509v3 Key Usage: critical Certificate Sign, CRL Sign" in text
    place = tmp_path / "other"
    make(place, of_arms("f", ["arm_0"]), days=30)
    verify = ("verify", "-x509_strict", "-CAfile", place / "ca.pem")
    assert "error" in openssl(*verify, folder / "arm_0.pem")
    issue(place, RosterEntry("arm_0", "arm"), days=1, now=datetime.now(UTC) - timedelta(days=3))
    assert "certificate has expired" in openssl(*verify, place / "arm_0.pem")
    with pytest.raises(BusError, match=r"/arm_0\.pem' expired on \d{4}-\d\d-\d\d \d\d:\d\d UTC"):
        check(place, "arm_0")
    shutil.copy(folder / "arm_0.pem", place / "arm_0.pem")
    with pytest.raises(BusError, match=r"arm_0\.key' is not the key of"):
        check(place, "arm_0")
    shutil.copy(folder / "arm_0.key", place / "arm_0.key")
    with pytest.raises(BusError, match="not signed by the certificate authority"):
        check(place, "arm_0")


@pytest.mark.parametrize("days", [1, LONGEST_DAYS])
def test_a_certificate_lasts_as_long_as_was_said_and_no_longer_than_its_authority(tmp_path, days):
    now = datetime.now(UTC).replace(microsecond=0)
    new_authority(tmp_path, "f", now=now - timedelta(days=1))
    ends = issue(tmp_path, RosterEntry("a", "arm"), days=days, now=now)
    assert read(tmp_path, "a").not_valid_after_utc == ends
    assert ends - now == timedelta(days=min(days, LONGEST_DAYS - 1))
    check(tmp_path, "a", now=ends)
    with pytest.raises(BusError, match=f"expired on {ends:%Y-%m-%d %H:%M} UTC"):
        check(tmp_path, "a", now=ends + timedelta(seconds=1))
    check(tmp_path, "a", now=now - timedelta(minutes=5))
    with pytest.raises(BusError, match="is valid only from"):
        check(tmp_path, "a", now=now - timedelta(minutes=6))


@pytest.mark.parametrize("days", [0, LONGEST_DAYS + 1])
def test_days_that_cannot_be_are_refused(tmp_path, days):
    with pytest.raises(BusError, match=f"lasts 1 to {LONGEST_DAYS} days"):
        make(tmp_path / "k", of_arms("f", ["a"]), days=days)
    assert list(tmp_path.iterdir()) == []


def test_only_the_owner_reads_what_is_secret(folder):
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}
    assert {name for name, mode in modes.items() if mode == 0o600} == {n for n in modes if n.endswith(".key")}
    assert all(mode in (0o600, 0o644) for mode in modes.values())


def test_everybody_has_a_pair_and_the_roster_names_them(folder):
    roster = read_roster(folder)
    assert roster == of_arms("f", ARMS)
    files = {participant.file for participant in roster.participants} | {"ca"}
    assert {p.name for p in folder.iterdir()} == {f"{f}.{end}" for f in files for end in ("pem", "key")} | {ROSTER}
    assert set(lifetimes(folder, roster)) == {*ARMS, "ca", *get_args(Role)} - {"arm", "policy"}
    for participant in roster.participants:
        assert certificates.common_name(check(folder, participant.file)) == participant.common_name


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_keys_are_replaced_only_when_that_was_said(tmp_path):
    place = tmp_path / "k"
    make(place, of_arms("f", ["a"]), days=3)
    before = contents(place)
    with pytest.raises(BusError, match="holds the keys of a fleet"):
        make(place, of_arms("f", ["a"]), days=3)
    assert contents(place) == before
    make(place, of_arms("g", ["b"]), days=3, overwrite=True)
    assert read_roster(place).fleet == "g"
    assert not set(contents(place).values()) & set(before.values())
    assert list(tmp_path.iterdir()) == [place]


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    place = tmp_path / "k"
    place.mkdir()
    (place / "arm_0.pem").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(BusError, match="is not a folder of keys"):
            make(place, of_arms("f", ["a"]), days=3, overwrite=overwrite)
    assert contents(place) == {"arm_0.pem": b"mine"}


@contextmanager
def breaking(name, nth):
    """A function of the system fails at its call of this number, from 0."""
    module, real, calls = (Path, Path.rename, []) if name == "rename" else (os, getattr(os, name), [])

    def fail(*args):
        calls.append(args)
        if len(calls) == 1 + nth:
            raise OSError(28, "No space left on device")
        return real(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, name, fail)
        with pytest.raises(BusError, match="No space left"):
            yield


@pytest.mark.parametrize(
    ("name", "nth"),
    [*((name, nth) for name in ("replace", "fsync") for nth in (0, 3, 7)), ("rename", 0), ("rename", 1)],
)
def test_what_breaks_off_leaves_what_was_there_and_nothing_half(tmp_path, name, nth):
    place = tmp_path / "k"
    make(place, of_arms("f", ["a"]), days=3)
    before = contents(place)
    with breaking(name, nth):
        make(place, of_arms("f", ["a", "b"]), days=3, overwrite=True)
    assert contents(place) == before
    assert list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize("nth", range(3))
def test_adding_that_breaks_off_leaves_a_folder_that_can_be_added_to(tmp_path, nth):
    place = tmp_path / "k"
    make(place, of_arms("f", ["a"]), days=3)
    with breaking("replace", nth):
        add(place, [RosterEntry("b", "arm")], days=3)
    assert read_roster(place) == of_arms("f", ["a"])
    assert not [name for name in contents(place) if name.endswith(".tmp")]
    add(place, [RosterEntry("b", "arm")], days=3)
    check(place, "b")
    assert read_roster(place).named("b") == RosterEntry("b", "arm")


def test_one_is_added_by_the_same_authority_once(tmp_path):
    place = tmp_path / "k"
    make(place, of_arms("f", ["a"]), days=3)
    before = contents(place)
    add(place, [RosterEntry("gateway", "submitter")], days=3)
    check(place, "gateway")
    after = contents(place)
    assert {name for name in after if after[name] != before.get(name)} == {"gateway.pem", "gateway.key", ROSTER}
    with pytest.raises(BusError, match="'gateway' has a certificate"):
        add(place, [RosterEntry("gateway", "submitter")], days=3)
    for overwrite in (False, True):
        with pytest.raises(BusError, match=r"has the role submitter in .* not monitor\. Choose another name"):
            add(place, [RosterEntry("gateway", "monitor")], days=3, overwrite=overwrite)
    with pytest.raises(BusError, match="'GATEWAY' is taken"):
        add(place, [RosterEntry("GATEWAY", "monitor")], days=3)
    add(place, [RosterEntry("gateway", "submitter")], days=3, overwrite=True)
    assert contents(place)["gateway.pem"] != after["gateway.pem"]
    check(place, "gateway")


@pytest.mark.parametrize(
    ("second", "complaint"),
    [
        (RosterEntry("a", "operator"), "has the role arm"),
        (RosterEntry("B", "monitor"), "'B' is taken"),
        (RosterEntry("hall", "router"), "'a b' is not a host name"),
    ],
)
def test_all_are_added_or_none(tmp_path, second, complaint):
    place, first = tmp_path / "k", RosterEntry("b", "arm")
    make(place, of_arms("f", ["a"]), days=3)
    before = contents(place)
    for entries in ([first, second], [RosterEntry("a", "arm"), first, second]):
        with pytest.raises(BusError, match=complaint):
            add(place, entries, days=3, hosts=["a b"], overwrite=True)
        assert contents(place) == before
    add(place, [first, first, RosterEntry("c", "arm")], days=3)
    assert read_roster(place) == of_arms("f", ["a", "b", "c"])


def test_without_the_key_of_the_authority_nobody_is_added(tmp_path):
    place = tmp_path / "k"
    make(place, of_arms("f", ["a"]), days=3)
    (place / "ca.key").unlink()
    with pytest.raises(BusError, match=r"There is no '.*ca\.key'"):
        add(place, [RosterEntry("b", "arm")], days=3)
    assert read_roster(place) == of_arms("f", ["a"])


def test_an_expired_authority_signs_nothing_and_vouches_for_nobody(tmp_path):
    new_authority(tmp_path, "f", now=datetime.now(UTC) - timedelta(days=LONGEST_DAYS + 1))
    with pytest.raises(BusError, match=r"/ca\.pem' expired on"):
        issue(tmp_path, RosterEntry("a", "arm"), days=1)


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        ({"a.pem": b"-----BEGIN"}, r"a\.pem' is not a certificate"),
        ({"a.key": b""}, r"a\.key' is not a private key"),
        ({"ca.pem": b"\xff"}, r"ca\.pem' is not a certificate"),
        ({"a.pem": None}, r"There is no '.*a\.pem'; thermofleet bus keys"),
        ({ROSTER: b"{"}, "is not a roster"),
        ({ROSTER: b'{"fleet":"f","participants":[{"name":"a","role":"king"}]}'}, "is not a roster: .*king"),
        ({ROSTER: b'{"fleet":"","participants":[]}'}, "is not a roster: .*must have 1 to 128"),
        ({ROSTER: None}, "not a folder of keys"),
    ],
)
def test_what_is_damaged_is_named(tmp_path, damage, complaint):
    place = tmp_path / "k"
    make(place, of_arms("f", ["a"]), days=3)
    for name, content in damage.items():
        (place / name).unlink()
        if content is not None:
            (place / name).write_bytes(content)
    with pytest.raises(BusError, match=complaint):
        read_roster(place) and check(place, "a")


def test_hosts_that_cannot_be_are_refused(tmp_path):
    with pytest.raises(BusError, match="not a host name"):
        make(tmp_path / "k", of_arms("f", ["a"]), days=3, hosts=["münchen.example"])
    assert list(tmp_path.iterdir()) == []


names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20)


@given(st.lists(names, max_size=6), names)
def test_files_stay_in_the_folder_and_differ(arms, fleet):
    try:
        roster = of_arms(fleet, arms)
    except ValueError:
        return
    files = [participant.file for participant in roster.participants]
    assert len({file.casefold() for file in [*files, "ca"]}) == len(files) + 1
    assert not [file for file in files if "/" in file or "\\" in file or "\0" in file]
    assert len({participant.common_name for participant in roster.participants}) == len(files)
    assert all(participant.common_name.isascii() for participant in roster.participants)


@pytest.mark.parametrize(
    ("arms", "complaint"),
    [
        (["a", "A"], "taken"),
        (["router"], "taken"),
        (["ca"], "cannot be named"),
        (["x" * 61], "64 are allowed"),
        ([""], "must have 1 to 128"),
    ],
)
def test_names_that_cannot_be_are_refused(arms, complaint):
    with pytest.raises(ValueError, match=complaint):
        of_arms("f", arms)
    assert Roster("f", (RosterEntry("x" * 60, "arm"),))
