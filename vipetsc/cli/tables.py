"""Text of tables: rows of a name and a value, lists that are cut after a few entries, durations."""

from collections.abc import Sequence

from vipetsc.wording import shortened


def table(rows: Sequence[tuple[str, str]]) -> str:
    """Return the ``rows`` (name, value) in two columns; a row with an empty value is left out."""
    width = max(len(name) for name, value in rows if value)
    return "\n".join(f"  {name:<{width}}  {value}" for name, value in rows if value)


def first_few(items: Sequence[object]) -> str:
    """Return the first ``items``, and how many there are if these are not all; "none" of an empty list."""
    return shortened(items) or "none"


def duration(seconds: float) -> str:
    """Return a time as text: seconds in two digits or, from two minutes on, minutes in three, without powers of ten."""
    # It is rounded first, since the format "g" alone writes 110 in two digits as 1.1e+02.
    if seconds < 120:
        return f"{float(f'{seconds:.2g}'):g} s"
    return f"{float(f'{seconds / 60:.3g}'):g} min"
