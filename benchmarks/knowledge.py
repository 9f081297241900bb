"""Store results of the best rule and of `mpc` by what the arms know: python -m benchmarks.knowledge FOLDER …

Each folder is of `thermofleet compare` on the instances that `--instances` prints, those of the cells of the test split
with at most eight arms, since past jobs of all arms are simulated for each source:

    thermofleet compare --suite $(python -m benchmarks.knowledge --instances) --trainings 3 --out runs/knowledge \
        --policies bid_price@blind,bid_price@torque,bid_price@untrained,bid_price@trained,bid_price@rc-nominal,\
    bid_price@torque-alone,bid_price@untrained-alone,bid_price@trained-alone,\
    bid_price@rc,mpc@rc,benchmarks/mpc_parts.py:WithoutHeat@rc
    python -m benchmarks.knowledge runs/knowledge

Whatever was chosen on these shifts is tested on fresh ones: other seeds of those instances in which heat binds. The
first seed of each, that of the split, is left out; without a reference of its own a fresh shift has the unit of its
instance.

    hot=$(python -m benchmarks.knowledge --instances --hot)
    thermofleet compare --suite $hot --seeds 6 --trainings 3 --out runs/fresh --policies bid_price@blind,\
    bid_price@torque-alone,bid_price@untrained-alone,bid_price@trained-alone,\
    bid_price@torque,bid_price@untrained,bid_price@trained,bid_price@rc-nominal
    thermofleet compare --suite $hot --seeds 6 --out runs/fresh_rc \
        --policies bid_price@rc,bid_price@twin,bid_price@oracle,wsept@twin,bid_price_shared@twin
    python -m benchmarks.knowledge --fresh runs/fresh runs/fresh_rc
"""

import json
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from scenarios.evaluate.leaderboard import submissions_of, write
from scenarios.evaluate.store import read_card, read_rows
from scenarios.evaluate.study import Row
from scenarios.suite.splits import cell_of_instance, heat_binds, manifest

RESULTS = Path(__file__).parents[1] / "docs" / "results"
OUT, FRESH = RESULTS / "knowledge", RESULTS / "fresh.json"
MOST_ARMS = 8


def main(given: list[str]) -> None:
    """Print the instances, or write a file for each source, or the one of fresh shifts."""
    if given[:1] == ["--instances"] and given[1:] in ([], ["--hot"]):
        names = [line.name for line in manifest("test") if cell_of_instance(line).arms <= MOST_ARMS]
        print(",".join(name for name in names if len(given) == 1 or heat_binds(name)))
    elif given[:1] == ["--fresh"] and given[1:]:
        FRESH.write_text(json.dumps(fresh(map(Path, given[1:])), indent=1) + "\n", encoding="utf-8")
        print(FRESH)
    elif not given or given[0].startswith("-"):
        raise SystemExit(__doc__)
    else:
        for folder in map(Path, given):
            for each in submissions_of(read_card(folder), read_rows(folder), "thermofleet", ""):
                print(write(each, OUT))


def fresh(folders: Iterable[Path]) -> dict[str, dict[str, object]]:
    """Shifts with other seeds than the split's: by source of `bid_price`, and by name for other policies, their seeds
    and trainings for each instance, and its mean reward and faults."""
    of_split = {line.name: line.seed for line in manifest("test")}
    found: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for folder in folders:
        for row in read_rows(folder):
            if row.outcome is None:
                raise SystemExit(f"{folder}: a shift of {row.key.instance} failed: {row.error}")
            if row.key.seed != of_split[row.key.instance]:
                source = row.key.difficulty if row.key.policy == "bid_price" else row.key.policy
                found[source][row.key.instance].append(row)
    return {
        source: {
            "seeds": len({row.key.seed for row in next(iter(of_instance.values()))}),
            "trainings": len({row.key.training for row in next(iter(of_instance.values()))}),
            **{
                figure: {
                    name: round(float(np.mean([getattr(row.outcome, figure) for row in rows])), 6)
                    for name, rows in of_instance.items()
                }
                for figure in ("reward", "faults")
            },
        }
        for source, of_instance in found.items()
    }


if __name__ == "__main__":
    main(sys.argv[1:])
