"""The section of a case about its contact sites: their cells, laws and stops."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, create_model

from vipetsc.case.parts import PartName
from vipetsc.case.places import Pair, Places
from vipetsc.case.schema import MOST_SITES, Finite, NotNegative, Positive
from vipetsc.case.section import BY_SHAPE, Section, described
from vipetsc.lattice.contact import DAMPINGS, LAWS, PARAMETERS, LawParameter
from vipetsc.register import DISSIPATION, LAW

Ends = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]  # host (0: ground), resonator
Side = Literal["both", "plus", "minus"]
Restitution = Annotated[float, Field(ge=0, le=1)]
Poisson = Annotated[float, Field(gt=-1, le=0.5)]
Law = Annotated[str, PartName(LAW, LAWS)]
Damping = Annotated[str, PartName(DISSIPATION, DAMPINGS)]


class Span(Section):
    """``count`` sites evenly from cell ``first`` to cell ``last`` (1-based), or every ``spacing``-th from ``first``."""

    first: int = described("cell of the first site")
    last: int | None = described("cell of the last site", None)
    spacing: int | None = described("cells between neighbouring sites, instead of `last`", None, ge=1)
    count: int = described("number of sites", ge=1, le=MOST_SITES)


class ClearanceSpan(Section):
    """Clearances in m, log-spaced from the first to the last site."""

    first: Positive = described("clearance of the first site", unit="m")
    last: Positive = described("clearance of the last site", unit="m")


OF_LAW: Any = described(
    "force over indentation: power 3/2, linear, the power `exponent`, or a stop that does not yield (rigid)", "hertz"
)
OF_LAWS: Any = described("contact law of each site", None)


def bounded(parameter: LawParameter) -> Any:
    """Return the type of a value of a law's ``parameter``."""
    return Annotated[float, Field(ge=parameter.least, le=parameter.most)]


if TYPE_CHECKING:
    # For the type checker, which does not see keys that are created at run time.
    class ElasticLaw(Section):
        """The law of all sites, and its parameters."""

        law: Law = OF_LAW

    class ElasticLaws(Section):
        """The law of each site, and their parameters."""

        law: list[Law] | None = OF_LAWS

else:
    # The parameters of elastic laws are declared where the laws are: each is a key here, behind that of the law.
    ElasticLaw = create_model(
        "ElasticLaw",
        __base__=Section,
        law=(Law, OF_LAW),
        **{
            key: (bounded(parameter) | None, described(parameter.text, None, unit=parameter.unit))
            for key, parameter in PARAMETERS.items()
        },
    )
    ElasticLaws = create_model(
        "ElasticLaws",
        __base__=Section,
        law=(list[Law] | None, OF_LAWS),
        **{
            key: (list[bounded(parameter)] | None, described(f"{key} of each site", None, unit=parameter.unit))
            for key, parameter in PARAMETERS.items()
        },
    )


class PerSiteTable(ElasticLaws):
    """Quantities that differ from site to site: lists with one value per site."""

    modulus: list[Positive] | None = described("Young's modulus of each site", None, unit="Pa")
    radius: list[Positive] | None = described("radius at each site", None, unit="m")
    poisson: list[Poisson] | None = described("Poisson's ratio of each site", None)
    stiffness: list[Positive] | None = described("contact stiffness of each site", None, unit="N/m^n")
    restitution: list[Restitution] | None = described("coefficient of restitution of each site", None)
    damping: list[Damping] | None = described("factor of the dissipation of each site", None)
    parameters: list[dict[str, Finite]] | None = described(
        "parameters of the law of each site, one table per site", None, unit="that of the parameter"
    )
    pair: list[Ends] | None = described("host and resonator of each site", None)
    next_cell: list[bool] | None = described("whether each site's resonator is in the next cell", None)
    precompression: list[NotNegative] | None = described("indentation of each site in the static state", None, unit="m")
    side: list[Side] | None = described("side of the stop of each site", None)
    clearance_minus: list[NotNegative] | None = described(
        "clearance of each site for negative relative displacement", None, unit="m"
    )


# Units of the stiffness of a law whose exponent has no key.
STIFFNESS_UNITS = {"hertz": "N/m^1.5", "bilinear": "N/m"}


class ContactsTable(ElasticLaw):
    """Contact law, stiffness (given, or from modulus in Pa, radius in m, Poisson ratio), sites, clearances.

    The sides are those of w = u_resonator - u_host.
    """

    modulus: Positive | None = described(
        "Young's modulus; with `radius` and `poisson`, instead of `stiffness`", None, unit="Pa"
    )
    radius: Positive | None = described(
        "radius R of a sphere at a flat stop of the same material; R1 R2/(R1 + R2) for two spheres", None, unit="m"
    )
    poisson: Poisson | None = described("Poisson's ratio", None)
    stiffness: Positive | None = described("contact stiffness; n is the exponent of the law", None, unit="N/m^n")
    restitution: Restitution = described("coefficient of restitution; 1 conserves energy", 1.0)
    damping: Damping | None = described(
        "factor of the dissipation: the paper's (Hunt and Crossley), another by name, or the one whose"
        " effective restitution equals `restitution` (exact)",
        None,
    )
    parameters: dict[str, Finite] | None = described(
        "parameters of a law that a module of [plugins] registers", None, unit="that of the parameter"
    )
    sites: Annotated[Annotated[int, Field(ge=0, le=MOST_SITES)] | list[int] | Span, BY_SHAPE] = described(
        "cells with stops: a number of sites spread as in the paper, a list of cells, or an even spacing", 0
    )
    clearance: Annotated[NotNegative | list[NotNegative] | ClearanceSpan, BY_SHAPE] | None = described(
        "clearance of all sites, of each site, or log-spaced; default: the preset's", None, unit="m"
    )
    clearance_minus: NotNegative | None = described(
        "clearance for negative relative displacement, if it differs", None, unit="m"
    )
    side: Side | None = described(
        "sign of the relative displacement (resonator - host) at which there is a stop; default: both signs", None
    )
    pair: Ends | None = described("host and resonator, instead of those of the cell; host 0 is the ground", None)
    next_cell: bool | None = described("whether the resonator is in the next cell, as in a chain of beads", None)
    places: Places | None = described("a strip: cells with stops, instead of sites; `pair` is by default [0, 1]", None)
    offset: Pair | None = described("a strip: how many cells [i, j] further the resonator is; i is 0 or 1", None)
    precompression: Positive | None = described(
        "indentation in the static state, from which displacements are measured; for a stop on one side", None, unit="m"
    )
    each: PerSiteTable | None = described("quantities that differ from site to site", None)
    adhesion: Literal["allow", "clip"] = described(
        "whether the contact force may become tensile at the end of a contact (allow) or is set to zero then (clip)",
        "allow",
    )
    approach_floor: NotNegative = described(
        "smallest approach velocity in the factor of the dissipation", 0.0, unit="m/s"
    )

    @classmethod
    def unit_of(cls, key: str, table: Mapping[str, Any]) -> str:
        """Return the unit of a ``key``; that of the stiffness depends on the law."""
        unit = super().unit_of(key, table)
        if key == "stiffness":
            return STIFFNESS_UNITS.get(table.get("law", "hertz"), unit)
        return unit
