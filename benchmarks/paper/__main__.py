"""`python -m benchmarks.paper STUDY`: the studies of the paper by name."""

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module

from benchmarks.paper import harness

MODULES = {
    "readings": "readings:READINGS",
    "sides": "readings:SIDES",
    "forms": "forms:FORMS_STUDY",
    "sweep": "sweep:SWEEP",
    "parsimony": "sweep:PARSIMONY",
    "surprises": "reliability:SURPRISES",
    "questions": "real_logs:QUESTIONS_OF_LOGS",
    "forecast": "real_logs:FORECAST",
    "amounts": "amounts:AMOUNTS",
    "transfer": "transfer:TRANSFER",
    "features": "features:FEATURES",
    "augmentation": "features:AUGMENTATION",
    "drift": "drift:DRIFT",
    "cooling": "cooling:COOLING_STUDY",
}
"""Module and attribute of each study; a module is imported when its study runs."""


def study(name: str) -> harness.Experiment:
    """Import a study."""
    module, attribute = MODULES[name].split(":")
    return getattr(import_module(f"benchmarks.paper.{module}"), attribute)


STUDIES: dict[str, Callable[[], harness.Experiment]] = {name: partial(study, name) for name in MODULES}


def main(argv: Sequence[str] | None = None) -> None:
    """Run a study; see `harness.main`."""
    harness.main(STUDIES, argv)


if __name__ == "__main__":
    main()
