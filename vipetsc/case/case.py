"""A lattice run: a strict case file is read into a typed and fully resolved case.

A case is TOML with the sections of ``vipetsc.case.schema``, in SI units; masses and cells count from 1.
"""

import hashlib
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, cached_property
from typing import Any, ClassVar

import numpy as np
import tomli_w
from numpy.typing import ArrayLike

from vipetsc.case.case_file import CaseFile, Valid
from vipetsc.case.contacts import check_joined, check_pairs, check_touching
from vipetsc.case.disorder import DisorderTable, with_drawn
from vipetsc.case.drive import DriveTable, build_drives, check_drives, check_waves, driven_wave, packet_frequency
from vipetsc.case.features import refusals
from vipetsc.case.html import case_html
from vipetsc.case.inhomogeneity import check_inhomogeneity, check_right_wall
from vipetsc.case.initial import Beginning, InitialTable, beginning_of, check_initial
from vipetsc.case.model import Model
from vipetsc.case.points import check_points
from vipetsc.case.reading import Table, read_section, unknown_key
from vipetsc.case.resolve import (
    build_chain,
    cells_of_sites,
    check_cell,
    check_contacts,
    clearances,
    contact_frequency,
    reference_drive,
    resolve,
    site_cells,
    with_preset,
)
from vipetsc.case.samples import with_samples
from vipetsc.case.schema import CONTACTS, AnalysisTable, LatticeTable, OutputTable, PetscTable, TimeTable
from vipetsc.case.section import CaseError, Problem, Section
from vipetsc.case.sites import ContactsTable
from vipetsc.case.warnings import loss_warnings, unit_warnings, warnings_of
from vipetsc.case.waveforms import DEFAULT
from vipetsc.lattice import Chain, Drive, UnitCell, pass_bands
from vipetsc.lattice.topology import Topology
from vipetsc.plugins import without_folders

# The absolute tolerances are this fraction of the relative one times the drive's wave, so that waves weaker by this
# factor are followed to the relative tolerance too: contacts that graze magnify their errors.
WEAKEST = 0.1
# The displacement and the velocity of one mass would take 16 GB at so many samples; more are a mistyped interval.
MOST_SAMPLES = 1e9
ORDER = ("lattice", "contacts", "disorder", "drive", "initial", "time", "output", "analysis", "petsc")


class Case(CaseFile):
    """A lattice run with every default filled in, built by ``load``, ``from_table`` or ``from_toml``."""

    lattice: LatticeTable
    contacts: ContactsTable
    drive: DriveTable
    time: TimeTable
    output: OutputTable
    initial: InitialTable | None = None
    analysis: AnalysisTable | None = None
    petsc: PetscTable | None = None

    verb = "run"
    # PETSc's integrator, on which the program is built, is what a first command shows.
    builtin_table: ClassVar[Table] = {"name": "four-band", "lattice": {"preset": "four-band"}, "time": {"engine": "ts"}}

    @classmethod
    @cache
    def sections(cls) -> dict[str, type[Section]]:
        """Return the class of each section that the verb reads, in the order of the manual."""
        # No field of a case has this section: a resolved case has the values that were drawn.
        classes = super().sections() | {"disorder": DisorderTable}
        return {name: classes.pop(name) for name in ORDER} | classes

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the resolved sections, and all problems with them."""
        table, unread = with_samples(with_preset(table))
        sections, problems = super().read(table)
        if unread:
            # A file that cannot be read leaves the drive's samples empty, which is no problem of its own.
            problems = unread + [p for p in problems if not (p.key.startswith("drive") and ".samples" in p.key)]
        disorder, wrong = read_section(DisorderTable, table.get("disorder", {}), "disorder")
        problems += wrong
        if problems:
            return sections, problems

        # The motion comes first: without a force, frequency and cell of the drive follow from it.
        beginning, problems = _beginning(sections)
        if problems:
            return sections, problems
        try:
            resolved = resolve(sections, beginning)
        except ValueError as error:
            reflection = sections["lattice"].absorbing and sections["lattice"].absorbing.reflection
            return sections, [Problem("lattice.absorbing.reflection", reflection, str(error))]

        problems = [*_resolved_problems(sections, resolved), *_touching_problems(sections, beginning)]
        # Scatter is drawn last, about the values of the resolved case: a preset's stiffness, clearances over a span.
        if problems or "disorder" not in table:
            return resolved, problems
        return with_drawn(super().read, resolved, disorder, sections["contacts"])

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> Iterator[Problem]:
        """Yield problems between keys."""
        lattice = sections["lattice"]
        contacts = sections["contacts"]
        drive = sections["drive"]
        time = sections["time"]
        cell: UnitCell | None = None
        if valid("lattice"):
            cell, problems = check_cell(lattice)
            yield from problems
        if cell and valid("drive"):
            # The cell of a moved wall is filled in on resolution only. Without an amplitude no cell is driven.
            driven = [one.cell for _, one in drive.every if one.end is None and one.amplitude != 0]
            yield from check_inhomogeneity(lattice, driven)

        if valid("lattice.cells", "contacts.sites"):
            initial = sections.get("initial") if valid("initial") else None
            yield from check_contacts(lattice, contacts, initial, valid)
            if cell and valid("contacts"):
                yield from check_pairs(lattice, contacts, cell, site_cells(lattice, contacts))
            if valid("lattice", "contacts"):
                yield from check_joined(lattice, contacts, len(site_cells(lattice, contacts)))
        if valid("initial.kind") and "initial" in sections:
            yield from check_initial(sections["initial"], lattice, cell, valid)
        yield from refusals(cls, sections, valid)

        yield from _check_undriven(sections, valid)
        length = None
        if valid("lattice.cells"):
            length = lattice.cells
        yield from _check_output(sections["output"], length, cell, valid)
        problems = list(check_drives(drive, lattice, cell, length, valid))
        yield from problems
        # Only for drives without problems, since their waves are computed.
        if cell and cell.joins_cells and not problems and valid("lattice", "drive", "time.end"):
            yield from check_waves(cell, drive, time)
        if cell and not cell.joins_cells and valid("drive", "time"):
            yield from check_waves(cell, drive, time)
        yield from _check_sampling(time, cell, valid)

    def model(self) -> Model:
        """Return the case in the terms of ``vipetsc.lattice``, built once, since a case does not change."""
        return self._model

    @cached_property
    def _model(self) -> Model:
        contacts = self.contacts
        time = self.time
        # ``read`` has replaced both words by numbers; the assertion narrows their types.
        assert time.end != "traverse" and time.sample_interval != "auto"
        chain = build_chain(self.lattice, contacts)
        # Tolerances refer to this drive: if nothing is driven, it has the frequency of the motion at t = 0.
        drive = reference_drive(self.drive, self.initial)
        drives = build_drives(drive, chain)
        scale = self._scale(chain, drives)

        return Model(
            chain=chain,
            drives=drives,
            end=time.end,
            sample_interval=time.sample_interval,
            method=time.method,
            rtol=time.rtol,
            atol=self._tolerances(scale, drives[0].waveform.frequency),
            scale=scale,
            packet=packet_frequency(drive),
            initial=self.initial,
        )

    @property
    def wave_frequency(self) -> float | None:
        """Frequency in rad/s of the drive, or of the wave that an undriven lattice begins with; None without either."""
        if self.drive.frequency is None and self.initial and self.initial.kind != "velocity":
            return self.initial.frequency
        return self.drive.frequency

    def _scale(self, chain: Chain, drives: tuple[Drive, ...]) -> float:
        """Return displacement in m of the linear waves of all ``drives``, or of the motion at t = 0 if that is more.

        The sum is a bound, since waves of different drives may cancel.
        """
        scale = 0.0
        for drive in drives:
            # A wall's drive is a displacement, by which springs and dashpots pull.
            if drive.waveform.amplitude:
                wave = chain.wave_scale(drive.waveform, drive.cell, drive.mass)
                scale += wave * drive.force_per_amplitude
        if self.initial:
            scale = max(scale, self.initial.amplitude or 0.0)
        return scale

    def _tolerances(self, scale: float, frequency: float) -> tuple[float, float]:
        """Return the tolerances in m and m/s where waves have the ``scale`` in m and the ``frequency`` in rad/s."""
        time = self.time
        drive = self.drive
        if time.atol == "scaled":
            small = WEAKEST * time.rtol * scale
            # The velocity of a harmonic wave is its frequency times its displacement.
            return small, small * frequency
        if time.atol == "paper":
            # The paper's tolerance is one number for displacements and velocities.
            small = 1e-9 * abs(drive.amplitude)
            return small, small
        return time.atol, time.atol

    def varied(
        self,
        *,
        name: str | None = None,
        without: Iterable[str] = (),
        overrides: Iterable[str] = (),
        **changes: Mapping[str, Any],
    ) -> "Case":
        """Return the lattice run of ``varied_table``, checked and resolved like any other; raises CaseError.

        ``overrides`` are as those of ``load``.
        """
        return Case.from_table(self.varied_table(name=name, without=without, **changes), overrides)

    def varied_table(
        self, *, name: str | None = None, without: Iterable[str] = (), **changes: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the table of a run like this case with some values changed; the section of another verb is dropped.

        ``changes`` are keys by section, as in ``drive={"amplitude": 2.0}``; the value None removes a key. Sections
        named in ``without`` begin with their defaults instead of the values of this case.
        """
        table = self.model_dump(by_alias=True, exclude_none=True, include={*Case.model_fields})
        left_out = list(without)
        sections = {*Case.model_fields, *type(self).model_fields}
        unknown = [unknown_key(section, None, sections) for section in left_out if section not in sections]
        if unknown:
            raise CaseError(unknown, "without")

        # First what is left out, then what changes: a section may be begun anew with some keys.
        for section in left_out:
            table.pop(section, None)
        for section, values in changes.items():
            if not isinstance(values, Mapping):
                raise TypeError(f"{section} is a section: give the keys that change, a dict, not {values!r}")
            merged = table.get(section, {}) | values
            table[section] = {key: value for key, value in merged.items() if value is not None}
        if name is not None:
            table["name"] = name
        return table

    @property
    def contact_radius(self) -> float | None:
        """Radius in m of the spheres in contact, by default the preset's; None if it is unknown."""
        if self.contacts.radius is None and self.lattice.preset:
            return CONTACTS["radius"]
        return self.contacts.radius

    def nearest_site(self, cells: ArrayLike) -> int | None:
        """Return the index in ``cells`` (site,) of the site that the drive's wave meets first: the nearest one.

        Cells count from 1. None without sites; of two at the same distance it is the first.
        """
        return Topology(self.lattice.cells, self.lattice.ends).nearest_index(cells, self.drive.cell)

    def runs(self) -> list[CaseFile]:
        """Return the case itself; verbs that simulate several runs vary it."""
        return [self]

    @property
    def petsc_options(self) -> dict[str, str]:
        """The PETSc options of the case by name, without the leading dash."""
        if self.petsc is None:
            return {}
        return self.petsc.model_dump()

    @property
    def wants_pictures(self) -> bool:
        """Whether the results are drawn, ``output.figures``."""
        return self.output.figures

    def _repr_html_(self) -> str:
        """Return the case as a notebook shows it: its numbers, and its cell drawn."""
        drives = [drive.describe() for _, drive in self.drive.every if drive.amplitude]
        return case_html(self.name, self.model(), self.lattice.ends, drives)

    def warnings(self) -> list[str]:
        """Return warnings of settings that are allowed but probably unintended."""
        is_measured = any(one.samples is not None for _, one in self.drive.every)
        return [
            *unit_warnings(self.drive, self.model().chain),
            *loss_warnings(self.lattice),
            *warnings_of(self.model(), self.output, self.petsc_options, is_measured),
        ]


def _beginning(sections: dict[str, Any]) -> tuple[Beginning | None, list[Problem]]:
    """Return the motion at t = 0 (None for a lattice at rest), and the problems with it."""
    initial = sections.get("initial")
    drive = sections["drive"]
    if initial is None or not initial.moves:
        return None, []
    lattice = sections["lattice"]
    frequency = None
    # The frequency of a drive's wave is that of the motion, too. A pulse has no frequency of which this could be said.
    if drive.wave_choices:
        frequency, _ = driven_wave(lattice.unit_cell(), drive)

    def touching(speed: float) -> float:
        """Return the frequency in rad/s of contacts at a ``speed`` in m/s; without sites, half a period is the run."""
        return contact_frequency(lattice, sections["contacts"], speed) or np.pi / sections["time"].end

    return beginning_of(initial, lattice, frequency, touching)


def _resolved_problems(given: dict[str, Any], resolved: dict[str, Any]) -> list[Problem]:
    """Return problems that show only in the ``resolved`` sections: of the absorbing end and of the samples."""
    # Checked a second time: the absorbing end and the wall of a drive have their cells only now.
    driven = [drive.cell for _, drive in resolved["drive"].every if drive.amplitude != 0]
    initial = resolved.get("initial")
    if not driven and initial is not None and initial.cell is not None:
        # A packet or a mass that is struck sends waves as a drive does.
        driven = [initial.cell]
    problems = list(check_inhomogeneity(resolved["lattice"], driven))
    for path, drive in resolved["drive"].every:
        if drive.end == "right" and not problems:
            problems += check_right_wall(resolved["lattice"], f"{path}.end")
    if problems:
        return problems

    time = resolved["time"]
    count = time.end / time.sample_interval
    if count > MOST_SAMPLES:
        remedy = f"makes {count:.3g} samples; at most {MOST_SAMPLES:.3g} are possible, and the bands need that many"
        return [Problem("time.end", given["time"].end, remedy)]
    for key in ("samples", "samples_per_period"):
        samples = getattr(given["time"], key)
        if samples is not None:
            return _too_coarse(given["lattice"].unit_cell(), time.sample_interval, f"time.{key}", samples)
    return []


def _touching_problems(sections: dict[str, Any], beginning: Beginning | None) -> Iterator[Problem]:
    """Yield the problem of a lossy site that touches its stop and is at rest in the state of a file."""
    if beginning is None or beginning.moving is None:
        return
    lattice = sections["lattice"]
    contacts = sections["contacts"]
    joined = cells_of_sites(lattice, contacts)
    at_rest = [not set(cells) & beginning.moving for cells in joined]
    yield from check_touching(contacts, clearances(lattice, contacts, len(joined)), at_rest)


def _check_undriven(sections: dict[str, Any], valid: Valid) -> Iterator[Problem]:
    """Yield problems of a lattice that nothing drives: no motion at t = 0, or a tolerance that refers to the drive.

    With a drive and a motion at t = 0, the problem of a second frequency.
    """
    drive = sections["drive"]
    initial = sections.get("initial")
    has_wave = drive.amplitude != 0 or bool(drive.wave_choices)
    if initial is not None and initial.frequency and has_wave and valid("initial", "drive"):
        yield Problem("initial.frequency", initial.frequency, "the drive has a frequency; remove this key")
    if drive.amplitude != 0:
        return

    moves = initial is not None and initial.moves
    if not moves and valid("initial") and drive.kind == DEFAULT:
        yield Problem("drive.amplitude", 0.0, "must not be zero if the lattice starts at rest; see [initial]")
    if sections["time"].atol == "paper":
        yield Problem(
            "time.atol",
            "paper",
            'is 1e-9 times the amplitude of a drive, but there is no drive; give "scaled" or a number',
        )


def _check_output(output: OutputTable, cells: int | None, cell: UnitCell | None, valid: Valid) -> Iterator[Problem]:
    """Yield problems with a window or points outside ``cells`` cells like ``cell``; None: those are invalid."""
    window = output.window
    if window is not None and cells is not None and not 1 <= window[0] <= window[1] <= cells:
        yield Problem("output.window", window, f"must be [first, last] within cells 1 to {cells}")
    if valid("output.points"):
        dofs = cell.dofs if cell else None
        yield from check_points(output.points or [], output.transmission or [], cells, dofs)


def _check_sampling(time: TimeTable, cell: UnitCell | None, valid: Valid) -> Iterator[Problem]:
    """Yield problems with an interval of samples that does not resolve the bands of ``cell``, or exceeds the run."""
    interval = time.sample_interval
    per_period = time.samples_per_period
    if per_period is not None and (interval != "auto" or time.samples is not None):
        yield Problem("time.samples_per_period", per_period, "give it, time.sample_interval or time.samples alone")
    if interval == "auto" or not valid("time.sample_interval"):
        return
    if cell:
        yield from _too_coarse(cell, interval, "time.sample_interval", interval)
    if time.samples is not None:
        yield Problem("time.samples", time.samples, "give it or time.sample_interval, not both")
    if time.end != "traverse" and time.end < interval:
        yield Problem("time.end", time.end, "shorter than one sample interval")


def _too_coarse(cell: UnitCell, interval: float, key: str, value: Any) -> list[Problem]:
    """Return the problem of samples at an ``interval`` in s that is not below the top band's Nyquist interval.

    For cells that contacts alone join it is that of a cell's highest mode. ``key`` is the key by which the case asks
    for samples, and ``value`` its value.
    """
    top = pass_bands(cell)[-1].high
    # Without springs nothing oscillates between contacts.
    if top == 0 or interval < np.pi / top:
        return []
    remedy = f"too coarse for the bands; the top band's Nyquist interval is {np.pi / top:.4g} s"
    if not cell.joins_cells:
        remedy = f"too coarse for the springs of a cell; its highest mode's Nyquist interval is {np.pi / top:.4g} s"
    if interval != value:
        remedy = f"an interval of {interval:.4g} s is {remedy}"
    return [Problem(key, value, remedy)]


def case_id(case: Case) -> str:
    """Return the first 16 digits of the SHA-256 of the resolved case."""
    # 64 bits: among a million cases two have one id with a probability of 3e-8.
    text = case.to_toml()
    if case.plugins is not None:
        text = tomli_w.dumps(without_folders(tomllib.loads(text)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class StudyCase(CaseFile):
    """The case of a study of many runs: its ``table`` is that of a run, without the study's ``section``."""

    table: Table

    @classmethod
    def keywords(cls) -> Iterable[str]:
        """Return the sections of a run, and that of the study."""
        # This class itself has no section.
        if not cls.section:
            return [*Case.sections()]
        return [*Case.sections(), cls.section]

    @classmethod
    def divide(cls, table: Table, remedy: str) -> tuple[Table, Table, list[Problem]]:
        """Return table of a run and the study's section, out of ``table``; the problem of a section that is missing.

        The problem's text ends with the ``remedy``.
        """
        of_run = dict(table)
        section = of_run.pop(cls.section, None)
        if not isinstance(section, dict):
            return of_run, {}, [Problem(cls.section, section, f"missing; {remedy}")]
        return of_run, section, []
