"""Which jobs are taken: rules on the words alone, before anything is promised."""

from collections.abc import Mapping, Sequence

import networkx as nx

from fleet.bus.protocol.auction import Admission, JobSpec

MOST_JOBS = 10_000
"""That one auctioneer keeps, finished ones included."""


def admit(
    words: Sequence[JobSpec],
    there: Mapping[str, JobSpec],
    *,
    places: frozenset[str] | None = None,
    most: int = MOST_JOBS,
) -> tuple[Admission, ...]:
    """What becomes of jobs that are handed in together; in whatever order, they may wait for each other.

    Args:
        there: Jobs that were accepted before. The same again, word for word, is accepted again and changes nothing.
        places: Places of the cell; None: any name goes.
    """
    refused: dict[int, str] = {}
    fresh: dict[str, JobSpec] = {}
    for index, word in enumerate(words):
        same_name = there.get(word.name) or fresh.get(word.name)
        unknown = [place for place in word.places if places is not None and place not in places]
        if same_name == word:
            continue
        if same_name is not None:
            refused[index] = f"Another job is called '{word.name}' already; one name is one job."
        elif unknown:
            refused[index] = f"No place '{unknown[0]}' in this cell. Places: {', '.join(sorted(places or ()))}."
        elif len(there) + len(fresh) >= most:
            refused[index] = f"There are {most} jobs already, and more are not taken."
        else:
            fresh[word.name] = word
    never = _never_ready(fresh, there)
    reasons = [refused.get(index) or never.get(word.name, "") for index, word in enumerate(words)]
    return tuple(
        Admission(word.name, accepted=not reason, reason=reason) for word, reason in zip(words, reasons, strict=True)
    )


def _never_ready(fresh: Mapping[str, JobSpec], there: Mapping[str, JobSpec]) -> dict[str, str]:
    """Of new jobs, those that wait for what will never be done, with the reason."""
    left = dict(fresh)
    for _ in fresh:  # every turn takes at least one away
        ready = [w.name for w in left.values() if all(b in there or (b in fresh and b not in left) for b in w.after)]
        if not ready:
            break
        for name in ready:
            del left[name]
    waits = nx.DiGraph([(name, before) for name, word in left.items() for before in word.after])
    ring = {name: group for group in nx.strongly_connected_components(waits) for name in group}
    reasons: dict[str, str] = {}
    for name, word in left.items():
        missing = [before for before in word.after if before not in there and before not in fresh]
        if missing:
            reasons[name] = f"It waits for '{missing[0]}', which is not there or was not taken."
        elif len(ring[name]) > 1 or name in word.after:
            around = [edge[0] for edge in nx.find_cycle(waits.subgraph(ring[name]), name)]
            reasons[name] = f"Jobs wait for each other in a ring: {' → '.join([*around, around[0]])}."
        else:
            stuck = next(before for before in word.after if before in left)
            reasons[name] = f"It waits for '{stuck}', which is not taken either."
    return reasons
