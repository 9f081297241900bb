"""What a report shows of a real arm's logs: the paper's claim on files that the twin has never seen."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from sklearn.metrics import roc_curve

from fleet.motion import CHANNELS
from scenarios.build import Progress, cache_folder, quiet
from scenarios.epochs import EPOCHS, epoch_study
from scenarios.log_rc import log_rc
from scenarios.log_study import AHEAD_S, HOT_C, JOINT, HotAndCool, LogStudy, hot_and_cool, log_study
from scenarios.twin_chapters import active_units
from scenarios.twin_charts import pairs_figure, ranking_figure, roc_figure
from scenarios.twin_figures import (
    data_figure,
    difficulty_figure,
    epochs_figure,
    latent_map_figure,
    latent_scatter_figure,
    reconstruction_figure,
)
from scenarios.twin_page import Picture, Section, Table, spread
from scenarios.twin_style import CHANNEL_NAMES, png
from twin.model import TwinConfig
from twin.recording import Recording

Array = np.ndarray

MOST_WINDOWS = 2000
"""Of each kind in a latent map."""


@dataclass(frozen=True, eq=False)
class Logbook:
    """Recordings of one arm, and what twins of several seeds make of them."""

    recordings: tuple[Recording, ...]
    seeds: tuple[int, ...]
    config: TwinConfig
    progress: Progress = quiet
    epochs: tuple[int, ...] = EPOCHS
    folder: Path = field(default_factory=cache_folder)
    """Where trained twins are kept."""

    @cached_property
    def studies(self) -> list[LogStudy]:
        """One twin per seed; each draws the files it learns from."""
        found = []
        for done, seed in enumerate(self.seeds):
            told = lambda share, done=done: self.progress("training", (done + share) / len(self.seeds))  # noqa: E731
            found.append(log_study(self.recordings, seed, config=self.config, progress=told, folder=self.folder))
        return found

    @cached_property
    def compared(self) -> list[HotAndCool]:
        """Hot against cool windows, seed by seed."""
        return [hot_and_cool(study) for study in self.studies]

    @property
    def first(self) -> LogStudy:
        """The study from which the pictures are; it has hot and cool windows, or `compared` raises."""
        _ = self.compared
        return self.studies[0]

    def example(self, hot: bool) -> int:
        """The window whose difficulty of joint 2 is the median of its kind."""
        index = np.flatnonzero(self.first.hot == hot)
        d = self.first.difficulty[index, JOINT]
        return int(index[np.argsort(d)[len(index) // 2]])


def log_data_chapter(book: Logbook) -> Section:
    """A cool and a hot window as recorded."""
    study, cool, hot = book.first, book.example(False), book.example(True)
    words = [f"{study.file[i]}, {study.start_s[i] / 60:.1f} min, {study.temp_c[i, JOINT]:.1f} °C" for i in (cool, hot)]
    drawn = data_figure(
        study.windows[cool].transpose(0, 2, 1),
        study.windows[hot].transpose(0, 2, 1),
        book.config.rate_hz,
        joint=JOINT,
        title="Recorded: a cool and a hot window of joint 2",
    )
    return Section(
        key="data",
        title="Training and anomalous data",
        sentences=(f"Cool: {words[0]}. Hot: {words[1]}.",),
        how=f"Windows of held-out files whose d of joint 2 is the median of their kind; hot is {HOT_C:g} °C or more.",
        pictures=(Picture(name="data", png=png(drawn), alt=f"Recorded motion and torque. {' '.join(words)}"),),
        numbers={
            "cool": words[0],
            "hot": words[1],
            "twins": ", ".join(each.twin.version for each in book.studies),
            "cool_windows": book.compared[0].cool_windows,
            "hot_windows": book.compared[0].hot_windows,
        },
    )


def log_latent_chapter(book: Logbook) -> Section:
    """The latent plane of joint 2 on recorded windows."""
    study, rng = book.first, np.random.default_rng(0)
    kinds = [rng.permutation(np.flatnonzero(study.hot == hot))[:MOST_WINDOWS] for hot in (False, True)]
    parts = [study.twin.posterior(study.windows[index]) for index in kinds]
    cool, hot = ((mu[:, JOINT], sigma[:, JOINT]) for mu, sigma in parts)
    maps = latent_map_figure(cool, hot, joint=JOINT, title="Latent map of recorded windows: hot against cool")
    temp_c = study.temp_c[np.concatenate(kinds), JOINT]
    mu = np.concatenate([cool[0], hot[0]])
    dots = latent_scatter_figure(mu, temp_c, limit_c=HOT_C, joint=JOINT, title="Posterior means by motor temperature")
    between = float(np.linalg.norm(cool[0].mean(axis=0) - hot[0].mean(axis=0)))
    said = f"The centres of cool and hot windows lie {between:.2f} apart in a plane whose prior has deviation 1."
    return Section(
        key="latent",
        title="Latent map",
        sentences=(said, active_units(mu)),
        how=f"Posterior of held-out windows under the network of joint 2, at most {MOST_WINDOWS} of each kind.",
        pictures=(
            Picture(name="latent_map", png=png(maps), alt="Density of cool and hot windows. " + said),
            Picture(name="latent_scatter", png=png(dots), alt="Posterior means by temperature. " + said),
        ),
        numbers={"distance_of_centres": between},
    )


def log_reconstruction_chapter(book: Logbook) -> Section:
    """What the twin makes of the two windows."""
    study, twin = book.first, book.first.twin
    pair = [book.example(hot) for hot in (False, True)]
    windows = study.windows[pair]
    seen = twin.scaler.to_si(twin.scaler.to_z(windows))[:, :, JOINT]
    made = twin.reconstruct(windows)[:, :, JOINT]
    error = study.errors[pair, JOINT]
    drawn = reconstruction_figure(
        seen[0], made[0], seen[1], made[1], book.config.rate_hz, joint=JOINT, title="What the twin makes of the two"
    )
    rows = tuple((name, f"{error[0, c]:.2f}", f"{error[1, c]:.2f}") for c, name in enumerate(CHANNEL_NAMES))
    return Section(
        key="reconstruction",
        title="Reconstruction of a cool and of a hot record",
        sentences=("The shaded area is the error from which the difficulty is computed.",),
        how="The two windows above, decoded from the posterior mean.",
        pictures=(Picture(name="reconstruction", png=png(drawn), alt="Recorded and reconstructed motion and torque."),),
        tables=(Table(head=("mean |error|, σ", "cool", "hot"), rows=rows),),
        numbers={"cool": error[0].tolist(), "hot": error[1].tolist()},
    )


def log_difficulty_chapter(book: Logbook) -> Section:
    """Error and difficulty, hot against cool, and how well they separate."""
    study, found = book.first, book.compared
    ratios = [each.ratio for each in found]
    bars = {
        name: {
            "cool": np.array([each.cool_error[c] for each in found]),
            "hot": np.array([each.hot_error[c] for each in found]),
        }
        for c, name in enumerate(CHANNEL_NAMES)
    }
    said = f"The error of joint 2 is {spread(ratios, 2)} times larger in hot windows than in cool ones (target 2)."
    errors = pairs_figure(bars, title=said.split(" (")[0].rstrip("."), y_label="mean |error| of joint 2 (σ)")
    d = difficulty_figure(
        {f"cool, below {HOT_C:g} °C": study.difficulty[~study.hot], "hot": study.difficulty[study.hot]},
        title="Difficulty of recorded windows, hot against cool",
        unit="windows",
    )
    scores = {"d of joint 2": study.errors[:, JOINT].sum(axis=-1), "RMS torque": study.rms_torque[:, JOINT]}
    curves = {}
    for name, key in (("d of joint 2", "d"), ("RMS torque", "rms_torque")):
        false_alarms, hits, _ = roc_curve(study.hot, scores[name])
        curves[name] = (false_alarms, hits, found[0].auroc[key])
    roc = roc_figure(curves, title="Which windows are hot, told from motion alone")
    best = max(found[0].auroc, key=lambda key: np.mean([each.auroc[key] for each in found]))
    sentences = (
        said,
        f"Median d of joint 2: {spread([each.cool_difficulty for each in found], 2)} cool, "
        f"{spread([each.hot_difficulty for each in found], 2)} hot; AUROC "
        f"{spread([each.auroc['d'] for each in found])}.",
        f"The best of the scores that see motion alone is {_words(best)}, AUROC "
        f"{spread([each.auroc[best] for each in found])}. Which windows are hot also depends on what the arm did in "
        f"the "
        "last forty minutes, which a window of some seconds cannot show.",
    )
    rows = tuple(
        (_words(key), spread([e.auroc[key] for e in found]), spread([e.auprc[key] for e in found]))
        for key in found[0].auroc
    )
    return Section(
        key="difficulty",
        title="Error and difficulty, hot against cool",
        sentences=sentences,
        how=f"{len(study.train_files)} of the files that never reach {HOT_C:g} °C on joint 2 train the twin, drawn "
        f"anew "
        f"for each of {len(found)} seeds; the others are tested: {found[0].cool_windows} cool and "
        f"{found[0].hot_windows} hot windows of the first seed.",
        pictures=(
            Picture(name="hot_and_cool", png=png(errors), alt=said),
            Picture(name="difficulty", png=png(d), alt="Boxes of d per joint, and the sum."),
            Picture(name="roc", png=png(roc), alt="Hits against false alarms."),
        ),
        tables=(Table(head=("hot against cool by", "AUROC", "AUPRC"), rows=rows),),
        numbers={
            "ratio": ratios,
            "auroc": [dict(each.auroc) for each in found],
            "auprc": [dict(each.auprc) for each in found],
        },
    )


def _words(key: str) -> str:
    named = {"d": "d of joint 2", "rms_torque": "RMS torque"}
    return named.get(key) or f"error of {CHANNEL_NAMES[CHANNELS.index(key)]}"


def log_epochs_chapter(book: Logbook) -> Section:
    """Reconstruction error against epochs on recorded motion."""
    windows, study = book.studies[0].windows, book.studies[0]
    cool = np.unique(study.file[~study.hot])
    jobs = [[w.transpose(0, 2, 1)] for name in cool for w in windows[(study.file == name) & ~study.hot][:40:4]]
    config = TwinConfig(
        rate_hz=book.config.rate_hz, record_hz=book.config.rate_hz, window=book.config.window, restarts=1
    )
    found = epoch_study(
        jobs, epochs=book.epochs, seeds=book.seeds, config=config, records=len(jobs) // 3, progress=book.progress
    )
    known, held_out = found.table(JOINT)
    rows = tuple(
        (f"{CHANNEL_NAMES[c]}, {kind}", *(spread(e[:, i, c].tolist(), 2) for i in range(len(found.epochs))))
        for c in (2, 0, 1)
        for kind, e in (("trained on", known), ("held out", held_out))
    )
    drawn = epochs_figure(np.array(found.epochs), known, held_out, title="Error against epochs on recorded windows")
    return Section(
        key="epochs",
        title="Reconstruction error against epochs",
        sentences=(f"{found.windows} recorded windows are trained on, others of the same files are held out.",),
        how=f"Joint 2, a separate training for each number of epochs and each of {len(book.seeds)} seeds.",
        pictures=(Picture(name="epochs", png=png(drawn), alt="Error against epochs, recorded windows."),),
        tables=(Table(head=("mean |error|, σ", *(f"{n} epochs" for n in found.epochs)), rows=rows),),
        numbers={"epochs": list(found.epochs), "known": known.tolist(), "held_out": held_out.tolist()},
    )


def log_rc_chapter(book: Logbook) -> Section:
    """Whether a motor passes 40 °C soon: the twin's difficulty against temperature and an identified network."""
    book.progress("identifying", 0.0)
    found = log_rc(book.first, book.recordings)
    rows = tuple(
        (name, f"{found.below.auroc[name]:.3f}", f"{found.below.auprc[name]:.3f}", f"{found.every.auroc[name]:.3f}")
        for name in found.below.auroc
    )
    best = max(found.below.auroc, key=lambda name: found.below.auroc[name])
    d = found.below.auroc["d"]
    said = (
        f"Of {found.below.windows} held-out windows still below {HOT_C:g} °C, {found.below.passing} (in "
        f"{found.below.files_passing} files) pass it within {AHEAD_S / 60:g} minutes. d alone ranks them with AUROC "
        f"{d:.3f}; the best is {best} with {found.below.auroc[best]:.3f} (target .95)."
    )
    values = {name: {"AUROC": np.array([auroc])} for name, auroc in found.below.auroc.items()}
    drawn = ranking_figure(
        values, ours=["d"], title=f"Passes {HOT_C:g} °C within five minutes? Best: {best}", targets={"AUROC": 0.95}
    )
    rms = [value for each in found.identified.rms_k.values() for value in each]
    fit = f"The network explains its own files to {np.median(rms):.2f} K (median over files and joints)."
    return Section(
        key="rc",
        title="With temperature and a thermal network",
        sentences=(said, *_together(found.below.auroc), fit),
        how="A thermal network identified from the twin's training files alone (rc), and a nominal one, started at the "
        "measured temperatures of each window; first seed. Windows of one file are much alike, so files count.",
        pictures=(Picture(name="rc", png=png(drawn), alt=said),),
        tables=(Table(head=("ranked by", "AUROC, still below", "AUPRC, still below", "AUROC, all"), rows=rows),),
        numbers={"below": vars(found.below), "every": vars(found.every), "rc": found.identified.version},
    )


def _together(auroc: dict[str, float]) -> tuple[str, ...]:
    """Whether d is worth adding to temperature and network, and whether identification is worth its logs."""
    rc, nominal = (auroc[f"{name}, load continued"] for name in ("rc", "nominal rc"))
    said = [f"With the load going on, the identified network ranks with {rc:.3f}, the nominal one with {nominal:.3f}."]
    if "all" in auroc:
        verdict = "do not add it" if auroc["all"] <= rc else "it adds something"
        said.append(f"d together with temperature and network gets {auroc['all']:.3f}: {verdict}.")
    return tuple(said)
