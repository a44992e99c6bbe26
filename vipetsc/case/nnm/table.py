"""The section [nnm]: the system, its branches, and how they are followed."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from vipetsc.case.schema import Finite, NotNegative, Positive, once, rising
from vipetsc.case.section import BY_SHAPE, Section, described

# Masses of a system whose orbits are shot with dense matrices: the derivatives of the state at the period by the state
# at the beginning are 8000 x 8000 numbers, 512 MB, and twice the masses take four times the memory.
MOST_MASSES = 4000
# Last harmonic of damped modes at most: all masses have harmonics.
MOST_OF_DAMPED = 63

Bounds = Annotated[list[NotNegative], Field(min_length=2, max_length=2), AfterValidator(rising)]


class LinearSpringTable(Section):
    """A spring between masses ``start`` and ``end`` (1-based; ``start`` 0 is the ground), N/m."""

    start: Annotated[int, Field(ge=0)] = described("mass at one end; 0 is the ground")
    end: Annotated[int, Field(ge=1)] = described("mass at the other end")
    stiffness: Positive = described("stiffness", unit="N/m")


class SmoothSpringTable(Section):
    """Force ``quadratic`` z^2 + ``cubic`` z^3 (N/m^2, N/m^3) between two masses, as in ``LinearSpringTable``."""

    start: Annotated[int, Field(ge=0)] = described("mass at one end; 0 is the ground")
    end: Annotated[int, Field(ge=1)] = described("mass at the other end")
    cubic: Finite = described("coefficient of z^3 in the force", 0.0, unit="N/m^3")
    quadratic: Finite = described("coefficient of z^2 in the force", 0.0, unit="N/m^2")


class DashpotTable(Section):
    """A dashpot of ``damping`` in N s/m between two masses, as in ``LinearSpringTable``."""

    start: Annotated[int, Field(ge=0)] = described("mass at one end; 0 is the ground")
    end: Annotated[int, Field(ge=1)] = described("mass at the other end")
    damping: Positive = described("force over the difference of velocities", unit="N s/m")


class PairTable(Section):
    """A contact between ``host`` (0 is the ground) and ``resonator`` (1-based) with its ``clearance`` in m.

    The law, the sides of its stops and the precompression are those of ``[contacts]``, whose lists ``each`` are over
    these contacts.
    """

    host: Annotated[int, Field(ge=0)] = described("mass with the stops; 0 is the ground")
    resonator: Annotated[int, Field(ge=1)] = described("mass between them")
    clearance: Annotated[float, Field(ge=0)] = described("clearance", unit="m")


class SystemTable(Section):
    """The section [nnm.own]: masses in kg, linear and smooth springs, dashpots, contact pairs (law: ``[contacts]``)."""

    masses: list[Positive] = described("masses, numbered from 1", unit="kg", min_length=1)
    springs: list[LinearSpringTable] = described("linear springs", min_length=1)
    smooth: list[SmoothSpringTable] = described("springs with quadratic and cubic forces", [])
    dashpots: list[DashpotTable] = described(
        "dashpots, which take energy along branches of the motions without them", []
    )
    contacts: list[PairTable] = described("contacts, with the law of [contacts]", [])


class Guards(Section):
    """Bounds on one step that keep a branch from jumping to another arc; 0 switches one off.

    ``half_trace`` bounds the change of asinh(c) of every Floquet half-trace c; ``corrector`` the length of the
    correction over that of the step; ``turn`` the angle in rad between consecutive tangents in the chart of the step,
    and ``turn_relative`` that in the chart ``relative``, since near grazing another chart hides the angle between two
    branches that cross. Residuals cannot show a jump: both arcs satisfy the equations to rounding. A branch whose last
    ``standstill`` points are all within ``advance`` times the orbit's size is ended: orbits are corrected to 1e-13, and
    the paper's branches move by 2e-6 in 200 points at least.
    """

    half_trace: Annotated[float, Field(ge=0)] = described(
        "change of asinh of a Floquet half-trace; 0 disables a guard", 0.5
    )
    corrector: Annotated[float, Field(ge=0)] = described("length of the correction over that of the step", 0.05)
    turn: Annotated[float, Field(ge=0)] = described("angle between tangents, in the chart of the step", 0.2, unit="rad")
    turn_relative: Annotated[float, Field(ge=0)] = described(
        "angle between tangents, in the chart relative", 0.25, unit="rad"
    )
    standstill: Annotated[int, Field(ge=0)] = described(
        "number of points within `advance` of each other after which a branch ends", 200
    )
    advance: Positive = described("distance of such points, in units of the orbit's size", 1e-9)


class NnmTable(Section):
    """Nonlinear normal modes.

    The ``method`` balance treats the systems ``reduced``, ``chain`` and ``own`` by harmonics, too. Where dashpots or
    contacts dissipate, points have the loss along the motion without loss, and the force on the mass ``forced`` that
    makes up for it.
    """

    system: Literal["reduced", "chain", "own", "condensed"] = described(
        "the paper's reduced model, the lattice with its sites (chain; condensed: any length), or a"
        " user-defined system (own)",
        "reduced",
    )
    method: Literal["shooting", "balance", "damped"] = described(
        "shooting; balance: harmonic balance at contacts and nonlinear springs; damped: modes with dashpots and"
        " contacts that dissipate (frequency and damping ratio over the energy)",
        "shooting",
    )
    start_frequency: list[Positive] = described(
        "frequencies outside the pass bands at which branches of a lattice begin, instead of modes", [], unit="rad/s"
    )
    start_sites: list[int] = described(
        "sites, numbered from 1, in contact at the start; negative: on the negative side", []
    )
    harmonics: int = described("largest number of the last harmonic", 1023, ge=15)
    truncation: Positive = described("largest fraction of a motion in the neglected harmonics", 1e-7)
    custom: SystemTable | None = described("masses, springs and contacts of a user-defined system", None, alias="own")
    forced: list[Annotated[int, Field(ge=1)]] | None = described(
        "mass whose force in resonance is computed where something dissipates: [cell, mass], or [mass] without cells",
        None,
        min_length=1,
        max_length=2,
    )
    modes: Annotated[list[Annotated[int, Field(ge=1)]], AfterValidator(once)] = described(
        "linear modes from which branches start; the lowest is 1", [1, 2], min_length=1
    )
    chart: Literal["auto", "relative", "grazing"] = described(
        "unknowns: displacements over the size of the motion (relative), or the root of the gap of a contact (grazing);"
        " auto: grazing near a touch",
        "relative",
    )
    start_energy: Annotated[Positive | Literal["auto"], BY_SHAPE] = described(
        "energy of the first point; auto: small enough for a linear mode", "auto", unit="J"
    )
    energy: Bounds = described("range of energies; a branch ends outside it", [0.0, 1e9], unit="J")
    frequency: Bounds = described("range of frequencies; a branch ends outside it", [0.0, 1e9], unit="rad/s")
    direction: Literal["up", "down", "both"] = described("initial direction of the energy", "up")
    points: int = described("largest number of points of a branch", 20000, ge=1)
    first_step: Positive = described("first step along the branch, in units of the chart", 1e-3)
    smallest_step: Positive = described("step size below which a branch has failed", 1e-13)
    largest_step: Positive = described("largest step size", 0.1)
    tolerance: Positive = described("largest scaled residual of an orbit", 1e-13)
    max_newton: int = described("largest number of Newton steps of a correction", 7, ge=1)
    locate: bool = described("whether folds, branch points and changes of stability are located", True)
    locate_grazing: bool = described("whether orbits that graze a stop are located", True)
    orbits_at: list[Positive] = described(
        "energies at which orbits are stored, wherever the branch passes them", [], unit="J"
    )
    points_at: dict[Literal["energy", "frequency", "period", "closed"], list[Positive]] = described(
        "values at which points are stored, wherever a branch passes them: of the energy in J, the frequency in rad/s,"
        " the period in s, the fraction of the time in contact",
        {},
    )
    switch: list[Literal["symmetry-breaking", "period-doubling", "branch-point"]] = described(
        "kinds of special points at which crossing branches are followed", []
    )
    switch_points: int = described("number of points of a crossing branch", 100, ge=1)
    guards: Guards = described("limits on a step", Guards())
