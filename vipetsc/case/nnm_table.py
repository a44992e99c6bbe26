"""The section [nnm]: the system, its branches, and how they are followed."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from vipetsc.case.case_file import Section
from vipetsc.case.schema import Finite, Positive, once

# Masses of a system whose orbits are shot with dense matrices: the derivatives of the state at the period by the state
# at the beginning are 8000 x 8000 numbers, 512 MB, and twice the masses take four times the memory.
MOST_MASSES = 4000
# Masses of a lattice whose orbits are shot without matrices. With so many, two points of a breather take 39 s of CPU,
# including compilation, and 0.7 GB, of which 200 vectors of GMRES with 80,000 numbers each are 0.13 GB. More masses
# have not been tried.
MOST_OF_LATTICE = 40_000
# Masses of a lattice beyond which "auto" shoots without matrices. Dense matrices give all multipliers and special
# points, and cost the cube: six points in contact take 8, 25 and 237 s of CPU at 52, 100 and 200 masses, without
# matrices 2 to 3.
FEW_MASSES = 100


class LinearSpringTable(Section):
    """A spring between masses ``start`` and ``end`` (1-based; ``start`` 0 is the ground), N/m."""

    start: Annotated[int, Field(ge=0)]
    end: Annotated[int, Field(ge=1)]
    stiffness: Positive


class SmoothSpringTable(Section):
    """Force ``quadratic`` z^2 + ``cubic`` z^3 (N/m^2, N/m^3) between two masses, as in ``LinearSpringTable``."""

    start: Annotated[int, Field(ge=0)]
    end: Annotated[int, Field(ge=1)]
    cubic: Finite = 0.0
    quadratic: Finite = 0.0


class DashpotTable(Section):
    """A dashpot of ``damping`` in N s/m between two masses, as in ``LinearSpringTable``."""

    start: Annotated[int, Field(ge=0)]
    end: Annotated[int, Field(ge=1)]
    damping: Positive


class PairTable(Section):
    """A contact between ``host`` (0 is the ground) and ``resonator`` (1-based) with its ``clearance`` in m.

    The law, the sides of its stops and the precompression are those of ``[contacts]``, whose lists ``each`` are over
    these contacts.
    """

    host: Annotated[int, Field(ge=0)]
    resonator: Annotated[int, Field(ge=1)]
    clearance: Annotated[float, Field(ge=0)]


class SystemTable(Section):
    """The section [nnm.own]: masses in kg, linear and smooth springs, dashpots, contact pairs (law: ``[contacts]``)."""

    masses: list[Positive] = Field(min_length=1)
    springs: list[LinearSpringTable] = Field(min_length=1)
    smooth: list[SmoothSpringTable] = Field([])
    dashpots: list[DashpotTable] = Field([])
    contacts: list[PairTable] = Field([])


class Guards(Section):
    """Bounds on one step that keep a branch from jumping to another arc; 0 switches one off.

    ``half_trace`` bounds the change of asinh(c) of every Floquet half-trace c; ``contacts`` that of the number of
    contact episodes of the arc that is integrated (a part or the whole of the orbit), of which those that a symmetry of
    the orbit takes to one another count once; ``corrector`` the length of the correction over that of the step;
    ``turn`` the angle in rad between consecutive tangents in the chart of the step, and ``turn_relative`` that in the
    chart ``relative``, since near grazing another chart hides the angle between two branches that cross. Residuals
    cannot show a jump: both arcs satisfy the equations to rounding. A branch whose last ``standstill`` points are all
    within ``advance`` times the orbit's size is ended: orbits are corrected to 1e-13, and the paper's branches move by
    2e-6 in 200 points at least.
    """

    half_trace: Annotated[float, Field(ge=0)] = 0.5
    contacts: Annotated[int, Field(ge=0)] = 1
    corrector: Annotated[float, Field(ge=0)] = 0.05
    turn: Annotated[float, Field(ge=0)] = 0.2
    turn_relative: Annotated[float, Field(ge=0)] = 0.25
    standstill: Annotated[int, Field(ge=0)] = 200
    advance: Positive = 1e-9


class NnmTable(Section):
    """Nonlinear normal modes.

    ``system``: ``reduced`` (the paper's model of the cell's contact pair), ``chain`` (the lattice with its sites),
    ``own`` (``[nnm.own]``), or ``condensed`` (the lattice of any length, by harmonics of its sites alone). The
    ``method`` condensed treats ``reduced``, ``chain`` and ``own`` by harmonics too. ``modes`` are the linear modes
    (from 1, lowest first) from which branches begin. Those of a condensed lattice, and others where it is given, begin
    at ``start_frequency`` in rad/s, outside the pass bands, with contact at ``start_sites`` (numbers of sites from 1;
    those that move in the opposite direction are negative). Condensed motions have at most ``harmonics``, as many as
    keep the part left out below ``truncation``.

    ``energy`` in J and ``frequency`` in Hz bound the branch; ``direction`` is that in which the energy goes first.
    ``orbits_at`` lists energies in J: the orbits of these energies, wherever the branch passes one, are stored in
    addition to those of the regions; ``compare`` corrects every fourth point with other flows; ``switch`` follows the
    branches that cross at these kinds of special points, ``switch_points`` points each. ``shooting`` "krylov" does
    without dense matrices, for a chain on all ranks together ("auto" beyond 100 masses): there and in a condensed
    lattice so many of the largest ``multipliers`` (true: 8) are found. Where dashpots or contacts dissipate, points
    have the loss along the motion without loss, and the force on the mass ``forced`` that makes up for it: [cell, mass]
    of a lattice, else [mass].
    """

    system: Literal["reduced", "chain", "own", "condensed"] = "reduced"
    method: Literal["shooting", "condensed"] = "shooting"
    start_frequency: list[Positive] = Field([])
    start_sites: list[int] = Field([])
    harmonics: int = Field(1023, ge=15)
    truncation: Positive = 1e-7
    custom: SystemTable | None = Field(None, alias="own")
    forced: list[Annotated[int, Field(ge=1)]] | None = Field(None, min_length=1, max_length=2)
    modes: Annotated[list[Annotated[int, Field(ge=1)]], AfterValidator(once)] = Field([1, 2], min_length=1)
    shooting: Literal["auto", "dense", "krylov"] = "auto"
    multipliers: bool | Annotated[int, Field(ge=1)] = False
    map: Literal["auto", "quarter", "half", "whole"] = "auto"
    flow: Literal["compiled", "tsrk", "newmark"] = "compiled"
    jacobian: Literal["variational", "differences"] = "variational"
    chart: Literal["auto", "relative", "logarithmic", "grazing"] = "relative"
    start_energy: Positive | Literal["auto"] = "auto"
    energy: list[Annotated[float, Field(ge=0)]] = Field([0.0, 1e9], min_length=2, max_length=2)
    frequency: list[Annotated[float, Field(ge=0)]] = Field([0.0, 1e9], min_length=2, max_length=2)
    direction: Literal["up", "down", "both"] = "up"
    points: int = Field(20000, ge=1)
    first_step: Positive = 1e-3
    smallest_step: Positive = 1e-13
    largest_step: Positive = 0.1
    tolerance: Positive = 1e-13
    max_newton: int = Field(7, ge=1)
    locate: bool = True
    locate_grazing: bool = True
    orbits_at: list[Positive] = Field([])
    compare: list[Literal["compiled", "tsrk", "newmark"]] = Field([])
    switch: list[Literal["symmetry-breaking", "period-doubling", "branch-point"]] = Field([])
    switch_points: int = Field(100, ge=1)
    switch_amplitude: Positive = 1e-3
    guards: Guards = Guards()

    def is_krylov(self, dofs: int, is_linear: bool = True) -> bool:
        """Whether orbits of a lattice of so many masses, with linear springs or others, are shot without matrices."""
        # Other flows, branch switching and difference quotients work on the whole matrix of derivatives.
        needs_dense = self.compare or self.switch or self.flow != "compiled" or self.jacobian != "variational"
        needs_krylov = bool(self.start_frequency or self.multipliers)
        is_chosen = is_linear and (needs_krylov or (dofs > FEW_MASSES and not needs_dense))
        return self.method == "shooting" and self.shooting != "dense" and (is_chosen or self.shooting == "krylov")
