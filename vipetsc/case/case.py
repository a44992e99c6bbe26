"""A lattice run: a strict case file in, a typed and fully resolved case out.

A case is TOML with the sections of ``vipetsc.case.schema``, in SI units; masses and cells count from 1.
"""

import hashlib
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vipetsc.case.checks import (
    Checks,
    check_drive,
    check_lattice,
    check_sampling,
    check_sites,
    check_stiffness,
    too_coarse,
)
from vipetsc.case.reading import CaseFile, Problem, Table
from vipetsc.case.resolve import resolved, wave_speed, with_preset
from vipetsc.case.schema import ContactsTable, DriveTable, LatticeTable, OutputTable, TimeTable
from vipetsc.lattice import waves_at
from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import Chain, ToneBurst
from vipetsc.lattice.contact import Contact

# Waves this much weaker than the drive's are still followed to the relative tolerance: grazes magnify their errors.
WEAKEST = 0.1


@dataclass(frozen=True)
class Model:
    """A case in the terms of ``vipetsc.lattice``: 0-based indices, seconds, newtons, everything decided.

    ``atol`` is the pair (displacement m, velocity m/s); ``scale`` the displacement in m of the drive's
    linear wave, ``speed`` the group velocity in cells/s that ``traverse`` uses.
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

    builtin_table: ClassVar[Table] = {"name": "four-band", "lattice": {"preset": "four-band"}}

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """The resolved sections, and everything that is wrong with them."""
        sections, problems = super().read(with_preset(table))
        if problems:
            return sections, problems
        tables, samples = resolved(sections), sections["time"].samples
        if samples is not None:
            cell, interval = sections["lattice"].unit_cell(), tables["time"]["sample_interval"]
            problems = too_coarse(cell, interval, "time.samples", samples)
        return tables, problems

    @classmethod
    def check(cls, sections: dict[str, Any], invalid: set[str]) -> list[Problem]:
        """What is wrong between keys."""
        lattice, contacts, checks = sections["lattice"], sections["contacts"], Checks(invalid)
        cell = check_lattice(checks, lattice)
        if checks.valid("lattice.cells", "contacts.sites"):
            check_sites(checks, lattice, contacts)
            check_stiffness(checks, lattice, contacts)
        check_drive(checks, sections["drive"], lattice, cell)
        check_sampling(checks, sections["time"], sections["output"], cell, lattice.cells)
        return checks.problems

    def unit_cell(self) -> UnitCell:
        """The unit cell, from the preset in its reading or from ``[lattice.cell]``."""
        return self.lattice.unit_cell()

    def model(self) -> Model:
        """The case in the terms of ``vipetsc.lattice``."""
        lattice, contacts, drive, time = self.lattice, self.contacts, self.drive, self.time
        clearances = contacts.clearance if isinstance(contacts.clearance, list) else []
        sites = contacts.sites if isinstance(contacts.sites, list) else []
        assert drive.frequency is not None and time.end != "traverse" and time.sample_interval != "auto"
        chain = Chain(self.unit_cell(), lattice.cells, lattice.ends, tuple(c - 1 for c in sites), tuple(clearances))
        burst = ToneBurst(drive.amplitude, drive.frequency, drive.cycles, drive.envelope)
        scale = chain.wave_scale(burst, drive.cell - 1, drive.mass - 1)
        if time.atol == "scaled":
            small = WEAKEST * time.rtol * scale
            atol = small, small * drive.frequency
        else:
            atol = (1e-9 * abs(drive.amplitude) if time.atol == "paper" else time.atol,) * 2
        return Model(
            chain=chain,
            contact=Contact(
                law=contacts.law,
                stiffness=contacts.stiffness or 0.0,
                restitution=contacts.restitution,
                adhesion=contacts.adhesion,
                approach_floor=contacts.approach_floor,
            ),
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
        )

    def warnings(self) -> list[str]:
        """What is allowed but likely not meant, one sentence each."""
        model, sentences = self.model(), []
        if not waves_at(model.chain.cell, model.drive.frequency):
            sentences.append(
                f"drive.frequency = {model.drive.frequency:.6g} rad/s lies in no pass band, so the wave is"
                " evanescent; see the verb `bands`"
            )
        if model.end <= model.drive.duration:
            sentences.append(f"time.end = {model.end:.6g} s comes before the burst is over")
        return sentences


def case_id(case: Case) -> str:
    """The first 16 digits of the SHA-256 of the resolved case."""
    return hashlib.sha256(case.to_toml().encode()).hexdigest()[:16]
