"""Conclusions of a twin report: the paper's claims beside the measured figures."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from scenarios.show.page import Section, Table
from scenarios.studies.benchmark import BASELINES, THERMAL, VAE
from scenarios.studies.ranking import LABELS, spread

CLAIM = (
    "The paper (E. Guiffo Kaigom, arXiv 2509.12740) claims that an LSTM variational autoencoder, trained without "
    "labels on motion that stays cool, reconstructs critical motion worse, that the error in [0, 1) per joint and "
    "summed is a measure of thermal difficulty, and that the latent gives new uncritical motion."
)
LIMITS = (
    "Limits: the score uses motion and torque alone. It ignores the start temperatures of the motors, the "
    "duration of a job, and the heat in the housings. P(saturation) uses the first two, a thermal network all three.",
    "Every novelty detector rates light new motion as difficult. A high d means new motion or more load than usual; "
    "the channel shares say which. Only load heats.",
)
SIMULATED = (
    "The simulated truth is a thermal network whose absolute scale is known to ± 25 % and which extrapolates above "
    "55 °C. Its figures compare methods; they do not predict temperatures of a real arm."
)

JOINT_2 = "joint 2, joint 2"
"""The paper's question, of `ranking.QUESTIONS`."""
RANKING_TARGETS = {"auroc": 0.93, "auprc": 0.80, "spearman": 0.75}
HEAD_TARGETS = {"auroc": 0.97, "brier": 0.05, "ece": 0.05}
RC_TARGETS = {"auroc": 0.985, "brier": 0.045, "ece": 0.04}
"""Set before anything was measured: for d of joint 2, and for P(saturation) of the learned twin and of the identified
network."""
Row = tuple[str, str, bool]
"""Claim, measurement, and whether it holds."""
Numbers = Mapping[str, Any]  # plain values of a section
Values = Sequence[float] | np.ndarray


def claims(sections: Sequence[Section], *, simulated: bool = False) -> Section:
    """The paper's claims with their measurements, baselines that are better, and limits."""
    by_key = {section.key: section.numbers for section in sections if not section.failed}
    rules = SIMULATION if simulated else LOGS
    results = [row for key, rule in rules.items() if key in by_key for row in rule(by_key[key])]
    rows = tuple((claim, measured, "yes" if holds else "no") for claim, measured, holds in results)
    missing = "; ".join(section.title for section in sections if section.failed)
    sentences = (
        CLAIM,
        _better_baselines(by_key["quality"]) if "quality" in by_key else "",
        *LIMITS,
        SIMULATED if simulated else "",
        f"Not measured in this report: {missing}." if missing else "",
    )
    return Section(
        key="claims",
        title="Conclusions",
        sentences=tuple(filter(None, sentences)),
        tables=(Table(head=("claim or target", "measured", "holds"), rows=rows),) if rows else (),
        numbers={"rows": [list(row) for row in rows]},
    )


def _better_baselines(quality: Numbers) -> str:
    """Baselines that rank jobs better than d of joint 2 under every seed, as a sentence."""
    auroc = {name: np.array(v["auroc"]) for name, v in quality[JOINT_2].items() if name in (VAE, *BASELINES)}
    own = auroc.pop(VAE)
    better = {name: spread(auroc[name]) for name in BASELINES if name in auroc and np.all(auroc[name] > own)}
    if not better:
        return f"No baseline ranks jobs better than the VAE's d of joint 2 (AUROC {spread(own)}) in every seed."
    groups = (
        ("with motion alone", [f"{name} ({a})" for name, a in better.items() if name not in THERMAL]),
        ("with thermal knowledge", [f"{name} ({a})" for name, a in better.items() if name in THERMAL]),
    )
    text = "; ".join(f"{given}: {', '.join(names)}" for given, names in groups if names)
    return f"Baselines that beat the VAE (AUROC {spread(own)}) in every seed, {text}."


def meets(values: Values, target: float, measure: str) -> bool:
    """Whether the mean over the seeds reaches a target: an upper bound for errors, else a lower one."""
    mean = float(np.mean(values))
    return mean <= target if measure in ("brier", "ece") else mean >= target


def against_targets(values: Mapping[str, Values], targets: Mapping[str, float]) -> str:
    """Measured against targets: `AUROC 0.981 ± 0.004 (target 0.97: reached), …`.

    Args:
        values: By measure, [seed].
    """
    return ", ".join(
        f"{LABELS[m]} {spread(values[m])} (target {target:g}: {'' if meets(values[m], target, m) else 'not '}reached)"
        for m, target in targets.items()
    )


def _difficulty(n: Numbers) -> Iterator[Row]:
    joint, auroc, of_sum = n["joint"], n["auroc"][n["joint"] - 1], n["auroc_of_sum"]
    measured = f"median d of joint {joint}: {n['critical']:.2f} critical, {n['cool']:.2f} cool"
    yield "critical motion is reconstructed worse", measured, n["critical"] > n["cool"]
    claim = "the sum over the joints measures difficulty as well as the best joint"
    yield claim, f"AUROC of the sum {of_sum:.2f}, of joint {joint} {auroc:.2f}", of_sum >= auroc - 0.01


def _quality(n: Numbers) -> Iterator[Row]:
    own = n[JOINT_2][VAE]
    for m, target in RANKING_TARGETS.items():
        yield f"d of joint 2: {LABELS[m]} ≥ {target:g}", spread(own[m]), meets(own[m], target, m)


def _saturation(n: Numbers) -> Iterator[Row]:
    for method, targets in ((n["best"], HEAD_TARGETS), ("rc identified", RC_TARGETS)):
        values = n["stated"][method]
        bounds = [f"{LABELS[m]} {'≥' if m == 'auroc' else '≤'} {target:g}" for m, target in targets.items()]
        measured = f"{'; '.join(spread(values[m]) for m in targets)} ({method})"
        yield f"P(saturation): {'; '.join(bounds)}", measured, all(meets(values[m], t, m) for m, t in targets.items())
    name = f"p_{n['best'].split(',')[0]}"
    if name in n["alarms"]:
        measures = ("false_alarms", "false_novel", "caught")
        false, novel, caught = (float(np.mean(n["alarms"][name][measure])) for measure in measures)
        claim = "alarm at 5 %: 2–8 % false, ≤ 10 % on light novel motions, ≥ 90 % caught"
        holds = 0.02 <= false <= 0.08 and novel <= 0.10 and caught >= 0.90
        yield claim, f"{false:.1%}; {novel:.1%}; {caught:.1%} ({name})", holds


def _generation(n: Numbers) -> Iterator[Row]:
    share = float(np.mean(n["truly_cool"]))
    yield (
        "generated motions stay uncritical: ≥ 95 % of the accepted ones",
        f"{share:.1%} truly stay cool",
        share >= 0.95,
    )


def _recovery(n: Numbers) -> Iterator[Row]:
    measured = f"{n['cooled_k']:+.1f} K in ten minutes"
    yield "a nearby posture lets the hottest motor cool", measured, n["cooled_k"] > 0


def _coverage(n: Numbers) -> Iterator[Row]:
    before, after = (float(np.mean([bar[how] for bar in n.values()])) for how in ("work only", "with exploration"))
    yield "exploration lowers false alarms on novel motions", f"{before:.0%} → {after:.0%}", after < before


def _log_difficulty(n: Numbers) -> Iterator[Row]:
    holds = float(np.mean(n["ratio"])) >= 2
    yield "error of joint 2 at least twice as large when hot", f"{spread(n['ratio'], 2)} times", holds


def _log_rc(n: Numbers) -> Iterator[Row]:
    auroc = n["below"]["auroc"]
    best = max(auroc, key=lambda name: auroc[name])
    claim = "passes 40 °C within 5 min: AUROC ≥ 0.95 with temperature and network"
    yield claim, f"{auroc[best]:.3f} ({best}); d alone {auroc['d']:.3f}", auroc[best] >= 0.95


Rules = dict[str, Callable[[Numbers], Iterator[Row]]]
"""By the key of the section that holds the figures."""
SIMULATION: Rules = {
    "difficulty": _difficulty,
    "quality": _quality,
    "saturation": _saturation,
    "generation": _generation,
    "recovery": _recovery,
    "coverage": _coverage,
}
LOGS: Rules = {"difficulty": _log_difficulty, "rc": _log_rc}
