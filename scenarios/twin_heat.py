"""What the twin knows of heat, chapter by chapter: P(saturation), its alarm, and the arm's own thermal network."""

from collections.abc import Callable, Sequence

import networkx as nx
import numpy as np

from fleet.robot import JOINTS
from fleet.thermal import NODES, ThermalModel, housing, winding
from scenarios.contest import LOGS
from scenarios.own_logs import AIR_SD_K, own_logs
from scenarios.rc_study import RcTrust, rc_trust
from scenarios.rehearse import trained
from scenarios.saturation_study import LABELLED, Trust, trust
from scenarios.twin_charts import reliability_figure
from scenarios.twin_lab import Lab
from scenarios.twin_page import Picture, Section, Table, spread
from scenarios.twin_style import png
from twin.identify import identify
from twin.thermal_values import Body

Array = np.ndarray

HELD_OUT = 200
"""Past jobs at least that nothing was fitted on."""
TARGETS = {"auroc": 0.97, "brier": 0.05, "ece": 0.05}
RC_TARGETS = {"auroc": 0.985, "brier": 0.045, "ece": 0.04}
"""Set for P(saturation) before anything was measured, of the learned twin and of the identified network."""
FIGURES: dict[str, Callable[..., float]] = {
    "auroc": lambda stated: stated.auroc,
    "brier": lambda stated: stated.brier,
    "ece": lambda stated: stated.table.error,
}


def saturation_chapter(lab: Lab) -> Section:
    """P(saturation) of the learned and of the physical twin, and the alarm."""
    found: list[Trust] = []
    physical: list[tuple[RcTrust, RcTrust]] = []
    known = {"labelled": lab.size.past, "watched": lab.size.past}
    count = max(lab.size.test, 2 * lab.size.past + HELD_OUT)
    explored = lab.size.explored
    for done, (seed, sequence) in enumerate(zip(lab.seeds, lab.sequences, strict=True)):
        lab.progress("saturation", done / len(lab.seeds))
        study = lab.make(sequence, test=count, exploration=explored)  # pyright: ignore[reportCallIssue]
        twin = trained(study.train.records(), lab.size.config, sequence, arm=study.robot.name, folder=lab.folder)
        found.append(trust(study, twin, seed=seed, exploration=explored, **known))
        physical.append(rc_trust(study, seed=seed, **known))
    stated = {f"{row[0].evidence}, {row[0].method}": row for row in zip(*(t.stated for t in found), strict=True)}
    stated |= {f"rc {row[0].name}": row for row in zip(*physical, strict=True)}
    numbers = {way: {name: [get(s) for s in row] for name, get in FIGURES.items()} for way, row in stated.items()}
    alarms = {
        row[0].score: {
            "false_alarms": [a.false_alarms for a in row],
            "false_novel": [a.false_novel for a in row],
            "caught": [a.caught for a in row],
        }
        for row in zip(*(t.alarms for t in found), strict=True)
    }
    peak = {row[0].name: [t.peak_error_k for t in row] for row in zip(*physical, strict=True)}
    learned = [way for way in numbers if not way.startswith("rc ")]
    best = min(learned, key=lambda way: float(np.mean(numbers[way]["brier"])))
    sentences = (
        f"The best head of the learned twin ({best}): {_against(numbers[best], TARGETS)}, from {lab.size.past} "
        f"labelled past jobs{'' if lab.size.past == LABELLED else f' (the targets were set for {LABELLED})'}.",
        f"The identified network (rc identified): {_against(numbers['rc identified'], RC_TARGETS)}.",
        _worth_of_identification(numbers, peak),
        "The alarm's false alarms are bounded for jobs exchangeable with those it was set on, and only for those; "
        "under novel motions the bound is void, and the column says what happened.",
    )
    shown = [best, "errors, logistic", "rc identified"]
    curves = {
        way: (stated[way][0].table.mean_p, stated[way][0].table.share, stated[way][0].table.count)
        for way in dict.fromkeys(shown)
        if way in stated
    }
    drawn = reliability_figure(curves, title="P(saturation): what was said against what happened (first seed)")
    return Section(
        key="saturation",
        title="Probability of saturation, and its alarm",
        sentences=sentences,
        how=f"Past jobs with start temperatures from real histories; the arm's own gains are unknown to the twin. "
        f"{lab.size.past} jobs teach, {lab.size.past} more set the alarm at 5 %, the other {count - 2 * lab.size.past} "
        f"are judged; {explored} of {lab.size.train} training jobs are light exploration.",
        pictures=(Picture(name="reliability", png=png(drawn), alt="Reliability diagram. " + sentences[0]),),
        tables=(
            Table(
                caption="P(saturation)",
                head=("evidence, method", "AUROC", "Brier", "ECE"),
                rows=tuple((way, *(spread(values) for values in row.values())) for way, row in numbers.items()),
            ),
            Table(
                caption="Alarm at 5 %",
                head=("alarm on", "false alarms", "on novel motions", "critical caught"),
                rows=tuple((name, *(spread(values) for values in row.values())) for name, row in alarms.items()),
            ),
        ),
        numbers={"stated": numbers, "alarms": alarms, "best": best, "peak_error_k": peak},
    )


def _against(figures: dict[str, list[float]], targets: dict[str, float]) -> str:
    """Measured against what was set, `AUROC 0.981 ± 0.004 (target 0.97: reached), …`."""
    return ", ".join(
        f"{name.upper() if name != 'brier' else 'Brier'} {spread(figures[name])} "
        f"(target {target:g}: {'' if meets(figures[name], target, name) else 'not '}reached)"
        for name, target in targets.items()
    )


def meets(values: Sequence[float], target: float, name: str) -> bool:
    """Whether the mean over the seeds reaches a target: of areas from above, of errors from below."""
    mean = float(np.mean(values))
    return mean >= target if name == "auroc" else mean <= target


def _worth_of_identification(numbers: dict[str, dict[str, list[float]]], peak: dict[str, list[float]]) -> str:
    gain = float(np.mean(numbers["rc identified"]["auroc"]) - np.mean(numbers["rc nominal"]["auroc"]))
    less = float(np.mean(peak["nominal"]) - np.mean(peak["identified"]))
    return (
        f"Identification {'adds' if gain >= 0 else 'costs'} {abs(gain):.3f} of AUROC to the nominal network, and its "
        f"error in the peak temperature is {spread(peak['identified'], 1)} K instead of "
        f"{spread(peak['nominal'], 1)} K: it "
        + ("pays in degrees rather than in ranking." if less > 0 and abs(gain) < 0.01 else "is worth what it shows.")
    )


def identification_chapter(lab: Lab) -> Section:
    """The network of the studied arm from its own logs, against the simulator's truth."""
    lab.progress("identifying", 0.0)
    study = lab.study
    logs = own_logs(study, study.train.plans[:LOGS], np.random.default_rng(lab.sequences[0]))
    found = identify(logs, arm=study.robot.name, ambient_c=study.ambient_c, ambient_sd_k=AIR_SD_K)
    truth = Body(study.motors, network_of(study.thermal))
    rows, inside, informed, before, after = [], 0, 0, [], []
    for p in found.parameters:
        true = float(truth.value(p.name)[0 if p.joint is None else p.joint - 1])
        inside += p.low <= true <= p.high
        informed += p.informed
        before.append(abs(p.prior / true - 1))
        after.append(abs(p.value / true - 1))
        if p.joint in (None, 2):
            numbers = (f"{v:.3g}" for v in (p.value, p.low, p.high, p.prior, true))
            rows.append((p.name, *numbers, "yes" if p.informed else "no"))
    count = len(found.parameters)
    sentence = (
        f"{inside} of {count} true values lie in their 95 % intervals; {informed} parameters are told by the logs, the "
        f"others stay near their prior. Median error {np.median(after):.0%}, of the prior {np.median(before):.0%}."
    )
    unexplained = [value for each in found.rms_k.values() for value in each]
    return Section(
        key="identification",
        title="The arm's own thermal network",
        sentences=(sentence, f"Unexplained: {np.median(unexplained):.2f} K (median over recordings and joints)."),
        how=f"{LOGS} simulated recordings of half an hour, cool training jobs and rest, with sensor noise; the air of "
        "each is off by what nobody measured. First seed; the table shows joint 2 and what joints share.",
        tables=(
            Table(head=("parameter", "value", "95 % from", "to", "prior", "truth", "told by logs"), rows=tuple(rows)),
        ),
        numbers={"inside": inside, "parameters": count, "informed": informed, "version": found.version},
    )


def network_of(model: ThermalModel) -> nx.Graph:
    """The graph that a thermal model was made from."""
    names = [winding(j) for j in range(JOINTS)] + [housing(j) for j in range(JOINTS)]
    network = nx.Graph()
    for i, name in enumerate(names):
        network.add_node(name, capacity_j_per_k=float(model.capacity[i]))
        if model.to_ambient[i]:
            network.add_edge(name, "ambient", conductance_w_per_k=float(model.to_ambient[i]))
    for i in range(NODES):
        for k in range(i):
            if model.laplacian[i, k]:
                network.add_edge(names[i], names[k], conductance_w_per_k=-float(model.laplacian[i, k]))
    return network
