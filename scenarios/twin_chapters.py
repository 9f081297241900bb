"""The paper's own pictures, each with its finding: data, latent map, reconstruction, difficulty, error by epochs."""

import numpy as np
from scipy.spatial import KDTree
from sklearn.metrics import roc_auc_score

from fleet.errors import FleetError
from fleet.motion import CHANNELS, RATE_HZ, Plan
from scenarios.epochs import epoch_study
from scenarios.quality import CARRIER
from scenarios.twin_figures import (
    data_figure,
    difficulty_figure,
    epochs_figure,
    latent_map_figure,
    latent_scatter_figure,
    reconstruction_figure,
)
from scenarios.twin_lab import Lab
from scenarios.twin_page import Picture, Section, Table, spread
from scenarios.twin_style import CHANNEL_NAMES, png
from twin.window import cut, resample

Array = np.ndarray

TAU = CHANNELS.index("tau")
LONGEST_S = 30.0
"""Of a record that is drawn."""


def data_chapter(lab: Lab) -> Section:
    """A normal and a critical record."""
    normal, critical = (lab.study.test.plans[i] for i in lab.examples)
    load = [float(np.sqrt(np.mean(_motion(plan)[:, TAU, CARRIER] ** 2))) for plan in (normal, critical)]
    peaks = [float(lab.study.test.peak_c[i, CARRIER]) for i in lab.examples]
    found = (
        f"RMS torque of joint {CARRIER + 1}: {load[0]:.1f} N·m in the normal job, {load[1]:.1f} N·m in the critical "
        f"one; repeated for {lab.study.horizon_s / 60:g} min they bring it to {peaks[0]:.1f} °C and {peaks[1]:.1f} °C."
    )
    title = f"The critical job loads joint {CARRIER + 1} with {load[1] / max(load[0], 1e-9):.1f} times the torque"
    drawn = data_figure(_motion(normal), _motion(critical), RATE_HZ, joint=CARRIER, title=title)
    return Section(
        key="data",
        title="Training and anomalous data",
        sentences=(found,),
        how="Of the held-out test jobs the normal and the critical one whose difficulty of joint 2 is the median of "
        f"its kind; planned motion at {RATE_HZ:g} Hz, torque from inverse dynamics. Normal: no motor passes "
        f"{lab.study.cool_c:g} °C within the horizon; critical: one passes {lab.study.warning_c:g} °C.",
        pictures=(Picture(name="data", png=png(drawn), alt=f"Position, velocity and torque over time. {found}"),),
        numbers={
            "rms_torque_nm": load,
            "peak_c": peaks,
            "twin": lab.twin.version,
            "data": lab.twin.data_hash,
        },
    )


def _motion(plan: Plan) -> Array:
    """The plan's first seconds as one profile, [time, 3, joint]."""
    whole = np.concatenate([phase.profile for phase in plan.phases])
    return whole[: int(LONGEST_S * RATE_HZ)]


def latent_chapter(lab: Lab) -> Section:
    """The latent plane of joint 2."""
    _ = lab.examples  # says what is missing
    windows, temp_c = lab.windows
    mu, sigma = (part[:, min(CARRIER, part.shape[1] - 1)] for part in lab.twin.posterior(windows))
    if mu.shape[1] < 2:
        raise FleetError(f"A latent map needs two units or more (the twin has {mu.shape[1]}).")
    critical = temp_c >= lab.study.warning_c
    distance = np.linalg.norm(mu, axis=1)
    overlap = _overlap(mu[~critical], mu[critical])
    sentence = (
        f"Critical windows lie {distance[critical].mean():.2f} from the centre of the plane on average, normal ones "
        f"{distance[~critical].mean():.2f}; {overlap:.0%} of the critical windows have a normal window nearer than "
        "normal windows have one another in 95 % of cases. Where kinds overlap, the map alone cannot tell them apart. "
        + active_units(mu)
    )
    some = {"joint": CARRIER}
    maps = latent_map_figure(
        (mu[~critical], sigma[~critical]),
        (mu[critical], sigma[critical]),
        title="Latent map: where normal and critical windows of joint 2 lie",
        **some,
    )
    dots = latent_scatter_figure(
        mu, temp_c, limit_c=lab.study.warning_c, title="Posterior means by temperature reached", **some
    )
    return Section(
        key="latent",
        title="Latent map",
        sentences=(sentence,),
        how=f"Posterior of {len(windows)} windows of test jobs under the network of joint 2; the temperature is the "
        "peak of joint 2 when the window's job is repeated over the horizon. Jobs between cool and critical are left "
        "out.",
        pictures=(
            Picture(name="latent_map", png=png(maps), alt="Density of normal and of critical windows. " + sentence),
            Picture(name="latent_scatter", png=png(dots), alt="Posterior means coloured by temperature. " + sentence),
        ),
        numbers={"windows": len(windows), "overlap": overlap},
    )


def active_units(mu: Array) -> str:
    """How many units of a latent say anything, by the variance of their means (Burda et al., ICLR 2016), in words.

    Args:
        mu: [window, latent].
    """
    count = int((mu.var(axis=0) > ACTIVE).sum())
    return f"{count} of {mu.shape[1]} units are active: the variance of their means over windows passes {ACTIVE:g}."


ACTIVE = 0.01


def _overlap(normal: Array, critical: Array) -> float:
    """Share of critical means with a normal one as near as normal ones have each other."""
    tree = KDTree(normal)
    own = tree.query(normal, k=2)[0][:, 1]
    return float((tree.query(critical)[0] <= np.percentile(own, 95)).mean())


def reconstruction_chapter(lab: Lab) -> Section:
    """What the twin makes of a normal and of a critical window."""
    twin, seen, made, error = lab.twin, [], [], []
    for i in lab.examples:
        plan = lab.study.test.plans[i]
        samples = resample(plan.cycle.profile, RATE_HZ, twin.config.rate_hz)
        windows = cut(samples, twin.config.window, twin.config.window)[:1]
        seen.append(twin.scaler.to_si(twin.scaler.to_z(windows))[0, :, CARRIER])
        made.append(twin.reconstruct(windows)[0, :, CARRIER])
        error.append(twin.window_errors(windows)[0, CARRIER])
    drawn = reconstruction_figure(
        seen[0],
        made[0],
        seen[1],
        made[1],
        twin.config.rate_hz,
        joint=CARRIER,
        title=f"Torque is missed by {error[1][TAU]:.1f} σ in the critical window, {error[0][TAU]:.1f} σ in the normal",
    )
    cells = tuple((name, f"{error[0][c]:.2f}", f"{error[1][c]:.2f}") for c, name in enumerate(CHANNEL_NAMES))
    return Section(
        key="reconstruction",
        title="Reconstruction of a normal and of a hot record",
        sentences=("The shaded area is the error from which the difficulty is computed.",),
        how="First window of the cycle of the two jobs above, decoded from the posterior mean.",
        pictures=(
            Picture(
                name="reconstruction", png=png(drawn), alt="Measured and reconstructed position, velocity, torque."
            ),
        ),
        tables=(Table(head=("mean |error|, σ", "normal", "critical"), rows=cells),),
        numbers={"normal": error[0].tolist(), "critical": error[1].tolist()},
    )


def difficulty_chapter(lab: Lab) -> Section:
    """Difficulty of critical and non-critical jobs."""
    d, study = lab.difficulty, lab.study
    critical, warm = study.critical, lab.warm
    groups = {
        f"cool, below {study.cool_c:g} °C": d[~critical & ~warm],
        "between": d[warm],
        f"critical, {study.warning_c:g} °C and more": d[critical],
    }
    if not all(len(values) for values in groups.values()):
        raise FleetError("The test jobs lack a kind (cool, between or critical), so there is nothing to compare.")
    medians = {name: np.median(values, axis=0) for name, values in groups.items()}
    cool, hot = medians[next(iter(medians))], medians[list(medians)[-1]]
    found = [float(roc_auc_score(critical, d[:, j])) for j in range(d.shape[1])]
    best, of_sum = int(np.argmax(found)), float(roc_auc_score(critical, d.sum(axis=1)))
    title = f"Joint {best + 1} tells critical jobs best (AUROC {found[best]:.2f}); the sum gets {of_sum:.2f}"
    drawn = difficulty_figure(groups, title=title)
    rows = tuple((name, *(f"{v:.2f}" for v in m), f"{m.sum():.2f}") for name, m in medians.items())
    return Section(
        key="difficulty",
        title="Thermal difficulty of critical and non-critical jobs",
        sentences=(
            f"Median d of joint {best + 1}: {cool[best]:.2f} for cool jobs, {hot[best]:.2f} for critical ones. Even "
            "cool jobs are far from zero, since two latent numbers never tell a window whole; and joints that bear "
            "no load "
            "carry only novelty, which the plain sum adds up.",
        ),
        how=f"d_k = 1 − exp(−e_k), e_k the time mean of the absolute error of joint k summed over the channels, of "
        f"{len(d)} held-out jobs repeated for {study.horizon_s / 60:g} min.",
        pictures=(Picture(name="difficulty", png=png(drawn), alt="Boxes of d per joint and histograms of the sum."),),
        tables=(Table(head=("median d", *(f"joint {j + 1}" for j in range(d.shape[1])), "of sum"), rows=rows),),
        numbers={
            "median": {name: m.tolist() for name, m in medians.items()},
            "joint": best + 1,
            "cool": float(cool[best]),
            "critical": float(hot[best]),
            "auroc": found,
            "auroc_of_sum": of_sum,
        },
    )


def epochs_chapter(lab: Lab) -> Section:
    """Reconstruction error against epochs."""
    jobs = [[phase.profile for phase in plan.phases] for plan in lab.study.train.plans]
    seeds = tuple(range(lab.size.epoch_seeds))
    study = epoch_study(jobs, epochs=lab.size.epochs, seeds=seeds, workers=1, progress=lab.progress)
    known, held_out = study.table(CARRIER)
    rising = study.rising(CARRIER)
    fall, new = (errors[:, -1].mean(axis=0) / errors[:, 0].mean(axis=0) for errors in (known, held_out))
    hardest = CHANNEL_NAMES[int(np.argmax(fall))]
    rows = tuple(
        (f"{CHANNEL_NAMES[c]}, {kind}", *(spread(errors[:, i, c].tolist(), 2) for i in range(len(study.epochs))))
        for c in (TAU, 0, 1)
        for kind, errors in (("trained on", known), ("held out", held_out))
    )
    first, last = study.epochs[0], study.epochs[-1]
    sentences = (
        f"From {first} to {last} epochs the error on the trained record goes to {fall[TAU]:.0%} of what it was for "
        f"torque, {fall[0]:.0%} for position and {fall[1]:.0%} for velocity; {hardest} gains least. On held-out jobs "
        f"it goes to {new[TAU]:.0%}, {new[0]:.0%} and {new[1]:.0%}.",
        f"It does not fall at every step: in {rising[0].mean():.0%} of seeds and channels it rises somewhere on the "
        f"trained record, in {rising[1].mean():.0%} on held-out jobs.",
    )
    drawn = epochs_figure(
        np.array(study.epochs),
        known,
        held_out,
        title=f"From {first} to {last} epochs {hardest} gains least, torque goes to {fall[TAU]:.0%}",
    )
    return Section(
        key="epochs",
        title="Reconstruction error against epochs",
        sentences=sentences,
        how=f"Joint {CARRIER + 1}. A separate training for each number of epochs and each of {len(seeds)} seeds, one "
        "restart, the one-cycle schedule stretched over just these epochs, on a record of 5 cool jobs (about "
        f"{study.windows} windows); held out are 20 other cool jobs. "
        "Mean and standard deviation over the seeds, in standard deviations of the training data.",
        pictures=(Picture(name="epochs", png=png(drawn), alt="Error against epochs. " + " ".join(sentences)),),
        tables=(Table(head=("mean |error|, σ", *(f"{n} epochs" for n in study.epochs)), rows=rows),),
        numbers={
            "epochs": list(study.epochs),
            "known": known.tolist(),
            "held_out": held_out.tolist(),
            "rising": rising.tolist(),
        },
    )
