"""The example of a policy in another process, through a router, beside the same rule in Python."""

import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zenoh

from fleet.bus.protocol.messages import encoding
from fleet.bus.protocol.policy import ActRequest
from fleet.bus.router import Router, open_client
from fleet.errors import BusError, FleetError
from scenarios.evaluate import runner
from scenarios.evaluate.rollout import outcomes, play
from scenarios.evaluate.study import Case, Study, policy_hash
from scenarios.policy_loader import is_built_in, is_on_bus, label, policy_of, scope_of, source_of
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.run.shift import run
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec
from tests.bus.test_policy_client import KEY, seen
from tests.examples.programs import ROOT, running, started
from tests.waiting import PATIENCE_S

MOST_WAITING = 32
SAME_RULE = """
class Quickest:
    scope = "central"
    def reset(self, rng): pass
    def act(self, observations):
        claims = [
            (float(own.duration_s[option]) / float(own.value[option // plans]), place, option, option // plans, arm)
            for place, (arm, own) in enumerate(observations.items())
            for plans in [len(own.difficulty) // len(own.group)]
            for option in own.action_mask[1:-1].nonzero()[0].tolist()
        ]
        actions, taken = {}, set()
        for _, _, option, job, arm in sorted(claims):
            if arm not in actions and job not in taken:
                actions[arm] = 1 + option
                taken.add(job)
        return actions
"""


@pytest.fixture
def served() -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The example as a process: the name of its policy, and the process."""
    with Router() as router, running("own_policy_process", router.endpoint.rsplit(":", 1)[1], "mine") as process:
        yield f"bus:mine@{router.endpoint}", process


@pytest.fixture
def same_rule(tmp_path: Path) -> str:
    path = tmp_path / "same_rule.py"
    path.write_text(SAME_RULE, encoding="utf-8")
    return f"{path}:Quickest"


@pytest.fixture
def fleet(small_toml: Path, plans: Path) -> Fleet:
    return prepare(load(small_toml), difficulty="blind", cache=plans)


def test_the_process_does_what_the_same_rule_does_in_python(fleet, served, same_rule):
    on_bus, _ = served
    shifts = outcomes(fleet, on_bus, range(4))
    assert shifts == outcomes(fleet, same_rule, range(4))
    assert any(shift.finished for shift in shifts)
    spec = RunSpec(policy=on_bus, seed=2, bus="memory", difficulty="blind")
    one, other = run(fleet, spec, record=False), run(fleet, replace(spec, policy=same_rule), record=False)
    assert (one.reward, one.metrics) == (other.reward, other.metrics)
    assert one.metrics.finished


@pytest.mark.ci_slow
def test_rows_are_the_same_on_one_and_two_processes(small_toml, plans, served, same_rule, monkeypatch):
    monkeypatch.setattr(runner, "HERE_S", 0.0)
    on_bus, _ = served
    case = Case(name="heat", scenario=load(small_toml), seeds=tuple(range(18)))  # two units
    study = Study(policies=[on_bus, same_rule], cases=[case], difficulties=["blind"])
    rows = runner.run_study(study, cache_dir=plans, workers=1)
    assert rows == runner.run_study(study, cache_dir=plans, workers=2)
    assert [row.outcome for row in rows[:18]] == [row.outcome for row in rows[18:]]
    assert not any(row.error or row.illegal for row in rows)


def test_a_process_that_ends_or_hangs_in_a_shift_fails_the_shift(fleet, served):
    on_bus, process = served
    policy, observations = policy_of(on_bus), seen()
    policy.act(observations)
    os.kill(process.pid, signal.SIGSTOP)
    hung = play(fleet, on_bus, [0], limit_s=0.5)[0]
    assert "a decision took longer than 0.5 s (--decision-limit)" in str(hung.error)
    later = threading.Timer(0.5, process.kill)  # while the decision is awaited
    later.start()
    with pytest.raises(BusError, match="No process serves the policy 'mine'"):
        policy.act(observations)
    later.join(PATIENCE_S)
    process.wait(PATIENCE_S)
    ended = play(fleet, on_bus, [0, 1])
    assert all("No process serves the policy 'mine'" in str(shift.error) for shift in ended)


def test_a_process_refuses_observations_of_another_version(served):
    on_bus, _ = served
    before = encoding(ActRequest).replace("v5", "v4")
    with open_client(on_bus.partition("@")[2], timeout_s=PATIENCE_S) as session:
        (reply,) = session.get(KEY, payload="{}", encoding=before, timeout=PATIENCE_S)
    expected = "Malformed ActRequest: .*thermofleet.ActRequest.v4', not 'application/json;thermofleet.ActRequest.v5'"
    assert re.search(expected, json.loads(reply.ok.payload.to_bytes())["reason"])


def test_few_requests_wait_for_a_process_and_the_oldest_are_dropped():
    act = "lambda _: (print('busy', flush=True), threading.Event().wait())"
    busy = f"import threading, own_policy_process as p; p.act = {act}; p.main({{}}, 'mine')"
    ended: queue.Queue[int] = queue.Queue()
    told: queue.Queue[str] = queue.Queue()
    with Router() as router, open_client(router.endpoint, timeout_s=PATIENCE_S) as session:
        command = [sys.executable, "-c", busy.format(router.endpoint.rsplit(":", 1)[1])]
        with started(command, cwd=ROOT / "examples") as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready mine\n"
            threading.Thread(target=lambda: told.put(process.stdout.readline()), daemon=True).start()

            def ask(when_over: Callable[[], None]) -> None:
                handler = zenoh.handlers.Callback(lambda _: None, when_over)
                session.get(KEY, handler, payload="{}", encoding=encoding(ActRequest), timeout=2 * PATIENCE_S)

            ask(partial(told.put, "nobody there yet"))
            while told.get(timeout=PATIENCE_S) != "busy\n":  # it is at work on the first one, so the others wait
                ask(partial(told.put, "nobody there yet"))
            for number in range(1, 1 + MOST_WAITING + 3):
                ask(partial(ended.put, number))
            assert {ended.get(timeout=PATIENCE_S) for _ in range(3)} == {1, 2, 3}
            assert ended.empty()


def test_names_of_policies_on_the_bus():
    for name in ("bus:mine", "bus:mine@tcp/127.0.0.1:7448"):
        assert (scope_of(name), label(name), source_of(name), policy_hash(name)) == ("central", "bus:mine", None, "")
        assert is_on_bus(name)
        assert not is_built_in(name)
    wrapped = "limited:bus:mine@tcp/127.0.0.1:7448"
    assert (scope_of(wrapped), label(wrapped), policy_hash(wrapped)) == ("central", "limited:bus:mine", "")
    assert policy_of(wrapped).scope == "central"
    for name, said in (
        ("bus:", "After 'bus:' the name of a policy must have 1 to 128 printable characters"),
        ("bus:a/b", r"\(got 'a/b'\)"),
        ("bus:mine@tcp/10.0.0.1:7447", "is not on loopback"),
        ("bus:mine@7448", "Expected tcp/<address>:<port>"),
    ):
        with pytest.raises(FleetError, match=said):
            policy_of(name)


def test_a_wrapped_policy_sees_the_narrowed_mask(served):
    on_bus, _ = served
    policy = policy_of(f"shutdown:{on_bus}")
    policy.reset(np.random.default_rng(0))
    cool = {arm: replace(each, headroom_k=np.float32(20.0)) for arm, each in seen().items()}
    hot = {arm: replace(each, headroom_k=np.float32(-1.0)) for arm, each in cool.items()}
    assert all(policy.act(cool).values())
    assert not any(policy.act(hot).values())
