"""The twin of one arm: how far a planned motion is from what the arm knows, joint by joint."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import msgspec
import numpy as np
import torch

from fleet.difficulty import Difficulty
from fleet.motion import CHANNELS, RATE_HZ, Plan
from twin.forward import Networks
from twin.measures import PARTS, TAU, Calibration, Features, Measures, measures_of
from twin.model import LstmVae, TwinConfig
from twin.window import Scaler, check_profile, cover, cut, resample

Array = np.ndarray

PHASES = ("approach", "cycle", "retreat")
_CHUNK = 128
"""Plans per pass: bounds the memory for their windows and keeps it in cache."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How well one network knows its training windows, and how its training went."""

    elbo: float
    """Nats per window, without the constant of the likelihood; of an autoencoder, minus half the squared error."""
    kl: float
    """Nats per window; 0 for an autoencoder, which has none."""
    active_units: int
    """Latent units that tell windows apart."""
    mean_squared_error: float
    """In z-scores, decoded from the posterior mean."""
    restart: int
    """Which of the restarts won."""
    restart_elbos: tuple[float | None, ...] = ()
    """ELBO by which the restarts were compared; None for one that diverged."""
    elbo_by_epoch: tuple[float, ...] = ()
    """Mean over the epoch's batches, nats per window, with sensor noise and β as trained."""
    kl_by_epoch: tuple[float, ...] = ()
    """The KL part of it, nats per window."""


class Twin:
    """A trained twin; implements `fleet.difficulty.DifficultyModel`.

    The score repeats: it decodes the posterior mean and draws nothing. Only the last digits (1e-6) depend on how many
    plans are scored in one call.

    Attributes:
        arm: Name of the arm it belongs to.
        data_hash: What it was trained on.
        seed: The seed it was trained with, as text.
        fits: Quality per network: one per joint, or one for the arm.
        calibration: What is usual in held-out cool jobs; None until `calibrated`.
    """

    def __init__(
        self,
        config: TwinConfig,
        scaler: Scaler,
        nets: Sequence[LstmVae],
        *,
        arm: str,
        data_hash: str,
        seed: str,
        fits: Sequence[Fit],
        calibration: Calibration | None = None,
    ) -> None:
        wanted = config.networks(scaler.joints)
        if not len(nets) == len(fits) == wanted:
            raise ValueError(
                f"A twin of scope '{config.scope}' for {scaler.joints} joints needs {wanted} network(s) and fits "
                f"(got {len(nets)} and {len(fits)})."
            )
        if calibration is not None and calibration.reference.packed.shape[1] != scaler.joints:
            raise ValueError(
                f"The calibration is for {calibration.reference.packed.shape[1]} joints, the twin has {scaler.joints}."
            )
        self.config = config
        self.scaler = scaler
        self.arm = arm
        self.data_hash = data_hash
        self.seed = seed
        self.fits = tuple(fits)
        self.calibration = calibration
        self._networks = Networks(nets)
        self._known: WeakKeyDictionary[Plan, Array] = WeakKeyDictionary()

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_known"}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self._known = WeakKeyDictionary()

    @property
    def joints(self) -> int:
        """How many joints it scores."""
        return self.scaler.joints

    @property
    def nets(self) -> tuple[LstmVae, ...]:
        """The networks, one per joint or one for the arm."""
        return self._networks.nets

    @property
    def version(self) -> str:
        """Short name of this twin by its content: configuration, scaler, weights, data and calibration."""
        return self._content_hash

    @cached_property
    def _content_hash(self) -> str:
        digest = hashlib.sha256()
        digest.update(msgspec.json.encode([self.config, self.arm, self.data_hash, self.seed, self.fits]))
        for name in ("turn_q", "mean", "std", "still"):
            digest.update(np.ascontiguousarray(getattr(self.scaler, name)).tobytes())
        for name, tensor in sorted(self.tensors().items()):
            digest.update(f"{name}{tuple(tensor.shape)}".encode())
            digest.update(tensor.numpy().tobytes())
        if self.calibration is not None:
            digest.update(np.ascontiguousarray(self.calibration.reference.packed, dtype=float).tobytes())
        return digest.hexdigest()[:16]

    def tensors(self) -> dict[str, torch.Tensor]:
        """All weights by name, `joint_1.encoder.weight_ih_l0` or `arm.encoder.weight_ih_l0` and so on."""
        names = net_names(self.config, self.joints)
        return {
            f"{net_name}.{name}": tensor.contiguous()
            for net_name, net in zip(names, self.nets, strict=True)
            for name, tensor in net.state_dict().items()
        }

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of doing the plan so many times: d_k = 1 − exp(−e_k), e_k the mean over the job's time.

        Raises:
            ValueError: repetitions < 1, an empty plan, or a plan that is not finite or has other joints.
        """
        return Difficulty(self.features([plan], [repetitions]).difficulty[0])

    def measure(self, plan: Plan, repetitions: int, *, score: str = "load") -> Measures:
        """All that the twin says of one job; `score` is what the p-value ranks jobs by (`measures.score_of`)."""
        return self.measures([plan], [repetitions], score=score).of_job(0)

    def measures(self, plans: Sequence[Plan], repetitions: Sequence[int], *, score: str = "load") -> Measures:
        """All that the twin says of many jobs, arrays with a leading axis [job]."""
        return self.measures_of(self.features(plans, repetitions), score=score)

    def measures_of(self, features: Features, *, score: str = "load") -> Measures:
        """All that the twin says of features that it found, of jobs, of a recorded stretch or of windows."""
        return measures_of(features, self.calibration, score=score, version=self.version)

    def calibrated(self, jobs: Sequence[tuple[Plan, int]]) -> "Twin":
        """The same twin that knows what is usual: the features of held-out cool jobs (plan, repetitions).

        Raises:
            ValueError: fewer than two jobs.
        """
        return self.calibrated_by(self.features([plan for plan, _ in jobs], [times for _, times in jobs]))

    def calibrated_by(self, reference: Features) -> "Twin":
        """The same twin, calibrated by the features [job, joint, part] of held-out cool jobs or recordings."""
        return Twin(
            self.config,
            self.scaler,
            self.nets,
            arm=self.arm,
            data_hash=self.data_hash,
            seed=self.seed,
            fits=self.fits,
            calibration=Calibration(reference),
        )

    def features(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Features:
        """Time means over whole jobs, [job, joint]; new plans in one pass.

        Raises:
            ValueError: as `score`.
        """
        if len(plans) != len(repetitions):
            raise ValueError(f"Every plan needs its repetitions (got {len(plans)} and {len(repetitions)}).")
        for plan, times in zip(plans, repetitions, strict=True):
            if times < 1:
                raise ValueError(f"A job has at least one repetition (got {times}).")
            if plan.duration_s(times) == 0:
                raise ValueError(f"The plan of arm '{plan.arm}' has no motion in it.")
        weights = [plan.weights(times) for plan, times in zip(plans, repetitions, strict=True)]
        shares = np.array(weights).reshape(-1, len(PHASES))
        return Features(np.einsum("np,npjf->njf", shares, self._of_phases(plans)))

    def profile_features(self, profile: Array, rate_hz: float) -> Features:
        """Time means over a recorded stretch [time, 3, joint], as over a phase of a plan, [joint].

        Raises:
            ValueError: no samples, or a profile that is misshapen, not finite or of another number of joints.
        """
        if len(profile) == 0:
            raise ValueError("A stretch without samples has no error.")
        return Features(self._of_stretches([("The stretch", profile)], rate_hz)[0])

    def window_features(self, windows: Array) -> Features:
        """Time means of windows [batch, time, joint, channel] in SI units, [batch, joint]."""
        z = self._z_of(windows)
        even = np.full(z.shape[:2], 1.0 / self.config.window)
        return Features(self._of_windows(z, even))

    def shares(self, plan: Plan, repetitions: int) -> Array:
        """Share of each joint and channel in all of a job's error, usual or not, [joint, channel], sums to one."""
        errors = self.job_errors(plan, repetitions)
        return errors / max(float(errors.sum()), np.finfo(float).tiny)

    def job_errors(self, plan: Plan, repetitions: int) -> Array:
        """Time mean of |x − x̂| over the whole job, in training standard deviations, [joint, channel]."""
        return self.features([plan], [repetitions]).errors[0]

    def plans_errors(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Array:
        """`job_errors` of many jobs, [plan, joint, channel]."""
        return self.features(plans, repetitions).errors

    def phase_errors(self, plans: Sequence[Plan]) -> Array:
        """Time mean of |x − x̂| per phase, [plan, phase, joint, channel]; an empty phase has none."""
        return self._of_phases(plans)[..., : len(CHANNELS)]

    def profile_errors(self, profile: Array, rate_hz: float) -> Array:
        """Time mean of |x − x̂| over a recorded stretch, [joint, channel]; see `profile_features`."""
        return self.profile_features(profile, rate_hz).errors

    def window_errors(self, windows: Array) -> Array:
        """Time mean of |x − x̂| of windows in SI units, [batch, joint, channel]; see `window_features`."""
        return self.window_features(windows).errors

    def posterior(self, windows: Array) -> tuple[Array, Array]:
        """Mean and standard deviation of the latent of windows in SI units, each [batch, net, latent]."""
        return self._networks.posterior(self._z_of(windows))

    def latent(self, windows: Array) -> Array:
        """Posterior means of windows [batch, time, joint, channel] in SI units, [batch, net, latent]."""
        return self.posterior(windows)[0]

    def decode(self, latent: Array) -> Array:
        """The windows that latents [batch, net, latent] stand for, SI units, [batch, time, joint, channel]."""
        wanted = (len(self.nets), self.config.latent)
        if latent.ndim != 3 or latent.shape[1:] != wanted:
            raise ValueError(f"Latents must be [batch, {wanted[0]}, {wanted[1]}] (got {latent.shape}).")
        return self.scaler.to_si(self._networks.decode(latent, self.config.window))

    def reconstruct(self, windows: Array) -> Array:
        """What the twin makes of windows, SI units, [batch, time, joint, channel]; angles near the training data."""
        return self.scaler.to_si(self._networks.reconstruct(self._z_of(windows)))

    def _z_of(self, windows: Array) -> Array:
        wanted = (self.config.window, self.joints, len(CHANNELS))
        if windows.ndim != 4 or windows.shape[1:] != wanted:
            raise ValueError(f"Windows must be [batch, {wanted[0]}, {wanted[1]}, {wanted[2]}] (got {windows.shape}).")
        if not np.isfinite(windows).all():
            raise ValueError("Windows must be finite.")
        return self.scaler.to_z(windows)

    def _of_phases(self, plans: Sequence[Plan]) -> Array:
        """[plan, phase, joint, part]; what a plan scored once is kept while the plan lives."""
        new = [plan for plan in dict.fromkeys(plans) if plan not in self._known]
        for first in range(0, len(new), _CHUNK):
            some = new[first : first + _CHUNK]
            stretches = [
                (f"{name.capitalize()} of arm '{plan.arm}'", phase.profile)
                for plan in some
                for name, phase in zip(PHASES, plan.phases, strict=True)
            ]
            found = self._of_stretches(stretches, RATE_HZ).reshape(len(some), len(PHASES), self.joints, PARTS)
            for plan, packed in zip(some, found, strict=True):
                self._known[plan] = packed
        empty = np.zeros((0, len(PHASES), self.joints, PARTS))
        return np.stack([self._known[plan] for plan in plans]) if len(plans) else empty

    def _of_stretches(self, stretches: Sequence[tuple[str, Array]], rate_hz: float) -> Array:
        """Packed features of each named profile [time, 3, joint], [stretch, joint, part]; zeros for an empty one."""
        c = self.config
        parts, weights, owners = [], [], []
        for i, (name, stretch) in enumerate(stretches):
            profile = check_profile(stretch, name)
            if profile.shape[-1] != self.joints:
                raise ValueError(f"The twin of '{self.arm}' has {self.joints} joints, {name} {profile.shape[-1]}.")
            samples = resample(profile, rate_hz, c.rate_hz)
            parts.append(cut(samples, c.window, c.score_stride))
            weights.append(cover(len(samples), c.window, c.score_stride))
            owners.append(np.full(len(parts[-1]), i))
        of_window = self._of_windows(self.scaler.to_z(np.concatenate(parts)), np.concatenate(weights))
        of_stretch = np.zeros((len(parts), self.joints, PARTS))
        np.add.at(of_stretch, np.concatenate(owners), of_window)
        return of_stretch

    def _of_windows(self, z: Array, weights: Array) -> Array:
        """Packed features of windows in z-scores, summed over time with weights [batch, time], [batch, joint, part]."""
        z_hat = self._networks.reconstruct(z)
        std, offset = self.scaler.std[:, TAU], self.scaler.mean[:, TAU] / self.scaler.std[:, TAU]
        size, size_hat = np.abs(z[..., TAU] + offset), np.abs(z_hat[..., TAU] + offset)
        packed = np.empty((len(z), self.joints, PARTS))
        packed[..., : len(CHANNELS)] = np.einsum("bt,btjc->bjc", weights, np.abs(z - z_hat))
        packed[..., -2] = np.einsum("bt,btj->bj", weights, np.maximum(size - size_hat, 0.0))
        packed[..., -1] = np.einsum("bt,btj->bj", weights, np.maximum(size**2 - size_hat**2, 0.0)) * std**2
        return packed


def net_names(config: TwinConfig, joints: int) -> list[str]:
    """What the networks are called in a checkpoint and in errors."""
    return ["arm"] if config.scope == "arm" else [f"joint_{j + 1}" for j in range(joints)]
