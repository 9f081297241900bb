"""Tables in Markdown."""

from collections.abc import Iterable, Sequence


def table(head: tuple[str, ...], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
