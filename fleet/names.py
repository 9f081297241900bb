"""The one rule for names of fleets, arms, auctioneers, jobs and places, and safe display of text from outside."""

MAX_NAME = 128
"""Characters; a file name with it and an ending has at most 255 bytes."""
NAME_RULE = f"1 to {MAX_NAME} printable characters without / \\ [ ], and no dot or space at the start"
_FORBIDDEN = frozenset("/\\[]")


def is_name(text: str) -> bool:
    """Whether a text follows the rule for names, `NAME_RULE`: it is one file name, and is shown as it is written."""
    return 0 < len(text) <= MAX_NAME and text[0] not in ". " and text.isprintable() and _FORBIDDEN.isdisjoint(text)


def check_names(owner: object, *fields: str) -> None:
    """Check that these fields, or all elements of a tuple, are names.

    Raises:
        ValueError: names the field, the value and the rule.
    """
    for field in fields:
        given = getattr(owner, field)
        for name in given if isinstance(given, tuple) else (given,):
            if not is_name(name):
                raise ValueError(f"{type(owner).__name__}.{field} must have {NAME_RULE} (got '{printable(name)}').")


def printable(text: str, longest: int = 4 * MAX_NAME) -> str:
    """Text from outside as a terminal or a page may show it: control characters and direction marks are escaped."""
    if text.isprintable() and len(text) <= longest:
        return text
    shown = "".join(char if char.isprintable() else ascii(char)[1:-1] for char in text[:longest])
    return shown + ("…" if len(text) > longest else "")
