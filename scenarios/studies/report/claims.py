"""Conclusions of a twin report: the paper's claims beside the measured figures."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from scenarios.report.page import Section, Table
from scenarios.studies.benchmark import BASELINES, THERMAL, VAE
from scenarios.studies.ranking import QUESTIONS, spread

CLAIM = (
    "The paper (E. Guiffo Kaigom, arXiv 2509.12740) claims that an LSTM variational autoencoder, trained without "
    "labels on motion that stays cool, reconstructs critical motion worse, that the error in [0, 1) per joint and "
    "summed is a measure of thermal difficulty, and that the latent gives new uncritical motion."
)
LIMITS = (
    "Limits: the score uses motion and torque alone. It does not know the start temperatures of the motors, the "
    "duration of a job, or the heat in the housings. P(saturation) uses the first two, a thermal network all three.",
    "Every novelty detector rates light new motion as difficult. A high d means new motion or more load than known; "
    "the channel shares say which. Only load heats.",
)
SIMULATED = (
    "The simulated truth is a thermal network whose absolute scale is known to ± 25 % and which extrapolates above "
    "55 °C. Its figures compare methods; they do not predict temperatures of a real arm."
)

AUROC = "auroc"
Row = tuple[str, str, str]
Numbers = Mapping[str, Any]  # plain values of a section


def claims(sections: Sequence[Section], *, simulated: bool = False) -> Section:
    """The paper's claims with their measurements, baselines that are better, and limits."""
    by_key = {section.key: section.numbers for section in sections if not section.failed}
    makers = SIMULATION if simulated else LOGS
    rows = tuple(row for key, make in makers if key in by_key for row in make(by_key[key]))
    missing = [section.title for section in sections if section.failed]
    unmeasured = (f"Not measured in this report: {'; '.join(missing)}.",) if missing else ()
    return Section(
        key="claims",
        title="Conclusions",
        sentences=(
            CLAIM,
            *ahead(by_key.get("quality", {})),
            *LIMITS,
            *((SIMULATED,) if simulated else ()),
            *unmeasured,
        ),
        tables=(Table(head=("claim or target", "measured", "holds"), rows=rows),) if rows else (),
        numbers={"rows": [list(row) for row in rows]},
    )


def ahead(quality: Numbers) -> tuple[str, ...]:
    """Baselines that rank jobs better than d of joint 2 under every seed, as a sentence."""
    values = quality.get(QUESTIONS[-1])
    if not values:
        return ()
    auroc = {name: np.array(values[name]["auroc"]) for name in (VAE, *BASELINES) if name in values}
    own = auroc.pop(VAE)
    better = {name: spread(seeds) for name, seeds in auroc.items() if np.all(seeds > own)}
    if not better:
        return (f"No baseline ranks jobs better than the VAE's d of joint 2 (AUROC {spread(own)}) in every seed.",)
    groups = (
        ("with motion alone", [f"{name} ({a})" for name, a in better.items() if name not in THERMAL]),
        ("with thermal knowledge", [f"{name} ({a})" for name, a in better.items() if name in THERMAL]),
    )
    text = "; ".join(f"{given}: {', '.join(names)}" for given, names in groups if names)
    return (f"Baselines that beat the VAE (AUROC {spread(own)}) in every seed, {text}.",)


def _judged(claim: str, measured: str, holds: bool) -> Row:
    return claim, measured, "yes" if holds else "no"


def _difficulty(n: Numbers) -> list[Row]:
    joint, auroc, whole = n["joint"], n["auroc"][n["joint"] - 1], n["auroc_of_sum"]
    return [
        _judged(
            "critical motion is reconstructed worse",
            f"median d of joint {joint}: {n['critical']:.2f} critical, {n['cool']:.2f} cool",
            n["critical"] > n["cool"],
        ),
        _judged(
            "the sum over the joints measures difficulty as well as the best joint",
            f"AUROC of the sum {whole:.2f}, of joint {joint} {auroc:.2f}",
            whole >= auroc - 0.01,
        ),
    ]


def _quality(n: Numbers) -> list[Row]:
    own = n[QUESTIONS[-1]][VAE]
    set_ = (("auroc", "AUROC", 0.93), ("auprc", "AUPRC", 0.80), ("spearman", "Spearman", 0.75))
    return [
        _judged(f"d of joint 2: {label} ≥ {target:g}", spread(own[m]), float(np.mean(own[m])) >= target)
        for m, label, target in set_
    ]


def _saturation(n: Numbers) -> list[Row]:
    rows = []
    for way, targets in ((n["best"], (0.97, 0.05, 0.05)), ("rc identified", (0.985, 0.045, 0.04))):
        got = n["stated"][way]
        measured = f"{spread(got['auroc'])}; {spread(got['brier'])}; {spread(got['ece'])} ({way})"
        auroc, brier, ece = (float(np.mean(got[name])) for name in ("auroc", "brier", "ece"))
        holds = auroc >= targets[0] and brier <= targets[1] and ece <= targets[2]
        text = f"P(saturation): AUROC ≥ {targets[0]:g}; Brier ≤ {targets[1]:g}; ECE ≤ {targets[2]:g}"
        rows.append(_judged(text, measured, holds))
    name = f"p_{n['best'].split(',')[0]}"
    alarm = n["alarms"].get(name)
    if alarm:
        false, novel, caught = (float(np.mean(alarm[key])) for key in ("false_alarms", "false_novel", "caught"))
        rows.append(
            _judged(
                "alarm at 5 %: 2–8 % false, ≤ 10 % on light novel motions, ≥ 90 % caught",
                f"{false:.1%}; {novel:.1%}; {caught:.1%} ({name})",
                0.02 <= false <= 0.08 and novel <= 0.10 and caught >= 0.90,
            )
        )
    return rows


def _generation(n: Numbers) -> list[Row]:
    share = float(np.mean(n["truly_cool"]))
    text = "generated motions stay uncritical: ≥ 95 % of those handed out"
    return [_judged(text, f"{share:.1%} truly stay cool", share >= 0.95)]


def _recovery(n: Numbers) -> list[Row]:
    text = "a nearby posture lets the hottest motor cool"
    return [_judged(text, f"{n['cooled_k']:+.1f} K in ten minutes", n["cooled_k"] > 0)]


def _coverage(n: Numbers) -> list[Row]:
    before, after = (float(np.mean([bar[how] for bar in n.values()])) for how in ("work only", "with exploration"))
    return [_judged("exploration lowers false alarms on novel motions", f"{before:.0%} → {after:.0%}", after < before)]


def _log_difficulty(n: Numbers) -> list[Row]:
    ratio = float(np.mean(n["ratio"]))
    return [_judged("error of joint 2 at least twice as large when hot", f"{spread(n['ratio'], 2)} times", ratio >= 2)]


def _log_rc(n: Numbers) -> list[Row]:
    auroc = n["below"]["auroc"]
    best = max(auroc, key=lambda name: auroc[name])
    text = "passes 40 °C within 5 min: AUROC ≥ 0.95 with temperature and network"
    return [_judged(text, f"{auroc[best]:.3f} ({best}); d alone {auroc['d']:.3f}", auroc[best] >= 0.95)]


Maker = Callable[[Numbers], list[Row]]
SIMULATION: tuple[tuple[str, Maker], ...] = (
    ("difficulty", _difficulty),
    ("quality", _quality),
    ("saturation", _saturation),
    ("generation", _generation),
    ("recovery", _recovery),
    ("coverage", _coverage),
)
LOGS: tuple[tuple[str, Maker], ...] = (("difficulty", _log_difficulty), ("rc", _log_rc))
