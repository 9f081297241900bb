"""Why each arm got its job: the offers behind each award, side by side."""

from collections.abc import Sequence
from itertools import groupby

from scenarios.report.gantt import clock
from scenarios.report.page import Moment, paragraph, table
from scenarios.shift_records import Offer

CANNOT = "cannot do it"
MOST_AWARDS = 300
MOST_ARMS = 8
"""With more arms, the columns are the best other offers instead of the arms."""
NOTE = (
    "Of each arm: P(saturation), the probability that a motor passes its warning limit; the predicted peak; the "
    "difficulty d; the duration of the job. In brackets: why the arm could not take the job then."
)


def choices(offers: Sequence[Offer], arms: Sequence[str]) -> list[str]:
    """A folded table with one row per award; nothing without offers.

    Args:
        offers: In order of time; those of one award are neighbours.
    """
    awards = [list(group) for _, group in groupby(offers, key=lambda o: (o.time_s, o.job))]
    if not awards:
        return []
    every_arm = len(arms) <= MOST_ARMS
    head = ["time", "job", "awarded to", *(arms if every_arm else ["its offer", "best other offers", "", ""])]
    rows, moments = [], []
    for award in awards[:MOST_AWARDS]:
        winner = next(offer for offer in award if offer.awarded)
        if every_arm:
            of = {offer.arm: offer for offer in award}
            cells = [_cell(of[arm]) if arm in of else "" for arm in arms]
        else:
            others = sorted(
                (o for o in award if o.free and not o.awarded), key=lambda o: (o.p_saturation or 0.0, o.arm)
            )
            cells = [_cell(winner), *(f"{o.arm}: {_cell(o)}" for o in others[:3])]
            cells += [""] * (4 - len(cells))
        rows.append((clock(winner.time_s), winner.job, winner.arm, *cells))
        moments.append(Moment(winner.time_s, winner.arm))
    left = f" The first {MOST_AWARDS} of {len(awards)} are listed; offers.parquet has all of them."
    return [
        f"<details><summary>Why each arm got its job: the offers behind {len(awards)} awards</summary>",
        paragraph(NOTE + (left if len(awards) > MOST_AWARDS else ""), "faint"),
        table(head, rows, moments=moments, key="choices"),
        "</details>",
    ]


def scores(offer: Offer) -> list[str]:
    """P(saturation), predicted peak and difficulty of an offer, as far as they are known."""
    parts = [f"P {offer.p_saturation:.2f}"] if offer.p_saturation is not None else []
    parts += [f"{offer.peak_c:.0f} °C"] if offer.peak_c is not None else []
    parts += [f"d {offer.difficulty:.2f}"] if offer.difficulty is not None else []
    return parts


def _cell(offer: Offer) -> str:
    if not offer.feasible:
        return CANNOT
    parts = [*scores(offer), f"{(offer.duration_s or 0.0) / 60:.0f} min"]
    barred = "" if offer.free else f" ({offer.state if offer.state != 'idle' else 'place or space taken'})"
    return ", ".join(parts) + barred
