"""The section ``[initial]`` of a run: the motion that it begins with, and the numbers that follow from it."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from vipetsc.case.case_file import CaseError, Problem, Section, Table, Valid
from vipetsc.case.schema import LatticeTable, Positive, Wavenumber
from vipetsc.io.state import State
from vipetsc.lattice import Chain, UnitCell, bloch
from vipetsc.lattice.modes import mode_frequency, mode_shape, number_near
from vipetsc.lattice.packet import Packet, gaussian_packet

# Which keys a kind needs all of, and of which it needs one; others that it takes.
NEEDS: dict[str, tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]] = {
    "zero": ((), (), ()),
    "mode": ((), ("number", "near"), ()),
    "packet": (("band", "wavenumber", "cell", "width"), (), ("direction",)),
    "file": (("path",), (), ("time", "orbit", "sha256", "amplitude")),
}
SCALED = "mode", "packet"  # kinds that want one of amplitude and energy


class InitialTable(Section):
    """What a run begins with at t = 0.

    ``zero``: at rest. ``mode``: mode ``number`` of the lattice without contacts, from 1, lowest first, or the one
    ``near`` a frequency in rad/s, at its turning point. ``packet``: Gaussian, of the waves of a ``band`` about a
    ``wavenumber``, ``width`` cells its standard deviation, in the middle of the ``cell``, that goes up the cells
    (``direction`` 1) or down (-1). Both have an ``amplitude``, the largest displacement of the packet's envelope or of
    the mode in m, or an ``energy`` in J. ``file``: the state in the file ``path``: of a run at ``time`` in s, of a
    branch's ``orbit`` (from 1), the last if not told, or a state alone; cells that are not in it are at rest. Its
    ``sha256`` and ``amplitude`` are filled in.
    """

    kind: Literal["zero", "mode", "packet", "file"] = "zero"
    number: int | None = Field(None, ge=1)
    near: Positive | None = None
    band: int | None = Field(None, ge=1)
    wavenumber: Wavenumber | None = None
    cell: int | None = Field(None, ge=1)
    width: Annotated[float, Field(ge=1, le=1e4)] | None = None
    direction: Literal[1, -1] | None = None
    amplitude: Positive | None = None
    energy: Positive | None = None
    path: str | None = None
    time: Annotated[float, Field(ge=0)] | None = None
    orbit: int | None = Field(None, ge=1)
    sha256: str | None = None

    @property
    def moves(self) -> bool:
        """Whether there is motion at t = 0."""
        return self.kind != "zero"

    def packet(self, cell: UnitCell) -> Packet:
        """The packet, of 1 m; only of that kind."""
        assert self.band and self.wavenumber and self.cell and self.width
        return gaussian_packet(cell, self.band, self.wavenumber, self.cell - 1, self.width, self.direction or 1)


class Beginning(NamedTuple):
    """The resolved section, the frequency in rad/s of the motion, the cell (1-based) in its middle."""

    table: Table
    frequency: float
    cell: int


def check_initial(
    initial: InitialTable, lattice: LatticeTable, cell: UnitCell | None, valid: Valid
) -> Iterator[Problem]:
    """What is wrong with the keys of a section."""
    needed, one_of, others = NEEDS[initial.kind]
    ways = [one_of, ("amplitude", "energy")] if initial.kind in SCALED else [one_of]
    given = initial.model_dump(exclude_none=True, exclude={"kind"})
    known = {*needed, *others, *(key for way in ways for key in way)}
    for key in given.keys() - known:
        yield Problem(f"initial.{key}", given[key], f"belongs to another kind than {initial.kind!r}")
    for key in needed:
        if key not in given and valid(f"initial.{key}"):
            yield Problem(f"initial.{key}", None, f"missing; kind = {initial.kind!r} needs {', '.join(needed)}")
    for way in filter(None, ways):
        if len(given.keys() & {*way}) != 1 and valid(*(f"initial.{key}" for key in way)):
            yield Problem(f"initial.{way[0]}", given.get(way[0]), f"give one of {' and '.join(way)}")
    if initial.cell and valid("lattice.cells") and initial.cell > lattice.cells:
        remedy = f"outside the lattice; cells count from 1 to {lattice.cells}"
        yield Problem("initial.cell", initial.cell, remedy)
    if cell and initial.band and initial.band > cell.dofs:
        yield Problem("initial.band", initial.band, f"the cell has {cell.dofs} bands")
    dofs = lattice.cells * cell.dofs if cell and valid("lattice.cells") else None
    if dofs and initial.number and initial.number > dofs:
        yield Problem("initial.number", initial.number, f"the lattice has {dofs} modes")
    elif initial.kind == "mode" and (lattice.profiles or lattice.scatter):
        yield Problem(
            "initial.kind", "mode", "the mode of a lattice whose cells differ; a packet, or a state in a file"
        )


def beginning_of(
    initial: InitialTable, lattice: LatticeTable, frequency: float | None
) -> tuple[Beginning | None, list[Problem]]:
    """What follows from a valid section, or what is wrong with it; ``frequency`` in rad/s is the case's, if any."""
    chain = Chain(lattice.unit_cell(), lattice.cells, lattice.ends)
    read = {"mode": _mode, "packet": _packet, "file": _file}[initial.kind]
    try:
        table, told, cell = read(initial, chain, frequency)
    except CaseError as error:
        return None, error.problems
    table = initial.model_dump(exclude_none=True) | table
    return Beginning({k: v for k, v in table.items() if v is not None}, told, cell), []


def _mode(initial: InitialTable, chain: Chain, frequency: float | None) -> tuple[Table, float, int]:
    number = initial.number or number_near(chain, initial.near or 0.0)
    omega = mode_frequency(chain, number)
    if omega == 0:
        raise CaseError([Problem("initial.number", number, "the frequency of this mode is 0; another one moves")])
    table: Table = {"number": number, "near": None}
    if initial.energy:
        weights = mode_shape(chain, number) ** 2 @ np.asarray(chain.cell.masses)
        table |= {"amplitude": float(np.sqrt(2 * initial.energy / weights.sum()) / omega), "energy": None}
    return table, frequency or omega, 1


def _packet(initial: InitialTable, chain: Chain, frequency: float | None) -> tuple[Table, float, int]:
    assert initial.band and initial.wavenumber and initial.cell
    omega = float(bloch(chain.cell, initial.wavenumber).frequency[initial.band - 1])
    table: Table = {}
    if initial.energy:
        table = {"amplitude": float(np.sqrt(initial.energy / initial.packet(chain.cell).energy)), "energy": None}
    return table, frequency or omega, initial.cell


def _file(initial: InitialTable, chain: Chain, frequency: float | None) -> tuple[Table, float, int]:
    """A resolved section, which has a hash, is taken as it is: runs are read where their file is gone."""
    if initial.sha256 and initial.amplitude and frequency:
        return {}, frequency, 1
    path = Path(str(initial.path)).resolve()
    try:
        state, digest = State.read(path, initial.time, initial.orbit), file_hash(path)
    except (OSError, ValueError, KeyError) as error:
        raise CaseError([Problem("initial.path", initial.path, str(error))]) from None
    if state.velocity.shape[1] != chain.cell.dofs or not np.all((state.cell >= 1) & (state.cell <= chain.cells)):
        here = f"{chain.cells} cells of {chain.cell.dofs} masses"
        held = f"cells up to {state.cell.max(initial=0)} of {state.velocity.shape[1]} masses"
        raise CaseError([Problem("initial.path", initial.path, f"the state has {held}, the lattice {here}")])
    for key, value in (("time", initial.time), ("orbit", initial.orbit)):
        if value is not None and getattr(state, key) is None:
            raise CaseError([Problem(f"initial.{key}", value, f"{path.name} has no such thing")])
    frequency = frequency or state.frequency()
    if not frequency:
        remedy = "tells no frequency; give drive.frequency, that of the motion in rad/s, and drive.amplitude = 0"
        raise CaseError([Problem("initial.path", initial.path, remedy)])
    amplitude, cell = state.largest(frequency)
    if amplitude == 0:
        raise CaseError([Problem("initial.path", initial.path, "the state in it is at rest")])
    table: Table = {"path": str(path), "sha256": digest, "amplitude": amplitude}
    return table | {"time": state.time, "orbit": state.orbit}, frequency, cell


def file_hash(path: str | Path) -> str:
    """The SHA-256 of a file."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
