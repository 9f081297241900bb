"""Fleets of 1 000 and 10 000 arms: the table of loads, and the value that is lost if few arms are asked for a quote.

    python -m benchmarks.scaling [load] [ask] [--seeds 8] [--arms 64] [--arrivals 1.0] [--difficulty twin]

`load` is a calculation: the sizes of the messages are those of encoded examples, the rates those of the contract, and
the costs per message those that `costs.py` measures.
`ask` simulates shifts of one large cell: the arms of quickstart repeated, arrivals multiplied accordingly, every arm
with its own stations. The auctioneer matches jobs and arms by the quotes of k arms for each job. The arms are chosen by
what they publish anyway: free ones that can do the job, the coolest first, or at random. Each seed is the same shift
for all k, so differences are paired. Deterministic.
"""

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks.scaling.ask import print_asked
from benchmarks.scaling.load import print_loads


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", choices=("load", "ask"), default=("load", "ask"))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--arms", type=int, default=64)
    parser.add_argument("--arrivals", type=float, default=1.0, help="jobs per arm, relative to quickstart")
    parser.add_argument("--difficulty", choices=("twin", "blind"), default="twin")
    arguments = parser.parse_args()
    if "load" in arguments.tables:
        print_loads()
    if "ask" in arguments.tables:
        print_asked(arguments.arms, arguments.seeds, arguments.difficulty, arguments.arrivals)


if __name__ == "__main__":
    main()
