"""The section ``[initial]`` of a run: the motion at t = 0, and the numbers that follow from it."""

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from vipetsc.case.case_file import Valid
from vipetsc.case.places import Place, Places
from vipetsc.case.schema import Finite, LatticeTable, Positive, Wavenumber
from vipetsc.case.section import CaseError, Problem, Section, described
from vipetsc.io.names import file_hash, resolved_path
from vipetsc.io.state import State
from vipetsc.lattice import Chain, UnitCell, bloch
from vipetsc.lattice.modes import mode_frequency, mode_shape, number_near
from vipetsc.lattice.packet import Packet, gaussian_packet
from vipetsc.wording import shortened

# So many widths from its middle the envelope of a packet is below 1e-10 of its height, as exp(-6.8^2/2) is: a fraction
# of a clearance to which contacts are located.
PACKET_WIDTHS = 6.8


class KindKeys(NamedTuple):
    """The keys of one kind of motion: all that it ``needs``, those of which it needs ``one_of``, and the ``others``.

    A motion that ``is_scaled`` needs either an amplitude or an energy, too.
    """

    needs: tuple[str, ...] = ()
    one_of: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    is_scaled: bool = False

    @property
    def choices(self) -> list[tuple[str, ...]]:
        """Groups of keys; a motion needs exactly one key of each group."""
        groups = []
        if self.one_of:
            groups.append(self.one_of)
        if self.is_scaled:
            groups.append(("amplitude", "energy"))
        return groups


KINDS = {
    "zero": KindKeys(),
    "mode": KindKeys(one_of=("number", "near"), others=("frequency",), is_scaled=True),
    "packet": KindKeys(
        needs=("band", "wavenumber", "cell", "width"), others=("direction", "frequency"), is_scaled=True
    ),
    "velocity": KindKeys(needs=("cell", "velocity"), others=("mass", "more", "amplitude", "frequency")),
    "file": KindKeys(needs=("path",), others=("time", "orbit", "sha256", "amplitude", "frequency")),
}


class StrikeTable(Section):
    """The initial ``velocity`` in m/s of one ``mass`` of a ``cell`` (from 1)."""

    cell: int = described("cell of the mass", ge=1)
    mass: int = described("number of the mass in the cell", 1, ge=1)
    velocity: Finite = described("velocity of this mass at t = 0", unit="m/s")
    place: Place | None = described("a strip: cell [i, j] or [i, j, mass], instead of cell and mass", None)
    places: Places | None = described("a strip: cells whose masses are struck, instead of cell and mass", None)


class InitialTable(Section):
    """The state of the lattice at t = 0.

    A mode begins at its turning point. A packet is Gaussian, of the waves of a band about a wavenumber. Masses that are
    not struck, and cells that a file lacks, are at rest.
    """

    kind: Literal["zero", "mode", "packet", "velocity", "file"] = described(
        "initial state: rest, a linear mode, a wave packet, struck masses, or a state from a file", "zero"
    )
    number: int | None = described("mode: number of the mode; the lowest is 1", None, ge=1)
    near: Positive | None = described(
        "mode: frequency to which the mode is nearest, instead of a number", None, unit="rad/s"
    )
    band: int | None = described("packet: pass band of its waves", None, ge=1)
    wavenumber: Wavenumber | None = described(
        'packet: mean wavenumber; multiples of pi as "5pi/9"', None, unit="rad/cell"
    )
    cell: int | None = described("packet: cell at its centre; velocity: cell of the struck mass", None, ge=1)
    width: Annotated[float, Field(ge=1, le=1e4)] | None = described(
        "packet: standard deviation of the envelope", None, unit="cells"
    )
    direction: Literal[1, -1] | None = described("packet: towards higher cells (1) or lower cells (-1)", None)
    amplitude: Positive | None = described(
        "mode or packet: largest displacement; filled in for a file or a velocity", None, unit="m"
    )
    energy: Positive | None = described("mode or packet: energy, instead of an amplitude", None, unit="J")
    path: str | None = described(
        "file: path of a run, a branch or a state; a relative one: in the folder of the case file, else in"
        " the current folder",
        None,
    )
    time: Annotated[float, Field(ge=0)] | None = described(
        "file of a run: time of the sample; default: the last sample", None, unit="s"
    )
    orbit: int | None = described("file of a branch: number of the orbit, from 1; default: the last", None, ge=1)
    sha256: str | None = described("file: its SHA-256 hash, filled in", None)
    mass: int | None = described("velocity: number of the struck mass in its cell; default: 1", None, ge=1)
    velocity: Finite | None = described("velocity: velocity of the struck mass at t = 0", None, unit="m/s")
    place: Place | None = described("a strip: cell [i, j] or [i, j, mass], instead of cell and mass", None)
    places: Places | None = described("a strip: cells whose masses are struck, instead of cell and mass", None)
    more: list[StrikeTable] | None = described("velocity: further struck masses, `[[initial.more]]`", None)
    frequency: Positive | None = described(
        "frequency of the motion, to which tolerances refer where nothing is driven; filled in", None, unit="rad/s"
    )

    def __hash__(self) -> int:
        # Engines keep their tables by model, whose hash includes this one; the list ``more`` has none.
        return hash(self.model_dump_json())

    @property
    def strikes(self) -> list[tuple[str, StrikeTable]]:
        """The masses that are struck, by the path of their keys; [] for another kind, or where keys are missing."""
        if self.kind != "velocity" or self.cell is None or self.velocity is None:
            return []
        first = StrikeTable(cell=self.cell, mass=self.mass or 1, velocity=self.velocity)
        others = [(f"initial.more[{i}]", strike) for i, strike in enumerate(self.more or [], 1)]
        return [("initial", first), *others]

    @property
    def moves(self) -> bool:
        """Whether there is motion at t = 0."""
        return self.kind != "zero"

    def is_at_rest(self, cell: int, ring: int | None = None) -> bool:
        """Return whether all masses of the ``cell`` (from 1) are at rest at t = 0; False if that is not known.

        ``ring`` is the number of cells of a ring, around which a packet may reach.
        """
        if self.kind == "packet" and self.cell and self.width:
            distance = abs(cell - self.cell)
            if ring:
                distance = min(distance, ring - distance)
            return distance > PACKET_WIDTHS * self.width
        if self.kind == "velocity":
            return all(strike.cell != cell for _, strike in self.strikes)
        return not self.moves

    def describe(self) -> str:
        """Return the description of the motion; empty for a lattice at rest."""
        if self.kind == "velocity":
            return self._describe_strikes()
        if self.kind == "file":
            text = str(self.path)
            if self.time is not None:
                text += f" at {self.time:g} s"
            if self.orbit is not None:
                text += f", orbit {self.orbit}"
            return text

        size = f"{self.energy or 0.0:.4g} J"
        if self.amplitude:
            size = f"{self.amplitude:.4g} m"
        if self.frequency:
            size += f", Om = {self.frequency:.4f} rad/s"
        if self.kind == "mode":
            return f"mode {self.number or f'near {self.near:g} rad/s'}, {size}"
        if self.kind == "packet":
            return (
                f"a packet of band {self.band} about kappa = {(self.wavenumber or 0) / np.pi:.4f} pi,"
                f" {self.width:g} cells wide in cell {self.cell}, {size}"
            )
        return ""

    def _describe_strikes(self) -> str:
        """Return the first of the masses that are struck, and the number of all if there are more."""
        return shortened([f"{one.velocity:g} m/s of mass {one.mass} of cell {one.cell}" for _, one in self.strikes])

    def packet(self, cell: UnitCell) -> Packet:
        """Return the packet, of 1 m; only of that kind."""
        assert self.band and self.wavenumber and self.cell and self.width
        return gaussian_packet(
            cell,
            self.band,
            kappa=self.wavenumber,
            centre=self.cell - 1,
            width=self.width,
            direction=self.direction or 1,
        )


class Beginning(NamedTuple):
    """The resolved ``section``, the ``frequency`` in rad/s of the motion, and its ``cell`` (1-based).

    The cell is the middle of a packet, that of the fastest mass that is struck, or that of the largest displacement of
    a state; for a mode, which is everywhere, it is the first one. ``moving`` are the cells (1-based) of a state from a
    file in which some mass moves or is displaced; it is None where the section alone says what is at rest.
    """

    section: InitialTable
    frequency: float
    cell: int
    moving: frozenset[int] | None = None


def check_initial(
    initial: InitialTable, lattice: LatticeTable, cell: UnitCell | None, valid: Valid
) -> Iterator[Problem]:
    """Yield problems with the keys of the section ``initial``, and with its cells, bands and modes in a ``lattice``.

    ``cell`` is the lattice's, None if it is invalid.
    """
    keys = KINDS[initial.kind]
    given = initial.model_dump(exclude_none=True, exclude={"kind"})
    taken = {*keys.needs, *keys.others, *itertools.chain(*keys.choices)}
    for key in sorted(given.keys() - taken):
        yield Problem(f"initial.{key}", given[key], f"does not apply to the kind {initial.kind!r}")
    for key in keys.needs:
        if key not in given and valid(f"initial.{key}"):
            yield Problem(f"initial.{key}", None, f"missing; kind = {initial.kind!r} needs {', '.join(keys.needs)}")
    for group in keys.choices:
        if len(given.keys() & {*group}) != 1 and valid(*(f"initial.{key}" for key in group)):
            yield Problem(f"initial.{group[0]}", given.get(group[0]), f"give one of {' and '.join(group)}")

    yield from _check_strikes(initial, cell)
    # Cells that are named: that of the section itself, of any kind, and those of further masses that are struck.
    others = [(path, strike.cell) for path, strike in initial.strikes[1:]]
    for path, at in [("initial", initial.cell), *others]:
        if at and valid("lattice.cells") and at > lattice.cells:
            remedy = f"outside the lattice; cells are numbered from 1 to {lattice.cells}"
            yield Problem(f"{path}.cell", at, remedy)
    if cell and initial.band and initial.band > cell.dofs:
        yield Problem("initial.band", initial.band, f"the cell has {cell.dofs} bands")

    dofs = None
    if cell and valid("lattice.cells"):
        dofs = lattice.cells * cell.dofs
    if dofs and initial.number and initial.number > dofs:
        yield Problem("initial.number", initial.number, f"the lattice has {dofs} modes")
    elif initial.kind in ("mode", "packet") and cell and not cell.joins_cells:
        remedy = "without springs from cell to cell a lattice has no waves, and only modes of single cells"
        remedy += '; kind = "velocity" gives velocities to masses'
        yield Problem("initial.kind", initial.kind, remedy)
    elif initial.kind == "mode" and (lattice.profiles or lattice.scatter):
        remedy = "modes are not available for lattices with different cells; use a packet, or a state in a file"
        yield Problem("initial.kind", "mode", remedy)


def _check_strikes(initial: InitialTable, cell: UnitCell | None) -> Iterator[Problem]:
    """Yield problems with masses that are struck: not in the ``cell``, struck twice, or without a velocity."""
    places: set[tuple[int, int]] = set()
    for path, strike in initial.strikes:
        if cell and strike.mass > cell.dofs:
            yield Problem(f"{path}.mass", strike.mass, f"the cell has {cell.dofs} masses")
        if (strike.cell, strike.mass) in places:
            yield Problem(f"{path}.cell", strike.cell, f"mass {strike.mass} of this cell is given twice")
        if strike.velocity == 0:
            yield Problem(f"{path}.velocity", 0.0, "must not be zero; give it in m/s")
        places.add((strike.cell, strike.mass))


def beginning_of(
    initial: InitialTable, lattice: LatticeTable, frequency: float | None, touching: Callable[[float], float]
) -> tuple[Beginning | None, list[Problem]]:
    """Return the numbers that follow from a valid section with motion, or the problems with it.

    ``frequency`` in rad/s is that of the case's drive, if it has one. If no springs hold a mass that is struck, its
    frequency is that of a contact, which ``touching`` gives for a speed in m/s.
    """
    # The chain has equal cells and no contacts: modes and packets are those of the linear, uniform lattice.
    chain = Chain(lattice.unit_cell(), lattice.cells, lattice.ends)
    frequency = frequency or initial.frequency
    try:
        if initial.kind == "velocity":
            return _velocity(initial, chain, frequency, touching), []
        resolve = {"mode": _mode, "packet": _packet, "file": _file}[initial.kind]
        return resolve(initial, chain, frequency), []
    except CaseError as error:
        return None, error.problems


def _mode(initial: InitialTable, chain: Chain, frequency: float | None) -> Beginning:
    """Return the beginning with a mode, which is given by its number and its amplitude."""
    number = initial.number or number_near(chain, initial.near or 0.0)
    omega = mode_frequency(chain, number)
    if omega == 0:
        raise CaseError([Problem("initial.number", number, "the frequency of this mode is 0; choose another mode")])

    update: dict[str, Any] = {"number": number, "near": None}
    if initial.energy:
        # At its turning point a mode's energy is that of its springs, omega^2 a^2 / 2 times the sum of m phi^2.
        weights = mode_shape(chain, number) ** 2 @ np.asarray(chain.cell.masses)
        update["amplitude"] = float(np.sqrt(2 * initial.energy / weights.sum()) / omega)
        update["energy"] = None
    return Beginning(initial.model_copy(update=update), frequency or omega, cell=1)


def _packet(initial: InitialTable, chain: Chain, frequency: float | None) -> Beginning:
    """Return the beginning with a packet, whose size is given by its amplitude."""
    assert initial.band and initial.wavenumber and initial.cell
    omega = float(bloch(chain.cell, initial.wavenumber).frequency[initial.band - 1])
    if initial.energy:
        # The energy of the packet of 1 m grows with the square of its amplitude.
        amplitude = float(np.sqrt(initial.energy / initial.packet(chain.cell).energy))
        initial = initial.model_copy(update={"amplitude": amplitude, "energy": None})
    return Beginning(initial, frequency or omega, cell=initial.cell or 1)


def _velocity(
    initial: InitialTable, chain: Chain, frequency: float | None, touching: Callable[[float], float]
) -> Beginning:
    """Return beginning with masses that are struck; their amplitude is that of a sine of their speed and frequency."""
    _, fastest = max(initial.strikes, key=lambda item: abs(item[1].velocity))
    speed = abs(fastest.velocity)
    if not frequency:
        # The frequency of the fastest mass on its springs while all others are held.
        mass = fastest.mass - 1
        stiffness = sum(end.stiffness for end in chain.cell.couplings() if end.mass == mass)
        frequency = float(np.sqrt(stiffness / chain.cell.masses[mass]))
        if not chain.cell.joins_cells:
            # What goes on to other cells goes through contacts.
            frequency = max(frequency, touching(speed))
    amplitude = initial.amplitude or speed / frequency
    return Beginning(initial.model_copy(update={"amplitude": amplitude}), frequency, fastest.cell)


def _file(initial: InitialTable, chain: Chain, frequency: float | None) -> Beginning:
    """Return the beginning with a state in a file, which is given by its path, hash and largest displacement."""
    # A section with a hash is resolved, and is taken as it is: results are read where that file is gone.
    if initial.sha256 and initial.amplitude and frequency:
        return Beginning(initial, frequency, cell=1)

    path, state, digest = _read_state(initial)
    # The lattice is checked before the numbers, since a state of another lattice has no meaning here.
    _check_state(state, path, initial, chain)
    frequency = frequency or state.frequency()
    if not frequency:
        remedy = "contains no frequency; give initial.frequency, the frequency of the motion in rad/s"
        raise CaseError([Problem("initial.path", initial.path, remedy)])

    amplitude, cell = state.largest(frequency)
    if amplitude == 0:
        raise CaseError([Problem("initial.path", initial.path, "the state in it is at rest")])
    update = {"path": str(path), "sha256": digest, "amplitude": amplitude, "time": state.time, "orbit": state.orbit}
    return Beginning(initial.model_copy(update=update), frequency, cell, state.moving())


def _read_state(initial: InitialTable) -> tuple[Path, State, str]:
    """Return the path of the file that the section names, the state in it, and its hash; raises CaseError."""
    try:
        path = resolved_path(str(initial.path))
        return path, State.read(path, initial.time, initial.orbit), file_hash(path)
    except (OSError, ValueError, KeyError) as error:
        raise CaseError([Problem("initial.path", initial.path, str(error))]) from None


def _check_state(state: State, path: Path, initial: InitialTable, chain: Chain) -> None:
    """Raise CaseError for a state of another lattice, and for an instant or an orbit that its file does not have."""
    if state.velocity.shape[1] != chain.cell.dofs or not np.all((state.cell >= 1) & (state.cell <= chain.cells)):
        here = f"{chain.cells} cells of {chain.cell.dofs} masses"
        held = f"cells up to {state.cell.max(initial=0)} of {state.velocity.shape[1]} masses"
        raise CaseError([Problem("initial.path", initial.path, f"the state has {held}, the lattice {here}")])
    for key, value in (("time", initial.time), ("orbit", initial.orbit)):
        if value is not None and getattr(state, key) is None:
            raise CaseError([Problem(f"initial.{key}", value, f"{path.name} has no such sample or orbit")])
