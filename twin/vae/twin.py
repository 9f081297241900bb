"""The twin of one arm: the distance of motion from the arm's training motion, joint by joint.

Its folder holds `weights.safetensors` and `twin.json`, neither of which can run code when read.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from fleet.difficulty import Difficulty, heat_weights
from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.json_file import check_version, read_card, write_card
from fleet.motion import CHANNELS, Plan
from fleet.robot import JOINTS
from twin.vae.config import TwinConfig
from twin.vae.inference import Networks, Weights, shapes
from twin.vae.measures import PARTS, TAU, Calibration, Features, Measures, latent_moments, measures_of, moments
from twin.vae.window import PHASES, PlanCache, Scaler, check_jobs, cut_phases

Array = np.ndarray

_CHUNK = 128
"""Plans per pass: bounds the memory for their windows and keeps it in cache."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Reconstruction quality of one network on its training windows, and its training history."""

    elbo: float
    """Nats per window, without the constant of the likelihood; of an autoencoder, minus half the squared error."""
    kl: float
    """Nats per window; 0 for an autoencoder, which has none."""
    active_units: int
    """Latent units that vary between windows."""
    mean_squared_error: float
    """In z-scores, decoded from the posterior mean."""
    restart: int
    """Index of the restart that was kept."""
    restart_elbos: tuple[float | None, ...] = ()
    """ELBO by which the restarts were compared; None for one that diverged."""
    elbo_by_epoch: tuple[float, ...] = ()
    """Mean over the epoch's batches, nats per window, with sensor noise and β as trained."""
    kl_by_epoch: tuple[float, ...] = ()
    """The same of the KL, 0 for an autoencoder."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A trained twin; implements `fleet.difficulty.DifficultyModel`. Scores are cached while their plan is alive."""

    config: TwinConfig
    scaler: Scaler
    nets: Sequence[Weights]
    """Weights of the networks, one per joint or one for the arm."""
    _: KW_ONLY
    arm: str
    data_hash: str
    """Hash of the training data."""
    seed: str
    """Training seed."""
    fits: Sequence[Fit]
    """Quality of each network."""
    calibration: Calibration | None = None
    """Features of held-out cool jobs; None until `with_calibration`."""
    _scored: PlanCache[Array] = field(default_factory=PlanCache, init=False, repr=False)

    def __post_init__(self) -> None:
        wanted = self.config.networks(self.joints)
        if not len(self.nets) == len(self.fits) == wanted:
            raise ValueError(
                f"A twin of scope '{self.config.scope}' for {self.joints} joints needs {wanted} network(s) and fits "
                f"(got {len(self.nets)} and {len(self.fits)})."
            )
        joints = self.joints if self.calibration is None else self.calibration.reference.packed.shape[1]
        if joints != self.joints:
            raise ValueError(f"The calibration is for {joints} joints, the twin has {self.joints}.")

    def __getstate__(self) -> dict[str, object]:
        return {each.name: getattr(self, each.name) for each in fields(self)}  # without cached properties

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.scaler.joints

    @cached_property
    def joint_weight(self) -> Array:
        """Weights of d_k by the torque of the training motion, [joint]; see `fleet.difficulty.heat_weights`."""
        return heat_weights(self.scaler.mean[:, TAU] ** 2 + self.scaler.std[:, TAU] ** 2)

    @cached_property
    def networks(self) -> Networks:
        """The networks as one."""
        return Networks(self.nets)

    @property
    def version(self) -> str:
        """Hash of configuration, scaler, weights, training data and calibration."""
        return self._content_hash

    @cached_property
    def _content_hash(self) -> str:
        digest = hashlib.sha256()
        digest.update(msgspec.json.encode([self.config, self.arm, self.data_hash, self.seed, self.fits]))
        for values in vars(self.scaler).values():
            digest.update(np.ascontiguousarray(values).tobytes())
        for name, tensor in sorted(self.tensors().items()):
            digest.update(f"{name}{tensor.shape}".encode())
            digest.update(tensor.tobytes())
        if self.calibration is not None:
            digest.update(np.ascontiguousarray(self.calibration.reference.packed, dtype=float).tobytes())
            digest.update(np.ascontiguousarray(self.calibration.group, dtype=np.int64).tobytes())
        return digest.hexdigest()[:16]

    def tensors(self) -> dict[str, Array]:
        """All weights by name, such as `joint_1.encoder.weight_ih_l0` or `arm.encoder.weight_ih_l0`."""
        names = net_names(self.config, self.joints)
        return {
            f"{net_name}.{name}": np.ascontiguousarray(tensor)
            for net_name, net in zip(names, self.nets, strict=True)
            for name, tensor in net.items()
        }

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of the repeated plan: d_k = 1 − exp(−e_k), e_k the mean error over the job's time.

        Raises:
            ValueError: repetitions < 1, an empty plan, or a plan that is not finite or has other joints.
        """
        return Difficulty(self.features([plan], [repetitions]).difficulty[0], weight=self.joint_weight)

    def measure(self, plan: Plan, repetitions: int) -> Measures:
        """All measures of one job."""
        return self.measures([plan], [repetitions]).of_job(0)

    def measures(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Measures:
        """All measures of many jobs, arrays with a leading axis [job]."""
        return self.measures_of(self.features(plans, repetitions))

    def measures_of(self, features: Features) -> Measures:
        """All measures of this twin's features, of jobs or of windows."""
        return measures_of(features, self.calibration, weight=self.joint_weight, version=self.version)

    def with_calibration(self, *kinds: Sequence[tuple[Plan, int]]) -> "Twin":
        """The same twin, calibrated on held-out cool jobs (plan, repetitions).

        Args:
            kinds: Jobs of each kind; those of one kind are exchangeable.

        Raises:
            ValueError: fewer than two jobs.
        """
        jobs = [job for kind in kinds for job in kind]
        reference = self.features([plan for plan, _ in jobs], [times for _, times in jobs])
        return self.calibrated_on(reference, np.repeat(np.arange(len(kinds)), [len(kind) for kind in kinds]))

    def calibrated_on(self, reference: Features, group: Array) -> "Twin":
        """The same twin, calibrated on features of held-out cool jobs [job, joint] of several kinds, int [job]."""
        return replace(self, calibration=Calibration(reference, group))

    def features(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Features:
        """Time means over whole jobs, [job, joint]; new plans go through the networks together.

        Raises:
            ValueError: as `score`, or unequal numbers of plans and repetitions.
        """
        check_jobs(plans, repetitions, least=0)
        new = [plan for plan in dict.fromkeys(plans) if plan not in self._scored]
        for first in range(0, len(new), _CHUNK):
            self._score_phases(new[first : first + _CHUNK])
        weights = [plan.weights(times) for plan, times in zip(plans, repetitions, strict=True)]
        shares = np.reshape(weights, (len(plans), len(PHASES)))
        parts = PARTS + moments(self.config.latent)
        packed = np.reshape([self._scored[plan] for plan in plans], (*shares.shape, self.joints, parts))
        return Features(np.einsum("np,npjf->njf", shares, packed))

    def window_features(self, windows: Array) -> Features:
        """Time means of windows [batch, time, joint, channel] in SI units, [batch, joint]."""
        return Features(self._window_features(self._to_z(windows), np.full(windows.shape[:2], 1.0 / windows.shape[1])))

    def window_errors(self, windows: Array) -> Array:
        """Time mean of |x − x̂| of windows in SI units, in training standard deviations, [batch, joint, channel]."""
        return self.window_features(windows).errors

    def posterior(self, windows: Array) -> tuple[Array, Array]:
        """Mean and standard deviation of the latent of windows in SI units, each [batch, net, latent]."""
        return self.networks.posterior(self._to_z(windows))

    def decode(self, latent: Array) -> Array:
        """Decoded latents [batch, net, latent], SI units, [batch, time, joint, channel]."""
        wanted = (len(self.nets), self.config.latent)
        if latent.ndim != 3 or latent.shape[1:] != wanted:
            raise ValueError(f"Latents must be [batch, {wanted[0]}, {wanted[1]}] (got {latent.shape}).")
        return self.scaler.to_si(self.networks.decode(latent, self.config.window))

    def reconstruct(self, windows: Array) -> Array:
        """Reconstructed windows, SI units, [batch, time, joint, channel]; angles near the training data."""
        return self.scaler.to_si(self.networks.reconstruct(self._to_z(windows))[0])

    def _to_z(self, windows: Array) -> Array:
        wanted = (self.config.window, self.joints, len(CHANNELS))
        if windows.ndim != 4 or windows.shape[1:] != wanted:
            raise ValueError(f"Windows must be [batch, {wanted[0]}, {wanted[1]}, {wanted[2]}] (got {windows.shape}).")
        if not np.isfinite(windows).all():
            raise ValueError("Windows must be finite.")
        return self.scaler.to_z(windows)

    def _score_phases(self, plans: Sequence[Plan]) -> None:
        """Cache the features of each phase, [phase, joint, part]; zeros for an empty phase."""
        for plan in plans:
            for name, phase in zip(PHASES, plan.phases, strict=True):
                if phase.profile.shape[-1] != self.joints:
                    raise ValueError(
                        f"The twin of '{self.arm}' has {self.joints} joints, {name.capitalize()} of arm '{plan.arm}' "
                        f"{phase.profile.shape[-1]}."
                    )
        phases = cut_phases(plans, self.config)
        packed = phases.total(self._window_features(self.scaler.to_z(phases.windows), phases.weight))
        for plan, of_plan in zip(plans, np.split(packed, len(plans)), strict=True):
            self._scored[plan] = of_plan

    def _window_features(self, z: Array, weights: Array) -> Array:
        """Packed features of windows in z-scores, summed over time with weights [batch, time], [batch, joint, part]."""
        z_hat, mu = self.networks.reconstruct(z)
        std = self.scaler.std[:, TAU]
        offset = (self.scaler.mean[:, TAU] / std).astype(np.float32)
        size, size_hat = np.abs(z[..., TAU] + offset), np.abs(z_hat[..., TAU] + offset)
        parts = np.empty((PARTS, *size.shape), np.float32)  # [part, batch, time, joint]
        for channel in range(len(CHANNELS)):
            np.abs(z[..., channel] - z_hat[..., channel], out=parts[channel])
        np.maximum(size - size_hat, 0.0, out=parts[-3])
        np.square(size, out=parts[-1])
        np.maximum(parts[-1] - np.square(size_hat), 0.0, out=parts[-2])
        means = np.matmul(weights[:, None].astype(np.float32), parts)[:, :, 0]  # [part, batch, joint]
        packed = np.empty((len(z), self.joints, PARTS + moments(mu.shape[-1])))
        packed[..., :PARTS] = means.transpose(1, 2, 0)
        packed[..., PARTS - 2 : PARTS] *= std[:, None] ** 2
        # One network of the whole arm has one latent for all joints.
        packed[..., PARTS:] = weights.sum(axis=1)[:, None, None] * latent_moments(mu.astype(float))
        return packed


def net_names(config: TwinConfig, joints: int) -> list[str]:
    """Names of the networks in a checkpoint and in errors."""
    return ["arm"] if config.scope == "arm" else [f"joint_{j + 1}" for j in range(joints)]


FORMAT = 3
WEIGHTS = "weights.safetensors"
CARD = "twin.json"
REFERENCE, GROUP = "calibration.reference", "calibration.group"
"""Tensors with the features of held-out cool jobs, float64 [job, joint, part], and their kinds, int64 [job]; absent
without a calibration."""


class TwinCard(msgspec.Struct, forbid_unknown_fields=True):
    """The content of `twin.json`; the names are those of `Twin` and `Scaler`."""

    format: int
    version: str
    arm: str
    data_hash: str
    seed: str
    config: TwinConfig
    turn_q: list[float]
    mean: list[tuple[float, float, float]]
    std: list[tuple[float, float, float]]
    still: list[bool]
    fits: tuple[Fit, ...]
    calibrated: bool


_SHARED = ("config", "arm", "data_hash", "seed", "fits")


def save(twin: Twin, folder: Path) -> None:
    """Write the twin into a folder, made if need be; each file is written atomically."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = twin.tensors()
    if twin.calibration is not None:
        tensors[REFERENCE] = np.array(twin.calibration.reference.packed, dtype=float)
        tensors[GROUP] = np.array(twin.calibration.group, dtype=np.int64)
    with atomic_path(folder / WEIGHTS) as draft:
        save_file(tensors, draft)
    shared = {name: getattr(twin, name) for name in _SHARED}
    scaler = {name: values.tolist() for name, values in vars(twin.scaler).items()}
    calibrated = twin.calibration is not None
    write_card(TwinCard(format=FORMAT, version=twin.version, calibrated=calibrated, **shared, **scaler), folder / CARD)


def load(folder: Path, *, joints: int = JOINTS) -> Twin:
    """The twin that `save` wrote, with the same scores to the last bit.

    Raises:
        CheckpointError: a file is missing or damaged, of another format, for another number of joints, lacks
            tensors, or is not what was saved.
    """
    card = read_card(folder / CARD, TwinCard, format_=FORMAT, what="twin")
    if len(card.turn_q) != joints:
        raise CheckpointError(f"{folder / CARD}: the twin has {len(card.turn_q)} joints, the arm has {joints}.")
    scaler = Scaler(*(np.array(getattr(card, field.name)) for field in fields(Scaler)))
    if {len(part) for part in (scaler.mean, scaler.std, scaler.still)} != {joints}:
        raise CheckpointError(f"{folder / CARD}: mean, std and still must each have {joints} joints.")
    wanted = shapes(card.config, card.config.channels(joints))
    try:
        tensors = load_file(folder / WEIGHTS)
        calibration = Calibration(Features(tensors.pop(REFERENCE)), tensors.pop(GROUP)) if card.calibrated else None
        nets = [
            {name: _tensor(tensors, f"{net}.{name}", shape) for name, shape in wanted.items()}
            for net in net_names(card.config, joints)
        ]
        if tensors:
            raise ValueError(f"unknown tensors {', '.join(sorted(tensors))}")
        shared = {name: getattr(card, name) for name in _SHARED}
        twin = Twin(scaler=scaler, nets=tuple(nets), calibration=calibration, **shared)
    except FileNotFoundError:
        raise CheckpointError(f"No twin in {folder}: {WEIGHTS} is missing.") from None
    except KeyError as error:
        raise CheckpointError(f"{folder / WEIGHTS}: missing tensor {error}.") from error
    except OSError as error:
        raise CheckpointError(f"{folder / WEIGHTS} cannot be read: {error.strerror or error}.") from error
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(f"{folder / WEIGHTS} does not fit {CARD}: {' '.join(str(error).split())}") from error
    check_version(folder, card.version, twin.version)
    return twin


def _tensor(tensors: dict[str, Array], name: str, shape: tuple[int, ...]) -> Array:
    """Take a tensor out; raises KeyError or ValueError."""
    tensor = tensors.pop(name)
    if tensor.shape != shape or tensor.dtype != np.float32:
        raise ValueError(f"'{name}' is {tensor.dtype} {list(tensor.shape)}, not float32 {list(shape)}")
    return tensor
