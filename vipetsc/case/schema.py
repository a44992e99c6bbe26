"""The sections of a case of one lattice run: types, bounds, defaults and presets; masses and cells count from 1."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator

from vipetsc.case.inhomogeneity_sections import AbsorbingTable, Defects, Finite, NotNegative, Profile, ScatterTable
from vipetsc.case.points import MOST_POINTS, PointTable
from vipetsc.case.section import BY_SHAPE, Section, described
from vipetsc.case.strip import DEFAULT_CELLS, StripTable
from vipetsc.lattice import Spring, UnitCell, diatomic, four_band
from vipetsc.lattice.damped import fitted_dashpots

Method = Literal["2a", "3bs", "5f", "5dp", "5bs", "6vr", "7vr", "8vr"]
"""Runge-Kutta methods of PETSc (``-ts_rk_type``)."""


MULTIPLE_OF_PI = r"\s*(\d+\.?\d*|\.\d+)?\s*\*?\s*pi\s*(?:/\s*([1-9]\d*))?\s*"


def number(value: Any) -> Any:
    """Return number that a text such as "5pi/9" stands for, as wavenumbers may be written; any other value as it is."""
    if not isinstance(value, str):
        return value
    match = re.fullmatch(MULTIPLE_OF_PI, value)
    # Other text stays as it is: the check of the type refuses it under the path of its key.
    if match is None:
        return value
    return float(match[1] or 1) * np.pi / float(match[2] or 1)


def once(values: list[Any]) -> list[Any]:
    """Return ``values`` if none of them comes twice; raises ValueError."""
    # A dictionary, so that the message names each value once, and in the order of the list.
    twice = [value for value in dict.fromkeys(values) if values.count(value) > 1]
    if twice:
        raise ValueError(f"names {', '.join(map(repr, twice))} more than once")
    return values


# The largest index of an array is 2^63 = 9.2e18. So many cells reach it with a thousand masses each in nine thousand
# samples; the product of two strides (over samples, cells or pixels) stays below it.
MOST_CELLS = 10**12
MOST_STRIDE = 10**9
# The resolved case lists the cell and the clearance of every site: a million are 39 MB of text and take 4 s to resolve.
MOST_SITES = 10**6


def _text(value: Any) -> Any:
    """Return a ``value`` of a PETSc option as text, which a case may give as a number or a truth value."""
    if isinstance(value, bool | int | float):
        return str(value)
    return value


def rising(bounds: list[Any]) -> list[Any]:
    """Return the two ``bounds`` if the first is below the second; raises ValueError."""
    low, high = bounds
    if not low < high:
        raise ValueError("must be [low, high] with low below high")
    return bounds


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Range = Annotated[list[Finite], Field(min_length=2, max_length=2), AfterValidator(rising)]
PositiveRange = Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(rising)]
Wavenumber = Annotated[float, Field(gt=0, le=np.pi), BeforeValidator(number)]


@dataclass(frozen=True)
class Preset:
    """A lattice of the paper: its cell, its length, and the sections ``[contacts]`` and ``[drive]``, in SI units.

    ``site_span(cells, count)`` gives the cells (first, last), from 1, between which sites are spread,
    ``clearance_span(count)`` the clearances in m of the first and of the last site.
    """

    cell: Callable[..., UnitCell]
    cells: int
    contacts: dict[str, Any]
    drive: dict[str, Any]
    site_span: Callable[[int, int], tuple[float, float]]
    clearance_span: Callable[[int], tuple[float, float]]


def _four_band_sites(cells: int, count: int) -> tuple[float, float]:
    """Return the first and last cell of sites of the four-band lattice: N/4 and 2N/3 of ``cells`` = N; N/3 for one."""
    if count == 1:
        return cells / 3, cells / 3
    return cells / 4, 2 * cells / 3


def _four_band_clearances(count: int) -> tuple[float, float]:
    """Return the ends of the four-band clearances in m: they fall from 10^-2.65 to 10^-2.75; one site has the last."""
    if count == 1:
        return 10**-2.75, 10**-2.75
    return 10**-2.65, 10**-2.75


CONTACTS: dict[str, Any] = {"law": "hertz", "radius": 0.005, "poisson": 0.3, "restitution": 0.7, "sites": 5}
"""Keys of ``[contacts]`` that both presets have."""

PRESETS: dict[str, Preset] = {
    "four-band": Preset(
        cell=four_band,
        cells=300,
        contacts=CONTACTS | {"modulus": 1e8},
        drive={"amplitude": 24.33, "cycles": 30, "band": 2, "at": "max-group-velocity"},
        site_span=_four_band_sites,
        clearance_span=_four_band_clearances,
    ),
    "diatomic": Preset(
        cell=diatomic,
        cells=600,
        contacts=CONTACTS | {"modulus": 2e8},
        drive={"amplitude": 1.0, "cycles": 30, "wavenumber": "5pi/9", "band": 2},
        site_span=lambda n, count: (n / 4, n / 2),
        clearance_span=lambda count: (2e-4, 1e-4),
    ),
}


class SpringTable(Section):
    """A spring from mass ``start`` (1-based; 0: ground) to ``end``, of the next cell if ``next_cell``, and a dashpot.

    Its force at the elongation z is ``stiffness`` z + ``quadratic`` z^2 + ``cubic`` z^3.
    """

    start: int = described("mass at one end; 0 is the ground")
    end: int = described("mass at the other end")
    stiffness: Finite = described("stiffness; negative where the lattice stays stable", unit="N/m")
    next_cell: bool = described("whether `end` is in the next cell", False)
    damping: Finite | None = described("constant of a dashpot parallel to the spring", None, unit="N s/m")
    quadratic: Finite | None = described(
        "coefficient of the elongation squared in the force; in single cells: lattice.profiles", None, unit="N/m^2"
    )
    cubic: Finite | None = described(
        "coefficient of the elongation cubed in the force; in single cells: lattice.profiles", None, unit="N/m^3"
    )

    def spring(self) -> Spring:
        """Return the spring, with 0-based indices."""
        return Spring(
            start=self.start - 1,
            end=self.end - 1,
            stiffness=self.stiffness,
            offset=int(self.next_cell),
            damping=self.damping or 0.0,
            quadratic=self.quadratic or 0.0,
            cubic=self.cubic or 0.0,
        )


class MatricesTable(Section):
    """Files of matrices from which a cell was made, as the resolved case records them."""

    files: list[str] = described("the files, by their absolute names")
    sha256: list[str] = described("their SHA-256 hashes")
    boundary: list[list[int]] | None = described("rows of the matrices on both boundaries", None)


class CellTable(Section):
    """A unit cell; ``contact`` names host and resonator (1-based; 1 and 2), ``grounding`` dashpots to ground.

    Instead of masses, springs and dashpots, ``matrices`` names files that have them (``vipetsc.case.cell_matrices``).
    """

    masses: list[Finite] = described("masses of the cell, numbered from 1", unit="kg", min_length=1)
    springs: list[SpringTable] = described("springs of the cell", [])
    contact: list[int] | None = described(
        "host and resonator, the two masses with stops between them", None, min_length=2, max_length=2
    )
    grounding: list[Finite] | None = described("dashpot from each mass to ground", None, unit="N s/m")
    matrices: Annotated[str | list[str], BY_SHAPE] | None = described(
        "NPZ file with the matrices M, K and perhaps C of the cell, or a list of MatrixMarket files of these; masses,"
        " springs and grounding are filled in",
        None,
    )
    boundary: list[list[int]] | None = described(
        "rows of the matrices on the left boundary, and those on the right one, which is the left one of the next cell",
        None,
    )
    from_matrices: MatricesTable | None = described("files of the matrices that the cell was made of, filled in", None)
    from_strip: StripTable | None = described("the strip that the cell was made of, filled in", None)

    @property
    def moves_in_plane(self) -> bool:
        """Whether it is the cell of a strip whose masses move along x and y."""
        return self.from_strip is not None and self.from_strip.motion == "in-plane"

    def arguments(self) -> tuple[tuple[float, ...], tuple[Spring, ...], int, int, tuple[float, ...]]:
        """Return the arguments of ``UnitCell`` and ``cell_problems``, with 0-based indices."""
        springs = tuple(spring.spring() for spring in self.springs)
        # A cell of one mass has no pair: host and resonator are the same mass, which is refused only if a contact joins
        # them.
        host, resonator = self.contact or (1, min(2, len(self.masses)))
        return tuple(self.masses), springs, host - 1, resonator - 1, tuple(self.grounding or ())


class DampingTable(Section):
    """Proportional dashpots: ``mass`` times each mass to ground, ``stiffness`` times the stiffness of each spring.

    A mode of frequency w then has the damping ratio (mass/w + stiffness w)/2. Instead, ``loss`` prescribes twice
    the ratio of bands, by number; ``grounding`` (dof) and ``springs`` (spring) are the dashpots in N s/m fitted to it.
    """

    mass: NotNegative = described("dashpot constant to ground over the mass", 0.0, unit="1/s")
    stiffness: NotNegative = described("dashpot constant parallel to each spring over its stiffness", 0.0, unit="s")
    loss: dict[str, Annotated[float, Field(ge=0, lt=1)]] | None = described(
        "loss ratio of each band (twice the damping ratio), as { 2 = 0.02 }; instead of mass and stiffness", None
    )
    grounding: list[NotNegative] | None = described(
        "dashpots from the cell's masses to ground that are fitted to `loss`, filled in", None, unit="N s/m"
    )
    springs: list[NotNegative] | None = described(
        "dashpots parallel to the cell's springs that are fitted to `loss`, filled in", None, unit="N s/m"
    )

    def fitted(self, cell: UnitCell) -> tuple[np.ndarray, np.ndarray]:
        """Return the dashpots (dof,) to ground and (spring,) in N s/m of a valid ``loss`` in the undamped ``cell``.

        Without a loss they are 0.
        """
        # A resolved case has its dashpots, which are not fitted again: another version might find others.
        if self.grounding is None and self.loss:
            return fitted_dashpots(cell, tuple((int(band), loss) for band, loss in self.loss.items()))
        return np.array(self.grounding or 0.0), np.array(self.springs or 0.0)


class LatticeTable(Section):
    """The lattice: a ``preset`` or a ``cell``, the number of cells, the ends, the reading of the parameters."""

    preset: Literal["four-band", "diatomic"] | None = described(
        "one of the paper's cells; it also gives defaults for contacts and drive", None
    )
    cell: CellTable | None = described("a user-defined cell, instead of a preset", None)
    strip: StripTable | None = described("a strip of the plane, which writes the cell", None)
    cells: int = described("number of cells; 600 in the preset diatomic", DEFAULT_CELLS, ge=1, le=MOST_CELLS)
    ends: Literal["fixed", "free", "periodic"] = described("what the first and the last cell are attached to", "fixed")
    reading: Literal["printed", "calibrated"] = described(
        "parameters of a preset: as printed in the paper, or calibrated to reproduce its figures", "calibrated"
    )
    lam: Positive | None = described(
        "parameter of the preset four-band: stiffness of the resonator's spring over that of another"
        " spring of the cell",
        None,
        alias="lambda",
    )
    eta: Annotated[float, Field(gt=0, lt=1)] | None = described(
        "parameter of the preset four-band: the resonator's fraction of the mass of host and resonator", None
    )
    damping: DampingTable | None = described("proportional dashpots, or dashpots fitted to a loss of each band", None)
    profiles: dict[str, Annotated[list[Finite] | Profile | Defects, BY_SHAPE]] | None = described(
        'quantities that vary from cell to cell, by name, as "masses[2]" or "springs[1].cubic"', None
    )
    scatter: ScatterTable | None = described("the request of [disorder.cells], filled in", None)
    absorbing: AbsorbingTable | None = described("an end with dashpots that absorb waves", None)

    @property
    def section_of_strip(self) -> StripTable | None:
        """The strip that the cell was made of; None for another cell."""
        return self.cell.from_strip if self.cell else None

    @property
    def nonlinear_keys(self) -> list[str]:
        """Keys of the case by which springs have, or may have in some cells, a quadratic or a cubic part.

        Raises ValueError for an invalid cell.
        """
        keys = []
        if not self.undamped_cell().is_linear:
            keys.append("lattice.cell.springs")
        varied = [("lattice.profiles", name) for name in self.profiles or {}]
        if self.scatter:
            varied += [("disorder.cells", name) for name in self.scatter.quantities]
        for section, name in varied:
            if name.endswith((".quadratic", ".cubic")):
                keys.append(f'{section}."{name}"')
        return keys

    def unit_cell(self) -> UnitCell:
        """Return unit cell: ``cell``, or the preset's in its reading, damped; raises ValueError for an invalid one."""
        cell = self.undamped_cell()
        damping = self.damping
        if damping is None or not (damping.mass or damping.stiffness or damping.loss):
            return cell

        # Rayleigh damping, dashpots that are fitted to a loss, and those of the cell itself act in parallel: they add.
        fitted_grounding, fitted_dashpots = damping.fitted(cell)
        dashpots = np.multiply(damping.stiffness, [spring.stiffness for spring in cell.springs]) + fitted_dashpots
        springs = tuple(
            replace(spring, damping=spring.damping + dashpot)
            for spring, dashpot in zip(cell.springs, dashpots.tolist(), strict=True)
        )
        grounding = np.add(cell.grounding or 0.0, np.multiply(damping.mass, cell.masses) + fitted_grounding)
        return replace(cell, springs=springs, grounding=tuple(grounding.tolist()))

    def undamped_cell(self) -> UnitCell:
        """Return the unit cell without what ``damping`` adds."""
        if self.cell is not None:
            return UnitCell(*self.cell.arguments())

        options: dict[str, float] = {}
        if self.lam is not None:
            options["lam"] = self.lam
        if self.eta is not None:
            options["eta"] = self.eta
        return PRESETS[str(self.preset)].cell(self.reading, **options)


class TimeTable(Section):
    """Time: end in s or ``traverse`` (burst + cells / group velocity), engine, method, tolerances, sampling.

    The tolerance ``scaled`` is 0.1 rtol times the displacement and the velocity of the drive's linear wave, ``paper``
    is 1e-9 times the amplitude; a number holds for displacements (m) and velocities (m/s).
    """

    end: Annotated[Positive | Literal["traverse"], BY_SHAPE] = described(
        'end of the run; "traverse": length of the burst plus the travel time of the wave through the'
        " lattice, down to the last sample before it",
        "traverse",
        unit="s",
    )
    engine: Literal["ts", "propagator", "auto"] = described(
        "Runge-Kutta steps (ts), or exact linear steps (propagator, auto): where these do not apply, ts is"
        " taken, and the summary says why",
        "auto",
    )
    method: Method = described("PETSc's Runge-Kutta method for ts", "8vr")
    rtol: Annotated[float, Field(ge=1e-14, le=1e-2)] = described("relative tolerance", 1e-10)
    atol: Annotated[Positive | Literal["scaled", "paper"], BY_SHAPE] = described(
        'absolute tolerance; "scaled": 0.1 rtol times the linear wave of the drive, "paper": 1e-9 times the amplitude',
        "scaled",
        unit="m, m/s",
    )
    sample_interval: Annotated[Positive | Literal["auto"], BY_SHAPE] = described(
        'time between samples, shortened where an `end` in s is not a whole number of intervals; "auto"'
        " resolves the top band",
        "auto",
        unit="s",
    )
    samples: int | None = described("number of samples from 0 to the end, instead of an interval", None, ge=2, le=10**9)
    samples_per_period: int | None = described(
        "number of samples in a period of the drive, instead of an interval; the run ends with the last whole period"
        " before `end`",
        None,
        ge=2,
        le=10**6,
    )


class OutputTable(Section):
    """Stored part of the fields (cells of the ``window``, every n-th cell, every n-th sample)."""

    fields: Annotated[list[Literal["displacement", "velocity"]], AfterValidator(once)] = described(
        "fields that are stored", ["displacement", "velocity"]
    )
    window: list[int] | None = described(
        "first and last cell that are stored; default: all cells", None, min_length=2, max_length=2
    )
    every: int = described("every n-th cell is stored", 1, ge=1, le=MOST_STRIDE)
    stride: int = described("every n-th sample is stored", 1, ge=1, le=MOST_STRIDE)
    figures: bool = described("whether pictures are drawn", True)
    points: list[PointTable] | None = described(
        "named masses whose motion is stored at every sample, independently of the stored cells; `nfrc`:"
        " in every state",
        None,
        max_length=MOST_POINTS,
    )
    transmission: list[Annotated[list[str], Field(min_length=2, max_length=2)]] | None = described(
        "pairs of points, [from, to], for which the transmission is measured", None
    )
    forces: bool | None = described(
        "whether the force of each contact is stored at every sample; `nfrc`: largest forces of contacts"
        " and on fixed walls",
        None,
    )
    lyapunov: bool | None = described(
        "whether the largest Lyapunov exponent is measured, which takes twice the time", None
    )

    def of_points(self) -> dict[str, Any]:
        """Return the keys about named points and measures, for a run of which nothing else is kept."""
        return self.model_dump(include={"points", "transmission", "lyapunov"}, exclude_none=True)


class AnalysisTable(Section):
    """Resolution of the measures. Strides of 1 leave nothing out; ``analysis.h5`` states the error of larger strides.

    A steady amplitude is that of the last ``steady_periods`` of the drive.
    """

    band_stride: int = described("samples between two energies above the pass bands", 10, ge=1, le=MOST_STRIDE)
    snapshot_stride: int = described(
        "entropy and partition are computed at every n-th of at most 500 snapshots", 2, ge=1, le=MOST_STRIDE
    )
    cell_stride: int = described("entropy is computed in every n-th cell", 2, ge=1, le=MOST_STRIDE)
    modal_stride: int = described(
        "samples between two modal energies, apart from those near contacts", 50, ge=1, le=MOST_STRIDE
    )
    pixels: int = described("largest number of rows and columns of a map", 600, ge=2, le=MOST_STRIDE)
    memory: Positive = described("amount of a field that is read at a time", 1.0, unit="GiB")
    steady_periods: int | None = described(
        "drive periods in each window for the steady amplitude; default: 10", None, ge=1, le=MOST_STRIDE
    )
    steady_tolerance: Annotated[float, Field(gt=0, lt=1)] | None = described(
        "largest relative difference between three windows for a steady amplitude; default: 0.01", None
    )


# PETSc 3.25 renamed these options: their names there, and the ones before.
RENAMED_OPTIONS = {"ts_time_step": "ts_dt", "ts_max_step_rejections": "ts_max_reject"}


class PetscTable(Section):
    """PETSc options by name, without the leading dash, as they follow ``--`` on the command line.

    Those of time stepping (``ts_...``) are for ``ts``; a case that has some is not simulated by the propagator.
    An option that PETSc has renamed may have either name under any version, and is stored by the earlier one.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Annotated[str, BeforeValidator(_text)]]

    @model_validator(mode="before")
    @classmethod
    def _rename(cls, table: Any) -> Any:
        if not isinstance(table, dict):
            return table

        # Both names stay if both are given; ``check_options`` refuses them.
        earlier = {new: old for new, old in RENAMED_OPTIONS.items() if old not in table}
        return {earlier.get(name, name): value for name, value in table.items()}


# Options for what PETSc prints, checks and does about an error, none of which changes a result.
_LOOKS = re.compile(
    r"log(_(view|trace|all|sync|exclude|summary)\w*)?|info(_exclude)?|malloc(_(debug|dump|view|test|hbw)\w*)?"
    r"|memory_view|options_(left|view|monitor|file)\w*|objects_dump|start_in_debugger|stop_for_debugger|debug(ger)?_\w+"
    r"|on_error_\w+|error_output_\w+|fp_trap|check_pointer_intensity|no_signal_handler|skip_petscrc|version|help"
    r"|display|history|citations|get_total_flops|\w+_(view|monitor)(_\w+)?"
)


def only_looks(name: str) -> bool:
    """Return whether the PETSc option ``name`` changes no result, and is therefore not part of a case."""
    return bool(_LOOKS.fullmatch(name))
