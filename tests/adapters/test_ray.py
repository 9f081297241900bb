"""A study on a Ray cluster of two nodes: the rows of one process, also when an actor or a node dies."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Thread

import pytest

from fleet.errors import FleetError
from scenarios.evaluate.runner import run_study
from scenarios.evaluate.study import Case, Row, Study
from scenarios.spec.load import load
from tests.own_policies import IDLE
from tests.waiting import wait_until

pytestmark = [
    pytest.mark.adapter,
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # of its processes' sockets
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

OWN = f"""{IDLE}
class Where(Idle):
    def act(self, seen):
        import ray
        node = ray.get_runtime_context().get_node_id()
        pathlib.Path(__file__).with_name(f"ran_{{node}}").touch()
        return {{}}
class Waits(Idle):
    def act(self, seen):
        here = pathlib.Path(__file__).parent
        (here / "waits").touch()
        for _ in range(1200):
            if (here / "go").exists(): break
            threading.Event().wait(0.05)
        return {{}}
"""


@pytest.fixture(scope="module")
def cluster(home) -> Iterator:
    """Two nodes of one CPU each, with a cache that both share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "disabled")
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", f"{Path(__file__).parents[2]}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
        import ray
        from ray.cluster_utils import Cluster

        nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        nodes.add_node(num_cpus=1)
        ray.init(nodes.address, log_to_driver=False)  # here, as it takes the signals of this process
        yield nodes
        ray.shutdown()
        nodes.shutdown()


@pytest.fixture
def study(tmp_path) -> Study:
    scenario = replace(load("quickstart"), horizon_s=300.0)
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    case = Case(name="quick", scenario=scenario, seeds=tuple(range(20)))
    return Study(policies=["random", "wspt"], cases=[case], difficulties=["blind"])


def own(study: Study, folder: Path, *names: str) -> Study:
    return replace(study, policies=[f"{folder / 'own.py'}:{name}" for name in names])


def figures(rows: list[Row]) -> list[object]:
    return [row.outcome for row in rows]


def test_two_nodes_give_the_rows_of_one_process(cluster, study, tmp_path):
    assert run_study(study, ray=cluster.address) == run_study(study, workers=1)
    where = own(study, tmp_path, "Where", "Idle")
    rows = run_study(where, ray=cluster.address, out=tmp_path / "out")
    assert figures(rows[:20]) == figures(rows[20:])
    assert len(list(tmp_path.glob("ran_*"))) == 2


def test_what_an_actor_ran_that_died_is_run_again(cluster, study, tmp_path):
    told: list[str] = []
    rows = run_study(own(study, tmp_path, "DiesOnce", "Idle"), ray=cluster.address, tell=told.append)
    assert figures(rows[:20]) == figures(rows[20:])
    assert len(told) == 1


def test_other_files_of_a_policy_are_refused(cluster, study, tmp_path, monkeypatch):
    monkeypatch.setattr("scenarios.evaluate.runner.policy_hash", lambda policy: "another")
    with pytest.raises(FleetError, match=r"has other files of the policy 'random': copy the same to every machine\."):
        run_study(study, ray=cluster.address)


@pytest.fixture(scope="module")
def node(cluster):
    return cluster.add_node(num_cpus=1)


def test_a_study_outlives_a_node(cluster, node, study, tmp_path):
    waits = own(study, tmp_path, "Waits")

    def take_it_away() -> None:
        wait_until((tmp_path / "waits").exists)
        cluster.remove_node(node)
        (tmp_path / "go").touch()

    thread = Thread(target=take_it_away)
    thread.start()
    rows = run_study(waits, ray=cluster.address)
    thread.join()
    (tmp_path / "go").touch()
    assert figures(rows) == figures(run_study(own(study, tmp_path, "Idle"), workers=1))
