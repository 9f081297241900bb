"""A policy in another process: what is sent to it, and what is said of one that does not reply as it should."""

import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh
from jsonschema import Draft202012Validator

from docs.bus_contract import EXAMPLES
from fleet.bus.protocol.messages import MOST_BYTES, decode, encoding
from fleet.bus.protocol.policy import MOST_REQUEST_BYTES, ActReply, ActRequest
from fleet.bus.router import Router, open_client
from fleet.errors import BusError
from fleet.live import policy_client
from fleet.live.policy_client import PolicyClient
from fleet.observation import FIELDS, Layout, Observation
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
SCHEMAS = json.loads((ROOT / "docs" / "contract" / "schemas.json").read_text(encoding="utf-8"))
REQUEST = Draft202012Validator({"$ref": "#/$defs/ActRequest", "$defs": SCHEMAS["$defs"]})
LIMIT_S = 0.3
KEY = "thermofleet/v4/f/policy/mine/act"
ACT_REPLY, REFUSAL = (f"application/json;thermofleet.{name}.v4" for name in ("ActReply", "Refusal"))


def seen(arms: int = 2, slots: int = 3, rng: np.random.Generator | None = None) -> dict[str, Observation]:
    """Observations of arms; with `rng` random ones within their bounds."""
    layout = Layout(arms, slots, plans=2, bids=True)
    low, high = layout.bounds
    vectors = np.zeros((arms, layout.size), np.float32) if rng is None else rng.uniform(low, high, (arms, layout.size))
    shared, own = vectors[0, : layout.shared].astype(np.float32), vectors[:, layout.shared :].astype(np.float32)
    names = [f"arm_{a}" for a in range(arms)]
    return layout.read_each(names, shared, own, np.ones((arms, layout.actions), np.int8))


class Server:
    """Replies to all queries of a key expression with one payload; to none without it.

    Attributes:
        requests: Key, encoding and payload of each query, oldest first.
    """

    def __init__(self, session: zenoh.Session, payload: str | None, sent_as: str = ACT_REPLY, key: str = KEY) -> None:
        self.requests: queue.Queue[tuple[str, str, bytes]] = queue.Queue()
        self._held: list[zenoh.Query] = []
        self._payload, self._sent_as = payload, sent_as
        self.queryable = session.declare_queryable(key, self._reply, complete=True)

    def _reply(self, query: zenoh.Query) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        self.requests.put((str(query.key_expr), str(query.encoding), payload))
        if self._payload is None:
            self._held.append(query)  # so that it is not finished
            return
        with query:
            query.reply(str(query.key_expr), self._payload, encoding=self._sent_as)


@pytest.fixture(scope="module")
def router() -> Iterator[Router]:
    with Router() as router:
        yield router


@pytest.fixture
def served(router: Router) -> Iterator[Callable[..., Server]]:
    """Make servers, each with a session of its own."""
    sessions: list[zenoh.Session] = []

    def serve(*arguments: str | None, **options: str) -> Server:
        sessions.append(open_client(router.endpoint, timeout_s=PATIENCE_S))
        return Server(sessions[-1], *arguments, **options)

    yield serve
    for session in sessions:
        session.close()


def client(router: Router, limit_s: float = PATIENCE_S) -> PolicyClient:
    return PolicyClient("mine", fleet="f", endpoint=router.endpoint, limit_s=limit_s)


@contextmanager
def refused(said: str) -> Iterator[None]:
    began_s = time.monotonic()
    with pytest.raises(BusError, match=said):
        yield
    assert time.monotonic() - began_s < PATIENCE_S


def test_a_request_is_as_the_contract_says_and_has_every_field_exactly(router, served):
    server = served('{"actions": {"arm_1": 7}}', key="thermofleet/v4/*/policy/mine/act")
    policy, observations = client(router), seen(rng=np.random.default_rng(1))
    assert policy.act(observations) == {"arm_1": 7}
    key, sent_as, payload = server.requests.get(timeout=PATIENCE_S)
    assert (key, sent_as) == (KEY, encoding(ActRequest))
    REQUEST.validate(json.loads(payload))
    decode(ActRequest, payload)
    for message, (arm, observation) in zip(json.loads(payload)["observations"], observations.items(), strict=True):
        assert message.pop("arm") == arm
        assert message.pop("action_mask") == [1] * 8
        assert message.pop("peers") == [int(arm == "arm_0")]
        assert set(message) == {field.name for field in FIELDS}
        for name, value in message.items():
            np.testing.assert_array_equal(np.array(value, np.float64), getattr(observation, name), strict=False)


def test_shifts_have_different_names_and_the_same_seed_and_count_their_decisions(router, served):
    server = served('{"actions": {}}')
    one, other = client(router), client(router)
    for policy in (one, other):
        policy.reset(np.random.default_rng(5))
    for policy in (one, other, one):
        policy.act(seen())
    one.reset(np.random.default_rng(6))
    one.act(seen())
    requests = [json.loads(server.requests.get(timeout=PATIENCE_S)[2]) for _ in range(4)]
    shifts, seeds, decisions = zip(*((each["shift"], each["seed"], each["decision"]) for each in requests), strict=True)
    assert decisions == (0, 0, 1, 0)
    assert shifts[0] == shifts[2]
    assert len(set(shifts)) == 3
    assert seeds[0] == seeds[1] == seeds[2] != seeds[3]


@pytest.mark.parametrize(
    ("payload", "sent_as", "said"),
    [
        ('{"reason": "busy"}', REFUSAL, "policy 'mine' at tcp/.* gave no actions: busy"),
        ("nonsense", ACT_REPLY, r"gave no actions: Not a thermofleet\.ActReply\.v4"),
        ('{"actions": {"arm_0": -1}}', ACT_REPLY, r"gave no actions: Not a thermofleet\.ActReply\.v4"),
        ('{"actions": {"arm_0": 1.5}}', ACT_REPLY, r"gave no actions: Not a thermofleet\.ActReply\.v4"),
        ('{"actions": {}}', "text/plain", "gave no actions: It is encoded as 'text/plain'"),
        ('{"actions": {"arm_9": 1}}', ACT_REPLY, r"replied for the arm 'arm_9'\. Arms: arm_0, arm_1\."),
        ('{"actions": {"arm_0": 8}}', ACT_REPLY, "chose the action 8 for 'arm_0', which has the actions 0 to 7"),
        (None, ACT_REPLY, rf"did not reply and finish the query within {LIMIT_S} s\."),
    ],
)
def test_a_reply_that_cannot_be_used_is_an_error_within_the_limit(router, served, payload, sent_as, said):
    served(payload, sent_as)
    policy = client(router, LIMIT_S if payload is None else PATIENCE_S)
    with refused(said):
        policy.act(seen())
    assert policy._client._session is None  # a failed decision ends the connection


def test_a_decision_without_a_valid_reply_is_requested_again(router, served):
    broken = served("nonsense")
    policy = client(router)
    with pytest.raises(BusError):
        policy.act(seen())
    broken.queryable.undeclare()
    server = served('{"actions": {}}')
    policy.act(seen())
    for requests in (broken.requests, server.requests):
        assert json.loads(requests.get(timeout=PATIENCE_S)[2])["decision"] == 0


def test_nobody_two_and_no_router_are_told_apart_at_once(router, served):
    with refused(f"No process serves the policy 'mine' at tcp/.*: start it; .* '{KEY}'"):
        client(router).act(seen())
    servers = [served('{"actions": {}}') for _ in range(2)]
    with refused("Several processes reply as policy 'mine' at tcp/.*: stop all but one"):
        client(router).act(seen())
    assert [server.requests.qsize() for server in servers] == [1, 1]
    nowhere = PolicyClient("mine", fleet="f", endpoint="tcp/127.0.0.1:1", limit_s=PATIENCE_S)
    with refused("No router answered at tcp/127.0.0.1:1 .* start a router with thermofleet bus router"):
        nowhere.act(seen())


def test_a_process_that_starts_with_the_first_decision_is_found(router, served, monkeypatch):
    monkeypatch.setattr(policy_client, "FOUND_S", PATIENCE_S)
    starting = threading.Timer(0.05, served, ['{"actions": {}}'])
    starting.start()
    assert client(router).act(seen()) == {}
    starting.join(PATIENCE_S)


def test_a_router_that_ends_in_a_shift_is_an_error_within_the_limit():
    with Router() as router, open_client(router.endpoint, timeout_s=PATIENCE_S) as session:
        server, policy = Server(session, '{"actions": {}}'), client(router, LIMIT_S)
        assert policy.act(seen()) == {}
        router.close()
        for said in ("policy 'mine'", "No router answered"):
            with refused(said):
                policy.act(seen())
        assert server.requests.qsize() == 1


def test_large_fleets_fit_and_larger_ones_are_told_to(router, served):
    server = served('{"actions": {}}')
    assert client(router).act(seen(16, 50, np.random.default_rng(2))) == {}
    size = len(server.requests.get(timeout=PATIENCE_S)[2])
    assert MOST_BYTES < size < MOST_REQUEST_BYTES
    with refused("observations of 64 arms have .* bytes, and a request to a policy at most 4,194,304"):
        client(router, LIMIT_S).act(seen(64, 256))


def test_a_process_that_leaves_its_client_open_ends(router, served):
    served('{"actions": {}}')
    code = f"""
from fleet.live.policy_client import PolicyClient
from tests.bus.test_policy_client import seen
policy = PolicyClient("mine", fleet="f", endpoint="{router.endpoint}", limit_s=120.0)
print(policy.act(seen()))
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300, check=True
    )
    assert ended.stdout == "{}\n"


def test_the_example_reply_answers_the_example_request():
    arms = {each.arm: len(each.action_mask) for each in EXAMPLES[ActRequest].observations}
    assert all(action < arms[arm] for arm, action in EXAMPLES[ActReply].actions.items())
