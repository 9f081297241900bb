"""Other forms of the twin's network, beside the paper's and squared torque (`forms`).

A network of each joint learns from cool jobs, in the size of `TwinConfig.quick`. The paper's reconstructs angle,
velocity and torque. The other forms explain the torque by the motion, weigh errors by a learned variance, know the
payload, or come from other arms. All are judged as in `readings`: do they rank jobs by whether a joint overheats, and
how much new light motion do they call unusual?
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import product

import numpy as np
import torch
from sklearn.metrics import roc_auc_score
from torch import Tensor, nn

from benchmarks.paper.harness import (
    Experiment,
    KeyedRows,
    Unit,
    content_key,
    matching,
    mean_by_group,
    mean_share,
    names,
    size_given,
    size_options,
    table_of,
    whole,
)
from benchmarks.paper.readings import ArmSize
from benchmarks.paper.subjects import (
    ALARM_RATE,
    SCENARIOS,
    TAU,
    Sample,
    Sizes,
    Study,
    Subject,
    arm_of,
    carrier_of,
    subjects_of,
)  # fmt: skip
from fleet.difficulty import heat_weights
from fleet.motion import CHANNELS
from fleet.robot import JOINTS
from scenarios.json_rows import Row
from scenarios.prepare.twins import records
from scenarios.table import Table
from twin.vae.config import LOGVAR_RANGE, TwinConfig
from twin.vae.model import kl, one_thread
from twin.vae.window import Scaler, cut_jobs, draw_windows, windows_of

Array = np.ndarray
CONFIG = TwinConfig.quick()


@dataclass(frozen=True)
class Form:
    """A form of the network."""

    label: str
    torque_only: bool = False
    """The decoder yields the torque, not all channels."""
    given: int = 0
    """Joints whose angle and velocity the decoder knows at every sample: none, 1 for its own, or all."""
    payload: bool = False
    """Encoder and decoder know the declared payload."""
    variance: bool = False
    """The decoder yields the variance of each value, too, and errors are negative log likelihoods."""
    latent: int = CONFIG.latent
    """0: the decoder knows only what is given."""
    trained: bool = True
    others: bool = False
    """Trained on the motion of the other arms; only the z-scores are those of the arm."""

    @property
    def explains(self) -> slice:
        """Channels that the decoder yields."""
        return slice(TAU if self.torque_only else 0, len(CHANNELS))


FORMS: Mapping[str, Form] = {
    "paper": Form("reconstruction of angle, velocity and torque (paper)"),
    "likelihood": Form("the same with learned variances, likelihood", variance=True),
    "payload": Form("the same, payload known", payload=True),
    "others": Form("the same, trained on other arms, own z-scores", others=True),
    "motion": Form("torque, motion of the joint known", True, given=1),
    "motion_untrained": Form("the same, untrained", True, given=1, trained=False),
    "motion_all": Form("torque, motion of all joints known", True, given=JOINTS),
    "motion_payload": Form("torque, motion of all joints and payload known", True, given=JOINTS, payload=True),
    "motion_likelihood": Form("torque, motion of all joints known, likelihood", True, given=JOINTS, variance=True),
    "dynamics": Form("torque, motion of all joints known, no latent", True, given=JOINTS, latent=0),
}
RIVALS = {"difficulty": "Σ d of the paper's network", "torque_error": "its torque error", "torque": "squared torque"}
"""Scores without a network of their own."""


class Net(nn.Module):
    """Encoder of a joint's windows to a Gaussian latent, and decoder from it and what is given."""

    def __init__(self, form: Form, given: int, hidden: int) -> None:
        super().__init__()
        self.form = form
        outputs = form.explains.stop - form.explains.start
        self.encoder = nn.LSTM(len(CHANNELS) + form.payload, hidden, batch_first=True)
        self.posterior = nn.Linear(hidden, 2 * form.latent) if form.latent else None
        self.expand = nn.Linear(form.latent, hidden) if form.latent else None
        self.decoder = nn.LSTM(hidden * bool(form.latent) + given, hidden, batch_first=True)
        self.out = nn.Linear(hidden, outputs * (1 + form.variance))

    def forward(self, x: Tensor, given: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Errors of each value, [batch, time, value], and the KL divergence, nats, [batch].

        Args:
            x: Channels of the joint, [batch, time, channel].
            given: Inputs of the decoder, [batch, time, input]; the payload is the last.
            noise: Of the latent, [batch, latent].
        """
        inputs, nats = [given], torch.zeros(len(x))
        if self.posterior is not None and self.expand is not None:
            seen = torch.cat([x, given[..., -1:]], dim=2) if self.form.payload else x
            summary = torch.tanh(self.encoder(seen)[1][0][-1])
            mu, logvar = self.posterior(summary).chunk(2, dim=1)
            logvar = logvar.clamp(*LOGVAR_RANGE)
            nats = kl(mu, logvar)
            z = mu + noise * torch.exp(0.5 * logvar)
            inputs.append(torch.tanh(self.expand(z))[:, None].expand(-1, x.shape[1], -1))
        wanted, found = x[..., self.form.explains], self.out(self.decoder(torch.cat(inputs, dim=2))[0])
        if not self.form.variance:
            return wanted - found, nats
        mean, logvar = found.chunk(2, dim=2)
        logvar = logvar.clamp(*LOGVAR_RANGE)
        return 0.5 * ((wanted - mean).square() * torch.exp(-logvar) + logvar), nats


def inputs_of(form: Form, z: Array, payload: Array, joint: int) -> tuple[Tensor, Tensor]:
    """Channels of a joint, and inputs of its decoder.

    Args:
        z: Windows, [batch, time, joint, channel].
        payload: Declared payload of each, kg, [batch].
    """
    known = {0: [], 1: [joint], JOINTS: range(z.shape[2])}[form.given]
    parts = [z[:, :, k, :TAU] for k in known]
    if form.payload:
        parts.append(np.broadcast_to(payload[:, None, None].astype(np.float32), (*z.shape[:2], 1)))
    given = np.concatenate(parts, axis=2) if parts else np.zeros((*z.shape[:2], 0), np.float32)
    return torch.from_numpy(z[:, :, joint]), torch.from_numpy(given)


def fitted(
    form: Form, z: Array, payload: Array, joint: int, noise: Array, seed: int, config: TwinConfig = CONFIG
) -> Net:
    """The network of a joint after training on windows; the first arguments as in `inputs_of`.

    Args:
        noise: Of the sensors, in z-scores, [channel].
    """
    with torch.random.fork_rng(devices=[]), one_thread():
        torch.manual_seed(seed)
        x, given = inputs_of(form, z, payload, joint)
        net = Net(form, given.shape[2], config.hidden)
        if not form.trained:
            return net.eval()
        steps = config.epochs * -(-len(x) // config.batch)
        optimizer = torch.optim.Adam(net.parameters(), lr=config.learning_rate)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, total_steps=steps)
        sensors = torch.from_numpy(noise.astype(np.float32))
        for _ in range(config.epochs):
            for some in torch.randperm(len(x)).split(config.batch):
                noisy = x[some] + sensors * torch.randn_like(x[some])
                error, nats = net(noisy, given[some], torch.randn(len(some), form.latent))
                loss = error if form.variance else 0.5 * error.square()
                optimizer.zero_grad()
                (loss.sum((1, 2)) + config.beta * nats).mean().backward()
                nn.utils.clip_grad_norm_(net.parameters(), config.clip)
                optimizer.step()
                schedule.step()
        return net.eval()


def errors_of(net: Net, z: Array, payload: Array, joint: int) -> Array:
    """Absolute error, or negative log likelihood, of each sample and value, [batch, time, value]."""
    x, given = inputs_of(net.form, z, payload, joint)
    with torch.no_grad(), one_thread():
        error, _ = net(x, given, torch.zeros(len(x), net.form.latent))
    return (error if net.form.variance else error.abs()).numpy()


@dataclass(frozen=True, eq=False)
class Motion:
    """Windows of an arm's training, with what its networks need."""

    windows: Array
    """SI, [batch, time, joint, channel]."""
    payload: Array
    """kg, [batch]."""

    @classmethod
    def of(cls, sample: Sample, seed: np.random.SeedSequence) -> "Motion":
        """Some windows of the plans of a sample."""
        each = [windows_of(records([plan]), CONFIG) for plan in sample.plans]
        payload = np.repeat([plan.work.payload_kg for plan in sample.plans], [len(part) for part in each])
        chosen = draw_windows(np.arange(len(payload)), CONFIG.max_windows, seed)
        return cls(np.concatenate(each)[chosen], payload[chosen])


def job_scores(nets: Sequence[Net], scaler: Scaler, sample: Sample) -> Array:
    """Time mean of the errors of each job, joint and value, [job, joint, value]."""
    jobs = cut_jobs(sample.plans, sample.repetitions, CONFIG)
    payload = np.array([plan.work.payload_kg for plan in sample.plans])[jobs.job]
    z = scaler.to_z(jobs.windows)
    return np.stack([jobs.mean(errors_of(net, z, payload, k)) for k, net in enumerate(nets)], axis=1)


def judged(scores: Mapping[str, Array], study: Study, carrier: int, weight: Array | None) -> Row:
    """Measures of scores [job, joint] of the samples `reference`, `test` and `novel`.

    Args:
        weight: w_k of the sum over the joints; None: 1.
    """
    total = {name: each.sum(axis=1) if weight is None else each @ weight for name, each in scores.items()}
    hot, own = study.critical, study.test.peak_c[:, carrier] >= study.warning_c
    threshold = np.quantile(total["reference"], 1.0 - ALARM_RATE)
    return {
        "any": float(roc_auc_score(hot, total["test"])),
        "carrier": float(roc_auc_score(own, scores["test"][:, carrier])),
        "found": float((total["test"][hot] > threshold).mean()),
        "novel": float((total["novel"] > threshold).mean()),
    }


SAMPLES = ("reference", "test", "novel")


def form_rows(
    subject: Subject, others: Sequence[Subject], size: ArmSize, wanted: Mapping[str, tuple[str, int]]
) -> Iterator[tuple[str, Row]]:
    """The measures of every form and training on one arm.

    Args:
        others: Arms from which the form `others` learns.
        wanted: Form or rival, and training, by key.
    """
    study = subject.study(**asdict(size))
    carrier, own = carrier_of(study), motion_of(subject, size)
    scaler = Scaler.fit(own.windows)
    weight, noise = heat_weights(np.square(own.windows[..., TAU]).mean(axis=(0, 1))), CONFIG.noise / scaler.std
    learned = {False: (scaler.to_z(own.windows), own.payload)}
    if any(name in FORMS and FORMS[name].others for name, _ in wanted.values()):
        learned[True] = _together([motion_of(each, size) for each in others])
    found: dict[tuple[str, int], dict[str, Array]] = {}
    for key, (name, training) in wanted.items():
        form = name if name in FORMS else "paper"
        if (form, training) not in found:
            seeds = np.random.SeedSequence([subject.seed, training]).generate_state(JOINTS)
            known = learned[FORMS[form].others]
            nets = [fitted(FORMS[form], *known, k, noise[k], int(seeds[k])) for k in range(JOINTS)]
            found[form, training] = {each: job_scores(nets, scaler, getattr(study, each)) for each in SAMPLES}
        errors, factor = found[form, training], None if name == "difficulty" else weight
        match name:
            case "difficulty":
                scores = {each: 1.0 - np.exp(-values.sum(axis=2)) for each, values in errors.items()}
            case "torque_error":
                scores = {each: values[..., TAU] for each, values in errors.items()}
            case "torque":
                scores = {each: _squared_torque(getattr(study, each), scaler) for each in SAMPLES}
            case _:
                scores = {each: values.sum(axis=2) for each, values in errors.items()}
        yield key, {"arm": subject.name, "form": name, "training": training, **judged(scores, study, carrier, factor)}


@cache
def motion_of(subject: Subject, size: ArmSize) -> Motion:
    """The training motion of an arm."""
    study = subject.study(**asdict(size) | {"reference": 0, "test": 0, "novel": 0})
    return Motion.of(study.train, subject.entropy)


def _together(each: Sequence[Motion]) -> tuple[Array, Array]:
    """Training windows of several arms, each in its own z-scores, and their payloads."""
    z = np.concatenate([Scaler.fit(motion.windows).to_z(motion.windows) for motion in each])
    return z, np.concatenate([motion.payload for motion in each])


def _squared_torque(sample: Sample, scaler: Scaler) -> Array:
    """Mean squared torque of each job over that of the training, [job, joint]."""
    jobs = cut_jobs(sample.plans, sample.repetitions, CONFIG)
    known = scaler.std[:, TAU] ** 2 + scaler.mean[:, TAU] ** 2
    return jobs.mean(np.square(jobs.windows[..., TAU])) / known


MEASURES = ("any", "carrier", "found", "novel")
HEADS = ("score", "AUROC, any joint", "less squared torque", "AUROC, carrying joint", "overheating jobs found",
         "new light motion above")  # fmt: skip


def form_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """A row for each form, with intervals over arms."""
    rival = {(row["arm"], row["training"]): row["any"] for row in matching(rows, form="torque")}
    lines: list[tuple[str, ...]] = []
    for name in dict.fromkeys(row["form"] for row in rows):
        own = [(arm_of(row["arm"]), row) for row in matching(rows, form=name)]
        cells = {each: mean_share((arm, row[each]) for arm, row in own).text(3) for each in MEASURES}
        lead = mean_by_group((arm, row["any"] - rival[row["arm"], row["training"]]) for arm, row in own)
        label = FORMS[name].label if name in FORMS else RIVALS[name]
        less = "" if name == "torque" else lead.text(3, "+")
        lines.append((label, cells["any"], less, cells["carrier"], cells["found"], cells["novel"]))
    return {"forms": table_of(HEADS, lines)}


def form_options(parser: ArgumentParser) -> None:
    """Options of `forms`."""
    parser.add_argument("--scenarios", type=names, default=names(SCENARIOS), help=f"scenarios [{SCENARIOS}]")
    parser.add_argument("--arms", type=whole(1), default=2, help="arms of each scenario [2]")
    parser.add_argument("--trainings", type=whole(1), default=2, help="trainings of each network [2]")
    size_options(parser, ArmSize)


def form_units(given: Namespace) -> list[Unit]:
    """A unit for each arm."""
    size = size_given(given, ArmSize)
    subjects = subjects_of(given.scenarios, arms=range(given.arms), seeds=[1], sizes=Sizes())
    basis = content_key(asdict(size), given.arms, given.scenarios)
    units: list[Unit] = []
    for subject in subjects:
        others = [each for each in subjects if each is not subject]
        possible = [name for name, form in FORMS.items() if others or not form.others]
        pairs = product((*RIVALS, *possible), range(given.trainings))
        keys = {f"{subject.name}/{name}/{training}/{basis}": (name, training) for name, training in pairs}
        units.append(Unit(tuple(keys), partial(_missing, subject, others, size, keys)))
    return units


def _missing(
    subject: Subject,
    others: Sequence[Subject],
    size: ArmSize,
    keys: Mapping[str, tuple[str, int]],
    missing: Collection[str],
) -> KeyedRows:
    return form_rows(subject, others, size, {key: what for key, what in keys.items() if key in missing})


FORMS_STUDY = Experiment(
    help="Compare forms of the twin's network on arms of some scenarios: ranking of jobs, and new light motion.\n\n"
    "Some minutes of one core for each arm.",
    options=form_options,
    units=form_units,
    tables=form_tables,
)
