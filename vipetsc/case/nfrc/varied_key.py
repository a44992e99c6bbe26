"""A key of the case that varies along a curve of steady states: ``nfrc.over`` with the key's path."""

import copy
from typing import Any

from vipetsc.case.reading import Table, put
from vipetsc.case.section import Problem

PARAMETERS = "amplitude", "frequency"
SECTIONS = ("lattice", "contacts", "disorder")  # whose keys can vary along a curve
# Positions in the range at which the case is read before a curve is followed: both ends, and one between them. A key
# that takes only whole numbers may be valid at both ends, and is refused at the third position, which gives none.
TRIED = (0.0, 0.381966, 1.0)


def is_key(over: Any) -> bool:
    """Return whether ``nfrc.over`` is the path of a key."""
    return isinstance(over, str) and over not in PARAMETERS and "." in over


def table_at(table: Table, value: float) -> tuple[Table, list[Problem]]:
    """Return the ``table`` of a case whose key ``nfrc.over`` has a ``value``, over the amplitude, and its problems."""
    changed = copy.deepcopy(table)
    nfrc = changed["nfrc"]
    key = nfrc["over"]
    problems = put(changed, key, value)
    # The range is one of the key, and the values that are fixed are amplitudes: the states begin below the smallest.
    amplitudes = nfrc.pop("fixed", [])
    smallest = min(amplitudes, default=1.0)
    nfrc.pop("isolas", None)
    nfrc |= {"over": "amplitude", "range": [0.5 * smallest, smallest]}
    return changed, problems


def key_problems(table: Table) -> list[Problem]:
    """Return problems with the key that varies, its range and fixed values, before any value of the key is tried."""
    nfrc = table["nfrc"]
    key = nfrc["over"]
    problems = []
    if key.partition(".")[0] not in SECTIONS:
        problems.append(Problem("nfrc.over", key, f"only keys of {', '.join(SECTIONS)} vary along a curve"))
    if "range" not in nfrc:
        problems.append(Problem("nfrc.range", None, f"give [low, high] of {key}"))
    if not nfrc.get("fixed"):
        problems.append(Problem("nfrc.fixed", [], "give the amplitudes of the curves; their frequency is the drive's"))
    if key == "contacts.restitution" and "restitutions" in nfrc:
        problems.append(Problem("nfrc.restitutions", nfrc["restitutions"], f"{key} varies along the curve; remove it"))
    return problems
