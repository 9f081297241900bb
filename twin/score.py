"""The twin of one arm: how far a planned motion is from what the arm knows, joint by joint."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import msgspec
import numpy as np
import torch

from fleet.difficulty import Difficulty, difficulty_of_error
from fleet.motion import CHANNELS, RATE_HZ, Plan
from twin.model import JointVae, TwinConfig, one_thread
from twin.window import Scaler, check_profile, cover, cut, resample

Array = np.ndarray

PHASES = ("approach", "cycle", "retreat")
ERROR_CAP = 30.0
"""Beyond this e_k, 1 − exp(−e_k) rounds to one; d_k stays below it."""
_CHUNK = 512
"""Windows per pass: keeps the activations in cache."""


@dataclass(frozen=True)
class JointFit:
    """How well the network of one joint knows its training windows."""

    elbo: float
    """Nats per window, without the constant of the likelihood."""
    kl: float
    """Nats per window."""
    active_units: int
    mean_squared_error: float
    """In z-scores, decoded from the posterior mean."""
    restart: int
    """Which of the restarts won."""


class Twin:
    """A trained twin; implements `fleet.difficulty.DifficultyModel`.

    The score repeats: it decodes the posterior mean and draws nothing.

    Attributes:
        arm: Name of the arm it belongs to.
        data_hash: What it was trained on.
        seed: The seed it was trained with, as text.
        fits: Quality per joint.
    """

    def __init__(
        self,
        config: TwinConfig,
        scaler: Scaler,
        nets: Sequence[JointVae],
        *,
        arm: str,
        data_hash: str,
        seed: str,
        fits: Sequence[JointFit],
    ) -> None:
        if not len(nets) == len(fits) == scaler.joints:
            raise ValueError(f"A twin needs one network per joint: {scaler.joints} joints, {len(nets)} networks.")
        self.config = config
        self.scaler = scaler
        self.nets = tuple(net.eval().requires_grad_(False) for net in nets)
        self.arm = arm
        self.data_hash = data_hash
        self.seed = seed
        self.fits = tuple(fits)
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
    def version(self) -> str:
        """Short name of this twin by its content: configuration, scaler, weights and data."""
        return self._content_hash

    @cached_property
    def _content_hash(self) -> str:
        """Short hash of everything that a score depends on, and of where it came from."""
        digest = hashlib.sha256()
        digest.update(msgspec.json.encode([self.config, self.arm, self.data_hash, self.seed, self.fits]))
        for name in ("turn_q", "mean", "std", "still"):
            digest.update(np.ascontiguousarray(getattr(self.scaler, name)).tobytes())
        for name, tensor in sorted(self.tensors().items()):
            digest.update(f"{name}{tuple(tensor.shape)}".encode())
            digest.update(tensor.numpy().tobytes())
        return digest.hexdigest()[:16]

    def tensors(self) -> dict[str, torch.Tensor]:
        """All weights by name, `joint_1.encoder.weight_ih_l0` and so on."""
        return {
            f"joint_{j + 1}.{name}": tensor.contiguous()
            for j, net in enumerate(self.nets)
            for name, tensor in net.state_dict().items()
        }

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of doing the plan so many times: d_k = 1 − exp(−e_k), e_k the mean over the job's time.

        Raises:
            ValueError: repetitions < 1, an empty plan, or a plan that is not finite or has other joints.
        """
        error = self.job_errors(plan, repetitions).sum(axis=-1)
        return Difficulty(difficulty_of_error(np.minimum(error, ERROR_CAP)))

    def shares(self, plan: Plan, repetitions: int) -> Array:
        """Why a plan is difficult: share of each joint and channel in all its error, [joint, channel], sums to one.

        Much q is a new place, much qd a new speed, much tau more load than known.
        """
        errors = self.job_errors(plan, repetitions)
        return errors / max(float(errors.sum()), np.finfo(float).tiny)

    def job_errors(self, plan: Plan, repetitions: int) -> Array:
        """Time mean of |x − x̂| over the whole job, in training standard deviations, [joint, channel]."""
        if repetitions < 1:
            raise ValueError(f"A job has at least one repetition (got {repetitions}).")
        if plan.duration_s(repetitions) == 0:
            raise ValueError(f"The plan of arm '{plan.arm}' has no motion in it.")
        return np.tensordot(plan.weights(repetitions), self.phase_errors([plan])[0], axes=1)

    def phase_errors(self, plans: Sequence[Plan]) -> Array:
        """Time mean of |x − x̂| per phase, [plan, phase, joint, channel]; an empty phase has none.

        New plans go through each joint's network in one pass; what a plan scored once is kept while the plan lives.
        """
        new = [plan for plan in dict.fromkeys(plans) if plan not in self._known]
        for first in range(0, len(new), _CHUNK):
            some = new[first : first + _CHUNK]
            for plan, errors in zip(some, self._errors(some), strict=True):
                self._known[plan] = errors
        empty = np.zeros((0, len(PHASES), self.joints, len(CHANNELS)))
        return np.stack([self._known[plan] for plan in plans]) if len(plans) else empty

    def plans_errors(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Array:
        """`job_errors` of many jobs, new plans in one pass, [plan, joint, channel]."""
        self.phase_errors(plans)
        errors = [self.job_errors(plan, times) for plan, times in zip(plans, repetitions, strict=True)]
        return np.stack(errors) if errors else np.zeros((0, self.joints, len(CHANNELS)))

    def profile_errors(self, profile: Array, rate_hz: float) -> Array:
        """Time mean of |x − x̂| over a recorded stretch [time, 3, joint], as over a phase of a plan, [joint, channel].

        Raises:
            ValueError: no samples, or a profile that is misshapen, not finite or of another number of joints.
        """
        if len(profile) == 0:
            raise ValueError("A stretch without samples has no error.")
        return self._stretch_errors([("The stretch", profile)], rate_hz)[0]

    def window_errors(self, windows: Array) -> Array:
        """Time mean of |x − x̂| of windows [batch, time, joint, channel] in SI units, [batch, joint, channel]."""
        z = self._z_of(windows)
        return np.abs(z - self._decoded(z)).mean(axis=1, dtype=float)

    def posterior(self, windows: Array) -> tuple[Array, Array]:
        """Mean and standard deviation of the latent of windows in SI units, each [batch, net, latent]."""
        z = self._z_of(windows)
        mu, sigma = [], []
        with one_thread(), torch.inference_mode():
            for j, net in enumerate(self.nets):
                mean, logvar = net.encode(torch.from_numpy(np.ascontiguousarray(z[:, :, j])))
                mu.append(mean.numpy())
                sigma.append(torch.exp(0.5 * logvar).numpy())
        return np.stack(mu, axis=1), np.stack(sigma, axis=1)

    def latent(self, windows: Array) -> Array:
        """Posterior means of windows [batch, time, joint, channel] in SI units, [batch, net, latent]."""
        return self.posterior(windows)[0]

    def decode(self, latent: Array) -> Array:
        """The windows that latents [batch, net, latent] stand for, SI units, [batch, time, joint, channel]."""
        wanted = (len(self.nets), self.config.latent)
        if latent.ndim != 3 or latent.shape[1:] != wanted:
            raise ValueError(f"Latents must be [batch, {wanted[0]}, {wanted[1]}] (got {latent.shape}).")
        told = torch.from_numpy(np.ascontiguousarray(latent, dtype=np.float32))
        with one_thread(), torch.inference_mode():
            made = [net.decode(told[:, j], self.config.window).numpy() for j, net in enumerate(self.nets)]
        return self.scaler.to_si(np.stack(made, axis=2))

    def reconstruct(self, windows: Array) -> Array:
        """What the twin makes of windows, SI units, [batch, time, joint, channel]; angles near the training data."""
        return self.scaler.to_si(self._decoded(self._z_of(windows)))

    def _z_of(self, windows: Array) -> Array:
        wanted = (self.config.window, self.joints, len(CHANNELS))
        if windows.ndim != 4 or windows.shape[1:] != wanted:
            raise ValueError(f"Windows must be [batch, {wanted[0]}, {wanted[1]}, {wanted[2]}] (got {windows.shape}).")
        if not np.isfinite(windows).all():
            raise ValueError("Windows must be finite.")
        return self.scaler.to_z(windows)

    def _decoded(self, z: Array) -> Array:
        """Reconstruction from the posterior mean, z-scores, float32 [batch, time, joint, channel]."""
        made = np.empty_like(z)
        with one_thread(), torch.inference_mode():
            for j, net in enumerate(self.nets):
                x = torch.from_numpy(np.ascontiguousarray(z[:, :, j]))
                for first in range(0, len(x), _CHUNK):
                    part = x[first : first + _CHUNK]
                    mu, _ = net.encode(part)
                    made[first : first + _CHUNK, :, j] = net.decode(mu, part.shape[1]).numpy()
        return made

    def _errors(self, plans: Sequence[Plan]) -> Array:
        """[plan, phase, joint, channel] of plans not seen before."""
        stretches = [
            (f"{name.capitalize()} of arm '{plan.arm}'", phase.profile)
            for plan in plans
            for name, phase in zip(PHASES, plan.phases, strict=True)
        ]
        return self._stretch_errors(stretches, RATE_HZ).reshape(len(plans), len(PHASES), self.joints, len(CHANNELS))

    def _stretch_errors(self, stretches: Sequence[tuple[str, Array]], rate_hz: float) -> Array:
        """Time mean of |x − x̂| over each named profile [time, 3, joint], [stretch, joint, channel]; empty: zeros."""
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
        z = self.scaler.to_z(np.concatenate(parts))
        error = np.abs(z - self._decoded(z))
        of_window = np.einsum("bt,btjc->bjc", np.concatenate(weights), error)
        of_stretch = np.zeros((len(parts), self.joints, len(CHANNELS)))
        np.add.at(of_stretch, np.concatenate(owners), of_window)
        return of_stretch
