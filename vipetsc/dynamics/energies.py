"""Energies of a distributed state, as sums of integers.

Sums of floating-point numbers depend on their order in the last bits, and so on the number of ranks. Each cell's energy
is therefore a whole number of a unit and a remainder in multiples of unit/2^52; both are summed as integers, whose sums
are exact in any order. The unit is 2^-20 of the run's scale of energy, so that rounding a cell's energy to unit/2^52
loses less than 2^-72 of that scale, and a sum may grow to 2^32 times the scale: that of an undamped resonance does not
stay near the scale, which is the energy of the forced wave.
"""

from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import kernel
from vipetsc.contact.law import elastic_energy
from vipetsc.dynamics.lattice_record import CHUNK, LatticeRecord
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.site_dofs import relative_motion
from vipetsc.dynamics.springs import damping_powers, is_varied, spring_energies

_FINE_BITS = 52
_FINE = 2.0**_FINE_BITS  # multiples of the finer remainder in one unit
_UNIT_BITS = 20  # of the scale of energy in a unit
# Whole multiples from which on a sum counts as a runaway energy, and at which a cell's energy is cut off.
LARGEST = 2.0**52
# Whole multiples at which a sum is cut off. A chunk of cells adds 2^61 at most, so that a sum of 64 bits never
# overflows, however many cells run away at once.
SATURATED = 2**61
# Ranks add their sums in parts of so many bits, as floats, which are exact below 2^53: for up to 2^20 ranks. The whole
# multiples have two such parts, an upper one of 32 bits and a lower one, and so have the remainders.
_PART_BITS = 30
_FINE_PART_BITS = 26
# Energies in J below this fraction of the scale are too small for the balance to be judged: in the first samples of a
# burst of 30 cycles the error may be as large as the work, with either engine. From there on it is below 1e-10 of it.
_NEGLIGIBLE = 1e-8
KINETIC, SPRING, CONTACT, DISSIPATED, DAMPING = range(5)
ENERGY_SUMS = 5


@kernel
def _multiples(energy: float, unit: float) -> tuple[np.int64, np.int64]:
    """Return an ``energy`` in J as a multiple of ``unit`` and one of unit/2^52."""
    multiple = energy * (1.0 / unit)
    whole = np.rint(multiple)
    # An energy that is not finite or far beyond the scale is cut off at LARGEST, where the guard ends the run.
    is_small = abs(whole) < LARGEST
    fine = np.rint((multiple - whole) * _FINE) if is_small else 0.0
    return np.int64(whole if is_small else LARGEST), np.int64(fine)


@kernel
def _add(sums: np.ndarray, kind: int, energies: np.ndarray, unit: float) -> None:
    """Add energies in J to row ``kind`` of ``sums`` (energy, 2), as multiples of ``unit`` and of unit/2^52.

    Whole multiples are cut off at ``SATURATED``.
    """
    for first in range(0, energies.size, CHUNK):
        whole_sum = fine_sum = np.int64(0)
        for i in range(first, min(first + CHUNK, energies.size)):
            whole, fine = _multiples(energies[i], unit)
            whole_sum += whole
            fine_sum += fine
        # Remainders are 2^51 at most: those of a chunk cannot overflow, those of all cells of a rank could.
        _carry(sums, kind, whole_sum, fine_sum)


@kernel
def add_one(sums: np.ndarray, kind: int, energy: float, unit: float) -> None:
    """Add one ``energy`` in J to row ``kind`` of ``sums``, as ``measure`` does."""
    whole, fine = _multiples(energy, unit)
    _carry(sums, kind, whole, fine)


@kernel
def _carry(sums: np.ndarray, kind: int, whole: int, fine: int) -> None:
    """Add a ``whole`` multiple and a remainder ``fine`` to row ``kind`` of ``sums``; its remainder stays below 2^52."""
    fine += sums[kind, 1]
    sums[kind, 0] = min(sums[kind, 0] + whole + (fine >> _FINE_BITS), SATURATED)
    sums[kind, 1] = fine - ((fine >> _FINE_BITS) << _FINE_BITS)


@kernel
def _kinetic_energies(y: np.ndarray, lattice: LatticeRecord, first: int, energies: np.ndarray) -> None:
    """Kinetic energies of the cells from ``first`` on."""
    energies[:] = 0.0
    for mass in range(lattice.shape.dofs):
        begin = (lattice.shape.dofs + mass) * lattice.shape.cells + first
        v = y[begin : begin + energies.size]
        if is_varied(lattice):
            inverse_masses = lattice.inverse_masses[mass * lattice.shape.cells + first :]
            for i in range(energies.size):
                energies[i] += 0.5 * v[i] * v[i] / inverse_masses[i]
        else:
            inverse_mass = lattice.masses[mass].inverse_mass
            for i in range(energies.size):
                energies[i] += 0.5 * v[i] * v[i] / inverse_mass


@kernel
def _contact_energy(site: Any, w: float) -> float:
    """Return elastic energy in J of a ``SITE`` at w, beyond that of the static state where a load holds it pressed."""
    energy = elastic_energy(site.elastic, max(w - site.clearance, -w - site.clearance_minus))
    if site.preload != 0.0:
        energy -= elastic_energy(site.elastic, -min(site.clearance, site.clearance_minus)) + site.preload * w
    return energy


@kernel
def measure(y: np.ndarray, lattice: LatticeRecord, unit: float, sums: np.ndarray) -> None:
    """Put kinetic, spring, contact energy and losses of contacts and dashpots into ``sums`` (5, 2): see ``_add``."""
    shape = lattice.shape
    sums[:] = 0
    room = np.empty(min(CHUNK, shape.cells))
    for first in range(0, shape.cells, CHUNK):
        energies = room[: shape.cells - first]
        _kinetic_energies(y, lattice, first, energies)
        _add(sums, KINETIC, energies, unit)
        spring_energies(y, lattice, first, energies)
        _add(sums, SPRING, energies, unit)

    owned = 0
    for i in range(lattice.site_dofs.size):
        if lattice.site_dofs[i].ledger >= 0:
            w, _ = relative_motion(y, lattice.site_dofs, i)
            add_one(sums, CONTACT, _contact_energy(lattice.contacts[i], w), unit)
            owned += 1
    _add(sums, DISSIPATED, y[shape.dissipated : shape.dissipated + owned], unit)
    if shape.damping >= 0:
        _add(sums, DAMPING, y[shape.damping : shape.damping + shape.cells], unit)


@kernel
def add_powers(y: np.ndarray, lattice: LatticeRecord, seconds: float, unit: float, sums: np.ndarray) -> None:
    """Add what the dashpots would dissipate in so many ``seconds`` at their present power, to ``sums`` (5, 2)."""
    room = np.empty(min(CHUNK, lattice.shape.cells))
    for first in range(0, lattice.shape.cells, CHUNK):
        powers = room[: lattice.shape.cells - first]
        damping_powers(y, lattice, first, powers)
        for i in range(powers.size):
            powers[i] *= seconds
        _add(sums, DAMPING, powers, unit)


@dataclass(frozen=True)
class Energies:
    """Energies in J of samples, arrays (sample,): kinetic, spring and contact energy, work of the drives, losses.

    The work begins with the energy of the initial state. ``dissipated`` is what contacts have dissipated so far,
    ``dissipated_by_damping`` what dashpots have. ``damping`` is None where the engine has integrated this. Elsewhere it
    is what dashpots would dissipate in a sample interval at their power at the sample, and ``dissipated_by_damping`` is
    what the other terms leave: ``residual`` then only shows energy that no drive has put in.
    """

    kinetic: np.ndarray
    spring: np.ndarray
    contact: np.ndarray
    work: np.ndarray
    dissipated: np.ndarray
    dissipated_by_damping: np.ndarray
    damping: np.ndarray | None = None

    @property
    def total(self) -> np.ndarray:
        """Kinetic, spring and contact energy together."""
        return self.kinetic + self.spring + self.contact

    @property
    def residual(self) -> np.ndarray:
        """Work less both losses and the total: zero for an exact solution."""
        return self.work - self.dissipated - self.dissipated_by_damping - self.total


def parts(sums: np.ndarray) -> np.ndarray:
    """Return the ``sums`` (sample, energy, 2) of a rank as floats (part and energy, sample), to add to others'.

    An energy has four parts: the upper and lower ones of the whole multiple and of the remainder.
    """
    pieces = []
    for number, bits in zip(sums.T, (_PART_BITS, _FINE_PART_BITS), strict=True):
        upper = number >> bits
        pieces += [upper, number - (upper << bits)]
    return np.vstack(pieces).astype(float)


def joined(total: np.ndarray) -> np.ndarray:
    """Return energies (energy, sample) in units of sums of ``parts``; the same for any division among ranks."""
    upper, lower, fine_upper, fine_lower = np.split(total.astype(np.int64), 4)
    fine_upper, fine_lower = _carried(fine_upper, fine_lower, _FINE_PART_BITS)
    lower, fine_upper = _carried(lower, fine_upper, _FINE_BITS - _FINE_PART_BITS)
    upper, lower = _carried(upper, lower, _PART_BITS)
    # Each of the three numbers is exact: no more than these two additions round.
    fine = (fine_upper << _FINE_PART_BITS) + fine_lower
    return upper * 2.0**_PART_BITS + (lower + fine / _FINE)


def _carried(upper: np.ndarray, lower: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Carry what the ``lower`` part of a number has beyond so many ``bits`` into the ``upper`` one."""
    carry = lower >> bits
    return upper + carry, lower - (carry << bits)


class EnergyMeter:
    """Measures the energies of a distributed state, of which ``lattice`` describes this rank's part.

    Energies are summed as integers, whose sums do not depend on their order: multiples of ``unit`` in J, a power of two
    far below the run's energy scale, and a finer remainder. From ``largest`` in J on the sums saturate. With less than
    ``negligible`` in J in the lattice the balance cannot be judged.
    """

    def __init__(self, model: Model, layout: Layout, lattice: LatticeRecord) -> None:
        self.comm = layout.comm
        self._balances_damping = layout.damped and not layout.integrates_damping
        self.lattice = lattice

        speed = model.scale * model.drive.frequency
        # The motion's scale in as many cells as the drive's wave train covers; an initial state may be in all cells.
        # The end of the run does not count: a run that is extended has the bits of one long run.
        cells = float(model.chain.cells)
        duration = max(drive.waveform.duration for drive in model.drives)
        if not model.initial and duration < np.inf:
            cells = min(duration * model.speed, cells)
        scale = sum(model.chain.cell.masses) * speed**2 * max(cells, 1.0)
        self.unit = float(2.0 ** (np.floor(np.log2(scale)) - _UNIT_BITS))
        self.largest = self.unit * LARGEST
        self.negligible = _NEGLIGIBLE * scale

    def sums(self, y: np.ndarray) -> np.ndarray:
        """Return the sums (5, 2) of ``measure`` over the rank's part ``y`` of a state, whose ghosts are up to date."""
        sums = np.zeros((ENERGY_SUMS, 2), np.int64)
        measure(y, self.lattice, self.unit, sums)
        return sums

    def total(self, sums: np.ndarray, work: np.ndarray) -> Energies:
        """Return energies over all ranks: ``sums`` (sample, energy, 2) of ``measure``, ``work`` (sample, drive) in J.

        All ranks must call it.
        """
        of_rank = parts(sums)
        numbers = np.vstack([of_rank, work.T])
        self.comm.Allreduce(MPI.IN_PLACE, numbers, MPI.SUM)

        total, works = np.split(numbers, [len(of_rank)])
        kinetic, spring, contact, dissipated, damping = self.unit * joined(total)
        energies = Energies(
            kinetic=kinetic,
            spring=spring,
            contact=contact,
            work=works.sum(axis=0),
            dissipated=dissipated,
            dissipated_by_damping=damping,
        )
        if not self._balances_damping:
            return energies
        missing = energies.work - energies.dissipated - energies.total
        return replace(energies, dissipated_by_damping=np.maximum(missing, 0.0), damping=damping)
