"""Chapters on heat: P(saturation), its alarm, and the arm's own thermal network."""

from collections.abc import Mapping, Sequence

import numpy as np

from scenarios.prepare.simulated_logs import LOGS, identify_from_work
from scenarios.show.page import Section, Table
from scenarios.studies.ranking import spread
from scenarios.studies.report.claims import HEAD_TARGETS, RC_TARGETS, against_targets
from scenarios.studies.report.context import Lab
from scenarios.studies.report.figures import picture, reliability_figure
from scenarios.studies.saturation import ALARM_MEASURES, LABELLED, measured, saturation_study
from twin.thermal.parameters import HeatModel

HELD_OUT = 200
"""Least number of past jobs that no model is fitted on."""
Values = Mapping[str, Sequence[float]]
"""By measure, [seed]."""


def saturation_chapter(lab: Lab) -> Section:
    """P(saturation) of the learned twin and of thermal networks, and the alarm."""
    past, explored = lab.size.past, lab.size.explored
    count = max(lab.size.test, 2 * past + HELD_OUT)
    predictions, alarms = saturation_study(
        lab.bench, exploration=explored, test=count, past=past, progress=lab.progress
    )
    quality, alarm_quality = measured(predictions, tuple(HEAD_TARGETS)), measured(alarms, ALARM_MEASURES)
    peak_k = {kind: [p.peak_error_k for p in predictions[f"rc {kind}"]] for kind in ("nominal", "identified")}
    best = min((n for n in quality if not n.startswith("rc ")), key=lambda name: np.mean(quality[name]["brier"]))
    sentences = (
        f"The best head of the learned twin ({best}): {against_targets(quality[best], HEAD_TARGETS)}, from "
        f"{past} labelled past jobs{'' if past == LABELLED else f' (the targets were set for {LABELLED})'}.",
        f"The identified network (rc identified): {against_targets(quality['rc identified'], RC_TARGETS)}.",
        _value_of_identification(quality, peak_k),
        "The bound on false alarms holds only for jobs exchangeable with those the alarm was set on. It does not hold "
        "for novel motions; their column shows what happened.",
    )
    shown = [name for name in dict.fromkeys((best, "errors, logistic", "rc identified")) if name in predictions]
    drawn = reliability_figure(
        {name: (t.mean_p, t.share, t.count) for name in shown for t in [predictions[name][0].table]},
        title="P(saturation): predicted against observed (first seed)",
    )
    heads = (
        ("evidence, method", "AUROC", "Brier", "ECE"),
        ("alarm on", "false alarms", "on novel motions", "critical caught"),
    )
    return Section(
        sentences=sentences,
        how="Past jobs with start temperatures from simulated histories; the arm's own parameters are unknown to the "
        f"twin. {past} jobs are fitted on, {past} more set the alarm at 5 %, the other {count - 2 * past} are judged. "
        f"{explored} of {lab.size.train} training jobs are light exploration.",
        pictures=(picture("reliability", drawn, "Reliability diagram. " + sentences[0]),),
        tables=tuple(
            Table(
                caption=caption,
                head=head,
                rows=tuple((name, *map(spread, values.values())) for name, values in rows.items()),
            )
            for caption, head, rows in zip(
                ("P(saturation)", "Alarm at 5 %"), heads, (quality, alarm_quality), strict=True
            )
        ),
        numbers={"stated": quality, "alarms": alarm_quality, "best": best, "peak_error_k": peak_k},
    )


def _value_of_identification(quality: Mapping[str, Values], peak_k: Values) -> str:
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
    result = identify_from_work(
        study.hardware, study.train.plans[:LOGS], np.random.default_rng(lab.bench.seeds[0]), ambient_c=study.ambient_c
    )
    model, parameters = HeatModel(study.motors, study.network), result.parameters
    truth = np.array([model.value(p.name)[0 if p.joint is None else p.joint - 1] for p in parameters])
    inside = sum(p.low <= true <= p.high for p, true in zip(parameters, truth, strict=True))
    informed = sum(p.informed for p in parameters)
    after, before = (
        np.median(np.abs(np.array(values) / truth - 1))
        for values in ([p.value for p in parameters], [p.prior for p in parameters])
    )
    rms_k = np.median([value for each in result.rms_k.values() for value in each])
    rows = tuple(
        (p.name, *(f"{v:.3g}" for v in (p.value, p.low, p.high, p.prior, true)), "yes" if p.informed else "no")
        for p, true in zip(parameters, truth, strict=True)
        if p.joint in (None, 2)
    )
    return Section(
        sentences=(
            f"{inside} of {len(truth)} true values lie in their 95 % intervals. The logs determine {informed} "
            f"parameters; the others stay near their prior. Median error {after:.0%}, of the prior {before:.0%}.",
            f"Residual: {rms_k:.2f} K (median over recordings and joints).",
        ),
        how=f"{LOGS} simulated recordings of half an hour, cool training jobs and rest, with sensor noise; the ambient "
        "temperature of each differs by an unmeasured amount. First seed; the table shows joint 2 and what joints "
        "share.",
        tables=(Table(head=("parameter", "value", "95 % from", "to", "prior", "truth", "from logs"), rows=rows),),
        numbers={"inside": int(inside), "parameters": len(truth), "informed": informed, "version": result.version},
    )
