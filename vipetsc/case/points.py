"""Named masses whose motion is recorded at every sample: the keys ``output.points`` and ``output.transmission``."""

from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from vipetsc.case.places import Place
from vipetsc.case.section import Problem, Section, described

NAME = "^[A-Za-z][A-Za-z0-9_]*$"  # of a point, which is part of names in result files
# Points are recorded at every sample, whatever the stride of the fields: displacement, velocity and acceleration of a
# thousand take 24 kB a sample.
MOST_POINTS = 1000


def _cell_or_place(schema: dict[str, Any]) -> None:
    """Let the JSON ``schema`` of a point ask for a cell or a place: a place becomes a cell before it is read."""
    schema["required"].remove("cell")
    schema["anyOf"] = [{"required": ["cell"]}, {"required": ["place"]}]


class PointTable(Section):
    """A ``mass`` of a ``cell``, both counted from 1, whose motion is recorded under its ``name``."""

    model_config = ConfigDict(json_schema_extra=_cell_or_place)

    name: Annotated[str, Field(pattern=NAME, max_length=40)] = described(
        "name of the point in files and measures: letters, digits, underscores"
    )
    cell: int = described("cell of the point; required without a place", ge=1)
    mass: int = described("number of the mass in the cell", 1, ge=1)
    place: Place | None = described("a strip: cell [i, j] or [i, j, mass], instead of cell and mass", None)


def masses_remedy(dofs: int) -> str:
    """Return the remedy for a mass beyond the ``dofs`` masses of a cell: a sentence on the masses that a cell has."""
    if dofs == 1:
        return "a cell has the one mass 1"
    return f"a cell has the masses 1 to {dofs}"


def check_points(
    points: list[PointTable], transmission: list[list[str]], cells: int | None, dofs: int | None
) -> Iterator[Problem]:
    """Yield problems of ``points``, and of ``transmission``, pairs of their names.

    The lattice has ``cells`` with ``dofs`` masses each; a number that is None is invalid, and not checked.
    """
    names = [point.name for point in points]
    for number, point in enumerate(points, 1):
        at = f"output.points[{number}]"
        if cells is not None and point.cell > cells:
            yield Problem(f"{at}.cell", point.cell, f"the lattice has the cells 1 to {cells}")
        if dofs is not None and point.mass > dofs:
            yield Problem(f"{at}.mass", point.mass, masses_remedy(dofs))
        if point.name in names[: number - 1]:
            yield Problem(f"{at}.name", point.name, "names another point too; every point needs a name that differs")

    for number, pair in enumerate(transmission, 1):
        at = f"output.transmission[{number}]"
        missing = [name for name in pair if name not in names]
        if missing:
            listed = ", ".join(names) or "none"
            remedy = f"{', '.join(missing)}: no point of that name in output.points; there are {listed}"
            yield Problem(at, pair, remedy)
        elif pair[0] == pair[1]:
            yield Problem(at, pair, 'names one point twice; give [from, to], as in ["base", "tip"]')
        elif pair in transmission[: number - 1]:
            yield Problem(at, pair, "is listed twice")
