r"""Energy that dashpots and contacts take from a motion in a period, and the force that gives it back.

Motions of a branch are those without loss. Along one of them, to first order in the loss,

    Delta E = int v^T C v dt + sum over contacts of (c/|w'_minus|) int f w'^2 dt

is lost in a period, with the dashpots C and the damping c of each contact. Of weakly damped motions the energy decays
by the factor exp(-2 zeta Om t), with zeta = Delta E/(4 pi E) at every energy, which is the damping ratio of a linear
mode. A force F cos(Om t) on one mass, a quarter of a period ahead of its displacement, gives the work pi F |U_1| in a
period, with the first harmonic U_1 of that mass: F = Delta E/(pi |U_1|) keeps the motion going (resonance by quadrature
of phase; M. Peeters, G. Kerschen, J. C. Golinval, J. Sound Vib. 330 (2011) 486).

The integrals are sums over the harmonics of the motion (``balance.harmonics`` for contacts); those of an orbit that is
shot are the transform of samples of its period, whose number is doubled until the loss no longer changes.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from vipetsc.case import NnmCase
from vipetsc.lattice import Contact
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.point import Point
from vipetsc.modes.problem import NoMotionError
from vipetsc.modes.shooting import Shooting, sample_orbit
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import elongation_rows

# Samples of an orbit's period are doubled between these numbers until the loss is that of half as many, to the fraction
# ``AGREEMENT`` or ``NEGLIGIBLE`` of the energy. A contact that begins slowly needs many: the approach velocity divides
# its loss.
FEWEST_SAMPLES = 1024
MOST_SAMPLES = 16384
AGREEMENT = 2e-4
NEGLIGIBLE = 1e-6


class Dissipation(NamedTuple):
    """Sources of loss, ``damping`` (n, n) in N s/m and the ``laws`` of all contacts; the ``forced`` mass or None."""

    damping: csr_matrix
    laws: Sequence[Contact]
    forced: int | None

    @property
    def acts(self) -> bool:
        """Whether anything dissipates."""
        return bool(self.damping.nnz) or any(law.damping for law in self.laws)


def dissipation_of(case: NnmCase) -> Dissipation:
    """Return the dashpots and contacts of a case that dissipate, and its forced mass."""
    damping = csr_matrix((0, 0))
    if case.nnm.system in ("chain", "condensed"):
        chain = case.damped_chain
        damping = chain.damping_rows(0, chain.cells)
        damping.eliminate_zeros()
    elif case.nnm.custom is not None:
        # The table counts masses from 1, and 0 is the ground.
        dashpots = case.nnm.custom.dashpots
        mass: list[int | None] = [None, *range(len(case.nnm.custom.masses))]
        ends = [(mass[dashpot.start], dashpot.end - 1) for dashpot in dashpots]
        rows = elongation_rows(ends, len(case.nnm.custom.masses))
        rates = np.array([dashpot.damping for dashpot in dashpots])
        damping = csr_matrix(rows.T @ (rates[:, None] * rows))
    return Dissipation(damping=damping, laws=case.laws(), forced=case.forced_mass())


def with_loss(
    point: Point,
    dissipation: Dissipation,
    stops: Sequence[Stops],
    elongations: np.ndarray,
    masses: Iterable[tuple[int, np.ndarray]],
) -> Point:
    """Return the ``point`` with its loss in J a period, and the force in N at the forced mass that makes up for it.

    ``stops`` are those of the contacts, whose ``elongations`` (contacts, K + 1) in m are harmonics; ``masses`` gives
    orders and the harmonics (masses,) in m of all displacements. The loss is NaN if a contact that dissipates never
    separates: it has no approach velocity.
    """
    omega = 2 * np.pi / point.period
    lossy = SiteForces([of_site._replace(law=law) for of_site, law in zip(stops, dissipation.laws, strict=True)])
    loss = np.nan
    with suppress(NoMotionError):
        loss = float(lossy.losses(elongations, omega).sum())

    first = 0.0
    for k, u in masses:
        if dissipation.damping.nnz:
            loss += np.pi * k**2 * omega * float((u.conj() @ (dissipation.damping @ u)).real)
        if k == 1 and dissipation.forced is not None:
            first = float(np.abs(u[dissipation.forced]))

    force = np.nan
    if dissipation.forced is not None:
        # At a node no force does work.
        force = np.inf
        if first:
            force = loss / (np.pi * first)
    return replace(point, loss=loss, force=force)


def with_orbits_loss(problem: Shooting, dissipation: Dissipation, point: Point) -> Point:
    """Return the ``point``, an orbit that is shot, with its loss and force."""
    samples = FEWEST_SAMPLES
    u, _ = sample_orbit(problem, point, samples)
    coarse = _with_sampled_loss(problem, dissipation, point, u[::2])
    while True:
        fine = _with_sampled_loss(problem, dissipation, point, u)
        allowed = AGREEMENT * fine.loss + NEGLIGIBLE * point.energy
        # The loss may be NaN, with any number of samples.
        if not abs(fine.loss - coarse.loss) > allowed or samples == MOST_SAMPLES:
            return fine
        coarse = fine
        samples *= 2
        u, _ = sample_orbit(problem, point, samples)


def _with_sampled_loss(problem: Shooting, dissipation: Dissipation, point: Point, u: np.ndarray) -> Point:
    """Return the ``point`` with loss and force of ``u`` (samples, n) in m at uniform times of a period."""
    samples = len(u)
    harmonics = np.fft.rfft(u, axis=0).T[:, : samples // 2] * (2 / samples)
    harmonics[:, 0] /= 2
    system = problem.system
    stops = [pair.stops for pair in system.contacts]
    return with_loss(point, dissipation, stops, system.contact_rows @ harmonics, enumerate(harmonics.T))
