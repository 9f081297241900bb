"""What the chapters of a twin report work on: one arm's study under several seeds, and its twins."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from joblib import Parallel, cpu_count, delayed

from fleet.errors import FleetError
from fleet.robot import Robot
from scenarios.prepare.train_twins import train_or_load
from scenarios.progress import Progress, quiet
from scenarios.studies.benchmark import VAE, Make, chosen_variants, jobs_of
from scenarios.studies.epochs import EPOCHS
from scenarios.studies.ranking import CARRIER, Jobs
from scenarios.studies.setup import Sample, Study, make_study
from scenarios.studies.transfer import LABELS
from twin.vae.model import TwinConfig
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
    """

    def __init__(
        self, robot: Robot, seeds: tuple[int, ...], size: Size, folder: Path, progress: Progress = quiet
    ) -> None:
        self.robot, self.seeds, self.size, self.folder, self.progress = robot, seeds, size, folder, progress

    def __reduce__(self) -> tuple[type["Lab"], tuple[Robot, tuple[int, ...], Size, Path]]:
        return Lab, (self.robot, self.seeds, self.size, self.folder)

    @property
    def sequences(self) -> list[np.random.SeedSequence]:
        """The seeds as SeedSequences."""
        return [np.random.SeedSequence(seed) for seed in self.seeds]

    @property
    def make(self) -> Make:
        """The study of a seed, in this report's size."""
        size = self.size
        return partial(
            make_study,
            robot=self.robot,
            train=size.train,
            reference=size.reference,
            test=size.test,
            novel=size.novel,
        )

    def train_twins(self, networks: Sequence[str] = (VAE,), *, explored: bool = False) -> None:
        """Train every twin that is not cached yet, all seeds in parallel.

        Args:
            networks: Names of `benchmark.variants`.
            explored: Also train, for every seed, a twin with exploration.
        """
        tasks = [(seed, name, 0) for name in networks for seed in self.seeds]
        tasks += [(seed, VAE, self.size.explored) for seed in self.seeds if explored]
        self.progress("training", 0.0)
        with Parallel(n_jobs=max(1, min(cpu_count(), len(tasks))), return_as="generator_unordered") as pool:
            for done, _ in enumerate(pool(delayed(_train)(self, *task) for task in tasks), start=1):
                self.progress("training", done / len(tasks))

    @cached_property
    def study(self) -> Study:
        """The study of the first seed, for figures."""
        self.progress("drawing jobs", 0.0)
        return self.make(self.sequences[0])

    @cached_property
    def twin(self) -> Twin:
        """Twin trained on the first study's cool jobs and calibrated on its held-out ones."""
        self.progress("training", 0.0)
        records = self.study.train.records()
        twin = train_or_load(records, self.size.config, self.sequences[0], arm=self.robot.name, folder=self.folder)
        held_out = self.jobs(self.study.reference)
        return twin.with_calibration(list(zip(held_out.plans, held_out.repetitions, strict=True)))

    def jobs(self, sample: Sample) -> Jobs:
        """A sample as jobs that fill the horizon."""
        return jobs_of(sample, self.study.horizon_s)

    @cached_property
    def windows(self) -> tuple[Array, Array]:
        """Windows of test jobs [window, time, joint, channel], and the peak of joint 2 in the job of each, °C."""
        index = np.flatnonzero(self.study.test.passes(self.study.warning_c) | ~self.warm)[:MOST_JOBS]
        jobs = self.jobs(self.study.test)
        reading = cut_jobs([jobs.plans[i] for i in index], [jobs.repetitions[i] for i in index], self.twin.config)
        return reading.windows, jobs.peak_c[index][reading.job, CARRIER]

    @property
    def warm(self) -> Array:
        """Test jobs that are neither cool nor critical, bool [job]."""
        return self.study.test.passes(self.study.cool_c) & ~self.study.critical

    @cached_property
    def difficulty(self) -> Array:
        """d_k of the test jobs, [job, joint]."""
        jobs = self.jobs(self.study.test)
        return self.twin.measures(jobs.plans, jobs.repetitions).difficulty

    @cached_property
    def examples(self) -> tuple[int, int]:
        """A normal and a critical test job, each with the median difficulty of joint 2 of its kind.

        Raises:
            FleetError: the test jobs lack a kind.
        """
        kinds = self.study.critical, ~self.warm & ~self.study.critical
        if not all(kind.any() for kind in kinds):
            raise FleetError(
                f"Of {len(self.study.test)} test jobs {kinds[0].sum()} are critical and {kinds[1].sum()} cool: without "
                "some of both there is nothing to compare. Take another arm, or leave out --quick."
            )
        d = self.difficulty[:, CARRIER]
        return tuple(  # pyright: ignore[reportReturnType]
            int(index[np.argsort(d[index])[len(index) // 2]])
            for index in (np.flatnonzero(~self.warm & ~self.study.critical), np.flatnonzero(self.study.critical))
        )


MOST_JOBS = 240
"""Largest number of jobs in a latent map."""


def _train(lab: Lab, seed: int, network: str, exploration: int) -> None:
    sequence = np.random.SeedSequence(seed)
    # The other samples do not affect the training.
    study = lab.make(sequence, exploration=exploration, reference=0, test=0, novel=0)
    config = chosen_variants(lab.size.config, (VAE, network))[network]
    train_or_load(study.train.records(), config, sequence, arm=study.robot.name, folder=lab.folder)
