"""Chapters on the value of the twin: against baselines, with exploration, self-trained, and as input of a regressor."""

import numpy as np

from scenarios.show.page import Section, Table
from scenarios.studies import self_training
from scenarios.studies.benchmark import BASELINES, THERMAL, VAE, quality
from scenarios.studies.exploration import coverage
from scenarios.studies.ranking import LABELS, MEASURES, QUESTIONS, RANKING, Quality, spread, verdicts
from scenarios.studies.report.claims import JOINT_2, RANKING_TARGETS, against_targets
from scenarios.studies.report.context import Lab
from scenarios.studies.report.figures import (
    LINES,
    MARKS,
    Line,
    bars_figure,
    lines_figure,
    picture,
    ranked,
    ranking_figure,
)
from scenarios.studies.transfer import transfer

ANY_BY_JOINT_2 = "any joint, joint 2"


def quality_chapter(lab: Lab) -> Section:
    """Every scorer on the same held-out jobs."""
    lab.progress("quality", 0.0)
    size = lab.size
    result = quality(lab.bench, size.networks)
    values = {name: {LABELS[m]: measures[m] for m in RANKING} for name, measures in result[JOINT_2].items()}
    first, own = ranked(values)[-1], result[JOINT_2][VAE]
    drawn = ranking_figure(
        values,
        ours=tuple(name for name in values if name.startswith(VAE)),
        title=f"{QUESTIONS[JOINT_2]}: {first} is best",
        targets={LABELS[m]: target for m, target in RANKING_TARGETS.items()},
    )
    return Section(
        sentences=(
            f"d of joint 2 under {len(lab.seeds)} seeds: {against_targets(own, RANKING_TARGETS)}.",
            *verdicts(result, VAE, BASELINES, thermal=THERMAL),
            "The label follows from the mean squared torque and the start temperature, so a torque rule is hard to "
            "beat by construction. The question is how close a score without thermal knowledge comes.",
        ),
        how=f"Each seed draws an arm, {size.train} cool training jobs, {size.reference} other cool jobs for the "
        f"thresholds, {size.test} test jobs and {size.novel} light novel motions. All scorers learn from the same "
        "training jobs. TPR and FPR are at a threshold that 5 % of held-out cool jobs pass. Mean ± standard deviation.",
        pictures=(picture("quality", drawn, f"Ranking of scorers; {first} is best."),),
        tables=tuple(quality_table(result, question) for question in QUESTIONS),
        numbers=result,
    )


def quality_table(result: Quality, question: str) -> Table:
    """One question's scorers, every measure as mean ± standard deviation."""
    return Table(
        caption=QUESTIONS[question],
        head=("score", "uses", *(LABELS[m] for m in MEASURES)),
        rows=tuple(
            (name, "heat" if name in THERMAL else "motion", *(spread(values[m]) for m in MEASURES))
            for name, values in result[question].items()
        ),
    )


def coverage_chapter(lab: Lab) -> Section:
    """Effect of light exploration in the training data."""
    lab.progress("coverage", 0.0)
    size = lab.size
    result = coverage(lab.bench, exploration=size.explored, train=size.train)
    names = {0: "work only", size.explored: "with exploration"}
    bars = {
        score: {names[count]: by_score[score]["false_novel"] for count, by_score in result.items()}
        for score in result[0]
    }
    rows = tuple(
        (f"{score}, {how}", *(spread(result[count][score][m]) for m in ("auroc", "caught", "false_novel")))
        for score in result[0]
        for count, how in names.items()
    )
    before, after = (np.mean([bar[how] for bar in bars.values()]) for how in names.values())
    finding = (
        f"Exploration {'lowers' if after < before else 'changes'} false alarms on novel motions from {before:.0%} to "
        f"{after:.0%} (mean of the scores)"
    )
    drawn = bars_figure(bars, title=finding, y_label="false alarms on light novel motions")
    return Section(
        sentences=(f"{finding}.",),
        how=f"{size.explored} of {size.train} training jobs are replaced by light random motions. The "
        "thresholds come from held-out cool jobs of work, of which 5 % may raise an alarm.",
        pictures=(picture("coverage", drawn, finding),),
        tables=(Table(head=("score", "AUROC", "critical caught", "false alarms on novel"), rows=rows),),
        numbers=bars,
    )


def autonomy_chapter(lab: Lab) -> Section:
    """A twin trained again on its own motion."""
    lab.progress("autonomy", 0.0)
    size = lab.size
    result = self_training.autonomy(lab.bench, count=size.own)
    scorers = result[ANY_BY_JOINT_2]
    kept = self_training.remaining(scorers)
    finding = f"{np.mean(kept['auroc']):.0%} of the AUROC above chance, {np.mean(kept['spearman']):.0%} of Spearman"
    bars = {LABELS[m]: {name: values[m] for name, values in scorers.items()} for m in RANKING}
    title = f"Trained on its own motion, it keeps {np.mean(kept['auroc']):.0%} of the AUROC"
    drawn = bars_figure(bars, title=title, y_label="quality")
    return Section(
        sentences=(f"Of the quality after training on real motion, {finding} remain ({QUESTIONS[ANY_BY_JOINT_2]}).",),
        how=f"A new twin is trained on {size.own} jobs generated near the training data of the first twin, verified to "
        "be executable and predicted to stay cool. Prior samples are decoded from N(0, I) without verification.",
        pictures=(picture("autonomy", drawn, f"Quality by training data: {finding}."),),
        tables=(quality_table(result, ANY_BY_JOINT_2),),
        numbers={**result, "remaining": kept},
    )


def transfer_chapter(lab: Lab) -> Section:
    """Latent features as input of a small regressor."""
    lab.progress("transfer", 0.0)
    size = lab.size
    errors = transfer(lab.bench, labels=size.labels)
    (_, first, _), labels = next(iter(errors)), sorted({n for _, _, n in errors})
    curves = {
        name: np.stack([errors[name, first, n]["rmse_k"] for n in labels], axis=1)
        for name in dict.fromkeys(name for name, *_ in errors)
    }
    latent, raw = (curves[name].mean(axis=0) for name in ("latent", "raw"))
    better = [n for n, is_better in zip(labels, latent < raw, strict=True) if is_better]
    finding = (
        f"Latent features beat raw ones with {', '.join(map(str, better))} labels ({first})."
        if better
        else f"Raw features beat latent ones at every number of labels ({first}): the latent keeps what rebuilds a "
        "window, not what heats a motor."
    )
    drawn = lines_figure(
        {"": {n: Line(np.array(labels), y, LINES[i], MARKS[i]) for i, (n, y) in enumerate(curves.items())}},
        title=finding.split(":")[0],
        x_label="labelled jobs",
        y_label="RMSE (K)",
        log=True,
        ticks=np.array(labels),
        from_zero=True,
    )
    return Section(
        sentences=(finding,),
        how="The temperature rise of the hottest winding of held-out jobs, from mean and deviation over the job's "
        "windows of the posterior means (latent), of each channel's mean, deviation and RMS (raw), or both. Several "
        "draws of the labelled jobs per seed; mean ± standard deviation over both.",
        pictures=(picture("transfer", drawn, finding),),
        tables=(
            Table(
                head=("input, regressor, labels", "RMSE, K", "R²"),
                rows=tuple(
                    (f"{name}, {regressor}, {n} labels", spread(row["rmse_k"], 2), spread(row["r2"]))
                    for (name, regressor, n), row in errors.items()
                ),
            ),
        ),
        numbers={f"{name}/{regressor}/{n}": row for (name, regressor, n), row in errors.items()},
    )
