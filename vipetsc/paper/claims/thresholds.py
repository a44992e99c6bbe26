"""Every number that decides on a claim: the criteria in ``claims.toml``, and the constants inside of quantities.

Sections (sec., App., Suppl.) are the paper's; SPEC is the specification that fixes what the paper leaves open.
"""

import tomllib
from importlib.resources import files
from typing import Any

from vipetsc.paper.claims.claim import ClaimSpec, Criterion

LAWS = "hertz", "bilinear"

# Constants of quantities: what is counted or measured, rather than what decides.
STRAIGHT, STRAIGHT_EVERYWHERE = 0.95, 0.9  # adjusted R^2 of a power law (SPEC 11, C7 and C8)
FEWEST = 4  # points of a fit: three lie near some power law by chance
QUIET = 0.1  # normalised entropy that is still "nearly zero" (sec. II.C)
ABRUPT = 10**0.5  # ratio of amplitudes, half a decade, in which an abrupt rise leads from QUIET to half the peak
PEAK = 0.9, 1.8  # N (sec. II.C; SPEC 4: 1.1-1.4 N)
HIGH, SEVERAL = 10.0, 3  # N, the paper's high amplitude; sites that are several
BESIDE = 0.02  # half-width of the band about a Bloch branch over the top edge of the pass bands
NATIVE = 7, 8  # wavenumber bins that the packet starts in (SPEC 11, C5)
PAPER_CELL, GRID = (0.1, 0.5), 0.1  # (lambda, eta) of the paper, spacing of its grid (SPEC 11, C10; Suppl. 3)
LOW = 10  # times the floor: up to there the transfer has not set in
SUDDEN = 10**0.5  # ratio of amplitudes from there to half the maximum
COUNTED = "band 1", "band 2", "band 3", "band 4", "gap 1", "gap 2"  # the parts that the paper filters (App. A3)
FEWEST_FOLDS = 2  # back in energy and forth again (SPEC 9)
HERTZ_LIMIT = 0.1  # d ln f / d ln E of a resonator on a spring of force w^n, n = 3/2: (n - 1)/(2 (n + 1))
SAME_MOTION, SAME_EXPONENT = 0.9, 0.2


def read_specs() -> dict[str, ClaimSpec]:
    """The claims of ``claims.toml`` by id."""
    tables = tomllib.loads((files("vipetsc.paper.claims") / "claims.toml").read_text(encoding="utf-8"))
    return {key: ClaimSpec(**table | {"criteria": _criteria(table["criteria"])}) for key, table in tables.items()}


def _criteria(rows: list[list[Any]]) -> tuple[Criterion, ...]:
    """The criteria of one claim; those of both laws (quantities that end in *) first, law by law."""
    criteria = []
    for law in (*LAWS, ""):
        for quantity, comparison, threshold, unit, source, *decisive in rows:
            if quantity.endswith("*") == bool(law):
                name = quantity.replace("*", f", {law}")
                bounds = tuple(threshold) if isinstance(threshold, list) else threshold
                criteria.append(Criterion(name, comparison, bounds, unit, source, bool(decisive)))
    return tuple(criteria)


CLAIMS = read_specs()
