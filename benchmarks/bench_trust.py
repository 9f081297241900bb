"""Calibration of the arms' P(saturation) in shifts: the probability at each award against the outcome.

    python -m benchmarks.bench_trust [quickstart] [--seeds 10] [--first-seed 100]

Every shift runs with `round_robin`, which ignores the probability. A job counts if its arm had a probability and was
below the warning limit at the award; it passed if the arm gave a warning before the end of the job. The models learned
from simulated past jobs only, at other ambient temperatures and other starts. Beside P: the paper's sum d, for ranking,
and one constant probability for all jobs, for the Brier score.
"""

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table
from sklearn.metrics import average_precision_score, roc_auc_score

from scenarios.cli.terminal import progress_bar
from scenarios.policy_loader import policy_of
from scenarios.prepare.fleet import Fleet, env_of, prepare
from scenarios.spec.load import load
from twin.p_saturation import brier, reliability

POLICY = "round_robin"
UNKNOWN = 0.5
"""Value of an observation without a probability (`fleet.observation.FIELDS`)."""


def awards(fleet: Fleet, seed: int) -> list[tuple[float, float, bool]]:
    """P(saturation), d and whether a motor passed the limit, of each award of a shift."""
    policy = policy_of(POLICY)
    policy.reset(np.random.default_rng(seed))
    env = env_of(fleet, keep_events=True)
    scores: dict[tuple[str, str, float], tuple[float, float]] = {}
    try:
        env.reset(seed=seed)
        while env.agents:
            known = env.knowledge()
            actions = policy.act(known)
            seen = len(env.events)
            env.step(actions)
            for event in env.events[seen:]:
                before = known.get(event.arm)
                if event.kind == "award" and before is not None and before.headroom_k > 0:
                    slot = actions[event.arm] - 1
                    p, d = float(before.p_saturation[slot]), float(before.difficulty[slot])
                    if p != UNKNOWN:
                        scores[event.arm, event.job, event.time_s] = p, d
        ends = [e for e in env.events if e.kind in ("home", "return")]
        warnings = [e for e in env.events if e.kind == "warning"]
    finally:
        env.close()
    rows = []
    for (arm, job, begun_s), (p, d) in scores.items():
        own_ends = [e.time_s for e in ends if e.arm == arm and e.job == job and e.time_s > begun_s]
        until_s = min(own_ends, default=np.inf)
        passed = any(e.arm == arm and begun_s <= e.time_s <= until_s for e in warnings)
        rows.append((p, d, passed))
    return rows


def main() -> None:
    """Print the figures and the reliability table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", nargs="?", default="quickstart")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=100)
    given = parser.parse_args()
    with progress_bar() as progress:
        fleet = prepare(load(given.scenario), progress=progress)
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    p, d, passed = np.array([row for seed in seeds for row in awards(fleet, seed)]).T
    event = passed > 0
    console = Console()
    share = event.mean()
    console.print(f"{given.scenario}, seeds {seeds.start} to {seeds.stop - 1}: {len(p)} awards, {share:.1%} passed.")
    if not 0 < share < 1:
        console.print("All jobs have the same outcome: there is nothing to rank.")
        return
    table = Table("", "P(saturation)", "d (paper)", "constant", box=None)
    table.add_row("AUROC", f"{roc_auc_score(event, p):.3f}", f"{roc_auc_score(event, d):.3f}", "0.500")
    table.add_row(
        "AUPRC", f"{average_precision_score(event, p):.3f}", f"{average_precision_score(event, d):.3f}", f"{share:.3f}"
    )
    table.add_row("Brier", f"{brier(p, event):.4f}", "", f"{share * (1 - share):.4f}")
    table.add_row("ECE", f"{reliability(p, event).error:.4f}", "", "0.0000")
    console.print(table)
    bins = Table("mean P", "share that passed", "95 % interval", "awards", box=None)
    found = reliability(p, event)
    for mean_p, shared, low, high, count in zip(
        found.mean_p, found.share, found.low, found.high, found.count, strict=True
    ):
        bins.add_row(f"{mean_p:.3f}", f"{shared:.3f}", f"{low:.3f} to {high:.3f}", str(int(count)))
    console.print(bins)


if __name__ == "__main__":
    main()
