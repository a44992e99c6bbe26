"""Cases with trial values of the parameters that ``identify`` seeks, without reading a table for each of them.

A fit asks for hundreds of cases that differ from each other in a few numbers. To read each would be to check and
resolve all of its sections, and to compute the bands of a lattice with other masses or springs, which takes more time
than its motion. In the sections of a resolved case only the numbers that are sought differ: a trial case is a copy of a
case that was read, with other numbers in their places. Tests compare the copies with cases that were read, bit by bit.
"""

import copy
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any

from vipetsc.case.case import Case
from vipetsc.case.drive import check_drives
from vipetsc.case.identify.sought import SoughtParameter, changed_case, numbers_of
from vipetsc.case.quantities import QUANTITIES
from vipetsc.case.resolve import check_cell, check_contacts
from vipetsc.case.section import CaseError, Problem

FOLLOWING = ("kind", "energy", "near")
"""Keys of ``[initial]`` from which, together with the lattice, other numbers of the motion follow."""
KEPT = 32
"""Cases that are kept. Residuals, contacts and derivatives are asked for at the same values, one after the other.

If half as many are kept, cases are read twice where eight parameters are differentiated in two parts; twice as many
change nothing.
"""


class TrialCases:
    """Cases like ``base`` with other values of ``parameters``, and with the ``changes`` of a record by section."""

    def __init__(self, base: Case, parameters: Sequence[SoughtParameter], changes: Mapping[str, Any]) -> None:
        self._base = base
        self._parameters = parameters
        self._changes = changes
        # If numbers of the initial motion follow from masses, springs or contacts, each case must be read.
        self._follows = bool(set(FOLLOWING) & set(changes.get("initial", {})))
        # The amplitude of a record's own drive is known, and is not the one that is sought.
        self._has_amplitude = "amplitude" in changes.get("drive", {})
        self._first: Case | None = None
        self._case = lru_cache(maxsize=KEPT)(self._new_case)

    def case(self, values: Iterable[float]) -> Case:
        """Return the case with the ``values`` (parameter,); raises CaseError if it is impossible."""
        return self._case(tuple(float(value) for value in values))

    @cached_property
    def base(self) -> Case:
        """The case without trial values."""
        return self._with_changes(self._base)

    def read(self, values: Sequence[float]) -> Case:
        """Return the same case as ``case`` gives, read from its table; raises CaseError."""
        return self._with_changes(changed_case(self._base, self._parameters, values, "model"))

    def _with_changes(self, case: Case) -> Case:
        """Return the ``case`` with what the record changes."""
        if not self._changes:
            return case
        # A copy: tables are changed as they are read.
        return case.varied(**copy.deepcopy(dict(self._changes)))

    def _new_case(self, values: tuple[float, ...]) -> Case:
        """Return the case with the ``values`` (parameter,), of which the first one alone is read."""
        if self._follows:
            return self.read(values)

        if self._first is None:
            self._first = self.read(values)
        base = self.base
        sections: dict[str, Any] = dict(base)
        for quantity, numbers in numbers_of(self._base, self._parameters, values).items():
            if quantity != "amplitude" or not self._has_amplitude:
                sections = QUANTITIES[quantity].put(sections, numbers)

        # The first case has the times of the new cell, and its name.
        update = {key: sections[key] for key in ("contacts", "lattice", "drive")}
        trial = self._first.model_copy(update=update)
        problems = _problems(trial, base)
        if problems:
            raise CaseError(problems, trial.name)
        return trial


def _problems(trial: Case, case: Case) -> list[Problem]:
    """Return problems with the numbers of a ``trial``, which differs from the valid ``case`` in these alone.

    Two problems that reading a case finds are left out: samples that are too coarse for the bands, and a drive that
    sends no wave. Samples and frequencies of an identification are those that were measured.
    """

    def valid(*keys: str) -> bool:
        return True

    problems: list[Problem] = []
    cell = None
    if trial.lattice is not case.lattice:
        cell, problems = check_cell(trial.lattice)
        if cell is not None:
            problems += check_drives(trial.drive, trial.lattice, cell, trial.lattice.cells, valid)
    if not problems:
        problems = list(check_contacts(trial.lattice, trial.contacts, trial.initial, valid))
    return problems
