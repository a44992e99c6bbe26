"""The section of a case about its contact sites: their cells, laws and stops."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, create_model

from vipetsc.case.case_file import Section
from vipetsc.case.parts import PartName
from vipetsc.case.schema import MOST_SITES, Finite, NotNegative, Positive
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

    first: int
    last: int | None = None
    spacing: int | None = Field(None, ge=1)
    count: int = Field(ge=1, le=MOST_SITES)


class ClearanceSpan(Section):
    """Clearances in m, log-spaced from the first to the last site."""

    first: Positive
    last: Positive


def bounded(parameter: LawParameter) -> Any:
    """The type of a value of a law's ``parameter``."""
    return Annotated[float, Field(ge=parameter.least, le=parameter.most)]


if TYPE_CHECKING:
    # For the type checker, which does not see keys that are created at run time.
    class ElasticLaw(Section):
        """The law of all sites, and its parameters."""

        law: Law = "hertz"

    class ElasticLaws(Section):
        """The law of each site, and their parameters."""

        law: list[Law] | None = None

else:
    # The parameters of elastic laws are declared where the laws are: each is a key here, behind that of the law.
    ElasticLaw = create_model(
        "ElasticLaw",
        __base__=Section,
        law=(Law, "hertz"),
        **{key: (bounded(parameter) | None, None) for key, parameter in PARAMETERS.items()},
    )
    ElasticLaws = create_model(
        "ElasticLaws",
        __base__=Section,
        law=(list[Law] | None, None),
        **{key: (list[bounded(parameter)] | None, None) for key, parameter in PARAMETERS.items()},
    )


class PerSiteTable(ElasticLaws):
    """Quantities that differ from site to site: lists with one value per site."""

    modulus: list[Positive] | None = None
    radius: list[Positive] | None = None
    poisson: list[Poisson] | None = None
    stiffness: list[Positive] | None = None
    restitution: list[Restitution] | None = None
    damping: list[Damping] | None = None
    parameters: list[dict[str, Finite]] | None = None
    pair: list[Ends] | None = None
    next_cell: list[bool] | None = None
    precompression: list[NotNegative] | None = None
    side: list[Side] | None = None
    clearance_minus: list[NotNegative] | None = None


class ContactsTable(ElasticLaw):
    """Contact law, stiffness (given, or from modulus in Pa, radius in m, Poisson ratio), sites, clearances.

    ``damping`` is the name of a dissipation factor, see ``vipetsc.lattice.Contact``; by default it is ``paper``, which
    is that of ``hunt-crossley``. ``parameters`` are those of a law that a module registers. ``side``: the sides of
    w = u_resonator - u_host that have stops; ``clearance_minus`` is the clearance on the side -, if it differs.
    ``pair``: host (0 is ground) and resonator, which is in the next cell if ``next_cell``; ``precompression``: static
    indentation in m, from which displacements count. ``each`` has lists over the sites.
    """

    modulus: Positive | None = None
    radius: Positive | None = None
    poisson: Poisson | None = None
    stiffness: Positive | None = None
    restitution: Restitution = 1.0
    damping: Damping | None = None
    parameters: dict[str, Finite] | None = None
    sites: Annotated[int, Field(ge=0, le=MOST_SITES)] | list[int] | Span = 0
    clearance: NotNegative | list[NotNegative] | ClearanceSpan | None = None
    clearance_minus: NotNegative | None = None
    side: Side | None = None
    pair: Ends | None = None
    next_cell: bool | None = None
    precompression: Positive | None = None
    each: PerSiteTable | None = None
    adhesion: Literal["allow", "clip"] = "allow"
    approach_floor: NotNegative = 0.0
