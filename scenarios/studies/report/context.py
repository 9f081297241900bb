"""What the chapters of a twin report work on: one arm's study under several seeds, and its twins."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from joblib import cpu_count, delayed

from fleet.errors import FleetError
from fleet.robot import Robot
from scenarios.processes import worker_processes
from scenarios.progress import Progress, quiet
from scenarios.studies.benchmark import VAE, chosen_variants, jobs_of
from scenarios.studies.epochs import EPOCHS
from scenarios.studies.ranking import CARRIER, Jobs
from scenarios.studies.setup import Bench, Study, make_study
from scenarios.studies.transfer import LABELS
from twin.vae.config import TwinConfig
from twin.vae.twin import Twin
from twin.vae.window import cut_jobs

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Size:
    """Amount of computation of a report."""

    train: int = 200
    reference: int = 200
    test: int = 1200
    novel: int = 300
    past: int = 200
    """Labelled past jobs on which the probability of saturation is fitted; as many again set its alarm."""
    epochs: tuple[int, ...] = EPOCHS
    epoch_seeds: int = 5
    generated: int = 20
    """Motions per strength of the perturbation."""
    own: int = 150
    """Generated jobs on which a second twin is trained."""
    labels: tuple[int, ...] = LABELS
    """Numbers of labelled jobs for the regressor of the transfer."""
    networks: tuple[str, ...] | None = None
    """Names of `benchmark.variants` in the benchmark; all by default."""
    config: TwinConfig = field(default_factory=TwinConfig)

    @property
    def explored(self) -> int:
        """Light motions among the training jobs of a twin with exploration."""
        return self.train * 2 // 5


QUICK = Size(
    train=60,
    reference=60,
    test=200,
    novel=60,
    past=100,
    epochs=(20, 40, 60),
    epoch_seeds=2,
    generated=6,
    own=40,
    labels=(10, 50, 100),
    networks=(VAE, "AE", "untrained VAE"),
    config=TwinConfig.quick(),
)


class Lab:
    """Studies and twins of one arm, each made when first needed; a pickle holds the arguments only.

    Attributes:
        robot: The studied arm.
        seeds: Every figure with a spread is repeated under each.
        size: Amount of computation.
        folder: Cache of trained twins.
        bench: The seeds' studies in this size.
    """

    def __init__(
        self, robot: Robot, seeds: tuple[int, ...], size: Size, folder: Path, progress: Progress = quiet
    ) -> None:
        self.robot, self.seeds, self.size, self.folder, self.progress = robot, seeds, size, folder, progress
        sizes = {name: getattr(size, name) for name in ("train", "reference", "test", "novel")}
        make = partial(make_study, robot=robot, **sizes)
        self.bench = Bench([np.random.SeedSequence(seed) for seed in seeds], size.config, folder, make)

    def __reduce__(self) -> tuple[type["Lab"], tuple[Robot, tuple[int, ...], Size, Path]]:
        return Lab, (self.robot, self.seeds, self.size, self.folder)

    def train_twins(self, networks: Sequence[str] = (VAE,), *, explored: bool = False) -> None:
        """Train every twin that is not cached yet, all seeds in parallel.

        Args:
            networks: Names of `benchmark.variants`.
            explored: Also train, for every seed, a twin with exploration.
        """
        tasks = [(seed, name, 0) for name in networks for seed in self.seeds]
        tasks += [(seed, VAE, self.size.explored) for seed in self.seeds if explored]
        self.progress("training", 0.0)
        with worker_processes(max(1, min(cpu_count(), len(tasks)))) as pool:
            for done, _ in enumerate(pool(delayed(_train)(self, *task) for task in tasks), start=1):
                self.progress("training", done / len(tasks))

    @cached_property
    def study(self) -> Study:
        """The study of the first seed, for figures."""
        self.progress("drawing jobs", 0.0)
        return self.bench.make(self.bench.seeds[0])

    @cached_property
    def twin(self) -> Twin:
        """Twin trained on the first study's cool jobs and calibrated on its held-out ones."""
        self.progress("training", 0.0)
        twin = self.bench.train(self.study.train.records(), self.study, self.bench.seeds[0])
        held_out = jobs_of(self.study.reference, self.study.horizon_s)
        return twin.with_calibration(list(zip(held_out.plans, held_out.repetitions, strict=True)))

    @cached_property
    def test(self) -> Jobs:
        """The test jobs, each repeated to fill the horizon."""
        return jobs_of(self.study.test, self.study.horizon_s)

    @cached_property
    def windows(self) -> tuple[Array, Array]:
        """Windows of test jobs [window, time, joint, channel], and the peak of joint 2 in the job of each, °C."""
        index = np.flatnonzero(self.cool | self.study.critical)[:MOST_JOBS]
        plans, repetitions = [self.test.plans[i] for i in index], [self.test.repetitions[i] for i in index]
        reading = cut_jobs(plans, repetitions, self.twin.config)
        return reading.windows, self.test.peak_c[index][reading.job, CARRIER]

    @property
    def cool(self) -> Array:
        """Test jobs in which every motor stays below the cool limit, bool [job]."""
        return ~self.study.test.passes(self.study.cool_c)

    @cached_property
    def difficulty(self) -> Array:
        """d_k of the test jobs, [job, joint]."""
        return self.twin.measures(self.test.plans, self.test.repetitions).difficulty

    @cached_property
    def examples(self) -> tuple[int, int]:
        """A normal and a critical test job, each with the median difficulty of joint 2 of its kind.

        Raises:
            FleetError: the test jobs lack a kind.
        """
        cool, critical = np.flatnonzero(self.cool), np.flatnonzero(self.study.critical)
        if not len(cool) or not len(critical):
            raise FleetError(
                f"Of {len(self.study.test)} test jobs {len(critical)} are critical and {len(cool)} cool: without "
                "some of both there is nothing to compare. Take another arm, or leave out --quick."
            )
        return median_of(cool, self.difficulty), median_of(critical, self.difficulty)


MOST_JOBS = 240
"""Largest number of jobs in a latent map."""


def median_of(index: Array, difficulty: Array) -> int:
    """The one of these jobs or windows with the median difficulty [job, joint] of joint 2."""
    return int(index[np.argsort(difficulty[index, CARRIER])[len(index) // 2]])


def _train(lab: Lab, seed: int, network: str, exploration: int) -> None:
    sequence = np.random.SeedSequence(seed)
    # The other samples do not affect the training.
    study = lab.bench.make(sequence, exploration=exploration, reference=0, test=0, novel=0)
    config = chosen_variants(lab.size.config, (VAE, network))[network]
    lab.bench.train(study.train.records(), study, sequence, config)
