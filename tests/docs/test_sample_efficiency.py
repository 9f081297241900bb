"""The table of sample efficiency, and that its trainings are comparable."""

from pathlib import Path

import pytest

from benchmarks.result_tables import efficiency_table, trainings
from scenarios.json_rows import Rows

FILE = Path(__file__).parents[2] / "docs/results/sample_efficiency/heat_wave.jsonl"


def points(*rewards: float) -> list[dict[str, float]]:
    return [
        {"env_steps": 1000.0 * n, "hours": 10.0 * n, "cpu_s": 50.0 + n, "reward": reward}
        for n, reward in enumerate(rewards)
    ]


def test_a_cell_is_the_mean_over_trainings_with_its_t_interval(tmp_path) -> None:
    rows = Rows(tmp_path / "rows.jsonl")
    rows.append("random/0", {"method": "random", "seed": 0, "points": points(7.0), "config": {}})
    for seed, end in enumerate((1.0, 2.0, 3.0)):
        row = {"method": "mappo", "seed": seed, "points": points(0.0, 5.0, 5.0, 5.0, end), "config": {}}
        rows.append(f"mappo/{seed}", row)
    *_, random, mappo = efficiency_table(trainings(rows.path)).splitlines()
    assert random == "| `random` | 1 | 7.0 |  |  |  | 0 | 0 |"
    # Student's t of two degrees of freedom: 2 ± 4.3027 / √3.
    assert mappo == "| `--algo mappo` | 3 | 0.0 | 5.0 | 5.0 | 2.0 [-0.5, 4.5] | 40 | 4 |"


def test_all_trainings_of_the_page_have_the_same_shifts_code_and_evaluations() -> None:
    found = trainings(FILE)
    rows = [row for own in found.values() for row in own]
    for own in found.values():
        assert [row["seed"] for row in own] == list(range(len(own)))
    for name in ("scenario", "difficulty", "shifts", "code"):
        assert all(row[name] == rows[0][name] for row in rows), name
    trained = [row for row in rows if len(row["points"]) > 1]
    assert trained
    for row in trained:
        assert [point["env_steps"] for point in row["points"]] == pytest.approx(range(0, 24_001, 6_000))
