"""Criteria that decide on the claims (``claims.toml``), and the constants in the quantities that they compare.

Every number on which a verdict depends is in that file or in this module. Sections and figures (sec., App., Suppl.,
Fig.) are the paper's. Constants without one are choices of this package, where the paper's words have no number.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from math import inf, isfinite
from typing import Any, SupportsFloat

HOLDS, IN_PART, FAILS, UNMEASURED = "holds", "holds in part", "does not hold", "not measured"
# A measured number may miss its threshold by this: a quotient of counts, as 3/5, is not exact in binary.
ROUNDING = 1e-9
LAWS = ("hertz", "bilinear")

# Constants of quantities: they say what is counted or measured, while thresholds decide on it.
STRAIGHT = 0.95  # adjusted R^2 of a power law (sec. II.C: above 0.95 for the majority of configurations)
STRAIGHT_EVERYWHERE = 0.9  # the same for each curve (Suppl. 2: 0.9 to 0.99 for nearly every simulation)
QUIET = 0.1  # normalised entropy that is still "nearly zero" (sec. II.C)
ABRUPT = 10**0.5  # ratio of amplitudes, half a decade, in which an abrupt rise leads from QUIET to half the peak
# Amplitudes in N at which the entropy is largest (Fig. 5). With calibrated parameters they are 1.1 to 1.4 N; a step of
# the sweep, a factor of 1.25, is allowed on either side.
PEAK = (0.9, 1.8)
HIGH = 10.0  # N, the paper's high amplitude (sec. II.B)
SEVERAL = 3  # the fewest sites that are several
HALF_WIDTH = 0.02  # half-width of the band about a Bloch branch over the top edge of the pass bands
NATIVE = (7, 8)  # wavenumber bins, from 1, in which the packet starts (sec. II.B)
GRID = 0.1  # spacing of lambda and eta at which the search has the paper's optimum, whose grid the paper does not state
LOW = 10  # times the floor: the transfer counts as not set in up to there
# The parts that the paper filters (App. A): the pass bands, the gap "between the acoustic band and first optical band",
# which is that above band 1, and the one "between the upper two optical bands", 3 and 4.
COUNTED = ("band 1", "band 2", "band 3", "band 4", "gap 1", "gap 3")
FEWEST_FOLDS = 2  # folds of a branch that turns back in energy and forth again (sec. IV.B)
# d ln f / d ln E of an oscillator on a spring of force w^n, n = 3/2: (n - 1)/(2 (n + 1)), since its frequency grows as
# w^((n - 1)/2) and its energy as w^(n + 1). It is the limit at high energy (sec. IV.B: a 3/2 nonlinear coupling).
HERTZ_LIMIT = 0.1
SAME_MOTION = 0.9  # least correlation of motions that count as the same
SAME_EXPONENT = 0.2  # largest difference of exponents that count as the same


@dataclass(frozen=True)
class Criterion:
    """The comparison of the number called ``quantity`` with ``threshold``.

    ========  =============  ========================================================
    "<="      bound          at most
    ">="      bound          at least
    "within"  (low, high)    in the closed interval
    "of"      (count, all)   the quantity is a fraction: at least ``count`` out of ``all``
    ========  =============  ========================================================

    ``source`` is where the paper gives the threshold, or "ours" if its words have no number (see ``claims.toml``). A
    claim that fails a ``decisive`` criterion does not hold.
    """

    quantity: str
    comparison: str
    threshold: float | tuple[float, float]
    unit: str
    source: str
    decisive: bool = False

    def met(self, value: SupportsFloat | None) -> bool:
        """Return whether ``value`` keeps to the threshold; a number that is not there or not finite does not."""
        if value is None or not isfinite(value):
            return False

        low, high = self.interval
        scale = high if self.comparison == "of" else 1
        return low - ROUNDING <= float(value) * scale <= high + ROUNDING

    @property
    def interval(self) -> tuple[float, float]:
        """Lowest and highest number that meets the criterion; counts for fractions."""
        if isinstance(self.threshold, tuple):
            return self.threshold
        if self.comparison == "<=":
            return -inf, self.threshold
        return self.threshold, inf

    def __str__(self) -> str:
        low, high = self.interval
        unit = f" {self.unit}" if self.unit else ""
        if self.comparison == "of":
            return f"{self.quantity}: at least {low:g} of {high:g}"
        if self.comparison == "within":
            return f"{self.quantity}: {low:.4g} to {high:.4g}{unit}"
        return f"{self.quantity} {self.comparison} {self.threshold:.4g}{unit}"


@dataclass(frozen=True)
class ClaimSpec:
    """A claim before it is measured: the sentence ``claim``, where the ``paper`` makes it, and the ``criteria``.

    ``figure`` is the stem of the picture that shows it, and may contain ``{reading}``. ``measure`` is the name
    "module.function" of the function (evidence, reading, measurement) that fills the measurement or raises
    MissingEvidence. The claim is measured in each of ``readings``.
    """

    claim: str
    paper: str
    figure: str
    measure: str
    criteria: tuple[Criterion, ...]
    readings: Sequence[str] = ("printed", "calibrated")


def verdict(criteria: Sequence[Criterion], value: Mapping[str, SupportsFloat | None]) -> tuple[str, list[str]]:
    """Return verdict on the numbers ``value``, by quantity, and the quantities of the criteria that they do not meet.

    The claim holds if every criterion is met. It does not hold if none is met, or if a decisive one is not. Otherwise
    it holds in part. A number that is None was not measured and meets no criterion; if all are, the claim is not
    measured.
    """
    # A number that was not measured does not meet its criterion, but decides nothing.
    missed = [c for c in criteria if not c.met(value.get(c.quantity))]
    failed = [c for c in missed if value.get(c.quantity) is not None]
    names = [c.quantity for c in missed]
    if not missed:
        return HOLDS, names
    if not failed and len(missed) == len(criteria):
        return UNMEASURED, names
    if len(missed) == len(criteria) or any(c.decisive for c in failed):
        return FAILS, names
    return IN_PART, names


def _criteria(rows: Sequence[Sequence[Any]]) -> tuple[Criterion, ...]:
    """Return the criteria of a claim from its ``rows`` in ``claims.toml``; those of the contact laws (*) come first."""
    criteria = []
    for law in (*LAWS, ""):
        for quantity, comparison, threshold, unit, source, *decisive in rows:
            if quantity.endswith("*") != bool(law):
                continue
            # TOML has lists, no tuples; a frozen criterion needs one, to be hashable.
            if isinstance(threshold, list):
                threshold = tuple(threshold)
            criteria.append(
                Criterion(
                    quantity=quantity.replace("*", f", {law}"),
                    comparison=comparison,
                    threshold=threshold,
                    unit=unit,
                    source=source,
                    decisive=bool(decisive),
                )
            )
    return tuple(criteria)


_TABLES = tomllib.loads((files("vipetsc.paper.claims") / "claims.toml").read_text(encoding="utf-8"))
CLAIMS = {key: ClaimSpec(**table | {"criteria": _criteria(table["criteria"])}) for key, table in _TABLES.items()}
