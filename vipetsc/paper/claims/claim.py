"""What a claim of the paper is: a sentence, criteria that were fixed beforehand, what was measured, a verdict."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import isfinite
from pathlib import Path

from vipetsc.io.atomic import write_text

HOLDS, IN_PART, FAILS, UNMEASURED = "holds", "holds in part", "does not hold", "not measured"
DIGITS = 6  # significant ones of the numbers in claims.json
ROUNDING = 1e-9  # of a measured number beside its threshold

Numbers = dict[str, float | None]


class MissingEvidence(Exception):
    """What a claim is measured from is not there; the message says what."""


@dataclass(frozen=True)
class Claim:
    """A claim as measured in one reading of the paper's parameters.

    ``value`` holds named numbers, None where one could not be had, the deciding ones among them under the names that
    stand in ``threshold``; ``uncertainty`` intervals, spreads and numbers of points by name. ``figure`` is the stem of
    the picture that shows it, ``files`` are what it was measured from, relative to the folder of all steps.
    """

    id: str
    reading: str
    claim: str
    value: Numbers
    uncertainty: Numbers
    threshold: str
    verdict: str
    reason: str
    figure: str
    files: tuple[str, ...]


@dataclass(frozen=True)
class Criterion:
    """What decides on a claim: the comparison of the number called ``quantity`` with ``threshold``.

    ========  =============  ========================================================
    "<="      bound          at most
    ">="      bound          at least
    "within"  (low, high)    in the closed interval
    "of"      (count, all)   the quantity is a share: at least ``count`` out of ``all``
    ========  =============  ========================================================

    ``source`` is where SPEC.md or the paper gives the threshold. A claim that fails a ``decisive`` criterion does not
    hold.
    """

    quantity: str
    comparison: str
    threshold: float | tuple[float, float]
    unit: str
    source: str
    decisive: bool = False

    def met(self, value: float) -> bool:
        """Whether ``value`` keeps to the threshold; a number that is not finite does not."""
        low, high = self.interval
        scale = high if self.comparison == "of" else 1
        return isfinite(value) and low - ROUNDING <= value * scale <= high + ROUNDING

    @property
    def interval(self) -> tuple[float, float]:
        """Lowest and highest number that meets the criterion; counts for shares."""
        if isinstance(self.threshold, tuple):
            return self.threshold
        return (-float("inf"), self.threshold) if self.comparison == "<=" else (self.threshold, float("inf"))

    def __str__(self) -> str:
        low, high = self.interval
        unit = f" {self.unit}" if self.unit else ""
        if self.comparison == "of":
            return f"{self.quantity}: at least {low:g} of {high:g}"
        if self.comparison == "within":
            return f"{self.quantity}: {low:.4g} to {high:.4g}{unit}"
        return f"{self.quantity} {self.comparison} {self.threshold:.4g}{unit}"


@dataclass
class Measurement:
    """What a measurement gathers: numbers by name, their uncertainties, and sentences that explain them.

    ``figure`` takes the place of the claim's where the picture's name depends on the data.
    """

    value: Numbers = field(default_factory=dict)
    uncertainty: Numbers = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)
    figure: str = ""


@dataclass(frozen=True)
class ClaimSpec:
    """A claim before it is measured: a sentence, where the ``paper`` makes it, and what decides on it.

    ``figure`` is the stem of the picture that shows it, and may hold ``{reading}``. ``measure`` names a function
    "module.name" (evidence, reading, measurement) that fills the measurement, or raises MissingEvidence.
    """

    claim: str
    paper: str
    figure: str
    measure: str
    criteria: tuple[Criterion, ...]


def verdict(criteria: Sequence[Criterion], value: Mapping[str, float | None]) -> tuple[str, list[str]]:
    """The verdict on the numbers ``value``, and the quantities of the criteria that are not met or not measured.

    It holds when every criterion is met, not at all when none is or a decisive one is not, and else in part; what
    was not measured keeps it from holding.
    """
    numbers = {c: value.get(c.quantity) for c in criteria}
    met = [c for c, number in numbers.items() if number is not None and c.met(number)]
    failed = [c for c, number in numbers.items() if number is not None and c not in met]
    missed = [c.quantity for c in criteria if c not in met]
    if not met and not failed:
        return UNMEASURED, missed
    if not missed:
        return HOLDS, missed
    return FAILS if not met or any(c.decisive for c in failed) else IN_PART, missed


def rounded(numbers: Mapping[str, float | None]) -> Numbers:
    """``numbers`` with ``DIGITS`` significant digits; None for what is not finite."""
    return {k: float(f"{v:.{DIGITS}g}") if v is not None and isfinite(v) else None for k, v in numbers.items()}


def write_claims(claims: Sequence[Claim], path: Path) -> None:
    """Write ``claims`` as a list of JSON objects, whole or not at all; the same claims give the same bytes."""
    rows = [asdict(claim) for claim in claims]
    write_text(path, json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
