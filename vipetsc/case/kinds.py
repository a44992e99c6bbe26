"""Kinds of sites: sites of one kind have one scattering law, a function of the amplitude over the clearance.

A kind is the law of the contact with its restitution, the clearances on the two sides over the lesser one, and the
masses that the contact joins. The lesser clearance itself may differ between sites of one kind.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vipetsc.case.contacts import JOINS, SIDES, Gaps, gaps_of_sites, lists_of
from vipetsc.case.model import Model
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import Contact
from vipetsc.lattice.chain import Pair
from vipetsc.lattice.contact import LAWS, PARAMETERS

NO_SITES: dict[str, Any] = {"sites": [], "clearance": [], **dict.fromkeys(("each", *SIDES, *JOINS))}
"""Changes of ``[contacts]`` that leave no site; None removes a key."""
DIGITS = 12  # of the ratio of two clearances: sites of one kind differ by rounding


class SiteKind(NamedTuple):
    """The properties that sites of one kind have in common.

    ``sides`` are the clearances on the sides + and - over the lesser of both; inf stands for no stop.
    """

    law: Contact
    sides: tuple[float, float]
    pair: Pair


class SiteKinds(NamedTuple):
    """The ``kinds`` of a lattice's sites in the order of their first site, and the number of each site's (``of``)."""

    kinds: tuple[SiteKind, ...]
    of: tuple[int, ...]

    def sites(self, kind: int) -> list[int]:
        """The sites (from 0) of the ``kind`` of that number."""
        return [site for site, number in enumerate(self.of) if number == kind]


def lesser_clearances(gaps: Gaps, clearances: Sequence[float]) -> np.ndarray:
    """Clearance (site,) in m on the side where it is less; ``gaps`` are those of both sides, () if they are equal."""
    if not gaps:
        return np.array(clearances, float)
    return np.min(np.array(gaps), axis=1)


def site_kinds(model: Model) -> SiteKinds:
    """The kinds of the sites of a ``model`` whose clearances are above 0."""
    chain = model.chain
    count = len(chain.sites)
    laws = model.laws or (model.contact,) * count
    gaps = model.gaps or tuple((gap, gap) for gap in chain.clearances)

    number: dict[SiteKind, int] = {}
    of = []
    for law, (plus, minus), pair in zip(laws, gaps, chain.contact_pairs, strict=True):
        lesser = min(plus, minus)
        sides = (round(plus / lesser, DIGITS), round(minus / lesser, DIGITS))
        of.append(number.setdefault(SiteKind(law=law, sides=sides, pair=pair), len(number)))
    return SiteKinds(kinds=tuple(number), of=tuple(of))


def mean_clearance(contacts: ContactsTable, clearances: Sequence[float], sites: Sequence[int]) -> float:
    """Geometric mean in m of the lesser clearances of those ``sites`` (from 0), all above 0."""
    # Geometric, since the law depends on ratios of amplitudes to clearances.
    lesser = lesser_clearances(gaps_of_sites(contacts, list(clearances)), clearances)
    return float(np.exp(np.mean(np.log(lesser[list(sites)]))))


def contacts_of_one(contacts: ContactsTable, site: int, kind: SiteKind, cell: int, clearance: float) -> dict[str, Any]:
    """Changes of ``[contacts]`` that leave a single site of a ``kind`` in ``cell`` (from 1).

    ``clearance`` in m is its lesser clearance; ``site`` (from 0) is a site of that kind in ``contacts``.
    """
    # The values of this site in the lists become those of all sites, of which one is left.
    of_site = {key: values[site] for key, values in lists_of(contacts).items()}
    if "stiffness" in of_site:
        # The stiffness of the site is that of its own material.
        of_site |= dict.fromkeys(("modulus", "radius", "poisson"))

    # Parameters of other laws, which the lists may have for other sites, are removed.
    law = kind.law.law
    of_site |= {key: None for key, parameter in PARAMETERS.items() if parameter.law != law}
    if law in LAWS:
        of_site["parameters"] = None

    changes: dict[str, Any] = of_site | {"each": None} | dict.fromkeys(SIDES)
    plus, minus = kind.sides
    if minus == np.inf:
        changes["side"] = "plus"
    elif plus == np.inf:
        changes["side"] = "minus"
    elif plus != minus:
        changes["clearance_minus"] = clearance * minus
    # The key ``clearance`` is that of the side +, or of the side - if stops are on that side alone.
    first = clearance
    if plus < np.inf:
        first *= plus
    return changes | {"sites": [cell], "clearance": [first]}
