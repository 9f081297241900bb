"""docs/env.md is correct: its generated tables are current, and its example runs."""

import re
from pathlib import Path
from typing import Any

import pytest

from docs.tables import fill_tables
from fleet.engine.batch import TERMS
from fleet.observation import BIDS, FIELDS, Layout
from scenarios.prepare.batch import make_batch
from scenarios.prepare.fleet import make_env
from scenarios.spec.parse import override
from scenarios.spec.schema import RewardSpec

PAGE = Path(__file__).parents[2] / "docs" / "env.md"
TEXT = PAGE.read_text(encoding="utf-8")


def test_tables_are_current() -> None:
    assert fill_tables(TEXT) == TEXT, "write it anew with: python docs/tables.py"


def test_offsets_of_the_table_are_correct() -> None:
    layout = Layout(4, 16, plans=2)
    rows = dict(re.findall(r"^\| `(\w+)` \| \w+ \| ([\d–]+) \| [^|]+ \| [^|]+ \| [^|]+ …", TEXT, re.MULTILINE))
    assert list(rows) == [field.name for field in FIELDS if field.name not in BIDS]
    ends = [int(place.split("–")[-1]) for place in rows.values()]
    assert [int(place.split("–")[0]) for place in rows.values()] == [0, *(end + 1 for end in ends[:-1])]
    assert ends[-1] == layout.size - 1 == 382
    parts = "(213 of the 383\nnumbers)", "own\npart (170)"
    assert all(part in TEXT for part in parts)
    assert (layout.shared, layout.size - layout.shared) == (213, 170)


@pytest.mark.parametrize(("n", "slots", "plans"), [(1, 1, 1), (4, 16, 2), (7, 3, 2)])
def test_the_size_in_the_page_is_correct(n, slots, plans) -> None:
    formula = r"size = (\d+) \+ (\d+) K \+ (\d+) K P \+ n \((\d+) \+ K\)"
    a, b, c, d = map(int, re.findall(formula, TEXT)[0])
    assert Layout(n, slots, plans=plans).size == a + (b + c * plans) * slots + n * (d + slots)
    assert Layout(n, slots, ((),) * n, plans=plans).size == a + (b + c * plans) * slots
    (per_plan,) = re.findall(r"with bids another (\d+) n K P", TEXT)
    assert Layout(n, slots, plans=plans, bids=True).size == a + (
        b + c * plans + int(per_plan) * n * plans
    ) * slots + n * (d + slots)


def test_every_info_is_in_the_page(make, batch) -> None:
    infos = make().reset(seed=0)[1]["arm_0"]
    named = set(re.findall(r"`(?:info\[\")?(\w+)(?:\"\])?`", TEXT))
    assert {name for name in (*infos, *batch(1).reset()[1]) if name not in named} == set()
    weights = RewardSpec()
    for name in TERMS:
        given = getattr(weights, name)
        weight = "−price of a fault" if given is None else f"{given:g}".replace("-", "−")
        assert f"| `reward_{name}` | {weight} |" in TEXT


def test_the_example_of_the_page_runs(monkeypatch, cell, plans) -> None:
    """With a cell that takes little time to plan."""

    def small(given: dict[str, Any]) -> dict[str, Any]:
        fields = {name: given.pop(name) for name in ("horizon_s",) if name in given}
        return {"scenario": override(cell, **fields), "cache": plans, **given}

    def env(scenario: str, **given: Any) -> Any:
        assert scenario == "quickstart"
        return make_env(**small(given))

    def batch(scenario: str, num_envs: int, **given: Any) -> Any:
        assert scenario == "quickstart"
        return make_batch(**small(given), num_envs=num_envs)

    monkeypatch.setattr("thermofleet.make_env", env, raising=False)
    monkeypatch.setattr("thermofleet.make_batch", batch, raising=False)
    monkeypatch.setattr("scenarios.prepare.env_registration.make_env", env)
    namespace: dict[str, Any] = {}
    exec(TEXT.split("```python\n")[1].split("```")[0], namespace)
    assert namespace["env"].agents == []
    assert namespace["by_name"].possible_agents == list(namespace["batch"].agents)
    assert namespace["reward"].shape == (32,)
