"""Numbers with nouns and names with units, as tables, messages and pictures write them."""

import difflib
import os
import re
from collections.abc import Iterable, Sequence

MOST_SHOWN = 8  # entries of a list, which with the number of all of them fit on a line
SHORT = 6  # digits of a number that differs from all others in them
EXACT = 17  # digits in which any two doubles differ


def shortened(items: Sequence[object]) -> str:
    """Return first of ``items`` between commas, and how many there are if these are not all; "" of an empty list."""
    shown = ", ".join(map(str, items[:MOST_SHOWN]))
    if len(items) > MOST_SHOWN:
        shown += f", ... ({len(items)})"
    return shown


def joined(parts: Sequence[str]) -> str:
    """Return the ``parts`` as a phrase: "a", "a and b", "a, b and c"."""
    return " and ".join(filter(None, [", ".join(parts[:-1]), *parts[-1:]]))


def system_number(error: Exception) -> int:
    """Return the number of the system's error that an ``error`` of Python or HDF5 reports; 0 without one."""
    # HDF5 gives the number in its message alone.
    in_text = re.search(r"errno = (\d+)", str(error))
    return getattr(error, "errno", None) or int(in_text[1] if in_text else 0)


def system_reason(error: Exception) -> str:
    """Return the system's reason for an ``error`` of Python or HDF5; else the text of the error."""
    number = system_number(error)
    return os.strerror(number) if number else str(error)


def of_system(error: OSError) -> str:
    """Return message of an ``error``; where it is the system's own, the file, the system's reason, and the remedy."""
    # The package's own messages name the file, and may have the number of the system's error.
    if error.errno is None or error.strerror != os.strerror(error.errno):
        return error.strerror or str(error)
    # Of a renaming both names, since either folder may be the cause.
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    file = " to ".join(names) or "a file"
    remedy = "after the cause is removed, the same command continues"
    return f"{file} could not be read or written: {error.strerror}; {remedy}"


def counted(number: int | str, noun: str) -> str:
    """Return a ``number``, or its text, with a ``noun`` whose plural ends in s: "1 site", "5 sites", "2 masses"."""
    text = str(number)
    if text == "1":
        return f"{text} {noun}"
    if noun.endswith("s"):
        noun += "e"
    return f"{text} {noun}s"


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return the one of the ``valid`` names that a misspelt ``name`` is nearest to; empty if none is near."""
    names = list(valid)
    # Words of one length with half of their letters in common, "tone" and "step", are not near.
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    longer = [other for other in names if name and other.startswith(name)]
    if not near and len(longer) == 1:
        near = longer
    return near[0] if near else ""


def key_name(path: str) -> str:
    """Return the words for the ``path`` of a key of a case: "Drive amplitude" for "drive.amplitude"."""
    return capitalised(path.replace("contacts.", "contact.").replace("_", " ").replace(".", " "))


def capitalised(text: str) -> str:
    """Return a ``text`` with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


def key_words(path: str) -> str:
    """Return the words for the ``path`` of a key within a sentence: "drive amplitude" for "drive.amplitude"."""
    name = key_name(path)
    return name[:1].lower() + name[1:]


def with_unit(name: str, unit: str) -> str:
    """Return a ``name`` with its ``unit`` in brackets, as "time (s)"; without one where the unit is "1" or empty."""
    if unit in ("", "1"):
        return name
    return f"{name} ({unit})"


def distinct(numbers: Sequence[float]) -> list[str]:
    """Return a text for each of different ``numbers``: six digits, or as many as it takes that all texts differ.

    A number that differs from all others in six digits is written with six, also if others need more.
    """
    texts = [f"{number:.{SHORT}g}" for number in numbers]
    for digits in range(SHORT + 1, EXACT + 1):
        shared = {text for text in texts if texts.count(text) > 1}
        if not shared:
            break
        for i, number in enumerate(numbers):
            if texts[i] in shared:
                texts[i] = f"{number:.{digits}g}"
    return texts
