"""What a claim of the paper is: a sentence, criteria that were fixed beforehand, what was measured, a verdict."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from vipetsc.io.atomic import write_text

if TYPE_CHECKING:
    from vipetsc.paper.claims.evidence import Evidence

HOLDS, IN_PART, FAILS, UNMEASURED = "holds", "holds in part", "does not hold", "not measured"
VERDICTS = (HOLDS, IN_PART, FAILS, UNMEASURED)
DIGITS = 6  # significant ones of the numbers in claims.json

Numbers = dict[str, float | None]


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
    """``low`` <= the number called ``name`` <= ``high``; a claim that fails a ``decisive`` one does not hold.

    With ``of`` the number is a share, and ``low`` counts out of ``of``.
    """

    name: str
    low: float = -float("inf")
    high: float = float("inf")
    unit: str = ""
    of: int = 0
    decisive: bool = False

    def met(self, value: float) -> bool:
        """Whether ``value`` keeps within the bounds; a number that is not finite does not."""
        scale = self.of or 1
        return isfinite(value) and self.low - 1e-9 <= value * scale <= self.high + 1e-9

    def __str__(self) -> str:
        if self.of:
            return f"{self.name}: at least {self.low:g} of {self.of}"
        unit = f" {self.unit}" if self.unit else ""
        if isfinite(self.low) and isfinite(self.high):
            return f"{self.name}: {self.low:.4g} to {self.high:.4g}{unit}"
        sign, bound = (">=", self.low) if isfinite(self.low) else ("<=", self.high)
        return f"{self.name} {sign} {bound:.4g}{unit}"


@dataclass
class Measurement:
    """What a measurement gathers: numbers by name, their uncertainties, and sentences that explain them.

    ``figure`` takes the place of the statement's where the picture's name depends on the data.
    """

    value: Numbers = field(default_factory=dict)
    uncertainty: Numbers = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)
    figure: str = ""


@dataclass(frozen=True)
class ClaimSpec:
    """A claim before it is measured.

    ``figure`` may hold ``{reading}``. ``measure`` (evidence, reading, finding) fills the finding, and raises
    ``MissingEvidence`` when it cannot.
    """

    id: str
    claim: str
    figure: str
    criteria: tuple[Criterion, ...]
    measure: Callable[[Evidence, str, Measurement], None]

    @property
    def threshold(self) -> str:
        """All criteria in words, from the numbers that decide."""
        return "; ".join(map(str, self.criteria))


def verdict(criteria: Sequence[Criterion], value: Mapping[str, float | None]) -> tuple[str, list[str]]:
    """The verdict on the numbers ``value``, and the names of the criteria that are not met or not measured.

    It holds when every criterion is met, not at all when none is or a decisive one is not, and else in part; what
    was not measured keeps it from holding.
    """
    known = [c for c in criteria if value.get(c.name) is not None]
    if not known:
        return UNMEASURED, [c.name for c in criteria]
    met = [c for c in known if c.met(value[c.name])]
    missed = [c.name for c in criteria if c not in met]
    if len(met) == len(criteria):
        return HOLDS, missed
    if not met or any(c.decisive for c in known if c not in met):
        return FAILS, missed
    return IN_PART, missed


def rounded(numbers: Mapping[str, float | None]) -> Numbers:
    """``numbers`` with ``DIGITS`` significant digits; None for what is not finite."""
    return {k: float(f"{v:.{DIGITS}g}") if v is not None and isfinite(v) else None for k, v in numbers.items()}


def write_claims(claims: Sequence[Claim], path: Path) -> None:
    """Write ``claims`` as a list of JSON objects, whole or not at all; the same claims give the same bytes."""
    rows = [asdict(claim) for claim in claims]
    write_text(path, json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
