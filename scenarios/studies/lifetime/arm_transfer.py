"""One arm's twin as the start for another arm: the data and training that this saves.

The second arm has another mount, tool or wear. Its twin is trained from nothing on n of its jobs, or starts from the
twin of the first arm: with its networks unchanged and only new z-scores, or with a short further training. All are
judged on other cool jobs of the second arm. Torque is computed from the motor current, so wear is visible.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from sklearn.metrics import roc_auc_score

from fleet.robot import Mount, Robot
from fleet.seeding import child
from scenarios.prepare.cool_motion import records
from scenarios.progress import Progress, quiet
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.lifetime.sensed_torque import sensed
from scenarios.studies.ranking import CARRIER
from scenarios.studies.setup import GRIPPER_KG, SUBJECT, Study, make_study
from twin.vae.config import TwinConfig
from twin.vae.continue_training import continue_training
from twin.vae.train import train
from twin.vae.twin import Twin
from twin.vae.window import Scaler, windows_of

Array = np.ndarray

TARGETS: Mapping[str, Robot] = {
    "tool": Robot(name="arm", tool_kg=2.0),
    "wear": Robot(name="arm", tool_kg=GRIPPER_KG, wear=1.0),
    "mount": Robot(name="arm", tool_kg=GRIPPER_KG, mount=Mount(position_m=(0.0, 0.0, 1.5), tilt_deg=(0.0, 90.0, 0.0))),
}
"""Second arms by what differs from the first one, which stands on the floor, is new and has a gripper of 0.925 kg."""
NOTHING, RESCALED, FURTHER = "from nothing", "new z-scores", "further training"
STARTS = (NOTHING, RESCALED, FURTHER)
SHORT = TwinConfig(
    hidden=16, rate_hz=6.25, window=25, stride=5, score_stride=25, batch=32, restarts=1, max_windows=100_000,
    allow_collapse=True,
)  # fmt: skip
"""Half the hidden units and half the sample rate of a usual twin: an eighth of its time."""
BETTER = replace(SHORT, learning_rate=6e-3, restarts=2)
"""The same with the better of two starts: a latent of two numbers has local minima."""


@dataclass(frozen=True, kw_only=True)
class TransferSize:
    """Numbers of jobs and training steps."""

    jobs: tuple[int, ...] = (5, 10, 20, 40)
    """Jobs of the second arm, ascending; the last one is the reference."""
    source_jobs: int = 160
    """Cool jobs of the first arm."""
    source_steps: int = 1500
    held_out: int = 60
    test: int = 200
    """Jobs of the natural mix, for AUROC."""
    steps: int = 600
    """Of a training from nothing; the better of two starts counts there and for the first arm."""
    further_steps: int = 100
    further_rate: float = 1e-3
    """Peak learning rate of the further training."""
    config: TwinConfig = field(default_factory=lambda: TwinConfig(batch=32, max_windows=100_000, allow_collapse=True))

    @classmethod
    def quick(cls) -> "TransferSize":
        """Smaller networks and fewer jobs, about a tenth of the time."""
        return cls(
            jobs=(5, 10, 40),
            source_jobs=120,
            source_steps=1000,
            held_out=30,
            test=40,
            steps=300,
            further_steps=75,
            config=BETTER,
        )


@dataclass(frozen=True)
class Trained:
    """One twin of the second arm, judged."""

    start: str
    """One of `STARTS`."""
    jobs: int
    steps: int
    """Training steps on the second arm."""
    cpu_s: float
    """Of this training."""
    error: float
    """Mean |x − x̂| of held-out cool jobs over all joints and channels, in standard deviations of the arm's motion."""
    auroc: float
    """Of d of joint 2 for jobs that overheat joint 2."""


@dataclass(frozen=True)
class Cell:
    """One pair of arms under one seed."""

    target: str
    seed: int
    minutes: tuple[float, ...]
    """Recorded motion of the numbers of jobs."""
    unchanged_error: float
    """Of the first arm's twin as it is, z-scores included."""
    trained: tuple[Trained, ...]

    def curve(self, start: str) -> tuple[Array, Array]:
        """Numbers of jobs and errors, each [size]."""
        rows = [row for row in self.trained if row.start == start]
        return np.array([row.jobs for row in rows]), np.array([row.error for row in rows])

    def data_ratio(self, start: str) -> float:
        """Jobs for the quality of the largest training from nothing, over the jobs of that; see `equal_quality`."""
        (all_jobs, nothing), (jobs, errors) = self.curve(NOTHING), self.curve(start)
        return equal_quality(jobs, errors, float(nothing[-1])) / float(all_jobs[-1])


def equal_quality(jobs: Array, errors: Array, wanted: float) -> float:
    """Fewest jobs whose error is at most `wanted`, interpolated over the logarithm of the jobs.

    At least the first and, if no number suffices, twice the last of the numbers.

    Args:
        jobs: Ascending, [size].
        errors: [size].
    """
    if errors[0] <= wanted:
        return float(jobs[0])
    for i in range(1, len(jobs)):
        if errors[i] <= wanted:
            share = (errors[i - 1] - wanted) / (errors[i - 1] - errors[i])
            return float(np.exp(np.log(jobs[i - 1]) + share * np.log(jobs[i] / jobs[i - 1])))
    return 2.0 * float(jobs[-1])


def arm_transfer(
    seeds: Sequence[int],
    size: TransferSize,
    *,
    targets: Mapping[str, Robot] = TARGETS,
    progress: Progress = quiet,
) -> tuple[Cell, ...]:
    """Every second arm under every seed; the first arm's twin is trained once per seed.

    Raises:
        FleetError: nearly no motion of an arm stays cool.
    """
    cells = []
    for seed in seeds:
        root = np.random.SeedSequence(seed)
        first = make_study(child(root, 0), train=size.source_jobs, reference=0, test=0, novel=0, robot=SUBJECT)
        own = records(sensed(first.train.plans, first.motors))
        source = train(own, with_steps(size.config, own, size.source_steps), child(root, 1), arm="first")
        for i, (name, robot) in enumerate(targets.items()):
            progress("transfer", len(cells) / (len(seeds) * len(targets)))
            study = make_study(
                child(root, 2, i), train=size.jobs[-1], reference=size.held_out, test=size.test, novel=0, robot=robot
            )
            cells.append(_cell(name, seed, study, source, size, child(root, 3, i)))
    return tuple(cells)


def with_steps(config: TwinConfig, parts: Sequence[Array], steps: int) -> TwinConfig:
    """The configuration with as many epochs on these records as come closest to a number of steps."""
    batches = -(-len(windows_of(parts, config)) // config.batch)
    return replace(config, epochs=max(1, round(steps / batches)))


def _cell(name: str, seed: int, study: Study, source: Twin, size: TransferSize, random: np.random.SeedSequence) -> Cell:
    cool, config = sensed(study.train.plans, study.motors), size.config
    held_out = windows_of(records(sensed(study.reference.plans, study.motors)), config)
    test = jobs_of(study.test, study.horizon_s)
    test_plans = sensed(test.plans, study.motors)
    critical = test.peak_c[:, CARRIER] >= study.warning_c

    def auroc(twin: Twin) -> float:
        if critical.all() or not critical.any():
            return float("nan")
        d = twin.features(test_plans, test.repetitions).difficulty[:, CARRIER]
        return float(roc_auc_score(critical, d))

    parts = {n: records(cool[:n]) for n in size.jobs}
    return compare_starts(name, seed, source, parts, held_out, size, random, auroc)


def compare_starts(
    name: str,
    seed: int,
    source: Twin,
    parts: Mapping[int, Sequence[Array]],
    held_out: Array,
    size: TransferSize,
    random: np.random.SeedSequence,
    auroc: Callable[[Twin], float],
) -> Cell:
    """Twins of a second arm by `STARTS` and number of jobs.

    Args:
        source: Twin of the first arm.
        parts: Records of the second arm by number of jobs, ascending.
        held_out: Windows of other cool motion of the second arm, SI units.
        auroc: Of d of joint 2 by a twin.
    """
    config = source.config
    common = Scaler.fit(windows_of(parts[max(parts)], config))
    rows = []
    for n, some in parts.items():

        def judged(start: str, twin: Twin, steps: int, began_s: float, n: int = n) -> Trained:
            cpu_s = time.process_time() - began_s
            return Trained(start, n, steps, cpu_s, error_of(twin, held_out, common), auroc(twin))

        began_s = time.process_time()
        twin = train(some, with_steps(config, some, size.steps), child(random, n), arm=source.arm)
        rows.append(judged(NOTHING, twin, size.steps, began_s))
        began_s = time.process_time()
        rescaled = replace(source, scaler=Scaler.fit(windows_of(some, config)))
        rows.append(judged(RESCALED, rescaled, 0, began_s))
        began_s = time.process_time()
        further = replace(with_steps(config, some, size.further_steps), learning_rate=size.further_rate)
        twin = continue_training(source, some, further, child(random, n), arm=source.arm)
        rows.append(judged(FURTHER, twin, size.further_steps, began_s))
    minutes = tuple(sum(map(len, some)) / config.record_hz / 60.0 for some in parts.values())
    return Cell(name, seed, minutes, error_of(source, held_out, common), tuple(rows))


def error_of(twin: Twin, windows: Array, common: Scaler) -> float:
    """Mean |x − x̂| of windows in the z-scores of `common`, whatever those of the twin."""
    return float(np.abs(common.to_z(windows) - common.to_z(twin.reconstruct(windows))).mean())
