"""Measures of whole frequency responses, for searches: their names, and what they are of."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from vipetsc.case.nfrc.table import NfrcTable
from vipetsc.case.schema import LatticeTable, OutputTable
from vipetsc.lattice import Chain, nonlinear_springs
from vipetsc.spectra.measures import JOINT
from vipetsc.spectra.responses import LAYOUT, OUTPUTS

RESPONSE = "response/"  # begins the names
FRACTIONS = ("transmitted", "reflected", "upper", "lost")
WALLS = ("left", "right")
OF_POINTS = tuple(f"{kind}_{of}" for kind in ("peak", "first") for of in ("displacement", "velocity", "acceleration"))


class ResponseMeasure(NamedTuple):
    """A quantity of the states of a curve: that of the ``member`` (from 0) of its dimension, or the largest of all.

    ``name`` is that of the measure, ``quantity`` the one in the curve's file, ``unit`` its unit there. ``member`` is a
    number of a site, a point, a pair of points, a wall or a fraction; None for the largest of all.
    """

    name: str
    quantity: str
    member: int | None
    unit: str


def measures_of(
    nfrc: NfrcTable, lattice: LatticeTable, output: OutputTable, chain: Chain
) -> dict[str, ResponseMeasure]:
    """Return the measures, by name, of curves with these sections and this ``chain``: of its sites and outputs."""
    sites = [str(number) for number in range(1, len(chain.sites) + 1)]
    members: dict[str, list[str]] = {}
    if sites:
        members |= {"largest": sites, "closed": sites}
    springs = nonlinear_springs(chain).labels()
    if springs:
        members["largest_elongation"] = springs
    if nfrc.infinite:
        members["share"] = list(FRACTIONS)
    if output.points:
        points = [point.name for point in output.points]
        members |= dict.fromkeys(OF_POINTS, points)
    if output.transmission:
        pairs = [JOINT.join(pair) for pair in output.transmission]
        members |= dict.fromkeys(("transmission", "steady_transmission"), pairs)
    if output.forces:
        members |= dict.fromkeys(("largest_force", "first_force"), sites)
        if lattice.ends == "fixed" and not (nfrc.infinite or nfrc.open_ends):
            members |= {quantity: list(WALLS) for quantity in ("largest_wall_force", "first_wall_force")}

    measures: list[ResponseMeasure] = []
    for quantity, names in members.items():
        unit = (LAYOUT | OUTPUTS)[quantity].units
        if names in (sites, springs):
            measures.append(ResponseMeasure(name=f"{RESPONSE}{quantity}", quantity=quantity, member=None, unit=unit))
        for member, name in enumerate(names):
            named = f"{RESPONSE}{quantity}/{name}"
            measures.append(ResponseMeasure(name=named, quantity=quantity, member=member, unit=unit))
    return {measure.name: measure for measure in measures}


def value_of(measures: Mapping[str, ResponseMeasure], name: str, quantities: Mapping[str, Any]) -> float:
    """Return the value of a measure, by its name without ``RESPONSE``, in a state with these ``quantities``.

    A name without a measure, such as ``frequency``, is that of a quantity that is one number.
    """
    measure = measures.get(f"{RESPONSE}{name}")
    if measure is None:
        return float(quantities[name])
    values = quantities[measure.quantity]
    if measure.member is None:
        return float(values.max())
    return float(values[measure.member])
