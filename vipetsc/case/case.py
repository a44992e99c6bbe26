"""What to simulate: a strict case file in, a typed and fully resolved case out.

A case is TOML with the sections of ``vipetsc.case.schema``, in SI units; masses and cells count from 1. Whatever
is wrong with it is reported at once, as a ``CaseError`` that names each key's path, the value, the remedy.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from vipetsc.case.checks import cross_problems, sites_of, too_coarse, unit_cell_of
from vipetsc.case.schema import (
    CaseError,
    ClearanceSpan,
    ContactsTable,
    DriveTable,
    LatticeTable,
    OutputTable,
    Problem,
    Section,
    TimeTable,
    read_section,
    read_toml,
    unknown_key,
    with_overrides,
)
from vipetsc.lattice.bloch import bloch, max_group_velocity, pass_bands, waves_at
from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import Chain, log_clearances
from vipetsc.lattice.contact import Contact, ContactLaw, contact_stiffness
from vipetsc.lattice.drive import ToneBurst
from vipetsc.lattice.presets import PRESETS

# Waves this much weaker than the drive's are still followed to the relative tolerance: grazes magnify their errors.
WEAKEST = 0.1
# Sections of the same file that belong to verbs of their own, which check them.
ELSEWHERE = ("nnm", "sweep", "design")


@dataclass(frozen=True)
class Model:
    """A case in the lattice's own terms: 0-based indices, seconds, newtons, everything decided.

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


class Case(Section):
    """A case with every default filled in; build one with ``from_table``, ``from_toml`` or ``load``."""

    name: str
    lattice: LatticeTable
    contacts: ContactsTable
    drive: DriveTable
    time: TimeTable
    output: OutputTable

    @classmethod
    def load(cls, path: str | Path, overrides: Iterable[str] = ()) -> Case:
        """The case in file ``path`` with ``a.b=value`` overrides; raises CaseError or OSError."""
        return cls.from_table(read_toml(path), overrides, str(path))

    @classmethod
    def from_toml(cls, text: str) -> Case:
        """The case written in ``text``."""
        return cls.from_table(tomllib.loads(text))

    @classmethod
    def builtin(cls, overrides: Iterable[str] = ()) -> Case:
        """The case of ``python -m vipetsc`` without a verb: four-band, calibrated, A = 24.33 N."""
        table = {"name": "four-band", "lattice": {"preset": "four-band"}}
        return cls.from_table(table, overrides, "built-in case")

    @classmethod
    def from_table(cls, table: dict[str, Any], overrides: Iterable[str] = (), source: str = "case") -> Case:
        """The resolved case of a parsed TOML table; raises CaseError with everything that is wrong."""
        table, problems = with_overrides(table, overrides)
        kinds = {name: field.annotation for name, field in cls.model_fields.items()}
        valid = [*kinds, *ELSEWHERE]
        problems += [unknown_key(key, table[key], valid) for key in table if key not in valid]
        table = _with_preset(table)
        name = table.get("name", "case")
        if not isinstance(name, str) or not name:
            problems.append(Problem("name", name, "must be a non-empty string"))
        sections = {}
        for key, kind in kinds.items():
            if key != "name":
                sections[key], wrong = read_section(kind, table.get(key, {}), key)
                problems += wrong
        problems += cross_problems(sections, {p.key for p in problems})
        if problems:
            raise CaseError(problems, source)
        resolved = _resolved(sections)
        samples = sections["time"].samples
        if samples is not None:
            cell = unit_cell_of(sections["lattice"])
            problems = too_coarse(cell, resolved["time"]["sample_interval"], "time.samples", samples)
            if problems:
                raise CaseError(problems, source)
        return cls(name=name, **resolved)

    def to_toml(self) -> str:
        """The resolved case as TOML; reading it back gives the same case."""
        return tomli_w.dumps(self.model_dump(by_alias=True, exclude_none=True))

    def unit_cell(self) -> UnitCell:
        """The unit cell, from the preset in its reading or from ``[lattice.cell]``."""
        return unit_cell_of(self.lattice)

    def model(self) -> Model:
        """The case in the lattice's own terms."""
        lattice, contacts, drive, time = self.lattice, self.contacts, self.drive, self.time
        cell = self.unit_cell()
        clearances = tuple(contacts.clearance or ())
        chain = Chain(cell, lattice.cells, lattice.ends, tuple(c - 1 for c in contacts.sites), clearances)
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
                law=ContactLaw.named(contacts.law),
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
            speed=_speed(cell, drive.frequency),
        )

    def warnings(self) -> list[str]:
        """What is allowed but likely not meant, one sentence each."""
        found = []
        if not waves_at(self.unit_cell(), self.drive.frequency):
            found.append(
                f"drive.frequency = {self.drive.frequency:.6g} rad/s lies in no pass band, so the wave is"
                " evanescent; see the verb `bands`"
            )
        if self.time.end <= 2 * np.pi * self.drive.cycles / self.drive.frequency:
            found.append(f"time.end = {self.time.end:.6g} s comes before the burst is over")
        return found


def _speed(cell: UnitCell, frequency: float) -> float:
    """Group velocity in cells/s of the fastest wave at ``frequency``; in a gap, the cell's fastest."""
    speed = max((wave[2] for wave in waves_at(cell, frequency)), default=0.0)
    return speed or max(max_group_velocity(cell, band + 1)[2] for band in range(cell.dofs))


# A case's own choice drops these of the preset.
_REPLACES = {
    "stiffness": {"modulus", "radius", "poisson"},
    "frequency": {"wavenumber", "band", "at"},
    "wavenumber": {"at"},
    "at": {"wavenumber"},
}


def _with_preset(table: dict[str, Any]) -> dict[str, Any]:
    """Fill in the preset's length, contacts and drive; a case's own choice drops the preset's."""
    lattice = table.get("lattice", {})
    if not isinstance(lattice, dict):
        return table
    if "cell" not in lattice:
        lattice = {"preset": "four-band"} | lattice
    preset = PRESETS.get(str(lattice.get("preset")))
    if preset is None or "cell" in lattice:
        return table | {"lattice": lattice}
    filled = table | {"lattice": {"cells": preset.cells} | lattice}
    for name, defaults in (("contacts", preset.contacts), ("drive", preset.drive)):
        own = table.get(name, {})
        if isinstance(own, dict):
            dropped = {key for choice in own.keys() & _REPLACES.keys() for key in _REPLACES[choice]}
            filled[name] = {k: v for k, v in defaults.items() if k not in dropped} | own
    return filled


def _resolved(sections: dict[str, Any]) -> dict[str, dict]:
    """Every choice made: sites and clearances listed; stiffness, frequency and times as numbers."""
    tables = {name: section.model_dump(by_alias=True, exclude_none=True) for name, section in sections.items()}
    lattice, contacts, drive, time = (sections[n] for n in ("lattice", "contacts", "drive", "time"))
    cell = unit_cell_of(lattice)

    sites, clearance = sites_of(lattice, contacts), contacts.clearance
    if isinstance(clearance, ClearanceSpan):
        clearance = log_clearances(clearance.first, clearance.last, len(sites))
    elif isinstance(clearance, float):
        clearance = [clearance] * len(sites)
    elif clearance is None:
        clearance = PRESETS[lattice.preset].clearances(len(sites)) if sites else []
    tables["contacts"] |= {"sites": sites, "clearance": list(clearance)}
    if contacts.stiffness is None and contacts.modulus is not None:
        stiffness = contact_stiffness(contacts.modulus, contacts.radius, contacts.poisson)
        tables["contacts"] = {k: v for k, v in tables["contacts"].items() if k not in ("modulus", "radius", "poisson")}
        tables["contacts"]["stiffness"] = float(stiffness)

    if drive.wavenumber is not None:
        frequency = float(bloch(cell, drive.wavenumber).frequency[drive.band - 1])
    elif drive.at is not None:
        frequency = max_group_velocity(cell, drive.band)[1]
    else:
        frequency = drive.frequency
    tables["drive"] = {k: v for k, v in tables["drive"].items() if k not in ("wavenumber", "band", "at")}
    tables["drive"]["frequency"] = frequency

    end = time.end
    if end == "traverse":
        end = 2 * np.pi * drive.cycles / frequency + lattice.cells / _speed(cell, frequency)
    interval = time.sample_interval
    if time.samples is not None:
        interval = end / (time.samples - 1)
        del tables["time"]["samples"]
    elif interval == "auto":
        interval = _round_down(np.pi / (3 * pass_bands(cell)[-1].high))
    tables["time"] |= {"sample_interval": float(interval), "end": float(end)}
    return tables


def _round_down(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above ``value``."""
    decade = int(np.floor(np.log10(value)))
    lead = max(m for m in (1, 2, 5) if m * 10.0**decade <= value)
    return float(f"{lead}e{decade}")
