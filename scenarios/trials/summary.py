"""From rows to figures and differences."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from fleet.errors import FleetError
from scenarios.policy_loader import scope_of
from scenarios.prepare.randomisation import Randomisation
from scenarios.run.compare import Comparison, Failed, figures_of_shifts
from scenarios.run.evaluate import Outcome
from scenarios.statistics.means import fewest, unit
from scenarios.statistics.scores import Normalised, and_trainings, scores_of
from scenarios.trials.cases import suite_label
from scenarios.trials.plan import Row, Study
from scenarios.trials.scores import Shift, normalised

if TYPE_CHECKING:  # slow to import
    from scenarios.bounds.references import Reference


def competitors(study: Study) -> dict[tuple[str, str], str]:
    """What a table calls each policy with each source of scores: POLICY, or POLICY@SOURCE if there are several."""
    several = len(study.difficulties) > 1
    return {(p, d): f"{p}@{d}" if several else p for d in study.difficulties for p in study.policies}


def check_baseline(study: Study, baseline: str) -> None:
    """Check that the baseline is compared.

    Raises:
        FleetError: it is not; names what is.
    """
    names = competitors(study).values()
    if baseline not in names:
        raise FleetError(f"The baseline '{baseline}' is not among the policies compared: {', '.join(names)}.")


def comparison_of(
    study: Study,
    rows: Sequence[Row],
    baseline: str,
    name: str | None = None,
    references: "Mapping[Shift, Reference] | None" = None,
) -> Comparison:
    """The figures of each policy over the fleets, trainings and seeds of all instances of the rows, and its differences
    to the baseline.

    Args:
        rows: In the order of the study.
        baseline: One of `competitors`.
        name: Of the instances together; default: that of the only one.
        references: Of the shifts, for normalised scores.
    """
    names, shifts = competitors(study), rows_of_competitors(study, rows)
    failures = [
        Failed(each, k.instance, k.fleet, k.training, k.seed, row.error, row.trace or "")
        for each, of in shifts.items()
        for row in of
        if row.error is not None
        for k in [row.key]
    ]
    failed, count = {each.policy for each in failures}, len({row.key.instance for row in rows})
    whole = {each: repeated(study, of) for each, of in shifts.items() if each not in failed}
    values = _scores(study, {each: shifts[each] for each in whole}, references) if baseline in whole else None
    fleets, trainings, per_fleet = study.shape
    several = (count, study.most_trainings) if count > 1 else (fleets if fleets > 1 else trainings, per_fleet)
    return Comparison(
        scenario=name or rows[0].key.instance,
        seeds=tuple(dict.fromkeys(row.key.seed for row in rows)),
        unit=unit(study.shape) if count == 1 else f"{count} instances{and_trainings(study.most_trainings)}",
        draws=fewest(several),
        baseline=baseline,
        figures=figures_of_shifts(whole, baseline, (count, *study.shape)) if baseline in whole else {},
        scopes={names[p, d]: scope_of(p) if names[p, d] in whole else "failed" for p, d in names},
        channel=study.channel.described(),
        channel_text=study.channel_text,
        illegal={each: sum(row.illegal for row in of) for each, of in shifts.items()},
        failures=tuple(failures),
        scores=scores_of(values, baseline) if values else None,
        randomise=study.randomise or Randomisation(),
    )


def rows_of_competitors(study: Study, rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each of `competitors`, in their order."""
    names = competitors(study)
    shifts: dict[str, list[Row]] = {each: [] for each in names.values()}
    for row in rows:
        shifts[names[row.key.policy, row.key.difficulty]].append(row)
    return shifts


def scores_over_all(study: Study, rows: Sequence[Row], references: "Mapping[Shift, Reference]") -> Normalised | None:
    """Scores of the policies without a failure over all instances; None without references of the shifts."""
    return _scores(study, rows_without_failures(study, rows), references)


def _scores(
    study: Study, by_policy: Mapping[str, Sequence[Row]], references: "Mapping[Shift, Reference] | None"
) -> Normalised | None:
    """As `normalised`; None with a randomisation, because references are of the shifts without one."""
    return None if study.randomise else normalised(by_policy, references or {})


def rows_without_failures(study: Study, rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of those competitors that failed in no shift."""
    shifts = rows_of_competitors(study, rows)
    return {each: of for each, of in shifts.items() if not any(row.error is not None for row in of)}


def repeated(study: Study, rows: Iterable[Row]) -> list[Outcome]:
    """The outcomes of one policy, those without trainings once for each training: in the order of `Study.shape`."""
    of: dict[tuple[str, int, int], list[Outcome]] = {}
    for row in rows:
        assert row.outcome is not None
        of.setdefault((row.key.instance, row.key.fleet, row.key.training), []).append(row.outcome)
    found: list[Outcome] = []
    for instance, fleet in dict.fromkeys((instance, fleet) for instance, fleet, _ in of):
        for training in range(study.shape[1]):
            own = of.get((instance, fleet, training))
            if own is None and (instance, fleet, 1) in of:
                raise FleetError(f"A training of the rows is missing: {training} of instance {instance}.")
            found += own or of[instance, fleet, 0]
    return found


def comparisons(
    study: Study,
    rows: Sequence[Row],
    baseline: str,
    suite: str | None = None,
    references: "Mapping[Shift, Reference] | None" = None,
) -> list[Comparison]:
    """One comparison of all instances of a suite, or one for each instance."""
    check_baseline(study, baseline)
    if suite:
        return [comparison_of(study, rows, baseline, suite_label(suite), references)]
    of = {case.name: [row for row in rows if row.key.instance == case.name] for case in study.cases}
    return [comparison_of(study, own, baseline, references=references) for own in of.values()]
