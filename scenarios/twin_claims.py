"""What may be concluded from a twin report: the paper's claims beside what was measured, told from the figures."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from scenarios.contest import RIVALS, TOLD_OF_HEAT, VAE
from scenarios.quality import QUESTIONS
from scenarios.twin_page import Section, Table, spread

CLAIM = (
    "The paper (E. Guiffo Kaigom, arXiv 2509.12740) claims that an LSTM variational autoencoder, trained without "
    "labels on motion that stays cool, reconstructs critical motion worse, that the error in [0, 1) per joint and "
    "summed is a measure of thermal difficulty, and that the latent gives new uncritical motion."
)
LIMITS = (
    "What no figure here can claim: the score looks at motion and torque alone. It cannot know the motors' "
    "temperatures at the start, how long a job will last, or the heat hidden in the housings; P(saturation) takes the "
    "first two in and a thermal network all three.",
    "What is light but new looks hard to every detector of novelty. A high d means: outside experience or more load "
    "than known; the channel shares say which. Only load heats.",
)
SIMULATED = (
    "In the simulation the truth is a thermal network whose absolute scale is known to ± 25 % and which extrapolates "
    "above 55 °C; figures from it compare methods, they do not promise degrees of a real arm."
)

AUROC = "auroc"
Row = tuple[str, str, str]
Found = Mapping[str, Any]


def claims(sections: Sequence[Section], *, simulated: bool = False) -> Section:
    """The paper's claims, what was measured of each, where a rival is ahead, and what cannot be claimed."""
    by_key = {section.key: section.numbers for section in sections if not section.failed}
    makers = SIMULATION if simulated else LOGS
    rows = tuple(row for key, make in makers if key in by_key for row in make(by_key[key]))
    missing = [section.title for section in sections if section.failed]
    told = (f"Not measured in this report: {'; '.join(missing)}.",) if missing else ()
    return Section(
        key="claims",
        title="What may be concluded",
        sentences=(
            CLAIM,
            *ahead(by_key.get("quality", {})),
            *LIMITS,
            *((SIMULATED,) if simulated else ()),
            *told,
        ),
        tables=(Table(head=("what is claimed or was set", "measured", "verdict"), rows=rows),) if rows else (),
        numbers={"rows": [list(row) for row in rows]},
    )


def ahead(quality: Found) -> tuple[str, ...]:
    """Which rivals rank jobs better than d of joint 2 under every seed, by the figures."""
    found = quality.get(QUESTIONS[-1])
    if not found:
        return ()
    own = np.array(found[VAE]["auroc"])
    better = [name for name in RIVALS if name in found and bool(np.all(np.array(found[name]["auroc"]) > own))]
    motion = [name for name in better if name not in TOLD_OF_HEAT]
    heat = [name for name in better if name in TOLD_OF_HEAT]
    said = [
        f"{', '.join(f'{name} ({spread(found[name][AUROC])})' for name in names)}, {what}"
        for names, what in ((motion, "which know motion alone as the VAE does"), (heat, "which were told of heat"))
        if names
    ]
    if not said:
        return (
            f"No rival ranks jobs better than the VAE's d of joint 2 (AUROC {spread(own.tolist())}) in every seed.",
        )
    return (f"Where a baseline beats the VAE (AUROC {spread(own.tolist())}) in every seed: {'; and '.join(said)}.",)


def _judged(claim: str, measured: str, holds: bool) -> Row:
    return claim, measured, "yes" if holds else "no"


def _difficulty(n: Found) -> list[Row]:
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


def _quality(n: Found) -> list[Row]:
    own = n[QUESTIONS[-1]][VAE]
    set_ = (("auroc", "AUROC", 0.93), ("auprc", "AUPRC", 0.80), ("spearman", "Spearman", 0.75))
    return [
        _judged(f"d of joint 2: {label} ≥ {target:g}", spread(own[m]), float(np.mean(own[m])) >= target)
        for m, label, target in set_
    ]


def _saturation(n: Found) -> list[Row]:
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


def _generation(n: Found) -> list[Row]:
    share = float(np.mean(n["truly_cool"]))
    text = "generated motions stay uncritical: ≥ 95 % of those handed out"
    return [_judged(text, f"{share:.1%} truly stay cool", share >= 0.95)]


def _recovery(n: Found) -> list[Row]:
    text = "a nearby posture lets the hottest motor cool"
    return [_judged(text, f"{n['cooled_k']:+.1f} K in ten minutes", n["cooled_k"] > 0)]


def _coverage(n: Found) -> list[Row]:
    before, after = (float(np.mean([bar[how] for bar in n.values()])) for how in ("work only", "with exploration"))
    return [_judged("exploration lowers false alarms on novel motions", f"{before:.0%} → {after:.0%}", after < before)]


def _log_difficulty(n: Found) -> list[Row]:
    ratio = float(np.mean(n["ratio"]))
    return [_judged("error of joint 2 at least twice as large when hot", f"{spread(n['ratio'], 2)} times", ratio >= 2)]


def _log_rc(n: Found) -> list[Row]:
    auroc = n["below"]["auroc"]
    best = max(auroc, key=lambda name: auroc[name])
    text = "passes 40 °C within 5 min: AUROC ≥ 0.95 with temperature and network"
    return [_judged(text, f"{auroc[best]:.3f} ({best}); d alone {auroc['d']:.3f}", auroc[best] >= 0.95)]


Maker = Callable[[Found], list[Row]]
SIMULATION: tuple[tuple[str, Maker], ...] = (
    ("difficulty", _difficulty),
    ("quality", _quality),
    ("saturation", _saturation),
    ("generation", _generation),
    ("recovery", _recovery),
    ("coverage", _coverage),
)
LOGS: tuple[tuple[str, Maker], ...] = (("difficulty", _log_difficulty), ("rc", _log_rc))
