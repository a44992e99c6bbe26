"""The case of the verb ``law``: a lattice run, of which cell, contact law and burst are taken, and ``[law]``."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vipetsc.case.case import Case
from vipetsc.case.case_file import Problem, Section, Table
from vipetsc.case.resolve import with_preset
from vipetsc.case.schema import PRESETS, Positive
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import max_group_velocity, waves_at
from vipetsc.lattice.packet import packet_speeds

LARGEST = 1e9  # cells times samples of a run
SHORTEST = 64  # cells of the ring: more than the propagator's band


class LawTable(Section):
    """How the scattering law of one site is taken.

    ``clearance`` in m (by default the geometric mean of the sites'), ``distance`` in cells from the driven cell to the
    site (that of the leading site, without sites the burst's length, but so many that the burst is over before a wave
    is back from the site). The law reaches up to ``largest`` relative
    displacement over clearance; between neighbouring points it is refined until no share is further than ``tolerance``
    from a straight line over log z, or than the scatter, or the points are closer than ``finest``. At each,
    ``samples`` runs with amplitudes up to ``jitter`` apart from it give mean and scatter. A run ends ``settle``
    lengths of the burst after the first of the slow waves reaches the site.
    """

    clearance: Positive | None = None
    distance: int | None = Field(None, ge=1)
    largest: Annotated[float, Field(gt=1, le=1e6)] = 128.0
    tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.01
    finest: Annotated[float, Field(ge=1e-9, lt=1)] = 1e-3
    samples: int = Field(3, ge=1, le=1000)
    jitter: Annotated[float, Field(ge=0, lt=0.5)] = 0.01
    settle: Annotated[float, Field(ge=1, le=1e3)] = 1.5


@dataclass(frozen=True)
class OneSite:
    """A ring of ``cells`` driven at its first; the ``site`` (0-based) lies ``distance`` cells on; ``clearance`` in m.

    Runs end at ``end`` s, after ``samples``. ``band`` (from 0) is the drive's, in which all but 1e-3 of the energy is
    faster than ``slow`` cells/s; ``towards`` is +1 if the site lies at higher cells than the drive, else -1.
    """

    cells: int
    site: int
    distance: int
    clearance: float
    towards: int
    band: int
    slow: float
    end: float
    samples: int


class LawCase(Case):
    """A case of the verb ``law``: that of a run, whose sites are replaced by one, with the section ``[law]``."""

    law: LawTable

    verb = section = "law"
    takes = frozenset({"disorder", "rings"})
    waveforms = ("burst",)
    premise = "a law of scattering is that of a lattice"

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """The resolved sections, and everything that is wrong with them."""
        time = table.get("time", {})
        table = table | ({"time": {"engine": "auto"} | time} if isinstance(time, dict) else {})
        fields, problems = super().read(table)
        if problems:
            return fields, problems
        law, contacts = fields["law"], fields["contacts"]
        if law.get("clearance") is None:
            gaps = contacts["clearance"] or _given(with_preset(table))
            law["clearance"] = float(np.exp(np.mean(np.log(gaps)))) if gaps else None
        if law["clearance"] is None:
            problems.append(Problem("law.clearance", None, "missing; give the clearance of the site in m"))
        if "stiffness" not in contacts:
            remedy = "missing; give it or contacts.modulus, radius and poisson"
            problems.append(Problem("contacts.stiffness", None, remedy))
        return fields, problems or _place(fields)

    def fastest(self) -> float:
        """The largest group velocity of all bands in cells/s."""
        cell = self.lattice.unit_cell()
        return max(max_group_velocity(cell, number + 1)[2] for number in range(cell.dofs))

    def one_site(self) -> OneSite:
        """The lattice and the times of the law's runs (see ``studies.ring``)."""
        distance, clearance, model = self.law.distance, self.law.clearance, self.model()
        assert distance is not None and clearance is not None
        cell, interval = model.chain.cell, model.sample_interval
        band, slow, _ = packet_speeds(cell, model.drive, model.drive_mass)
        samples = int(np.ceil((distance / max(slow, 1e-9) + self.law.settle * model.drive.duration) / interval))
        cells = max(int(np.ceil(distance + self.fastest() * samples * interval)) + 1, SHORTEST)
        towards = _way(self.contacts.sites, self.drive.cell, self.lattice.cells, self.lattice.ends)[1]
        site = towards * distance % cells
        return OneSite(cells, site, distance, clearance, towards, band, slow, samples * interval, samples)


def _given(table: Table) -> list[float]:
    """The clearances of a case without sites."""
    contacts, preset = table["contacts"], PRESETS.get(str(table["lattice"].get("preset")))
    given = ContactsTable(**{k: v for k, v in contacts.items() if k == "clearance"}).clearance
    if given is None:
        return list(preset.clearance_span(1)) if preset else []
    return given if isinstance(given, list) else [given] if isinstance(given, float) else [given.first, given.last]


def _way(sites: Any, drive: int, cells: int, ends: str) -> tuple[int, int]:
    """Cells from the driven one to the nearest site that is another (0 without any), and whether up (1) or down."""
    ways = [site - drive for site in sites if site != drive]
    if ends == "periodic":
        ways = [(way + cells // 2) % cells - cells // 2 for way in ways]
    way = min(ways, key=abs, default=0)
    return abs(way), 1 if way > 0 or (way == 0 and 2 * drive <= cells + 1) else -1


def _place(fields: dict[str, Any]) -> list[Problem]:
    """Fill in the distance of a resolved case; what is wrong with its waves."""
    sections = {name: section for name, section in fields.items() if name in LawCase.model_fields}
    case = LawCase(name="law", **sections)
    cell, frequency, drive = case.lattice.unit_cell(), case.drive.frequency or 0.0, case.drive
    if not waves_at(cell, frequency):
        return [Problem("drive.frequency", frequency, "lies in no pass band, so that nothing arrives at a site")]
    model = case.model()
    least = int(np.ceil(case.fastest() * model.drive.duration / 2))
    if case.law.distance is not None and case.law.distance < least:
        remedy = f"the burst must be over before a wave from the site is back at the drive; at least {least} cells"
        return [Problem("law.distance", case.law.distance, remedy)]
    if case.law.distance is None:
        length = model.drive.duration * packet_speeds(cell, model.drive, model.drive_mass)[1]
        way = _way(case.contacts.sites, drive.cell, case.lattice.cells, case.lattice.ends)[0]
        fields["law"]["distance"] = max(way or int(min(length, LARGEST)), least)
        case = LawCase(name="law", **sections)
    setting = case.one_site()
    if setting.cells * setting.samples > LARGEST:
        remedy = (
            f"has waves of {setting.slow:.3g} cells/s, too slow to wait for: {setting.cells} cells and"
            f" {setting.samples} samples; more cycles, another frequency or a shorter law.distance need less"
        )
        return [Problem("drive.frequency", frequency, f"the burst {remedy}")]
    return []
