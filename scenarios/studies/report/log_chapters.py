"""Chapters of a report on a real arm's logs: the paper's claim on files outside the twin's training data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from sklearn.metrics import roc_curve

from fleet.motion import CHANNELS
from scenarios.progress import Progress
from scenarios.show.page import Section, Table
from scenarios.studies.epochs import epoch_study
from scenarios.studies.ranking import CARRIER, spread
from scenarios.studies.real_logs import AHEAD_S, HOT_C, HotAndCool, LogStudy, hot_and_cool, log_study
from scenarios.studies.real_logs_forecast import by_motion, log_rc
from scenarios.studies.report.context import median_of
from scenarios.studies.report.figures import (
    ACCENT,
    CHANNEL_NAMES,
    NORMAL,
    Line,
    bars_figure,
    difficulty_figure,
    lines_figure,
    picture,
    ranking_figure,
)
from scenarios.studies.report.paper_chapters import (
    data_picture,
    epochs_section,
    latent_section,
    reconstruction_section,
)
from twin.logs.recording import Recording
from twin.vae.config import TwinConfig

Array = np.ndarray

MOST_WINDOWS = 2000
"""Largest number of each kind in a latent map."""


@dataclass(frozen=True, eq=False)
class Logbook:
    """Recordings of one arm, and what twins of several seeds make of them."""

    recordings: tuple[Recording, ...]
    seeds: tuple[int, ...]
    config: TwinConfig
    progress: Progress
    epochs: tuple[int, ...]
    folder: Path
    """Cache of trained twins."""

    @cached_property
    def studies(self) -> list[LogStudy]:
        """One twin per seed; each draws its training files."""
        studies = []
        for done, seed in enumerate(self.seeds):
            self.progress("training", done / len(self.seeds))
            studies.append(log_study(self.recordings, seed, config=self.config, folder=self.folder))
        return studies

    @cached_property
    def compared(self) -> list[HotAndCool]:
        """Hot against cool windows, seed by seed."""
        return [hot_and_cool(study) for study in self.studies]

    @property
    def first(self) -> LogStudy:
        """The study of the first seed, for figures; it has hot and cool windows, or `compared` raises."""
        _ = self.compared
        return self.studies[0]

    @property
    def examples(self) -> list[int]:
        """A cool and a hot window, each with the median difficulty of joint 2 of its kind."""
        study = self.first
        return [median_of(np.flatnonzero(study.hot == hot), study.difficulty) for hot in (False, True)]


def log_data_chapter(book: Logbook) -> Section:
    """A cool and a hot window as recorded."""
    study, pair = book.first, book.examples
    cool, hot = (f"{study.file[i]}, {study.start_s[i] / 60:.1f} min, {study.temp_c[i, CARRIER]:.1f} °C" for i in pair)
    finding = f"Cool: {cool}. Hot: {hot}."
    records = tuple(study.windows[pair].transpose(0, 1, 3, 2))
    title = "Recorded: a cool and a hot window of joint 2"
    return Section(
        sentences=(finding,),
        how=f"Windows of held-out files, each with the median d of joint 2 of its kind; hot is {HOT_C:g} °C or more.",
        pictures=(data_picture(records, book.config.rate_hz, CARRIER, title, finding),),
        numbers={
            "cool": cool,
            "hot": hot,
            "twins": ", ".join(each.twin.version for each in book.studies),
            "cool_windows": book.compared[0].cool_windows,
            "hot_windows": book.compared[0].hot_windows,
        },
    )


def log_latent_chapter(book: Logbook) -> Section:
    """The latent plane of joint 2 on recorded windows."""
    study, rng = book.first, np.random.default_rng(0)
    chosen = [rng.permutation(np.flatnonzero(study.hot == hot))[:MOST_WINDOWS] for hot in (False, True)]
    index = np.concatenate(chosen)
    mu, sigma = (part[:, CARRIER] for part in study.twin.posterior(study.windows[index]))
    cool, hot = (mu[study.hot[index] == kind].mean(axis=0) for kind in (False, True))
    apart = float(np.linalg.norm(cool - hot))
    finding = f"The centres of cool and hot windows lie {apart:.2f} apart; the prior has standard deviation 1."
    return replace(
        latent_section(mu, sigma, study.temp_c[index, CARRIER], HOT_C, finding),
        how=f"Posteriors of held-out windows under the network of joint 2, at most {MOST_WINDOWS} of each kind.",
        numbers={"distance_of_centres": apart},
    )


def log_reconstruction_chapter(book: Logbook) -> Section:
    """The two windows and their reconstructions."""
    study = book.first
    return reconstruction_section(study.twin, study.windows[book.examples], "The two windows above")


def log_difficulty_chapter(book: Logbook) -> Section:
    """Error and difficulty, hot against cool, and how well they separate."""
    study, seeds = book.first, book.compared
    ratios, scores = [each.ratio for each in seeds], list(seeds[0].ranking["auroc"])
    by_seed = {"cool": [each.cool_error for each in seeds], "hot": [each.hot_error for each in seeds]}
    errors = {
        name: {kind: np.array(values)[:, c] for kind, values in by_seed.items()} for c, name in enumerate(CHANNEL_NAMES)
    }
    auroc, auprc = (
        {key: [each.ranking[measure][key] for each in seeds] for key in scores} for measure in ("auroc", "auprc")
    )
    best = max(auroc, key=lambda key: np.mean(auroc[key]))
    ratio = f"The error of joint 2 is {spread(ratios, 2)} times larger in hot windows than in cool ones"
    groups = {f"cool, below {HOT_C:g} °C": study.difficulty[~study.hot], "hot": study.difficulty[study.hot]}
    curves = {}
    for key, values, colour in (
        ("d", study.errors[:, CARRIER].sum(axis=-1), NORMAL),
        ("rms_torque", study.rms_torque[:, CARRIER], ACCENT),
    ):
        false_alarms, hits, _ = roc_curve(study.hot, values)
        curves[f"{_score_name(key)}: AUROC {auroc[key][0]:.3f}"] = Line(false_alarms, hits, colour)
    roc = lines_figure(
        {"": curves},
        title="Hot windows by motion alone",
        x_label="false alarms (share of cool windows)",
        y_label="hits (share of hot windows)",
        height=5.6,
        diagonal=True,
    )
    drawn_d = difficulty_figure(groups, title="Difficulty of recorded windows, hot against cool", unit="windows")
    drawn_errors = bars_figure(errors, title=ratio, y_label="mean |error| of joint 2 (σ)")
    return Section(
        sentences=(
            f"{ratio} (target 2).",
            f"Median d of joint 2: {spread([each.cool_difficulty for each in seeds], 2)} cool, "
            f"{spread([each.hot_difficulty for each in seeds], 2)} hot.",
            f"AUROC for each seed: d {_each(auroc['d'])}, RMS torque {_each(auroc['rms_torque'])}.",
            f"The best score from motion alone is {_score_name(best)}, AUROC {spread(auroc[best])}. The temperature "
            "also depends on the work of the last forty minutes, which a window of some seconds cannot show.",
        ),
        how=f"{len(study.train_files)} of the files that never reach {HOT_C:g} °C on joint 2 train the twin, drawn "
        f"anew for each of {len(seeds)} seeds. The others are tested: {seeds[0].cool_windows} cool and "
        f"{seeds[0].hot_windows} hot windows of the first seed.",
        pictures=(
            picture("hot_and_cool", drawn_errors, f"{ratio}."),
            picture("difficulty", drawn_d, "Boxes of d per joint, and the sum."),
            picture("roc", roc, "Hits against false alarms."),
        ),
        tables=(
            Table(
                head=("hot against cool by", "AUROC", "AUPRC"),
                rows=tuple((_score_name(key), spread(auroc[key]), spread(auprc[key])) for key in scores),
            ),
        ),
        numbers={
            "ratio": ratios,
            **{measure: [each.ranking[measure] for each in seeds] for measure in ("auroc", "auprc")},
        },
    )


def _score_name(key: str) -> str:
    names = {
        "d": "d of joint 2",
        "load": "torque above the reconstruction",
        "latent": "latent distance",
        "rms_torque": "RMS torque",
    }
    return names.get(key) or f"error of {CHANNEL_NAMES[CHANNELS.index(key)]}"


def log_epochs_chapter(book: Logbook) -> Section:
    """Reconstruction error against epochs on recorded motion."""
    study, config = book.studies[0], book.config
    cool = ~study.hot
    windows = [study.windows[(study.file == name) & cool][:40:4] for name in np.unique(study.file[cool])]
    jobs = [[window.transpose(0, 2, 1)] for some in windows for window in some]
    once = TwinConfig(rate_hz=config.rate_hz, record_hz=config.rate_hz, window=config.window, restarts=1)
    epochs = epoch_study(
        jobs, epochs=book.epochs, seeds=book.seeds, config=once, records=len(jobs) // 3, progress=book.progress
    )
    return epochs_section(
        epochs,
        (f"{epochs.windows} recorded windows are trained on; other windows of the same files are held out.",),
        f"Joint 2, a separate training for each number of epochs and each of {len(book.seeds)} seeds.",
        "Error against epochs on recorded windows",
    )


def log_rc_chapter(book: Logbook) -> Section:
    """Prediction that joint 2 passes 40 °C soon: difficulty against temperature and an identified network."""
    book.progress("identifying", 0.0)
    result, seeds = log_rc(book.first, book.recordings), [by_motion(study).auroc for study in book.studies]
    below, auroc = result.below, result.below.auroc
    best = max(auroc, key=lambda name: auroc[name])
    finding = (
        f"Of {below.windows} held-out windows still below {HOT_C:g} °C, {below.passing} (in {below.files_passing} "
        f"files) pass it within {AHEAD_S / 60:g} minutes. d alone ranks them with AUROC {auroc['d']:.3f}; the best is "
        f"{best} with {auroc[best]:.3f} (target 0.95)."
    )
    drawn = ranking_figure(
        {name: {"AUROC": np.array([value])} for name, value in auroc.items()},
        ours=["d"],
        title=f"Passes {HOT_C:g} °C within five minutes? Best: {best}",
        targets={"AUROC": 0.95},
    )
    rms_k = np.median([value for each in result.identified.rms_k.values() for value in each])
    rc, nominal = (auroc[f"{name}, load continued"] for name in ("rc", "nominal rc"))
    sentences = [
        finding,
        "From the motion of the window alone, AUROC for each seed: d "
        f"{_each([auroc['d'] for auroc in seeds])}, RMS torque {_each([auroc['RMS torque'] for auroc in seeds])}.",
        f"With the load continued, the identified network has AUROC {rc:.3f}, the nominal one {nominal:.3f}.",
    ]
    if "all" in auroc:
        verdict = "d adds nothing" if auroc["all"] <= rc else "d adds something"
        sentences.append(f"d together with temperature and network: {auroc['all']:.3f}, so {verdict}.")
    sentences.append(f"The network explains its own files to {rms_k:.2f} K (median over files and joints).")
    return Section(
        sentences=tuple(sentences),
        how="A thermal network identified from the twin's training files alone (rc), and a nominal one, both started "
        "at the measured temperatures of each window; first seed. Windows of one file are much alike, so the number of "
        "files counts.",
        pictures=(picture("rc", drawn, finding),),
        tables=(
            Table(
                head=("ranked by", "AUROC, still below", "AUPRC, still below", "AUROC, all"),
                rows=tuple(
                    (name, f"{auroc[name]:.3f}", f"{below.auprc[name]:.3f}", f"{result.every.auroc[name]:.3f}")
                    for name in auroc
                ),
            ),
        ),
        numbers={
            "below": vars(below),
            "every": vars(result.every),
            "rc": result.identified.version,
            "by_motion": seeds,
        },
    )


def _each(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.3f}" for value in values)
