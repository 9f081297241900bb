"""The paper's own figures, each with its finding: data, latent map, reconstruction, difficulty, error by epochs."""

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree
from sklearn.metrics import roc_auc_score

from fleet.errors import FleetError
from fleet.motion import CHANNELS, RATE_HZ, Plan
from scenarios.show.page import Picture, Section, Table
from scenarios.studies.epochs import EpochStudy, epoch_study
from scenarios.studies.ranking import CARRIER, spread
from scenarios.studies.report.context import Lab
from scenarios.studies.report.figures import (
    CHANNEL_NAMES,
    INK,
    NORMAL,
    Line,
    Pair,
    difficulty_figure,
    latent_map_figure,
    latent_scatter_figure,
    lines_figure,
    picture,
    signals_figure,
)
from twin.vae.twin import Twin
from twin.vae.window import cut, resample

Array = np.ndarray

TAU = CHANNELS.index("tau")
LONGEST_S = 30.0
"""Longest record that is drawn."""
ACTIVE = 0.01
"""Variance of its posterior means from which a latent unit counts as active (Burda et al., ICLR 2016)."""


def data_chapter(lab: Lab) -> Section:
    """A normal and a critical record."""
    study = lab.study
    normal, critical = (_motion(study.test.plans[i]) for i in lab.examples)
    load = [float(np.sqrt(np.mean(motion[:, TAU, CARRIER] ** 2))) for motion in (normal, critical)]
    peaks = [float(study.test.peak_c[i, CARRIER]) for i in lab.examples]
    finding = (
        f"RMS torque of joint {CARRIER + 1}: {load[0]:.1f} N·m in the normal job, {load[1]:.1f} N·m in the critical "
        f"one. Repeated for {study.horizon_s / 60:g} min, they heat it to {peaks[0]:.1f} °C and {peaks[1]:.1f} °C."
    )
    title = f"The critical job loads joint {CARRIER + 1} with {load[1] / max(load[0], 1e-9):.1f} times the torque"
    return Section(
        sentences=(finding,),
        how="One normal and one critical held-out test job, each with the median difficulty of joint 2 of its kind. "
        f"Planned motion at {RATE_HZ:g} Hz, torque from inverse dynamics. Normal: no motor passes {study.cool_c:g} °C "
        f"within the horizon. Critical: a motor passes {study.warning_c:g} °C.",
        pictures=(data_picture((normal, critical), RATE_HZ, CARRIER, title, finding),),
        numbers={"rms_torque_nm": load, "peak_c": peaks, "twin": lab.twin.version, "data": lab.twin.data_hash},
    )


def _motion(plan: Plan) -> Array:
    """The first seconds of a plan as one profile, [time, 3, joint]."""
    return np.concatenate([phase.profile for phase in plan.phases])[: int(LONGEST_S * RATE_HZ)]


def data_picture(records: Pair, rate_hz: float, joint: int, title: str, finding: str) -> Picture:
    """A normal and a critical record, [time, 3, joint] each, with one joint before the others."""
    others = tuple(np.delete(each, joint, axis=2) for each in records)
    own = tuple(each[:, :, joint] for each in records)
    drawn = signals_figure(own, rate_hz, joint=joint, title=title, others=others)
    return picture("data", drawn, f"Position, velocity and torque over time. {finding}")


def latent_chapter(lab: Lab) -> Section:
    """The latent plane of joint 2."""
    _ = lab.examples  # raises if a kind of job is missing
    windows, temp_c = lab.windows
    mu, sigma = (part[:, min(CARRIER, part.shape[1] - 1)] for part in lab.twin.posterior(windows))
    if mu.shape[1] < 2:
        raise FleetError(f"A latent map needs two units or more (the twin has {mu.shape[1]}).")
    critical = temp_c >= lab.study.warning_c
    distance, overlap = np.linalg.norm(mu, axis=1), _overlap(mu[~critical], mu[critical])
    finding = (
        f"The mean distance from the centre of the plane is {distance[critical].mean():.2f} for critical windows and "
        f"{distance[~critical].mean():.2f} for normal ones. {overlap:.0%} of the critical windows have a normal "
        "neighbour closer than 95 % of normal windows have one. Where the kinds overlap, the map alone cannot separate "
        "them."
    )
    section = latent_section(mu, sigma, temp_c, lab.study.warning_c, finding)
    return replace(
        section,
        how=f"Posteriors of {len(windows)} windows of test jobs under the network of joint 2. The temperature is the "
        "peak of joint 2 when the job is repeated over the horizon. Jobs between cool and critical are left out.",
        numbers={"windows": len(windows), "overlap": overlap},
    )


def latent_section(mu: Array, sigma: Array, temp_c: Array, limit_c: float, finding: str) -> Section:
    """Density and scatter plot of posteriors (mu, sigma) [window, latent] of joint 2 with temperatures [window]."""
    hot = temp_c >= limit_c
    kinds = (mu[~hot], sigma[~hot]), (mu[hot], sigma[hot])
    maps = latent_map_figure(*kinds, joint=CARRIER, title="Latent map of normal and critical windows of joint 2")
    dots = latent_scatter_figure(mu, temp_c, limit_c=limit_c, joint=CARRIER, title="Posterior means by temperature")
    return Section(
        sentences=(finding, active_units(mu)),
        pictures=(
            picture("latent_map", maps, f"Density of normal and critical windows. {finding}"),
            picture("latent_scatter", dots, f"Posterior means coloured by temperature. {finding}"),
        ),
    )


def active_units(mu: Array) -> str:
    """How many latent units carry information, as a sentence.

    Args:
        mu: [window, latent].
    """
    count = int((mu.var(axis=0) > ACTIVE).sum())
    return f"{count} of {mu.shape[1]} units are active: the variance of their means over windows exceeds {ACTIVE:g}."


def _overlap(normal: Array, critical: Array) -> float:
    """Share of critical means with a normal one as near as normal ones have each other."""
    tree = KDTree(normal)
    own = tree.query(normal, k=2)[0][:, 1]
    return float((tree.query(critical)[0] <= np.percentile(own, 95)).mean())


def reconstruction_chapter(lab: Lab) -> Section:
    """A normal and a critical window and their reconstructions."""
    config = lab.twin.config
    cycles = [lab.study.test.plans[i].cycle.profile for i in lab.examples]
    samples = [resample(profile, RATE_HZ, config.rate_hz) for profile in cycles]
    windows = np.concatenate([cut(each, config.window, config.window)[:1] for each in samples])
    return reconstruction_section(lab.twin, windows, "First window of the cycle of the two jobs above")


def reconstruction_section(twin: Twin, windows: Array, source: str) -> Section:
    """Joint 2 of a normal and of a critical window, [2, time, joint, channel], and its reconstructions."""
    recorded = twin.scaler.to_si(twin.scaler.to_z(windows))[:, :, CARRIER]
    made, error = twin.reconstruct(windows)[:, :, CARRIER], twin.window_errors(windows)[:, CARRIER]
    title = f"Torque error: {error[1][TAU]:.1f} σ in the critical window, {error[0][TAU]:.1f} σ in the normal one"
    drawn = signals_figure(tuple(recorded), twin.config.rate_hz, joint=CARRIER, title=title, made=tuple(made))
    return Section(
        sentences=("The shaded area is the error from which the difficulty is computed.",),
        how=f"{source}, decoded from the posterior mean.",
        pictures=(picture("reconstruction", drawn, "Recorded and reconstructed motion and torque."),),
        tables=(
            Table(
                head=("mean |error|, σ", "normal", "critical"),
                rows=tuple((name, *(f"{e:.2f}" for e in error[:, c])) for c, name in enumerate(CHANNEL_NAMES)),
            ),
        ),
        numbers={"normal": error[0], "critical": error[1]},
    )


def difficulty_chapter(lab: Lab) -> Section:
    """Difficulty of critical and non-critical jobs."""
    d, study = lab.difficulty, lab.study
    critical, cool = study.critical, lab.cool
    groups = {
        f"cool, below {study.cool_c:g} °C": d[cool],
        "between": d[~cool & ~critical],
        f"critical, {study.warning_c:g} °C and more": d[critical],
    }
    if not all(len(values) for values in groups.values()):
        raise FleetError("The test jobs must include cool, medium and critical ones; at least one group is empty.")
    medians = {name: np.median(values, axis=0) for name, values in groups.items()}
    of_cool, _, of_critical = medians.values()
    auroc = [float(roc_auc_score(critical, d[:, j])) for j in range(d.shape[1])]
    best, of_sum = int(np.argmax(auroc)), float(roc_auc_score(critical, d.sum(axis=1)))
    title = f"Joint {best + 1} separates critical jobs best (AUROC {auroc[best]:.2f}); the sum gets {of_sum:.2f}"
    drawn = difficulty_figure(groups, title=title)
    rows = tuple((name, *(f"{v:.2f}" for v in m), f"{m.sum():.2f}") for name, m in medians.items())
    return Section(
        sentences=(
            f"Median d of joint {best + 1}: {of_cool[best]:.2f} for cool jobs, {of_critical[best]:.2f} for critical "
            "ones. Even cool jobs are far from zero, because two latent numbers never describe a window completely. "
            "Joints without load carry only novelty, which the plain sum adds up.",
        ),
        how=f"d_k = 1 − exp(−e_k), with e_k the time mean of the absolute error of joint k summed over the channels, "
        f"for {len(d)} held-out jobs repeated for {study.horizon_s / 60:g} min.",
        pictures=(picture("difficulty", drawn, "Boxes of d per joint and histograms of the sum."),),
        tables=(Table(head=("median d", *(f"joint {j + 1}" for j in range(d.shape[1])), "sum"), rows=rows),),
        numbers={
            "median": medians,
            "joint": best + 1,
            "cool": float(of_cool[best]),
            "critical": float(of_critical[best]),
            "auroc": auroc,
            "auroc_of_sum": of_sum,
        },
    )


def epochs_chapter(lab: Lab) -> Section:
    """Reconstruction error against epochs."""
    jobs = [[phase.profile for phase in plan.phases] for plan in lab.study.train.plans]
    seeds = tuple(range(lab.size.epoch_seeds))
    study = epoch_study(jobs, epochs=lab.size.epochs, seeds=seeds, workers=1, progress=lab.progress)
    trained_on, held_out = (errors[:, :, CARRIER].mean(axis=0) for errors in (study.trained_on, study.held_out))
    rising = study.rising(CARRIER)
    left, left_new = trained_on[-1] / trained_on[0], held_out[-1] / held_out[0]
    hardest = CHANNEL_NAMES[int(np.argmax(left))]
    first, last = study.epochs[0], study.epochs[-1]
    sentences = (
        f"From {first} to {last} epochs the error on the trained record falls to {left[TAU]:.0%} of its first value "
        f"for torque, {left[0]:.0%} for position and {left[1]:.0%} for velocity; {hardest} gains least. On held-out "
        f"jobs it falls to {left_new[TAU]:.0%}, {left_new[0]:.0%} and {left_new[1]:.0%}.",
        f"The error does not fall at every step. It rises somewhere in {rising[0].mean():.0%} of seeds and channels "
        f"on the trained record, and in {rising[1].mean():.0%} on held-out jobs.",
    )
    how = (
        f"Joint {CARRIER + 1}. A separate training for each number of epochs and each of {len(seeds)} seeds, with one "
        "restart and the one-cycle schedule over just these epochs, on a record of 5 cool jobs (about "
        f"{study.windows} windows). 20 other cool jobs are held out."
    )
    title = f"From {first} to {last} epochs {hardest} gains least, torque falls to {left[TAU]:.0%}"
    section = epochs_section(study, sentences, how, title)
    return replace(section, numbers={**section.numbers, "rising": rising})


def epochs_section(study: EpochStudy, sentences: tuple[str, ...], how: str, title: str) -> Section:
    """Errors of joint 2 by number of epochs, as figure and table."""
    epochs = np.array(study.epochs)
    kinds = {"trained on": study.trained_on[:, :, CARRIER], "held out": study.held_out[:, :, CARRIER]}
    looks = {"trained on": (NORMAL, "o"), "held out": (INK, "s")}
    channels = {CHANNEL_NAMES[c]: c for c in (TAU, 0, 1)}
    drawn = lines_figure(
        {name: {k: Line(epochs, kinds[k][:, :, c], *looks[k]) for k in kinds} for name, c in channels.items()},
        title=title,
        x_label="epochs",
        y_label="mean |error| (σ of the training data)",
        height=4.0,
        log=True,
        ticks=epochs,
        from_zero=True,
    )
    rows = tuple(
        (f"{name}, {kind}", *(spread(seeds, 2) for seeds in errors[:, :, c].T))
        for name, c in channels.items()
        for kind, errors in kinds.items()
    )
    return Section(
        sentences=sentences,
        how=f"{how} Mean and standard deviation over the seeds, in standard deviations of the training data.",
        pictures=(picture("epochs", drawn, "Error against epochs. " + " ".join(sentences)),),
        tables=(Table(head=("mean |error|, σ", *(f"{n} epochs" for n in study.epochs)), rows=rows),),
        numbers={"epochs": study.epochs, "known": kinds["trained on"], "held_out": kinds["held out"]},
    )
