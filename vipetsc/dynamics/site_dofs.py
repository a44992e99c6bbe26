"""Records of contact sites for compiled code: the components of the state on which each acts, its law and its stops.

A site whose masses are in cells of two ranks is followed by both, from the same numbers to the same bits; the one that
owns the site's cell logs it and has what it dissipates in its ledger.
"""

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.case import Model
from vipetsc.compiled import kernel
from vipetsc.contact.law import SHORTEST_FLIGHT, create_contacts, hold
from vipetsc.dynamics.layout import Layout
from vipetsc.lattice import Chain, contacts
from vipetsc.lattice.sites import NO_STOP

END = np.dtype([(name, np.int64) for name in ("u", "v", "cell", "mass")])
"""An end of a site: components of its displacement and velocity, -1 on ground; its owned cell, else -1; its mass."""
SITE_DOFS = np.dtype([("host", END), ("resonator", END), ("ledger", np.int64)])
"""A site: its ends, the component of the energy that it dissipates, -1 on a rank that does not own the site."""


def site_records(model: Model, numbers: ArrayLike) -> np.ndarray:
    """Return records (site,) of dtype ``SITE`` of the sites with these ``numbers`` (site,) in the lattice, from 0.

    Sites are free, or of the mode ``UNSWITCHED`` where they touch or are pressed at rest. A number below 0 stands for a
    site without stops.
    """
    numbers = np.asarray(numbers, np.int64)
    chain = model.chain
    exists = numbers >= 0
    asked = chain.sites.table[numbers[exists]]

    # A number below 0 has no stops, and the cell's own pair.
    gaps = np.full((len(numbers), 2), np.inf)
    gaps[exists] = np.column_stack([asked["plus"], asked["minus"]])
    masses = np.full(len(numbers), chain.cell.reduced_mass)
    masses[exists] = np.array(chain.reduced_masses())[numbers[exists]]
    joins_cells = np.zeros(len(numbers), bool)
    joins_cells[exists] = asked["offset"] > 0
    law_numbers = np.full(len(numbers), -1)
    law_numbers[exists] = asked["law"]
    every_law = [*chain.sites.laws, NO_STOP]
    laws = [every_law[number] for number in law_numbers.tolist()]
    sites = create_contacts(laws, gaps, masses, model.scale)

    least = gaps.min(axis=1)
    # Contacts that are pressed at rest, and beads of neighbouring cells that touch and do not dissipate, part and meet
    # all the time: no such change is landed on, and the force has a kink. With loss a contact needs an onset, at which
    # its approach velocity is taken.
    unswitched = (least < 0) | ((least == 0) & joins_cells & (sites["damping"] == 0) & ~sites["rigid"])
    hold(sites, laws, unswitched, speed=model.scale * model.drive.frequency)

    sites["rigid"] &= exists
    if sites["rigid"].any():
        _describe_rigid_sites(sites, np.where(exists, numbers, 0), model)
    return sites


def shortest_period(model: Model) -> float:
    """Return the highest frequency's period in s, or a bound of it, in lattice and drives; else a sample interval."""
    chain = model.chain
    if chain.variation is None:
        chain = Chain(chain.cell, 1)
    # Rows of M^-1 K: the springs of a mass on the diagonal, and as much beside it (Gershgorin).
    coefficients = chain.coefficients(-1, chain.cells)
    circles = np.zeros((chain.cells, chain.cell.dofs))
    for coupling in chain.cell.couplings():
        # A spring to the cell before is stored with that cell.
        springs = coefficients.stiffness[1 + min(coupling.offset, 0) :][: chain.cells, coupling.spring]
        circles[:, coupling.mass] += 2 * np.abs(springs) / coefficients.masses[1:, coupling.mass]
    highest = max(np.sqrt(circles.max()), *(drive.waveform.frequency for drive in model.drives))
    if highest == 0.0:
        return model.sample_interval
    return float(2 * np.pi / highest)


def _describe_rigid_sites(sites: np.ndarray, numbers: np.ndarray, model: Model) -> None:
    """Fill what the rigid ones among ``sites`` (site,), with these ``numbers`` (site,), have more than others."""
    elements = contacts(model.chain)
    shared = model.shared_masses
    chosen = sites["rigid"]
    sites["flight"][chosen] = SHORTEST_FLIGHT * shortest_period(model)
    sites["approach"][chosen] = model.scale * model.drive.frequency
    for name, masses in (("host", elements.start), ("resonator", elements.end)):
        mass = masses[numbers]
        sites[name] = mass
        sites["shares"] |= chosen & np.isin(mass, shared)
        cells, place = np.divmod(np.maximum(mass, 0), model.chain.cell.dofs)
        places_of = zip(cells.tolist(), place.tolist(), strict=True)
        inverse = [1 / model.chain.coefficients(cell, cell + 1).masses[0, i] for cell, i in places_of]
        sites[f"{name}_inverse"] = np.where(mass >= 0, inverse, 0.0)


def create_site_dofs(model: Model, layout: Layout) -> np.ndarray:
    """Return records (site,) of dtype ``SITE_DOFS`` of the sites ``layout.acting_sites``."""
    elements = contacts(model.chain)
    chosen = np.array(layout.acting_sites, np.int64)
    site_dofs = np.zeros(len(chosen), SITE_DOFS)
    for name, masses in (("host", elements.start[chosen]), ("resonator", elements.end[chosen])):
        ends = site_dofs[name]
        ends["u"], ends["v"] = layout.components(masses).T
        cells, mass = np.divmod(masses, layout.dofs)
        is_own = (cells >= layout.start) & (cells < layout.stop)
        ends["cell"] = np.where(is_own, cells - layout.start, -1)
        ends["mass"] = np.where(masses >= 0, mass, -1)

    owned = np.isin(layout.acting_sites, layout.sites)
    site_dofs["ledger"] = np.where(owned, layout.dissipated + np.cumsum(owned) - 1, -1)
    return site_dofs


@kernel
def relative_motion(y: np.ndarray, site_dofs: np.ndarray, i: int) -> tuple[float, float]:
    """Return w = u_resonator - u_host in m of site ``i`` in the state ``y`` (component,), and w' in m/s.

    ``site_dofs`` (site,) are of dtype ``SITE_DOFS``.
    """
    host, resonator = site_dofs[i].host, site_dofs[i].resonator
    if host.u < 0:
        return y[resonator.u], y[resonator.v]
    return y[resonator.u] - y[host.u], y[resonator.v] - y[host.v]
