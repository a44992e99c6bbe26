"""A lattice run: a strict case file in, a typed and fully resolved case out.

A case is TOML with the sections of ``vipetsc.case.schema``, in SI units; masses and cells count from 1.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from vipetsc.case.contacts import Gaps, check_alike, contact_of, gaps_of_sites, laws_of_sites
from vipetsc.case.disorder import SEED, DisorderTable, scatter
from vipetsc.case.initial import InitialTable, beginning_of, check_initial
from vipetsc.case.reading import CaseFile, Problem, Table, Valid, read_section
from vipetsc.case.resolve import (
    build_chain,
    check_cell,
    check_contacts,
    check_wave,
    driven_wave,
    resolved,
    wave_speed,
    with_preset,
)
from vipetsc.case.schema import CONTACTS, AnalysisTable, DriveTable, LatticeTable, OutputTable, PetscTable, TimeTable
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import Chain, Contact, ToneBurst, UnitCell, pass_bands, waves_at

# Waves this much weaker than the drive's are still followed to the relative tolerance: grazes magnify their errors.
WEAKEST = 0.1
MOST_SAMPLES = 1e9


@dataclass(frozen=True)
class Model:
    """A case in the terms of ``vipetsc.lattice``: 0-based indices, seconds, newtons, everything decided.

    ``atol`` is the pair (displacement m, velocity m/s); ``scale`` the displacement in m of the drive's
    linear wave or of the ``initial`` state, ``speed`` the group velocity in cells/s that ``traverse`` uses. The law of
    each site is in ``laws`` (() if all have ``contact``), its clearances in m on the sides + and - are in ``gaps`` (()
    if the chain's are those of both).
    """

    chain: Chain
    contact: Contact
    drive: ToneBurst
    drive_cell: int
    drive_mass: int
    end: float
    sample_interval: float
    method: str
    rtol: float
    atol: tuple[float, float]
    scale: float
    speed: float
    initial: InitialTable | None = None
    laws: tuple[Contact, ...] = ()
    gaps: Gaps = ()

    @property
    def samples(self) -> int:
        """Number of uniform samples, the one at t = 0 included."""
        return int(np.floor(self.end / self.sample_interval * (1 + 1e-12))) + 1


class Case(CaseFile):
    """A lattice run with every default filled in; make one with ``load``, ``from_table`` or ``from_toml``."""

    lattice: LatticeTable
    contacts: ContactsTable
    drive: DriveTable
    time: TimeTable
    output: OutputTable
    initial: InitialTable | None = None
    analysis: AnalysisTable | None = None
    petsc: PetscTable | None = None

    builtin_table: ClassVar[Table] = {"name": "four-band", "lattice": {"preset": "four-band"}}

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """The resolved sections, and everything that is wrong with them."""
        sections, problems = super().read(with_preset(table))
        disorder, wrong = read_section(DisorderTable, table.get("disorder", {}), "disorder")
        if problems := problems + wrong:
            return sections, problems
        beginning, drive = None, sections["drive"]
        if (initial := sections.get("initial")) and initial.moves:
            frequency = driven_wave(sections["lattice"].unit_cell(), drive)[0] if _ways(drive) else None
            beginning, problems = beginning_of(initial, sections["lattice"], frequency)
            if problems:
                return sections, problems
        tables, samples = resolved(sections, beginning), sections["time"].samples
        count = tables["time"]["end"] / tables["time"]["sample_interval"]
        if count > MOST_SAMPLES:
            remedy = f"makes {count:.3g} samples; at most {MOST_SAMPLES:.3g} can be taken, and the bands need so many"
            return tables, [Problem("time.end", sections["time"].end, remedy)]
        if samples is not None:
            cell, interval = sections["lattice"].unit_cell(), tables["time"]["sample_interval"]
            problems = _too_coarse(cell, interval, "time.samples", samples)
        if "disorder" in table and not problems:
            nominal, (tables, problems) = tables, scatter(tables, disorder, sections["lattice"], sections["contacts"])
            if tables is not nominal:
                problems = [replace(p, key=f"{SEED} = {disorder.seed} draws {p.key}") for p in super().read(tables)[1]]
        return tables, problems

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> Iterator[Problem]:
        """What is wrong between keys."""
        lattice, contacts = sections["lattice"], sections["contacts"]
        cell, problems = check_cell(lattice) if valid("lattice") else (None, [])
        yield from problems
        if valid("lattice.cells", "contacts.sites"):
            yield from check_contacts(lattice, contacts, valid)
        length = lattice.cells if valid("lattice.cells") else None
        initial, undriven = sections.get("initial", InitialTable.model_validate({})), sections["drive"].amplitude == 0
        if valid("initial.kind"):
            yield from check_initial(initial, lattice, cell, valid)
        if cls is not Case and valid("contacts"):
            yield from check_alike(contacts)
        if initial.moves and cls is not Case:
            yield Problem("initial.kind", initial.kind, "this verb is about a wave in a lattice at rest; leave it out")
        if undriven and not initial.moves and valid("initial"):
            yield Problem("drive.amplitude", 0.0, "must not be zero in a lattice at rest; see [initial]")
        if undriven and sections["time"].atol == "paper":
            yield Problem("time.atol", "paper", 'is 1e-9 of the drive, and there is none; give "scaled" or a number')
        of_drive = list(_check_drive(sections["drive"], length, cell, valid))
        yield from of_drive
        if cell and not of_drive and _ways(sections["drive"]) and valid("lattice", "drive", "time.end"):
            yield from check_wave(cell, sections["drive"], sections["time"])
        yield from _check_sampling(sections["time"], cell, valid)
        window = sections["output"].window
        if window is not None and length is not None and not 1 <= window[0] <= window[1] <= length:
            yield Problem("output.window", window, f"must be [first, last] within cells 1 to {length}")

    def model(self) -> Model:
        """The case in the terms of ``vipetsc.lattice``."""
        contacts, drive, time = self.contacts, self.drive, self.time
        assert drive.frequency is not None and time.end != "traverse" and time.sample_interval != "auto"
        chain = build_chain(self.lattice, contacts)
        burst = ToneBurst(drive.amplitude, drive.frequency, drive.cycles, drive.envelope)
        scale = chain.wave_scale(burst, drive.cell - 1, drive.mass - 1) if drive.amplitude else 0.0
        if self.initial:
            scale = max(scale, self.initial.amplitude or 0.0)
        if time.atol == "scaled":
            small = WEAKEST * time.rtol * scale
            atol = small, small * drive.frequency
        else:
            atol = (1e-9 * abs(drive.amplitude) if time.atol == "paper" else time.atol,) * 2
        return Model(
            chain=chain,
            contact=contact_of(contacts),
            drive=burst,
            drive_cell=drive.cell - 1,
            drive_mass=drive.mass - 1,
            end=time.end,
            sample_interval=time.sample_interval,
            method=time.method,
            rtol=time.rtol,
            atol=atol,
            scale=scale,
            speed=wave_speed(chain.cell, drive.frequency),
            initial=self.initial,
            laws=laws_of_sites(contacts, len(chain.sites)),
            gaps=gaps_of_sites(contacts, list(chain.clearances)),
        )

    @property
    def contact_radius(self) -> float | None:
        """Radius in m of the spheres in contact, the preset's where another one is not given; None if it is unknown."""
        return self.contacts.radius or (CONTACTS["radius"] if self.lattice.preset else None)

    def warnings(self) -> list[str]:
        """What is allowed but likely not meant, one sentence each."""
        model, output = self.model(), self.output
        drive, sites, top = model.drive, model.chain.sites, pass_bands(model.chain.cell)[-1].high
        interval, (first, last) = output.stride * model.sample_interval, output.window or (1, model.chain.cells)
        outside = f"drive.frequency = {drive.frequency:.6g} rad/s lies in no pass band"
        coarse = f"fields kept every {interval:.4g} s resolve {np.pi / interval:.5g} of {top:.5g} rad/s"
        sparse = f"fields of one cell in {output.every} do not resolve waves shorter than {2 * output.every} cells"
        checks = [
            (drive.amplitude and not waves_at(model.chain.cell, drive.frequency),
             f"{outside}, so the wave is evanescent; see the verb `bands`"),
            (model.end <= drive.duration, f"time.end = {model.end:.6g} s comes before the burst is over"),
            # In the words of the analysis, so that each is said once.
            (output.fields and interval >= np.pi / top, f"{coarse}: dispersion, bands and ibtet are not measured"),
            (output.fields and output.every > 1,
             f"{sparse}: wavenumber_content, dispersion, partition and entropy are not measured"),
            (output.fields and sites and not any(first <= site + 1 <= last for site in sites),
             f"output.window = [{first}, {last}] holds none of the contact sites"),
        ]  # fmt: skip
        return [sentence for applies, sentence in checks if applies]


def _check_drive(drive: DriveTable, length: int | None, cell: UnitCell | None, valid: Valid) -> Iterator[Problem]:
    """The frequency is given in one way, and the driven mass exists."""
    if valid("drive"):
        by_band = drive.wavenumber is not None or drive.at is not None
        ways = _ways(drive)
        remedy = 'give one of: frequency; wavenumber and band; band and at = "max-group-velocity"'
        if len(ways) != 1 and (ways or drive.amplitude != 0):
            yield Problem("drive.frequency", drive.frequency, remedy)
        elif by_band != (drive.band is not None):
            yield Problem("drive.band", drive.band, remedy)
        if cell and drive.band is not None and drive.band > cell.dofs:
            yield Problem("drive.band", drive.band, f"the cell has {cell.dofs} bands")
    if length is not None and drive.cell > length:
        yield Problem("drive.cell", drive.cell, f"outside the lattice; cells count from 1 to {length}")
    if cell and drive.mass > cell.dofs:
        yield Problem("drive.mass", drive.mass, f"the cell has {cell.dofs} masses")


def _ways(drive: DriveTable) -> list[Any]:
    """The frequency as it is given, in how many ways it is."""
    return [way for way in (drive.frequency, drive.wavenumber, drive.at) if way is not None]


def _check_sampling(time: TimeTable, cell: UnitCell | None, valid: Valid) -> Iterator[Problem]:
    """The samples resolve the bands, and there is one before the end."""
    interval = time.sample_interval
    if interval == "auto" or not valid("time.sample_interval"):
        return
    if cell:
        yield from _too_coarse(cell, interval, "time.sample_interval", interval)
    if time.samples is not None:
        yield Problem("time.samples", time.samples, "give it or time.sample_interval, not both")
    if time.end != "traverse" and time.end < interval:
        yield Problem("time.end", time.end, "shorter than one sample interval")


def _too_coarse(cell: UnitCell, interval: float, key: str, value: Any) -> list[Problem]:
    """The problem of samples every ``interval`` s, asked for by ``key``, beyond the top band's Nyquist interval."""
    nyquist = np.pi / pass_bands(cell)[-1].high
    if interval < nyquist:
        return []
    given = "" if interval == value else f"an interval of {interval:.4g} s is "
    return [Problem(key, value, f"{given}too coarse for the bands; the top band's Nyquist interval is {nyquist:.4g} s")]


def case_id(case: Case) -> str:
    """The first 16 digits of the SHA-256 of the resolved case."""
    return hashlib.sha256(case.to_toml().encode()).hexdigest()[:16]
