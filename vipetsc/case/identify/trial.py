"""Cases with trial values of the parameters that ``identify`` seeks, without reading a table for each of them.

A fit asks for hundreds of cases that differ from each other in a few numbers. To read each would be to check and
resolve all of its sections, and to compute the bands of a lattice with other masses or springs, which takes more time
than its motion. In the sections of a resolved case only the numbers that are sought differ: a trial case is a copy of a
case that was read, with other numbers in their places. Tests compare the copies with cases that were read, bit by bit.
"""

import copy
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from vipetsc.case.case import Case
from vipetsc.case.case_file import CaseError, Problem, Table
from vipetsc.case.drive import check_drives
from vipetsc.case.identify.sought import OF_CELL, OF_SPRINGS, SoughtParameter, changed_case, numbers_of
from vipetsc.case.resolve import check_cell, check_contacts
from vipetsc.case.schema import LatticeTable

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
        self._read: dict[tuple[str, ...], Case] = {}
        self._case = lru_cache(maxsize=KEPT)(self._new_case)

    def case(self, values: Iterable[float]) -> Case:
        """The case with the ``values`` (parameter,); raises CaseError if it is impossible."""
        return self._case(tuple(float(value) for value in values))

    @property
    def base(self) -> Case:
        """The case without trial values."""
        return self._with_changes(self._base)

    def read(self, values: Sequence[float]) -> Case:
        """The same case as ``case`` gives, read from its table; raises CaseError."""
        return self._with_changes(changed_case(self._base, self._parameters, values, "model"))

    def _with_changes(self, case: Case) -> Case:
        """The ``case`` with what the record changes."""
        if not self._changes:
            return case
        # A copy: tables are changed as they are read.
        return case.varied(**copy.deepcopy(dict(self._changes)))

    def _new_case(self, values: tuple[float, ...]) -> Case:
        """The case with the ``values`` (parameter,), which is read once for each form of its table."""
        if self._follows:
            return self.read(values)

        numbers = numbers_of(self._base, self._parameters, values)
        # The form: a number that all sites have in common stands in another place of the table than a list.
        form = tuple(quantity for quantity, several in numbers.items() if len(set(several)) == 1)
        if form not in self._read:
            self._read[form] = self.read(values)
        return self._with_numbers(self._read[form], numbers)

    def _with_numbers(self, case: Case, numbers: dict[str, list[float]]) -> Case:
        """The ``case`` with other ``numbers`` by quantity; raises CaseError."""
        contacts = case.contacts
        lattice = case.lattice
        drive = case.drive
        for quantity, several in numbers.items():
            if quantity in OF_CELL:
                lattice = _with_cell_numbers(lattice, quantity, several)
            elif quantity == "amplitude":
                if not self._has_amplitude:
                    drive = drive.model_copy(update={"amplitude": several[0]})
            elif quantity == "clearance":
                contacts = contacts.model_copy(update={"clearance": several})
            elif contacts.each and getattr(contacts.each, quantity):
                each = contacts.each.model_copy(update={quantity: several})
                contacts = contacts.model_copy(update={"each": each})
            else:
                contacts = contacts.model_copy(update={quantity: several[0]})

        trial = case.model_copy(update={"contacts": contacts, "lattice": lattice, "drive": drive})
        problems = _problems(trial, case)
        if problems:
            raise CaseError(problems, trial.name)
        return trial


def _with_cell_numbers(lattice: LatticeTable, quantity: str, numbers: list[float]) -> LatticeTable:
    """The ``lattice`` with other ``numbers`` of a ``quantity`` of its cell's masses or springs."""
    cell = lattice.cell
    assert cell is not None  # changed_case writes a preset's cell out
    if quantity == "mass":
        update: Table = {"masses": numbers}
    elif quantity == "grounding":
        update = {"grounding": numbers}
    else:
        key = OF_SPRINGS[quantity]
        springs = []
        for spring, number in zip(cell.springs, numbers, strict=True):
            # A parameter that is 0 is left out, as ``with_cell`` does it.
            value: float | None = number
            if number == 0 and key != "stiffness":
                value = None
            springs.append(spring.model_copy(update={key: value}))
        update = {"springs": springs}
    return lattice.model_copy(update={"cell": cell.model_copy(update=update)})


def _problems(trial: Case, case: Case) -> list[Problem]:
    """Problems with the numbers of a ``trial``, which differs from the valid ``case`` in these alone.

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
