"""The case of the verb ``design``: which (lambda, eta) are searched, in which readings."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import Field

from vipetsc.case.schema import (
    CaseError,
    Positive,
    Problem,
    Section,
    read_section,
    read_toml,
    unknown_key,
    with_overrides,
)

BESIDE = {"lattice", "contacts", "drive", "time", "output", "sweep", "nnm"}
"""Sections of other verbs that may stand in the same file; the search is always of the paper's four-band cell."""

LARGEST = 20_000_000  # Bloch problems (lambda, eta, kappa) of a reading whose bands fit in memory and on disk


class GridTable(Section):
    """``count`` evenly spaced values from ``first`` to ``last``."""

    first: Positive = 0.1
    last: Positive = 1.0
    count: Annotated[int, Field(ge=2)] = 37

    def values(self) -> np.ndarray:
        """The values (count,), free of the last digits' noise."""
        return np.round(np.linspace(self.first, self.last, self.count), 12)


class EtaTable(GridTable):
    """The grid of eta; a value of 1 in it is left out, since the host mass m (1 - eta) vanishes there."""

    first: Annotated[float, Field(gt=0, lt=1)] = 0.1
    last: Annotated[float, Field(gt=0, le=1)] = 1.0

    def values(self) -> np.ndarray:
        """The values below 1."""
        found = super().values()
        return found[found < 1]


class DesignTable(Section):
    """Grids of lambda and eta, number of ``wavenumbers`` in [0, pi], readings of the paper's parameters."""

    readings: list[Literal["printed", "calibrated"]] = Field(["printed", "calibrated"], min_length=1)
    lam: GridTable = Field(GridTable(), alias="lambda")
    eta: EtaTable = EtaTable()
    wavenumbers: Annotated[int, Field(ge=3)] = 101


class DesignCase(Section):
    """A case of the verb ``design``: the section ``[design]``; everything in it may be left out."""

    name: str
    design: DesignTable

    @classmethod
    def load(cls, path: str | Path | None, overrides: Iterable[str] = ()) -> DesignCase:
        """The case in file ``path``, or the paper's search, with overrides; raises CaseError or OSError."""
        if path is None:
            return cls.from_table({"name": "design"}, overrides, "built-in search")
        return cls.from_table(read_toml(path), overrides, str(path))

    @classmethod
    def from_table(cls, table: dict[str, Any], overrides: Iterable[str] = (), source: str = "case") -> DesignCase:
        """The case of a parsed table; raises CaseError with everything that is wrong."""
        table, problems = with_overrides(table, overrides)
        known = {"name", "design", *BESIDE}
        problems += [unknown_key(key, table[key], known) for key in table if key not in known]
        lattice = table.get("lattice", {})
        if isinstance(lattice, dict) and ("cell" in lattice or lattice.get("preset", "four-band") != "four-band"):
            found = lattice.get("preset", "a cell of one's own")
            problems.append(Problem("lattice", found, "only the four-band preset has a lambda and an eta to search"))
        name = table.get("name", "design")
        if not isinstance(name, str) or not name:
            problems.append(Problem("name", name, "must be a non-empty string"))
        design, wrong = read_section(DesignTable, table.get("design", {}), "design")
        problems += wrong or _cross_problems(design)
        if problems:
            raise CaseError(problems, source)
        return cls(name=name, design=design)

    def to_toml(self) -> str:
        """The resolved case as TOML; reading it back gives the same case."""
        return tomli_w.dumps(self.model_dump(by_alias=True))


def _cross_problems(design: DesignTable) -> list[Problem]:
    problems = []
    for key, grid in (("lambda", design.lam), ("eta", design.eta)):
        if not grid.first < grid.last:
            remedy = f"must be above design.{key}.first = {grid.first}"
            problems.append(Problem(f"design.{key}.last", grid.last, remedy))
    if len(set(design.readings)) < len(design.readings):
        problems.append(Problem("design.readings", design.readings, "name each reading once"))
    size = design.lam.count * design.eta.count * design.wavenumbers
    if size > LARGEST:
        remedy = f"times design.eta.count and design.wavenumbers it is {size}; at most {LARGEST} fit"
        problems.append(Problem("design.lambda.count", design.lam.count, remedy))
    return problems
