"""Store results of the best rule and of `mpc` by what the arms know: python -m benchmarks.knowledge FOLDER …

Each folder is of `thermofleet compare` on the instances that `--instances` prints, those of the cells of the test split
with at most eight arms, since past jobs of all arms are simulated for each source:

    thermofleet compare --suite $(python -m benchmarks.knowledge --instances) --trainings 3 --out runs/knowledge \
        --policies bid_price@blind,bid_price@torque,bid_price@untrained,bid_price@trained,bid_price@rc-nominal,\
    bid_price@torque-alone,bid_price@untrained-alone,bid_price@trained-alone,\
    bid_price@rc,mpc@rc,benchmarks/mpc_parts.py:WithoutHeat@rc
    python -m benchmarks.knowledge runs/knowledge
"""

import sys
from pathlib import Path

from scenarios.evaluate.leaderboard import submissions_of, write
from scenarios.evaluate.store import read_card, read_rows
from scenarios.suite.splits import cell_of_instance, manifest

OUT = Path(__file__).parents[1] / "docs" / "results" / "knowledge"
MOST_ARMS = 8


def main(given: list[str]) -> None:
    """Print the instances, or write a file for each source."""
    if given == ["--instances"]:
        print(",".join(line.name for line in manifest("test") if cell_of_instance(line).arms <= MOST_ARMS))
        return
    if not given or given[0].startswith("-"):
        raise SystemExit(__doc__)
    for folder in map(Path, given):
        for each in submissions_of(read_card(folder), read_rows(folder), "thermofleet", ""):
            print(write(each, OUT))


if __name__ == "__main__":
    main(sys.argv[1:])
