"""What the twin is worth, chapter by chapter: against its rivals, after exploration, as a teacher, as an input."""

from typing import Any

import numpy as np

from scenarios import autonomy as again
from scenarios.contest import RIVALS, VAE, quality
from scenarios.coverage import coverage
from scenarios.quality import LABELS, MEASURES, QUESTIONS, WORDS, QualityTable, verdicts
from scenarios.transfer import transfer
from scenarios.twin_charts import curves_figure, pairs_figure, ranked, ranking_figure
from scenarios.twin_lab import Lab
from scenarios.twin_page import Picture, Section, Table, spread
from scenarios.twin_style import png

Array = np.ndarray

SHOWN = ("auroc", "auprc", "spearman")
TARGETS = {"AUROC": 0.93, "AUPRC": 0.80, "Spearman": 0.75}
"""Set for d of joint 2 before anything was measured."""


def quality_chapter(lab: Lab) -> Section:
    """The quality table: every scorer on the same held-out jobs."""
    lab.progress("quality", 0.0)
    found = quality(lab.sequences, config=lab.size.config, folder=lab.folder, make=lab.make, networks=lab.size.networks)
    question = QUESTIONS[-1]
    values = {row.scorer: {LABELS[m]: row.values(m) for m in SHOWN} for row in found.rows if row.question == question}
    ours = tuple(name for name in values if name.startswith(VAE))
    first = ranked(values)[-1]
    drawn = ranking_figure(values, ours=ours, title=f"{WORDS[question]}: {first} does it best", targets=TARGETS)
    d_2 = found.row(VAE, question)
    met = [
        f"{LABELS[m]} {spread(d_2.values(m).tolist())} (target {TARGETS[LABELS[m]]:g}: "
        f"{'reached' if d_2.values(m).mean() >= TARGETS[LABELS[m]] else 'not reached'})"
        for m in SHOWN
    ]
    sentences = (
        f"d of joint 2 under {len(lab.seeds)} seeds: {'; '.join(met)}.",
        *verdicts(found, VAE, RIVALS),
        "The label follows from the mean squared torque and the temperature at the start, so a torque rule is hard to "
        "beat by construction; the question is how near a score comes that was told nothing of heat.",
    )
    return Section(
        key="quality",
        title="Quality of the difficulty, against its rivals",
        sentences=sentences,
        how=f"Each seed draws an arm, {lab.size.train} cool training jobs, {lab.size.reference} other cool jobs for "
        f"the "
        f"thresholds, {lab.size.test} test jobs and {lab.size.novel} light novel motions; all scorers learn from the "
        "same training jobs. TPR and FPR at a threshold that 5 % of held-out cool jobs pass. Mean ± standard "
        "deviation.",
        pictures=(Picture(name="quality", png=png(drawn), alt=f"Scorers ranked; {first} is first."),),
        tables=tuple(quality_table(found, q) for q in QUESTIONS),
        numbers=quality_numbers(found),
    )


def quality_table(found: QualityTable, question: str) -> Table:
    """One question's rows, every measure as mean ± standard deviation."""
    return Table(
        caption=WORDS[question],
        head=("score", "knows", *(LABELS[m] for m in MEASURES)),
        rows=tuple(
            (row.scorer, found.knows(row.scorer), *(spread(row.values(m).tolist()) for m in MEASURES))
            for row in found.rows
            if row.question == question
        ),
    )


def quality_numbers(found: QualityTable) -> dict[str, Any]:
    """[question][scorer][measure] → one value per seed."""
    return {
        question: {
            row.scorer: {m: row.values(m).tolist() for m in MEASURES} for row in found.rows if row.question == question
        }
        for question in QUESTIONS
    }


def coverage_chapter(lab: Lab) -> Section:
    """What light exploration in the rehearsal is worth."""
    lab.progress("coverage", 0.0)
    size = lab.size
    found = coverage(
        lab.sequences,
        config=size.config,
        folder=lab.folder,
        exploration=size.explored,
        train=size.train,
        make=lab.make,
    )
    bars = {
        name: {
            "work only": np.array([d.false_novel for d in found.without[name]]),
            "with exploration": np.array([d.false_novel for d in found.explored[name]]),
        }
        for name in found.without
    }
    rows = tuple(
        (
            f"{name}, {how}",
            spread([d.auroc for d in some]),
            spread([d.caught for d in some]),
            spread([d.false_novel for d in some]),
        )
        for name in found.without
        for how, some in (("work only", found.without[name]), ("with exploration", found.explored[name]))
    )
    before, after = (np.mean([v[how] for v in bars.values()]) for how in ("work only", "with exploration"))
    title = f"Exploration takes false alarms on novel motions from {before:.0%} to {after:.0%} (mean of the scores)"
    drawn = pairs_figure(bars, title=title, y_label="false alarms on light novel motions")
    return Section(
        key="coverage",
        title="What exploration is worth",
        sentences=(f"{title}.",),
        how=f"{found.exploration} of {found.train} training jobs replaced by light random motions; the thresholds come "
        "from held-out cool jobs of work, of which 5 % may raise an alarm.",
        pictures=(Picture(name="coverage", png=png(drawn), alt=title),),
        tables=(Table(head=("score", "AUROC", "critical caught", "false alarms on novel"), rows=rows),),
        numbers={name: {how: v.tolist() for how, v in bar.items()} for name, bar in bars.items()},
    )


def autonomy_chapter(lab: Lab) -> Section:
    """A twin retrained on its own motion."""
    lab.progress("autonomy", 0.0)
    found = again.autonomy(
        lab.sequences,
        config=lab.size.config,
        folder=lab.folder,
        make=lab.make,
        count=lab.size.own,
    )
    question = QUESTIONS[1]
    kept = again.remaining(found, question)
    said = f"{np.mean(kept['auroc']):.0%} of the AUROC above chance, {np.mean(kept['spearman']):.0%} of Spearman"
    bars = {LABELS[m]: {row.scorer: row.values(m) for row in found.rows if row.question == question} for m in SHOWN}
    title = f"Taught by its own motion alone, it keeps {np.mean(kept['auroc']):.0%} of the AUROC"  # wider is cut off
    drawn = pairs_figure(bars, title=title, y_label="quality")
    return Section(
        key="autonomy",
        title="A twin taught by its own motion alone",
        sentences=(f"Of what real motion taught, {said} remain ({WORDS[question].lower()}).",),
        how=f"{lab.size.own} jobs generated near what the twin knows, verified to be executable and predicted to stay "
        "cool, train a new twin; prior samples are decoded from N(0, I) without any check.",
        pictures=(Picture(name="autonomy", png=png(drawn), alt=f"Quality by what was trained on: {said}."),),
        tables=(quality_table(found, question),),
        numbers={**quality_numbers(found), "remaining": {m: v.tolist() for m, v in kept.items()}},
    )


def transfer_chapter(lab: Lab) -> Section:
    """Latent features as input of a small regressor."""
    lab.progress("transfer", 0.0)
    found = transfer(lab.sequences, config=lab.size.config, folder=lab.folder, make=lab.make, labels=lab.size.labels)
    regressors = list(dict.fromkeys(row.regressor for row in found))
    inputs = list(dict.fromkeys(row.inputs for row in found))
    labels = sorted({row.labels for row in found})

    def errors(name: str, regressor: str) -> Array:
        rows = {row.labels: row.rmse_k for row in found if (row.inputs, row.regressor) == (name, regressor)}
        return np.array([rows[n] for n in labels]).T  # [draw, labels]

    first = regressors[0]
    curves = {name: errors(name, first) for name in inputs}
    ahead = [n for i, n in enumerate(labels) if curves["latent"][:, i].mean() < curves["raw"][:, i].mean()]
    verdict = (
        f"Latent features beat raw ones with {', '.join(map(str, ahead))} labels ({first})."
        if ahead
        else f"Raw features beat latent ones at every number of labels ({first}): the latent keeps what rebuilds a "
        "window, not what heats a motor."
    )
    drawn = curves_figure(
        np.array(labels), curves, title=verdict.split(":")[0], x_label="labelled jobs", y_label="RMSE (K)", log=True
    )
    rows = tuple(
        (f"{row.inputs}, {row.regressor}, {row.labels} labels", spread(row.rmse_k, 2), spread(row.r2)) for row in found
    )
    return Section(
        key="transfer",
        title="Latent features for a small regressor",
        sentences=(verdict,),
        how="The rise of the hottest winding of held-out jobs, from the mean and the deviation over the job's "
        "windows of "
        "the posterior means (latent), of each channel's mean, deviation and RMS (raw), or both; several draws of the "
        "labelled jobs per seed, spread over both.",
        pictures=(Picture(name="transfer", png=png(drawn), alt=verdict),),
        tables=(Table(head=("input, regressor, labels", "RMSE, K", "R²"), rows=rows),),
        numbers={f"{r.inputs}/{r.regressor}/{r.labels}": {"rmse_k": r.rmse_k, "r2": r.r2} for r in found},
    )
