"""Compare P(saturation) and predicted peaks at each award of simulated shifts with the outcome of the plan."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from sklearn.metrics import roc_auc_score

from agents.policy import WAIT
from fleet.difficulty import SETTLING_S
from fleet.engine.shift import StepRecord
from fleet.events import Event
from fleet.thermal import WINDING
from scenarios.evaluate.sources import drawn
from scenarios.policy_loader import policy_at
from scenarios.prepare.fleet import RISK, Fleet, RiskName, env_of, prepare
from scenarios.prepare.known_cell import let_plan
from scenarios.progress import Progress, quiet
from scenarios.schema import Scenario
from twin.saturation.reliability import Reliability, brier, reliability

Array = np.ndarray

POLICIES = ("wspt", "wspt_cool", "least_difficulty")
FIRST_SEED = 10_000
"""Seeds from this one on were not used for tuning."""
WARM_K = 5.0
"""An arm is warm if its hottest motor is at most this far below the warning limit, or above the limit."""


@dataclass(frozen=True, eq=False)
class Awards:
    """Awards with a known outcome, arrays [award]."""

    p: Array
    """P(saturation) at the award."""
    predicted_c: Array
    """Predicted peak at the award."""
    peak_c: Array
    """True peak, counted as in `fleet.difficulty.SETTLING_S`; NaN if a fault ended the plan."""
    passed: Array
    """Whether a motor passed the warning limit, bool."""
    warm: Array
    """Whether the arm was warm at the award, bool; see `WARM_K`."""
    unknown: int = 0
    """Number of awards without a known outcome: the shift ended, or the arm gave the job back."""

    def __len__(self) -> int:
        return len(self.p)

    def part(self, rows: Array) -> "Awards":
        """Some of the awards, by index or mask."""
        return Awards(*(getattr(self, field.name)[rows] for field in fields(self)[:-1]))


def groups(awards: Awards) -> dict[str, Awards]:
    """All awards, those of warm arms, and those of cool arms."""
    return {"all": awards, "warm": awards.part(awards.warm), "cool": awards.part(~awards.warm)}


def awards_as_json(awards: Awards) -> dict[str, Any]:  # JSON
    """Verdict on each of the `groups`, and the number of unknown outcomes."""
    verdicts = {name: verdict(part) for name, part in groups(awards).items()}
    return {"unknown": awards.unknown} | {name: v and v.as_json() for name, v in verdicts.items()}


def join(parts: Sequence[Awards]) -> Awards:
    """Concatenate the awards of several shifts."""
    names = [field.name for field in fields(Awards)[:-1]]
    arrays = [np.concatenate([getattr(part, name) for part in parts]) for name in names]
    return Awards(*arrays, unknown=sum(part.unknown for part in parts))


@dataclass(frozen=True, eq=False, kw_only=True)
class Verdict:
    """Accuracy of P(saturation) and predicted peaks."""

    awards: int
    passed: int
    ece: float
    brier: float
    auroc: float
    """NaN if all awards had the same outcome."""
    peak_rms_k: float
    """Root mean square of predicted minus true peak, over plans that no fault ended."""
    peak_bias_k: float
    table: Reliability

    def as_json(self) -> dict[str, Any]:
        """All numbers; NaN becomes None."""
        numbers = {name: value for name, value in vars(self).items() if name != "table"}
        numbers = {name: None if value != value else value for name, value in numbers.items()}
        return numbers | {"reliability": {name: values.tolist() for name, values in vars(self.table).items()}}


def verdict(awards: Awards) -> Verdict | None:
    """Accuracy of the predictions at these awards; None without awards."""
    if not len(awards):
        return None
    table, error_k = reliability(awards.p, awards.passed), (awards.predicted_c - awards.peak_c)
    error_k = error_k[np.isfinite(error_k)]
    both = 0 < awards.passed.sum() < len(awards)
    return Verdict(
        awards=len(awards),
        passed=int(awards.passed.sum()),
        ece=table.error,
        brier=brier(awards.p, awards.passed),
        auroc=float(roc_auc_score(awards.passed, awards.p)) if both else np.nan,
        peak_rms_k=float(np.sqrt(np.mean(error_k**2))) if len(error_k) else np.nan,
        peak_bias_k=float(error_k.mean()) if len(error_k) else np.nan,
        table=table,
    )


def shift_reliability(
    scenario: Scenario,
    *,
    policies: Sequence[str] = POLICIES,
    seeds: Sequence[int] = tuple(range(FIRST_SEED, FIRST_SEED + 4)),
    fleets: int = 3,
    risk: RiskName = RISK,
    progress: Progress = quiet,
    make: Callable[..., Fleet] = prepare,
) -> dict[str, Awards]:
    """The awards of every policy, over all seeds and over several draws of the arms.

    Args:
        fleets: Number of draws: with `spread.seed` of the scenario and the following numbers.
        make: Function that prepares the fleet of a scenario.
    """
    found: dict[str, list[Awards]] = {policy: [] for policy in policies}
    runs = len(seeds) * len(policies)
    for draw in range(fleets):
        fleet = make(drawn(scenario, draw), risk=risk, progress=progress)
        for i, (policy, seed) in enumerate((policy, seed) for policy in policies for seed in seeds):
            progress("working", (draw + i / runs) / fleets)
            found[policy].append(awards_of_shift(fleet, policy, seed))
    return {policy: join(parts) for policy, parts in found.items()}


def awards_of_shift(fleet: Fleet, policy: str, seed: int) -> Awards:
    """The awards of one shift, with the predictions at each award and the outcome of its plan."""
    records: list[StepRecord] = []
    env = env_of(fleet, bus="memory", keep_events=True, watch=records.append, decisions="interval")
    chooser, stated = policy_at(policy, seed), dict[tuple[str, int], tuple[float, float, bool]]()
    warm_c = fleet.scenario.limits.warning_c - WARM_K
    try:
        env.reset(seed=seed)
        let_plan(chooser, fleet, env, seed)
        while env.agents:
            known, tick = env.knowledge(), env.tick
            actions = chooser.act(known)
            for arm, action in actions.items():
                own = known[arm]
                if WAIT < action < env.layout.actions - 1:
                    option, warm = int(action) - 1, bool(own.temp_c.max() >= warm_c)
                    stated[arm, tick] = float(own.p_saturation[option]), float(own.peak_c[option]), warm
            env.step(actions)
    finally:
        env.close()
    ends_c = np.concatenate([record.end_c for record in records])[..., WINDING]  # [step, arm, joint]
    rows, unknown = [], 0
    for arm, begin_s, end_s, faulted in _plans(env.events):
        tick = round(begin_s / env.world.dt_s)
        if end_s is None:
            unknown += 1
            continue
        own_c = ends_c[:, env.possible_agents.index(arm)]
        peak_c = np.nan if faulted else _true_peak(own_c, env.world.dt_s, begin_s, end_s)
        rows.append((*stated[arm, tick], peak_c, faulted or peak_c >= fleet.scenario.limits.warning_c))
    p, predicted_c, warm, peak_c, passed = np.array(rows, dtype=float).reshape(-1, 5).T
    return Awards(p, predicted_c, peak_c, passed.astype(bool), warm.astype(bool), unknown)


def _plans(events: Sequence[Event]) -> Iterator[tuple[str, float, float | None, bool]]:
    """Arm, begin, end, and whether a fault ended it, of every awarded plan; the end is None if it is unknown."""
    ends = ("home", "fault", "give_back", "award")
    own: dict[str, list[Event]] = {}
    for event in sorted(events, key=lambda event: event.time_s):
        if event.kind in ends:
            own.setdefault(event.arm, []).append(event)
    for arm, log in own.items():
        for event, after in zip(log, [*log[1:], None], strict=True):
            if event.kind == "award":
                end = after if after is not None and after.kind in ("home", "fault") else None
                yield arm, event.time_s, end and end.time_s, end is not None and end.kind == "fault"


def _true_peak(ends_c: Array, dt_s: float, begin_s: float, end_s: float) -> float:
    """Hottest winding at the ends of the steps between `SETTLING_S` after the begin and the end, °C.

    Args:
        ends_c: Windings of the arm at the end of each step, [step, joint].
    """
    first = round(min(begin_s + SETTLING_S, end_s) / dt_s - 1e-9)
    last = int(np.ceil(end_s / dt_s - 1e-9))
    return float(ends_c[max(first, 1) - 1 : max(last, 1)].max())
