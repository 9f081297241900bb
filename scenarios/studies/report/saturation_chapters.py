"""What the twin knows of heat, chapter by chapter: P(saturation), its alarm, and the arm's own thermal network."""

from collections.abc import Sequence

import networkx as nx
import numpy as np

from fleet.robot import JOINTS
from fleet.thermal import NODES, ThermalModel, housing, winding
from scenarios.prepare.train_twins import train_or_load
from scenarios.report.page import Picture, Section, Table
from scenarios.studies.benchmark import LOGS
from scenarios.studies.ranking import spread
from scenarios.studies.report.context import Lab
from scenarios.studies.report.figures import png, reliability_figure
from scenarios.studies.saturation import LABELLED, Alarm, Prediction, judge_networks, judge_twin, past_work
from scenarios.studies.simulated_logs import AIR_SD_K, own_logs
from twin.thermal.identify import identify
from twin.thermal.parameters import HeatModel

HELD_OUT = 200
"""Least number of past jobs that nothing is fitted on."""
TARGETS = {"auroc": 0.97, "brier": 0.05, "ece": 0.05}
RC_TARGETS = {"auroc": 0.985, "brier": 0.045, "ece": 0.04}
"""Set for P(saturation) before anything was measured, of the learned twin and of the identified network."""


def saturation_chapter(lab: Lab) -> Section:
    """P(saturation) of the learned twin and of thermal networks, and the alarm."""
    predictions, alarms = list[list[Prediction]](), list[list[Alarm]]()
    past, explored = lab.size.past, lab.size.explored
    count = max(lab.size.test, 2 * past + HELD_OUT)
    for done, (seed, sequence) in enumerate(zip(lab.seeds, lab.sequences, strict=True)):
        lab.progress("saturation", done / len(lab.seeds))
        study = lab.make(sequence, test=count, exploration=explored)
        twin = train_or_load(study.train.records(), lab.size.config, sequence, arm=study.robot.name, folder=lab.folder)
        work = past_work(study, seed=seed, labelled=past, watched=past)
        of_twin, raised = judge_twin(work, twin)
        predictions.append([*of_twin, *judge_networks(work)])
        alarms.append(raised)
    by_name = {row[0].name: row for row in zip(*predictions, strict=True)}
    quality = {
        name: {"auroc": [p.auroc for p in row], "brier": [p.brier for p in row], "ece": [p.table.error for p in row]}
        for name, row in by_name.items()
    }
    alarm_quality = {
        row[0].score: {name: [getattr(a, name) for a in row] for name in ("false_alarms", "false_novel", "caught")}
        for row in zip(*alarms, strict=True)
    }
    peak_k = {kind: [p.peak_error_k or np.nan for p in by_name[f"rc {kind}"]] for kind in ("nominal", "identified")}
    best = min((n for n in quality if not n.startswith("rc ")), key=lambda name: np.mean(quality[name]["brier"]))
    sentences = (
        f"The best head of the learned twin ({best}): {_against(quality[best], TARGETS)}, from {past} labelled past "
        f"jobs{'' if past == LABELLED else f' (the targets were set for {LABELLED})'}.",
        f"The identified network (rc identified): {_against(quality['rc identified'], RC_TARGETS)}.",
        _worth_of_identification(quality, peak_k),
        "The bound on false alarms holds only for jobs exchangeable with those the alarm was set on. It does not hold "
        "for novel motions; their column shows what happened.",
    )
    shown = [name for name in dict.fromkeys((best, "errors, logistic", "rc identified")) if name in by_name]
    tables = {name: by_name[name][0].table for name in shown}
    drawn = reliability_figure(
        {name: (t.mean_p, t.share, t.count) for name, t in tables.items()},
        title="P(saturation): predicted against observed (first seed)",
    )
    return Section(
        sentences=sentences,
        how="Past jobs with start temperatures from simulated histories; the arm's own parameters are unknown to the "
        f"twin. {past} jobs are fitted on, {past} more set the alarm at 5 %, the other {count - 2 * past} are judged. "
        f"{explored} of {lab.size.train} training jobs are light exploration.",
        pictures=(Picture(name="reliability", png=png(drawn), alt="Reliability diagram. " + sentences[0]),),
        tables=(
            Table(
                caption="P(saturation)",
                head=("evidence, method", "AUROC", "Brier", "ECE"),
                rows=tuple((name, *map(spread, row.values())) for name, row in quality.items()),
            ),
            Table(
                caption="Alarm at 5 %",
                head=("alarm on", "false alarms", "on novel motions", "critical caught"),
                rows=tuple((name, *map(spread, row.values())) for name, row in alarm_quality.items()),
            ),
        ),
        numbers={"stated": quality, "alarms": alarm_quality, "best": best, "peak_error_k": peak_k},
    )


def _against(values: dict[str, list[float]], targets: dict[str, float]) -> str:
    """Measured against targets: `AUROC 0.981 ± 0.004 (target 0.97: reached), …`."""
    return ", ".join(
        f"{'Brier' if name == 'brier' else name.upper()} {spread(values[name])} "
        f"(target {target:g}: {'' if meets(values[name], target, name) else 'not '}reached)"
        for name, target in targets.items()
    )


def meets(values: Sequence[float], target: float, name: str) -> bool:
    """Whether the mean over the seeds reaches a target: a lower bound for AUROC, an upper bound for errors."""
    mean = float(np.mean(values))
    return mean >= target if name == "auroc" else mean <= target


def _worth_of_identification(quality: dict[str, dict[str, list[float]]], peak_k: dict[str, list[float]]) -> str:
    gain = float(np.mean(quality["rc identified"]["auroc"]) - np.mean(quality["rc nominal"]["auroc"]))
    better = np.mean(peak_k["identified"]) < np.mean(peak_k["nominal"]) and abs(gain) < 0.01
    return (
        f"Identification changes the AUROC of the nominal network by {gain:+.3f}. Its error in the peak temperature is "
        f"{spread(peak_k['identified'], 1)} K instead of {spread(peak_k['nominal'], 1)} K"
        + (": it improves temperatures rather than the ranking." if better else ".")
    )


def identification_chapter(lab: Lab) -> Section:
    """The thermal network of the studied arm from its own logs, against the simulator's truth."""
    lab.progress("identifying", 0.0)
    study = lab.study
    logs = own_logs(study, study.train.plans[:LOGS], np.random.default_rng(lab.sequences[0]))
    result = identify(logs, arm=study.robot.name, ambient_c=study.ambient_c, ambient_sd_k=AIR_SD_K)
    body = HeatModel(study.motors, network_of(study.thermal))
    truth = [float(body.value(p.name)[0 if p.joint is None else p.joint - 1]) for p in result.parameters]
    pairs = list(zip(result.parameters, truth, strict=True))
    inside = sum(p.low <= true <= p.high for p, true in pairs)
    informed = sum(p.informed for p in result.parameters)
    after, before = (
        np.median([abs(v / true - 1) for v, (_, true) in zip(values, pairs, strict=True)])
        for values in ([p.value for p, _ in pairs], [p.prior for p, _ in pairs])
    )
    rms_k = np.median([value for each in result.rms_k.values() for value in each])
    rows = tuple(
        (p.name, *(f"{v:.3g}" for v in (p.value, p.low, p.high, p.prior, true)), "yes" if p.informed else "no")
        for p, true in pairs
        if p.joint in (None, 2)
    )
    return Section(
        sentences=(
            f"{inside} of {len(pairs)} true values lie in their 95 % intervals. The logs determine {informed} "
            f"parameters; the others stay near their prior. Median error {after:.0%}, of the prior {before:.0%}.",
            f"Residual: {rms_k:.2f} K (median over recordings and joints).",
        ),
        how=f"{LOGS} simulated recordings of half an hour, cool training jobs and rest, with sensor noise; the ambient "
        "temperature of each differs by an unmeasured amount. First seed; the table shows joint 2 and what joints "
        "share.",
        tables=(Table(head=("parameter", "value", "95 % from", "to", "prior", "truth", "from logs"), rows=rows),),
        numbers={"inside": inside, "parameters": len(pairs), "informed": informed, "version": result.version},
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
