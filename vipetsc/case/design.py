"""The case of the verb ``design``: the grid of (lambda, eta) and the readings of the parameters."""

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vipetsc.case.case_file import CaseFile, Valid
from vipetsc.case.reading import Table
from vipetsc.case.schema import OutputTable, Positive
from vipetsc.case.section import Problem, Section, described

# Bloch problems (lambda, eta, kappa) of one reading: the four bands of so many are 640 MB in memory and on disk.
LARGEST = 20_000_000


class GridTable(Section):
    """``count`` evenly spaced values from ``first`` to ``last``."""

    first: Positive = described("first value", 0.1)
    last: Positive = described("last value", 1.0)
    count: Annotated[int, Field(ge=2)] = described("number of values, evenly spaced", 37)

    def values(self) -> np.ndarray:
        """Return the values (count,), rounded to remove errors in the last digits."""
        return np.round(np.linspace(self.first, self.last, self.count), 12)


class EtaTable(GridTable):
    """The grid of eta; the value 1 is left out, because the host mass m (1 - eta) vanishes there."""

    first: Annotated[float, Field(gt=0, lt=1)] = described("first value", 0.1)
    last: Annotated[float, Field(gt=0, le=1)] = described(
        "last value; the value 1, at which the host has no mass, is left out", 1.0
    )

    def values(self) -> np.ndarray:
        """Return the values (eta,) below 1, where the host has mass."""
        eta = super().values()
        return eta[eta < 1]


class DesignTable(Section):
    """Grids of lambda and eta, the number of ``wavenumbers`` in [0, pi], the ``readings`` of the paper's parameters.

    One map of the search is computed for each reading.
    """

    readings: list[Literal["printed", "calibrated"]] = described(
        "readings of the paper's parameters that are searched", ["printed", "calibrated"], min_length=1
    )
    lam: GridTable = described("grid of lambda", GridTable(), alias="lambda")
    eta: EtaTable = described("grid of eta", EtaTable())
    wavenumbers: Annotated[int, Field(ge=3)] = described("wavenumbers from 0 to pi", 101)


class DesignCase(CaseFile):
    """A case of the verb ``design``, all of whose keys have defaults; the search is of the four-band cell."""

    design: DesignTable
    # No part of the case: results that are drawn or not are the same.
    output: Annotated[OutputTable, Field(exclude=True)]

    verb = section = "design"
    builtin_table: ClassVar[Table] = {"name": "design"}

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the section, and all problems with it or with ``[lattice]`` in the same file."""
        fields, problems = super().read(table)
        lattice = table.get("lattice", {})
        if isinstance(lattice, dict) and ("cell" in lattice or lattice.get("preset", "four-band") != "four-band"):
            remedy = "only the four-band preset has a lambda and an eta to search"
            problems.append(Problem("lattice", lattice.get("preset", "a user-defined cell"), remedy))
        return fields, problems

    @property
    def wants_pictures(self) -> bool:
        """Whether the search is drawn, ``output.figures``."""
        return self.output.figures

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> Iterator[Problem]:
        """Yield problems between the keys of a valid section."""
        if not valid("design"):
            return
        design = sections["design"]
        for key, grid in (("lambda", design.lam), ("eta", design.eta)):
            if not grid.first < grid.last:
                yield Problem(f"design.{key}.last", grid.last, f"must be above design.{key}.first = {grid.first}")
        if len(set(design.readings)) < len(design.readings):
            yield Problem("design.readings", design.readings, "give each reading once")
        size = design.lam.count * design.eta.count * design.wavenumbers
        if size > LARGEST:
            remedy = f"times design.eta.count and design.wavenumbers it is {size}; at most {LARGEST} fit"
            yield Problem("design.lambda.count", design.lam.count, remedy)
