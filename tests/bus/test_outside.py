"""Fleets seen from outside, with eclipse-zenoh, jsonschema and docs/contract alone: every message is as promised.

Nothing of thermofleet is imported: an outsider subscribes to all keys of the contract, receives every request with a
queryable that never replies, repeats some of them to see the replies too, and validates all of it.
"""

import json
import os
import queue
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh
from jsonschema import Draft202012Validator

from tests import commands

ROOT = Path(__file__).parents[2]
CONTRACT = ROOT / "docs" / "contract"
API = json.loads((CONTRACT / "asyncapi.json").read_text(encoding="utf-8"))
SCHEMAS = json.loads((CONTRACT / "schemas.json").read_text(encoding="utf-8"))
EXAMPLES = {name: message["examples"][0]["payload"] for name, message in API["components"]["messages"].items()}
CHANNELS = {name: (channel["address"], channel["x-zenoh"]) for name, channel in API["channels"].items()}
QUERIED = {name for name, (_, how) in CHANNELS.items() if how["pattern"] == "query"}
ARM = {"arm_alive", "arm_state", "arm_info", "arm_difficulty"}
"""What a simulated shift has."""
GATEWAY = {"monitor_alive", "monitor_alarm"}
CONSENSUS = {"arm_bid", "arm_claim", "arm_operation"}
PATIENCE_S = 240.0
REPEATED = 2
"""Requests of each channel that are sent again."""

SCENARIO = """
description = "Arms hold and sort."
horizon_s = 1800
arms = [{ name = "left", position_m = [-0.45, 0.0, 0.0] }, { name = "right", position_m = [0.45, 0.0, 0.0] }, \
{ name = "spare", position_m = [0.0, 0.9, 0.0] }]
places = [{ name = "bench", position_m = [0.0, 0.2, 0.25] }, { name = "shelf", position_m = [0.0, -0.2, 0.25] }]

[[jobs]]
name = "hold"
kind = "hold"
places = ["bench"]
repetitions = [1, 2]
dwell_s = 10
arrivals = { kind = "batch", count = 2 }

[[jobs]]
name = "sort"
kind = "sort"
places = ["shelf", "bench"]
repetitions = [1, 2]
arrivals = { kind = "poisson", every_s = 60 }

[planning]
elbows = 1
speeds = [1.0]
"""


def validator(message: str) -> Draft202012Validator:
    return Draft202012Validator({"$ref": f"#/$defs/{message}", "$defs": SCHEMAS["$defs"]})


class Outsider:
    """One that knows only the contract.

    Attributes:
        seen: Names of the messages seen, by channel; of a token, `token`.
    """

    def __init__(self, session: zenoh.Session, fleet: str) -> None:
        self.session, self.fleet = session, fleet
        self.seen: dict[str, set[str]] = {name: set() for name in CHANNELS}
        self._queue: queue.Queue[tuple[str, str, str, bytes]] = queue.Queue()
        self._repeated = dict.fromkeys(QUERIED, 0)
        self._kept: list[object] = []
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1024)
        for name, (address, how) in CHANNELS.items():
            expression = re.sub(r"{\w+}", "*", address.replace("{fleet}", fleet))
            if how["pattern"] == "publish":
                take = self._taker(name)
                self._kept.append(zenoh.ext.declare_advanced_subscriber(session, expression, take, history=history))
            elif how["pattern"] == "query":
                declared = session.declare_queryable(
                    expression, self._listener(name), complete=False, allowed_origin=zenoh.Locality.REMOTE
                )
                self._kept.append(declared)
            else:
                seen = lambda sample, name=name: self.seen[name].add("token")  # noqa: E731
                self._kept.append(session.liveliness().declare_subscriber(expression, seen, history=True))

    def _taker(self, name: str):
        return lambda sample: self._queue.put(
            (name, str(sample.key_expr), str(sample.encoding), sample.payload.to_bytes())
        )

    def _listener(self, name: str):
        def listen(query: zenoh.Query) -> None:
            with query:  # finished without a reply
                payload = b"" if query.payload is None else query.payload.to_bytes()
                self._queue.put((name, str(query.key_expr), str(query.encoding), payload))

        return listen

    def work(self, seconds: float = 0.2) -> None:
        """Validate what has come, and send some requests again."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            try:
                name, key, encoding, payload = self._queue.get(timeout=left_s)
            except queue.Empty:
                return
            self.validate(name, key, encoding, payload)
            if name in QUERIED and self._repeated[name] < REPEATED:
                self._repeated[name] += 1
                self.ask(name, key, encoding, payload)

    def validate(self, name: str, key: str, encoding: str, payload: bytes) -> None:
        """A message must be of its channel, and as its schema says."""
        address = re.escape(CHANNELS[name][0].replace("{fleet}", self.fleet))
        pattern = re.sub(r"\\{\w+\\}", "[^/]+", address)
        assert "*" in key or re.fullmatch(pattern, key), f"{key} is no {address}"
        known = {API["components"]["messages"][m]["x-zenoh"]["encoding"]: m for m in API["channels"][name]["messages"]}
        assert encoding in known, f"{key}: {encoding}"
        validator(known[encoding]).validate(json.loads(payload))
        self.seen[name].add(known[encoding])

    def ask(self, name: str, key: str, encoding: str, payload: bytes) -> None:
        """Send a request, and validate the replies."""
        for reply in self.session.get(
            key,
            payload=payload,
            encoding=encoding,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=PATIENCE_S,
        ):
            if reply.ok is not None:
                key, said = str(reply.ok.key_expr), str(reply.ok.encoding)
                self.validate(name, key, said, reply.ok.payload.to_bytes())

    def request(self, *names: str) -> None:
        """Send requests that are in no fleet's way: examples of the contract, with these contents."""
        for name in names:
            message, content = REQUESTS[name]
            key = CHANNELS[name][0].format(fleet=self.fleet, arm="*", peer="spare")
            encoding = API["components"]["messages"][message]["x-zenoh"]["encoding"]
            payload = json.dumps({**EXAMPLES[message], **content}).encode()
            self.validate(name, key, encoding, payload)
            self.ask(name, key, encoding, payload)

    def missing(self, channels: set[str]) -> dict[str, set[str]]:
        """Messages of channels that were not seen; a refusal need not be."""
        expected = {name: set(API["channels"][name]["messages"]) - {"Refusal"} or {"token"} for name in channels}
        return {name: rest for name, all_of_it in expected.items() if (rest := all_of_it - self.seen[name])}


JOB = {"name": "extra", "kind": "hold", "places": ["bench"], "repetitions": 1, "payload_kg": 0.5, "due_s": None}
REQUESTS = {
    "jobs_submit": ("Submission", {"jobs": [JOB]}),
    "jobs_status": ("StatusRequest", {"jobs": []}),
    "jobs_control": ("ControlRequest", {"request": "extra", "action": {"action": "resume"}}),
    "jobs_cell": ("CellRequest", {}),
    "clock_now": ("ClockRequest", {}),
    "arm_quote": ("QuoteRequest", {"jobs": [JOB], "dry_run": True}),
    "arm_reset": ("ResetRequest", {}),
    "arm_claim": (
        "Claim",
        {"arm": "spare", "number": 1, "entries": [], "outcomes": [], "jobs": [], "space": []},
    ),
    "jobs_clear": ("ClearRequest", {"arm": "spare"}),
}
EVERYWHERE = ("jobs_submit", "jobs_status", "jobs_control", "jobs_cell", "clock_now", "arm_quote")
"""Requests that fleets with and without an auctioneer reply to."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("outside")
    (place / "cell.toml").write_text(SCENARIO, encoding="utf-8")
    return place


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextmanager
def started(folder: Path, *words: object) -> Iterator[subprocess.Popen[str]]:
    """A command as a process of its own, which is ended with the block."""
    with (folder / f"{words[0]}.log").open("a+") as log:
        env = {**os.environ, "THERMOFLEET_CACHE": str(folder / "cache")}
        process = commands.start(*words, env=env, stdout=log, stderr=log)
        try:
            yield process
        finally:
            if process.poll() is None:
                process.terminate()
            process.wait(PATIENCE_S)


@contextmanager
def policy(port: int) -> Iterator[None]:
    """The example of a policy in another process, on a router that is there."""
    process = subprocess.Popen([sys.executable, str(ROOT / "examples" / "own_policy_process.py"), str(port), "mine"])
    try:
        yield
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


@contextmanager
def outside(port: int, fleet: str) -> Iterator[Outsider]:
    """An outsider on the router of a fleet, which may not be there yet."""
    config = {
        "mode": "client",
        "connect": {
            "endpoints": [f"tcp/127.0.0.1:{port}"],
            "timeout_ms": round(1000 * PATIENCE_S),
            "exit_on_failure": True,
            "retry": {"period_init_ms": 20, "period_max_ms": 20, "period_increase_factor": 1.0},
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        yield Outsider(session, fleet)


@pytest.mark.ci_slow
def test_a_simulated_shift_is_as_the_contract_says(folder, port):
    words = ("run", folder / "cell.toml", "--difficulty", "blind", "--listen", port, "--out", folder / "run")
    with started(folder, *words) as shift, outside(port, "cell") as outsider:
        deadline_s = time.monotonic() + PATIENCE_S
        while shift.poll() is None and time.monotonic() < deadline_s:
            outsider.work()
        outsider.work()
        assert shift.returncode == 0, (folder / "run.log").read_text()
    assert not outsider.missing(ARM)
    assert not any(seen for name, seen in outsider.seen.items() if name not in ARM)


@pytest.mark.ci_slow
def test_a_live_fleet_is_as_the_contract_says(folder, port):
    words = ("up", folder / "cell.toml", "--difficulty", "blind", "--speed", 20, "--jobs", "none", "--port", port)
    words += ("--policy", "bus:mine", "--out", folder / "up")
    channels = set(CHANNELS) - CONSENSUS - GATEWAY - {"jobs_clear"}  # all arms are present and state where they are
    with started(folder, *words) as fleet, outside(port, "cell") as outsider, policy(port):
        deadline_s = time.monotonic() + PATIENCE_S
        while outsider.missing(channels) and fleet.poll() is None and time.monotonic() < deadline_s:
            outsider.work()
            if outsider.seen["auction_alive"]:
                outsider.request(*EVERYWHERE, "arm_reset")
    assert not outsider.missing(channels), (folder / "up.log").read_text()
    assert not any(outsider.seen[name] for name in CONSENSUS)


@pytest.mark.ci_slow
def test_a_fleet_without_an_auctioneer_is_as_the_contract_says(folder, port):
    """Two of three arms are there, a majority; in the name of the third the outsider claims nothing."""
    at = ("--endpoint", f"tcp/127.0.0.1:{port}", "--difficulty", "blind", "--speed", 20, "--policy", "consensus")
    here = ("--jobs", "none", "--journal", folder / "journals")
    channels = {*ARM, "arm_event", *CONSENSUS, *EVERYWHERE}
    with ExitStack() as stack:
        stack.enter_context(started(folder, "bus", "router", "--port", port))
        outsider = stack.enter_context(outside(port, "cell"))
        token = outsider.session.liveliness().declare_token(
            CHANNELS["arm_alive"][0].format(fleet=outsider.fleet, arm="spare")
        )
        for arm in ("left", "right"):
            stack.enter_context(started(folder, "arm", "run", folder / "cell.toml", arm, *at, *here))
        deadline_s = time.monotonic() + PATIENCE_S
        while outsider.missing(channels) and time.monotonic() < deadline_s:
            outsider.work()
            if outsider.seen["arm_bid"]:
                outsider.request(*EVERYWHERE, "arm_claim")
        token.undeclare()
        while outsider.missing({"jobs_clear"}) and time.monotonic() < deadline_s:
            outsider.work()
            outsider.request("jobs_clear")
    assert not outsider.missing({*channels, "jobs_clear"}), (folder / "arm.log").read_text()
    assert not any(seen for name, seen in outsider.seen.items() if name.startswith("auction"))
