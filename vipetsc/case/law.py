"""The case of the verb ``law``: cell, contact law and burst of a lattice run, and the section ``[law]``.

Sites of one kind have one scattering law, a function of the amplitude over the clearance. A kind is the law of the
contact with its restitution, the clearances on the two sides over the lesser one, and the masses that the contact
joins. The lesser clearance itself may differ between sites of one kind.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field

from vipetsc.case.case import Case
from vipetsc.case.case_file import Valid
from vipetsc.case.contacts import JOINS, SIDES, Gaps, gaps_of_sites, lists_of, path_of, values_of_sites
from vipetsc.case.model import Model
from vipetsc.case.reading import Table
from vipetsc.case.resolve import check_cell, with_preset
from vipetsc.case.schema import PRESETS, Positive
from vipetsc.case.section import Problem, Section, described
from vipetsc.case.sites import ContactsTable
from vipetsc.case.warnings import wave_warnings
from vipetsc.lattice import Contact, max_group_velocity, pass_bands, waves_at
from vipetsc.lattice.contact import LAWS, PARAMETERS
from vipetsc.lattice.packet import packet_speeds
from vipetsc.lattice.sites import Pair

# Cells times samples of a run, at most: so many take the propagator 100 s, and a point of the law has several runs.
LARGEST = 1e9
# Samples of a damped lattice resolve frequencies up to so many times the top band's edge. Half and twice as many change
# fractions of the energy by 2e-4, far less than the scatter of the runs of a point (0.01).
RESOLVED = 8
SHORTEST = 64  # cells of the ring, at least: more than the propagator's band
# Speed in cells/s of a wave that stands: its run is too large, for which the case is refused.
SLOWEST = 1e-9
NO_SITES: dict[str, Any] = {"sites": [], "clearance": [], **dict.fromkeys(("each", *SIDES, *JOINS))}
"""Changes of ``[contacts]`` that leave no site; None removes a key."""
DIGITS = 12  # of the ratio of two clearances: sites of one kind differ by rounding


class LawTable(Section):
    """How the scattering law of one site is computed.

    The law is that of one kind of site: a contact law with its restitution, the ratio of the clearances on both sides,
    and the masses that the contact joins. It is a function of z, the largest relative displacement over the clearance.
    Points are added until all fractions between neighbouring points are straight lines over log z, within ``tolerance``
    or the scatter.
    """

    site: int | None = described(
        "number of a site, from 1, whose kind the law has; default: the site nearest to the drive", None, ge=1
    )
    clearance: Positive | None = described(
        "clearance of the single site; default: geometric mean over the sites", None, unit="m"
    )
    distance: int | None = described(
        "cells from the driven cell to the site; default: that of the nearest site, or without sites the"
        " length of the burst",
        None,
        unit="cells",
        ge=1,
    )
    largest: Annotated[float, Field(gt=1, le=1e6)] = described(
        "largest z, the relative displacement of the linear wave over the clearance", 128.0
    )
    tolerance: Annotated[float, Field(gt=0, lt=1)] = described(
        "largest deviation of a fraction of the energy from linear interpolation over log z between points", 0.01
    )
    finest: Annotated[float, Field(ge=1e-9, lt=1)] = described(
        "largest distance in log z of neighbouring points between which no further one is added", 1e-3
    )
    samples: int = described("runs at each point, for mean and scatter", 3, ge=1, le=1000)
    jitter: Annotated[float, Field(ge=0, lt=0.5)] = described(
        "largest relative deviation of the amplitudes of these runs", 0.01
    )
    settle: Annotated[float, Field(ge=1, le=1e3)] = described(
        "time from the arrival of slow waves at the site to the end of a run, in lengths of the burst", 1.5
    )


class NearestSite(NamedTuple):
    """The site nearest to the drive: ``distance`` in cells, 0 without any; ``towards`` is +1 at higher cells, else -1.

    ``number`` (from 0) is that in the list of the sites.
    """

    distance: int
    towards: int
    number: int


@dataclass(frozen=True)
class OneSite:
    """A ring of ``cells`` cells that is driven in its first cell, with one ``site`` ``distance`` cells away.

    ``site`` is its cell (0-based), ``kind`` the number of its kind, ``clearance`` in m the lesser one of its two sides;
    ``towards`` is +1 if it lies at higher cells than the drive, else -1. Runs end at ``end`` s, after ``samples``
    intervals of ``interval`` s. ``band`` (from 0) is the drive's; all but 1e-3 of its energy there is faster than
    ``slow`` cells/s.
    """

    cells: int
    site: int
    distance: int
    kind: int
    clearance: float
    towards: int
    band: int
    slow: float
    end: float
    samples: int
    interval: float


class SiteKind(NamedTuple):
    """The properties that sites of one kind have in common.

    ``sides`` are the clearances on the sides + and - over the lesser of both; inf stands for no stop.
    """

    law: Contact
    sides: tuple[float, float]
    pair: Pair


class SiteKinds(NamedTuple):
    """The ``kinds`` of a lattice's sites in the order of their first site, and the number of each site's (``of``)."""

    kinds: tuple[SiteKind, ...]
    of: tuple[int, ...]

    def sites(self, kind: int) -> list[int]:
        """Return the sites (from 0) of the ``kind`` of that number."""
        return [site for site, number in enumerate(self.of) if number == kind]


class LawCase(Case):
    """A case of the verb ``law``: that of a run, whose sites are replaced by one, with the section ``[law]``."""

    law: LawTable

    verb = section = "law"
    refuses: ClassVar[Mapping[str, str]] = {
        "nonlinear springs": "with nonlinear springs, waves depend on amplitude even without contact",
        "profiles": "the law compares the waves that arrive at a site and leave it, in equal cells",
        "scatter": "the law compares the waves that arrive at a site and leave it, in equal cells",
        "strips": "the waves that leave a site of a strip go to all sides",
        "absorbing ends": "runs end before waves return, so that nothing has to be absorbed",
        "touching stops": "the law is one of amplitude over clearance, and there is no clearance",
        "rigid stops": "sites are compared by the stiffness of their stops",
        "initial motion": "fractions refer to the work of the drive, in a lattice at rest",
        "many drives": "the law has one wave",
        "other waveforms": 'the scattering law needs a finite single-frequency wave: use waveform = "burst"',
    }
    waveforms = ("burst",)

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the resolved sections, and everything that is wrong with them."""
        sections, problems = super().read(table)
        if problems:
            return sections, problems

        problems = list(_check_sites(sections["law"], sections["contacts"]))
        if problems:
            return sections, problems
        clearance = cls._clearance(sections, table)
        if clearance is None:
            problems.append(Problem("law.clearance", None, "missing; give the clearance of the site in m"))
            return sections, problems

        # Only a whole case has a model, by whose burst the distance is judged.
        case = cls._of_sections(sections, clearance=clearance)
        problems = case._place_problems()
        if problems:
            return sections, problems
        if case.law.distance is None:
            case = cls._of_sections(sections, clearance=clearance, distance=case._default_distance())
        return sections | {"law": case.law}, case._size_problems()

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> Iterator[Problem]:
        """Yield problems between keys."""
        yield from super().check(sections, valid)
        if not valid("lattice"):
            return
        cell, _ = check_cell(sections["lattice"])
        if cell is not None and not cell.joins_cells:
            remedy = "only contacts join the cells, so that no linear wave arrives at a site"
            yield Problem("lattice.cell.springs", None, f"{remedy}; add springs with next_cell, or use run")

    @classmethod
    def _of_sections(cls, sections: Mapping[str, Any], **update: Any) -> Self:
        """Return the case of resolved ``sections`` in which the section ``[law]`` is changed."""
        changed = {**sections, "law": sections["law"].model_copy(update=update)}
        return cls.resolved({"name": "law", **changed})

    @classmethod
    def _clearance(cls, sections: Mapping[str, Any], table: Table) -> float | None:
        """Return clearance in m of the law of resolved ``sections``, read from ``table``; None where there is none."""
        given = sections["law"].clearance
        contacts = sections["contacts"]
        if given is not None:
            return float(given)
        if contacts.clearance:
            case = cls._of_sections(sections)
            return case.mean_clearance(case._kind())
        clearances = _given_clearances(with_preset(table))
        if not clearances:
            return None
        return mean_clearance(contacts, clearances, range(len(clearances)))

    @cached_property
    def kinds(self) -> SiteKinds:
        """The kinds of the sites; of a lattice without sites the one that a site would have."""
        if self.contacts.sites:
            return site_kinds(self.model())
        clearance = self.law.clearance or 1.0
        return site_kinds(self.varied(contacts={"sites": [1], "clearance": [clearance]}).model())

    def _kind(self) -> int:
        """Return the number of the kind whose law is computed."""
        if self.law.site is not None:
            return self.kinds.of[self.law.site - 1]
        if not self.contacts.sites:
            return 0
        return self.kinds.of[self._nearest_site().number]

    def mean_clearance(self, kind: int) -> float:
        """Return the geometric mean in m of the lesser clearances of the sites of the ``kind`` of that number."""
        clearances = self.contacts.clearance
        assert isinstance(clearances, list)
        return mean_clearance(self.contacts, clearances, self.kinds.sites(kind))

    def warnings(self) -> list[str]:
        """Return warnings about the wave; those about lattice, times and sites do not apply to the runs of a law."""
        return list(wave_warnings(self.model()))

    def fastest(self) -> float:
        """Return the largest group velocity of all bands in cells/s."""
        cell = self.lattice.unit_cell()
        return max(max_group_velocity(cell, number + 1)[2] for number in range(cell.dofs))

    def one_site(self, kind: int | None = None) -> OneSite:
        """Return lattice and times of the law's runs (see ``studies.ring``), with a site of the kind ``kind``.

        By default it is the kind of ``law.site``, and the clearance that of the law.
        """
        law = self.law
        clearance = law.clearance
        if kind is None:
            kind = self._kind()
        elif len(self.kinds.kinds) > 1:
            # The law's clearance is that of another kind.
            clearance = self.mean_clearance(kind)
        model = self.model()
        assert law.distance is not None and clearance is not None

        cell = model.chain.cell
        interval = model.sample_interval
        if cell.is_damped:
            # The contact's force follows from samples, and has parts far above the bands.
            interval = min(interval, np.pi / (RESOLVED * pass_bands(cell)[-1].high))
        band, slow, _ = packet_speeds(cell, model.drive, model.drive_mass)
        # The slow waves of the burst set the end: until they have passed, the fractions of the energy still change.
        end = law.distance / max(slow, SLOWEST) + law.settle * model.drive.duration
        samples = int(np.ceil(end / interval))
        # Until the end nothing reaches the site from behind: the wave that the drive sends the other way round has
        # ``cells - distance`` to go, and what the site sends out a whole revolution.
        cells = max(int(np.ceil(law.distance + self.fastest() * samples * interval)) + 1, SHORTEST)
        towards = self._nearest_site().towards
        return OneSite(
            cells=cells,
            site=towards * law.distance % cells,
            distance=law.distance,
            kind=kind,
            clearance=clearance,
            towards=towards,
            band=band,
            slow=slow,
            end=samples * interval,
            samples=samples,
            interval=interval,
        )

    def _nearest_site(self) -> NearestSite:
        """Return nearest site that is not in the driven cell; without any, one in the direction of the farther end."""
        drive = self.drive.cell
        cells = self.lattice.cells
        assert isinstance(self.contacts.sites, list)
        offsets = [site - drive for site in self.contacts.sites]
        if self.lattice.ends == "periodic":
            # Along the shorter arc of the ring.
            offsets = [(offset + cells // 2) % cells - cells // 2 for offset in offsets]

        numbers = [number for number, offset in enumerate(offsets) if offset != 0]
        if not numbers:
            towards = -1
            if 2 * drive <= cells + 1:
                towards = 1
            return NearestSite(distance=0, towards=towards, number=0)
        nearest = min(numbers, key=lambda number: abs(offsets[number]))
        return NearestSite(distance=abs(offsets[nearest]), towards=int(np.sign(offsets[nearest])), number=nearest)

    def _least_distance(self) -> int:
        """Return least number of cells from the drive to the site for which the burst ends before a wave is back."""
        # The fastest wave goes to the site and back in the duration of the burst.
        return int(np.ceil(self.fastest() * self.model().drive.duration / 2))

    def _default_distance(self) -> int:
        """Return distance of the nearest site, without sites the length of the burst; at least ``_least_distance``."""
        model = self.model()
        distance = self._nearest_site().distance
        if not distance:
            _, slow, _ = packet_speeds(model.chain.cell, model.drive, model.drive_mass)
            distance = int(min(model.drive.duration * slow, LARGEST))
        return max(distance, self._least_distance())

    def _place_problems(self) -> list[Problem]:
        """Return problems with the frequency of the wave of a resolved case, and with the distance that it gives."""
        frequency = self.drive.frequency or 0.0
        if not waves_at(self.lattice.unit_cell(), frequency):
            return [Problem("drive.frequency", frequency, "lies in no pass band, so that no wave reaches the site")]
        least = self._least_distance()
        if self.law.distance is not None and self.law.distance < least:
            remedy = f"the burst must end before a wave from the site returns to the drive; give at least {least} cells"
            return [Problem("law.distance", self.law.distance, remedy)]
        return []

    def _size_problems(self) -> list[Problem]:
        """Return the problem of runs that are too large, because the wave is too slow."""
        setting = self.one_site()
        if setting.cells * setting.samples <= LARGEST:
            return []
        remedy = (
            f"the burst has waves of {setting.slow:.3g} cells/s, too slow to wait for: {setting.cells} cells and"
            f" {setting.samples} samples; more cycles, another frequency or a shorter law.distance reduce these numbers"
        )
        return [Problem("drive.frequency", self.drive.frequency, remedy)]


def _check_sites(law: LawTable, contacts: ContactsTable) -> Iterator[Problem]:
    """Yield problems with the sites of resolved ``contacts`` whose law is to be computed."""
    sites = contacts.sites
    clearances = contacts.clearance
    assert isinstance(sites, list) and isinstance(clearances, list)
    if law.site is not None and law.site > len(sites):
        yield Problem("law.site", law.site, f"sites are numbered from 1 to {len(sites)}")
    if contacts.stiffness is None and "stiffness" not in lists_of(contacts):
        yield Problem("contacts.stiffness", None, "missing; give it or contacts.modulus, radius and poisson")

    pressed = values_of_sites(contacts, "precompression", len(sites))
    lesser = lesser_clearances(gaps_of_sites(contacts, clearances))
    for number, clearance in enumerate(lesser):
        if clearance <= 0:
            remedy = (
                f"site {number + 1} is pressed at rest; the law is one of amplitude over clearance, and there is no"
                " clearance: remove it"
            )
            yield Problem(path_of(contacts, "precompression"), pressed[number], remedy)
            return


def _given_clearances(table: Table) -> list[float]:
    """Return the clearances of a case without sites."""
    contacts = {key: value for key, value in table["contacts"].items() if key == "clearance"}
    clearance = ContactsTable(**contacts).clearance
    if isinstance(clearance, list):
        return clearance
    if isinstance(clearance, float):
        return [clearance]
    if clearance:
        return [clearance.first, clearance.last]
    preset = PRESETS.get(str(table["lattice"].get("preset")))
    if preset is None:
        return []
    return list(preset.clearance_span(1))


def lesser_clearances(gaps: Gaps) -> np.ndarray:
    """Return the clearance (site,) in m on the side where it is less; ``gaps`` are those of both sides."""
    return np.reshape(gaps, (-1, 2)).min(axis=1)


def site_kinds(model: Model) -> SiteKinds:
    """Return the kinds of the sites of a ``model`` whose clearances are above 0."""
    number: dict[SiteKind, int] = {}
    of = []
    for site in model.chain.sites:
        plus, minus = site.gaps
        lesser = min(plus, minus)
        sides = (round(plus / lesser, DIGITS), round(minus / lesser, DIGITS))
        of.append(number.setdefault(SiteKind(law=site.law, sides=sides, pair=site.pair), len(number)))
    return SiteKinds(kinds=tuple(number), of=tuple(of))


def mean_clearance(contacts: ContactsTable, clearances: Sequence[float], sites: Sequence[int]) -> float:
    """Return the geometric mean in m of the lesser clearances of those ``sites`` (from 0), all above 0."""
    # Geometric, since the law depends on ratios of amplitudes to clearances.
    lesser = lesser_clearances(gaps_of_sites(contacts, list(clearances)))
    return float(np.exp(np.mean(np.log(lesser[list(sites)]))))


def contacts_of_one(contacts: ContactsTable, site: int, kind: SiteKind, cell: int, clearance: float) -> dict[str, Any]:
    """Return changes of ``[contacts]`` that leave a single site of a ``kind`` in ``cell`` (from 1).

    ``clearance`` in m is its lesser clearance; ``site`` (from 0) is a site of that kind in ``contacts``.
    """
    # The values of this site in the lists become those of all sites, of which one is left.
    of_site = {key: values[site] for key, values in lists_of(contacts).items()}
    if "stiffness" in of_site:
        # The stiffness of the site is that of its own material.
        of_site |= dict.fromkeys(("modulus", "radius", "poisson"))

    # Parameters of other laws, which the lists may have for other sites, are removed.
    law = kind.law.law
    of_site |= {key: None for key, parameter in PARAMETERS.items() if parameter.law != law}
    if law in LAWS:
        of_site["parameters"] = None

    changes: dict[str, Any] = of_site | {"each": None} | dict.fromkeys(SIDES)
    plus, minus = kind.sides
    if minus == np.inf:
        changes["side"] = "plus"
    elif plus == np.inf:
        changes["side"] = "minus"
    elif plus != minus:
        changes["clearance_minus"] = clearance * minus
    # The key ``clearance`` is that of the side +, or of the side - if stops are on that side alone.
    first = clearance
    if plus < np.inf:
        first *= plus
    return changes | {"sites": [cell], "clearance": [first]}
