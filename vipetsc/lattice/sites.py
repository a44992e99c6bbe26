"""The contact sites of a lattice: where each is, which masses it joins, its law and its stops."""

import hashlib
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.lattice.contact import Contact

SITE = np.dtype(
    [(name, np.int64) for name in ("cell", "host", "resonator", "offset", "law")]
    + [(name, np.float64) for name in ("clearance", "plus", "minus")]
)
"""A site in a table, with the fields of ``Site``: ``law`` is a number in the table's laws."""


class Pair(NamedTuple):
    """Masses that a contact joins (0-based; host -1 is ground); ``resonator`` is ``offset`` cells further, 0 or 1."""

    host: int
    resonator: int
    offset: int = 0

    def relative(self, field: np.ndarray, cell: int) -> np.ndarray:
        """Return the motion (...) of the resonator relative to its host in a ``cell`` (0-based).

        ``field`` (..., cell, dof) is the displacement or the velocity of all cells. The resonator may be in the next
        cell, which of a ring's last cell is the first one; the ground does not move.
        """
        w = field[..., (cell + self.offset) % field.shape[-2], self.resonator]
        if self.host < 0:
            return np.asarray(w)
        return np.asarray(w - field[..., cell, self.host])


class Site(NamedTuple):
    """A contact site in a ``cell`` (0-based): the ``pair`` that it joins, its ``law``, its stops.

    ``clearance`` in m is the one that a case gives; ``gaps`` in m are what is left of it on the sides + and -: inf on a
    side without a stop, less by the precompression where the contact is pressed at rest.
    """

    cell: int
    pair: Pair
    law: Contact
    clearance: float
    gaps: tuple[float, float]


class Sites:
    """Sites, as a read-only ``table`` (site,) of dtype ``SITE``, since there may be a million, and their ``laws``.

    Items are records ``Site``. Chains are keys of caches: two are equal if their tables are, bit for bit, and laws.
    """

    def __init__(self, table: np.ndarray, laws: tuple[Contact, ...]) -> None:
        self.table = table.copy()
        self.table.flags.writeable = False
        self.laws = laws

    @cached_property
    def _digest(self) -> tuple[bytes, tuple[Contact, ...]]:
        return hashlib.sha256(self.table.tobytes()).digest(), self.laws

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sites) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    def __len__(self) -> int:
        return len(self.table)

    def __iter__(self) -> Iterator[Site]:
        return map(self._site, self.table.tolist())

    def __getitem__(self, number: int) -> Site:
        return self._site(self.table[number].item())

    def _site(self, row: tuple[int, int, int, int, int, float, float, float]) -> Site:
        """Return the record of a ``row`` of the table."""
        cell, host, resonator, offset, law, clearance, plus, minus = row
        return Site(cell, Pair(host, resonator, offset), self.laws[law], clearance, (plus, minus))

    @property
    def cells(self) -> np.ndarray:
        """The cell (site,) of each site, from 0."""
        return np.asarray(self.table["cell"])

    @property
    def clearances(self) -> np.ndarray:
        """The clearance (site,) in m of each site that the case gives."""
        return np.asarray(self.table["clearance"])

    @property
    def gaps(self) -> np.ndarray:
        """The clearances (site, 2) in m of each site on the sides + and -."""
        return np.column_stack([self.table["plus"], self.table["minus"]])

    @property
    def pairs(self) -> list[Pair]:
        """The pair of each site."""
        return [site.pair for site in self]

    @property
    def join_cells(self) -> bool:
        """Whether any contact joins masses of two cells."""
        return bool(self.table["offset"].any())

    @property
    def are_rigid(self) -> np.ndarray:
        """Whether each site (site,) has a stop that does not yield."""
        return np.array([law.is_rigid for law in self.laws], bool)[self.table["law"]]

    def change(self, **columns: ArrayLike) -> "Sites":
        """Return the sites with other ``columns`` of their table."""
        table = self.table.copy()
        for name, column in columns.items():
            table[name] = column
        return Sites(table, self.laws)


NO_STOP = Contact("bilinear", 0.0)
"""The law of a site that is only a place: its clearances are infinite."""
NO_SITES = Sites(np.zeros(0, SITE), ())


def sites_at(
    cells: ArrayLike,
    pairs: Pair | Sequence[Pair],
    laws: Contact | Sequence[Contact] = NO_STOP,
    clearances: ArrayLike = np.inf,
    gaps: ArrayLike | None = None,
) -> Sites:
    """Return sites in ``cells`` (site,), from 0: what is one value here, a pair or a law, is that of each site.

    ``clearances`` (site,) in m are those on both sides, unless ``gaps`` (site, 2) are given.
    """
    cells = np.asarray(cells, np.int64)
    table = np.zeros(len(cells), SITE)
    if isinstance(laws, Contact):
        laws = [laws] * len(cells)
    # Many sites have few laws, and most share the objects: each object is looked at once.
    objects = {id(law): law for law in laws}
    distinct = tuple(dict.fromkeys(objects.values()))
    order = {law: number for number, law in enumerate(distinct)}
    numbers = {key: order[law] for key, law in objects.items()}

    table["cell"] = cells
    table["law"] = [numbers[id(law)] for law in laws]
    if isinstance(pairs, Pair):
        pairs = [pairs] * len(cells)
    of_sites = np.fromiter(chain.from_iterable(pairs), np.int64, count=3 * len(cells))  # far faster than by np.array
    table["host"], table["resonator"], table["offset"] = of_sites.reshape(-1, 3).T
    table["clearance"] = clearances
    if gaps is None:
        gaps = np.column_stack([table["clearance"]] * 2)
    table["plus"], table["minus"] = np.asarray(gaps, float).reshape(-1, 2).T
    return Sites(table, distinct)
