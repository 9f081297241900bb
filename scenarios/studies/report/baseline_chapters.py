"""What the twin is worth, chapter by chapter: against baselines, after exploration, as a teacher, as an input."""

from typing import Any  # plain values for report.json

import numpy as np

from scenarios.report.page import Picture, Section, Table
from scenarios.studies import self_training
from scenarios.studies.benchmark import BASELINES, VAE, quality
from scenarios.studies.exploration import coverage
from scenarios.studies.ranking import LABELS, MEASURES, QUESTIONS, RANKING, WORDS, QualityTable, spread, verdicts
from scenarios.studies.report.context import Lab
from scenarios.studies.report.figures import LINES, MARKS, Line, bars_figure, lines_figure, png, ranked, ranking_figure
from scenarios.studies.transfer import transfer

TARGETS = {"AUROC": 0.93, "AUPRC": 0.80, "Spearman": 0.75}
"""Set for d of joint 2 before anything was measured."""


def quality_chapter(lab: Lab) -> Section:
    """Every scorer on the same held-out jobs."""
    lab.progress("quality", 0.0)
    size = lab.size
    result = quality(lab.sequences, config=size.config, folder=lab.folder, make=lab.make, networks=size.networks)
    question = QUESTIONS[-1]
    values = {
        row.scorer: {LABELS[m]: row.values(m) for m in RANKING} for row in result.rows if row.question == question
    }
    first, own = ranked(values)[-1], values[VAE]
    ours = tuple(name for name in values if name.startswith(VAE))
    drawn = ranking_figure(values, ours=ours, title=f"{WORDS[question]}: {first} is best", targets=TARGETS)
    against = [
        f"{label} {spread(own[label])} (target {target:g}: {'' if own[label].mean() >= target else 'not '}reached)"
        for label, target in TARGETS.items()
    ]
    return Section(
        sentences=(
            f"d of joint 2 under {len(lab.seeds)} seeds: {'; '.join(against)}.",
            *verdicts(result, VAE, BASELINES),
            "The label follows from the mean squared torque and the start temperature, so a torque rule is hard to "
            "beat by construction. The question is how close a score without thermal knowledge comes.",
        ),
        how=f"Each seed draws an arm, {size.train} cool training jobs, {size.reference} other cool jobs for the "
        f"thresholds, {size.test} test jobs and {size.novel} light novel motions. All scorers learn from the same "
        "training jobs. TPR and FPR are at a threshold that 5 % of held-out cool jobs pass. Mean ± standard deviation.",
        pictures=(Picture(name="quality", png=png(drawn), alt=f"Ranking of scorers; {first} is best."),),
        tables=tuple(quality_table(result, each) for each in QUESTIONS),
        numbers=quality_numbers(result),
    )


def quality_table(result: QualityTable, question: str) -> Table:
    """One question's rows, every measure as mean ± standard deviation."""
    return Table(
        caption=WORDS[question],
        head=("score", "knows", *(LABELS[m] for m in MEASURES)),
        rows=tuple(
            (row.scorer, result.knows(row.scorer), *(spread(row.values(m)) for m in MEASURES))
            for row in result.rows
            if row.question == question
        ),
    )


def quality_numbers(result: QualityTable) -> dict[str, Any]:
    """[question][scorer][measure] → one value per seed."""
    numbers: dict[str, Any] = {question: {} for question in QUESTIONS}
    for row in result.rows:
        numbers[row.question][row.scorer] = {m: row.values(m).tolist() for m in MEASURES}
    return numbers


def coverage_chapter(lab: Lab) -> Section:
    """Effect of light exploration in the rehearsal."""
    lab.progress("coverage", 0.0)
    size = lab.size
    result = coverage(
        lab.sequences, config=size.config, folder=lab.folder, exploration=size.explored, train=size.train, make=lab.make
    )
    by_training = {"work only": result.without, "with exploration": result.explored}
    bars = {
        name: {how: np.array([d.false_novel for d in scores[name]]) for how, scores in by_training.items()}
        for name in result.without
    }
    rows = tuple(
        (f"{name}, {how}", *(spread([getattr(d, m) for d in scores[name]]) for m in ("auroc", "caught", "false_novel")))
        for name in result.without
        for how, scores in by_training.items()
    )
    before, after = (np.mean([bar[how] for bar in bars.values()]) for how in by_training)
    finding = f"Exploration lowers false alarms on novel motions from {before:.0%} to {after:.0%} (mean of the scores)"
    if after >= before:
        finding = finding.replace("lowers", "changes")
    drawn = bars_figure(bars, title=finding, y_label="false alarms on light novel motions")
    return Section(
        sentences=(f"{finding}.",),
        how=f"{result.exploration} of {result.train} training jobs are replaced by light random motions. The "
        "thresholds come from held-out cool jobs of work, of which 5 % may raise an alarm.",
        pictures=(Picture(name="coverage", png=png(drawn), alt=finding),),
        tables=(Table(head=("score", "AUROC", "critical caught", "false alarms on novel"), rows=rows),),
        numbers={name: {how: v.tolist() for how, v in bar.items()} for name, bar in bars.items()},
    )


def autonomy_chapter(lab: Lab) -> Section:
    """A twin trained again on its own motion."""
    lab.progress("autonomy", 0.0)
    size, question = lab.size, QUESTIONS[1]
    result = self_training.autonomy(lab.sequences, config=size.config, folder=lab.folder, make=lab.make, count=size.own)
    kept = self_training.remaining(result, question)
    finding = f"{np.mean(kept['auroc']):.0%} of the AUROC above chance, {np.mean(kept['spearman']):.0%} of Spearman"
    bars = {LABELS[m]: {row.scorer: row.values(m) for row in result.rows if row.question == question} for m in RANKING}
    title = f"Trained on its own motion, it keeps {np.mean(kept['auroc']):.0%} of the AUROC"
    drawn = bars_figure(bars, title=title, y_label="quality")
    return Section(
        sentences=(f"Of the quality after training on real motion, {finding} remain ({WORDS[question]}).",),
        how=f"A new twin is trained on {size.own} jobs generated near what the first twin knows, verified to be "
        "executable and predicted to stay cool. Prior samples are decoded from N(0, I) without verification.",
        pictures=(Picture(name="autonomy", png=png(drawn), alt=f"Quality by training data: {finding}."),),
        tables=(quality_table(result, question),),
        numbers={**quality_numbers(result), "remaining": {m: v.tolist() for m, v in kept.items()}},
    )


def transfer_chapter(lab: Lab) -> Section:
    """Latent features as input of a small regressor."""
    lab.progress("transfer", 0.0)
    size = lab.size
    rows = transfer(lab.sequences, config=size.config, folder=lab.folder, make=lab.make, labels=size.labels)
    first, labels = rows[0].regressor, sorted({row.labels for row in rows})
    rmse_k = {(row.inputs, row.labels): np.array(row.rmse_k) for row in rows if row.regressor == first}
    curves = {name: np.stack([rmse_k[name, n] for n in labels], axis=1) for name in {inputs: 0 for inputs, _ in rmse_k}}
    ahead = [n for n in labels if rmse_k["latent", n].mean() < rmse_k["raw", n].mean()]
    finding = (
        f"Latent features beat raw ones with {', '.join(map(str, ahead))} labels ({first})."
        if ahead
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
        pictures=(Picture(name="transfer", png=png(drawn), alt=finding),),
        tables=(
            Table(
                head=("input, regressor, labels", "RMSE, K", "R²"),
                rows=tuple(
                    (f"{r.inputs}, {r.regressor}, {r.labels} labels", spread(r.rmse_k, 2), spread(r.r2)) for r in rows
                ),
            ),
        ),
        numbers={f"{r.inputs}/{r.regressor}/{r.labels}": {"rmse_k": r.rmse_k, "r2": r.r2} for r in rows},
    )
