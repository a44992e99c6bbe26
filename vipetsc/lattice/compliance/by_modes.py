r"""Compliance of a finite lattice of any cells, with dashpots, from its modes: poles and residues.

With the modes phi of M u'' + K u = 0, phi^T M phi = 1, as coordinates, u = sum_n phi_n q_n, motions obey

    q'' + D q' + Omega^2 q = phi^T f,    D = phi^T C phi.

Without dashpots these equations are not coupled. With dashpots the state (S q, q'), S a diagonal scale, has the matrix
[[0, S], [-Omega^2/S, -D]], whose eigenvalues p and eigenvectors give the compliance as a sum over poles,

    G(omega) = sum_r a_r b_r / (i omega - p_r).

With the eigenvectors x_r as columns of X, a_r = phi S^-1 (upper half of x_r) is the motion of pole r, and
b_r = (right half of row r of X^-1) phi^T is what a force adds to it.

A motion as a rigid body, which neither a spring nor a dashpot opposes, is kept apart: its pole is double, and such a
matrix has too few eigenvectors. Where dashpots to the ground oppose it, one of its poles is 0. Cf. F. Tisseur, K.
Meerbergen, The quadratic eigenvalue problem, SIAM Rev. 43 (2001) 235.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eig, eigh
from scipy.sparse import csc_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from vipetsc.lattice.compliance.base import ChainCompliance, ComplianceError
from vipetsc.lattice.compliance.dense import RIGID, UNMOVED
from vipetsc.lattice.elements import Elements, contacts, joined_stiffness, nonlinear_springs

MOST_DOFS = 1000  # masses of a lattice whose modes are all computed: a minute with dashpots, and 100 MB
# Error over the largest compliance that is accepted of the sum over poles: near critical damping two of them are
# nearly parallel, and cancel.
ACCURACY = 1e-8
# Differences in a rigid motion, over its largest displacement, that are rounding: 1e-13 to 1e-6 are seen. In motions
# that strain soft springs the differences are as large as the displacements.
EVEN = 1e-3


class Poles(NamedTuple):
    """A sum over ``poles`` (pole,) in 1/s: ``output`` (dofs, pole) and ``input`` (pole, dofs), see ``ModalCompliance``.

    ``rigid`` (dofs, motion) are the mass-normalised motions as a rigid body.
    """

    poles: np.ndarray
    output: np.ndarray
    input: np.ndarray
    rigid: np.ndarray


@dataclass(frozen=True)
class ModalCompliance(ChainCompliance):
    """Compliance of the contacts of a finite ``chain``, whose cells may differ and have dashpots.

    Elongations of the nonlinear springs are pairs, too, after those of the contacts. ``contact_springs`` are
    stiffnesses in N/m of springs in the place of the contacts, one each, () if there are none.

    Raises ComplianceError for more than ``MOST_DOFS`` masses, and where the damping is so close to critical that the
    modes do not represent the motion.
    """

    contact_springs: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        dofs = self.chain.cells * self.chain.cell.dofs
        if dofs > MOST_DOFS:
            raise ComplianceError(f"a lattice of {dofs} masses: all modes are computed of up to {MOST_DOFS}")

    @cached_property
    def springs(self) -> Elements:
        """The nonlinear springs."""
        return nonlinear_springs(self.chain)

    @cached_property
    def _elements(self) -> list[tuple[int, int]]:
        return [*contacts(self.chain).mass_pairs(), *self.springs.mass_pairs()]

    @cached_property
    def slowest(self) -> float:
        """Rate in 1/s at which the linear mode that is damped least decays; 0 without dashpots."""
        return float(np.abs(self._poles.poles.real).min(initial=np.inf))

    @cached_property
    def highest(self) -> float:
        """The highest frequency of a mode in rad/s."""
        return float(np.abs(self._poles.poles.imag).max(initial=0.0))

    @cached_property
    def stiffness(self) -> csc_matrix:
        """Stiffness (dofs, dofs) in N/m of the lattice, with the springs in the place of contacts."""
        stiffness = self.chain.stiffness_matrix()
        if not self.contact_springs:
            return stiffness
        joined = joined_stiffness(contacts(self.chain), self.contact_springs, stiffness.shape[0], slice(None))
        return (stiffness + joined).tocsc()

    def response(self, omegas: ArrayLike) -> np.ndarray:
        """Return the motions of ``ChainCompliance.response``."""
        rows, columns, rigid_rows, rigid_columns = self._parts
        omega = np.atleast_1d(np.asarray(omegas, complex))
        out = (rows * self._gain(omega, self._moved)[:, None, :]) @ columns
        if rigid_columns.size:
            with np.errstate(divide="ignore", invalid="ignore"):
                out += rigid_rows @ rigid_columns / (-(omega[:, None, None] ** 2))
        if not self._is_damped and np.all(omega.imag == 0):
            return np.asarray(out.real)
        return np.asarray(out)

    def field(self, omega: complex, forces: ArrayLike, cells: ArrayLike) -> np.ndarray:
        """Return the displacement (cells, dofs) in m at ``cells`` (from 0) by ``forces`` in N, as of ``signed``."""
        signed = self.signed(forces)
        force = self.loads[:, : len(signed)] @ signed

        # Only the masses in the cells are computed: a state has a field for each of its harmonics.
        poles = self._poles
        dofs = self.chain.cell.dofs
        rows = (np.atleast_1d(cells)[:, None] * dofs + np.arange(dofs)).ravel()
        _, columns, _, _ = self._parts
        # The mean position of a lattice that is free to move is arbitrary.
        gain = self._gain(np.array([omega]), np.zeros(len(poles.poles), bool))[0]
        u = poles.output[rows] @ ((columns[:, : len(signed)] @ signed) * gain)
        moved = poles.rigid.T @ force
        if np.any(moved) and omega != 0:
            u = u - poles.rigid[rows] @ moved / omega**2
        return np.asarray(u.reshape(-1, dofs))

    def _gain(self, omega: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return the factor 1/(i omega - p) (omega, pole) at ``omega`` in rad/s.

        It is unbounded for p = 0 at omega = 0, where a body that nothing holds may be anywhere. It is set to 0 there
        unless the pole is ``moved`` (pole,).
        """
        gap = 1j * omega[:, None] - self._poles.poles
        given = moved | self._oscillates
        with np.errstate(divide="ignore", invalid="ignore"):
            # In most lattices no pole is 0.
            if given.all():
                return np.divide(1, gap)
            return np.divide(1, gap, out=np.zeros_like(gap), where=given | (gap != 0))

    # What a response needs at each frequency is kept: to find it takes as long as the response of a small lattice.
    @cached_property
    def _is_damped(self) -> bool:
        """Whether the lattice has a dashpot."""
        return self.chain.is_damped

    @cached_property
    def _moved(self) -> np.ndarray:
        """Mask (pole,) of the poles whose motion moves a pair."""
        return np.asarray(np.any(self._parts[0], axis=0))

    @cached_property
    def _oscillates(self) -> np.ndarray:
        """Mask (pole,) of the poles that are not 0."""
        return np.asarray(self._poles.poles != 0)

    @cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Outputs and inputs of the pairs and points: (pairs, pole), (pole, loads), and those of rigid motions."""
        poles = self._poles
        loads = self.loads
        pairs = loads[:, : self.pairs]
        rigid_rows = pairs.T @ poles.rigid
        rigid_columns = poles.rigid.T @ loads

        # Forces of pairs do not move a rigid motion without relative displacement. Rounding would make them do so, and
        # at omega = 0 without bound.
        scale = np.abs(poles.rigid).max(initial=0.0)
        rigid_rows[np.abs(rigid_rows) < UNMOVED * scale] = 0
        rigid_columns[np.abs(rigid_columns) < UNMOVED * scale] = 0
        if not rigid_rows.any():
            rigid_rows, rigid_columns = rigid_rows[:, :0], rigid_columns[:0]

        # Rounding is removed likewise from rigid motions that dashpots oppose, whose pole is 0.
        rows = pairs.T @ poles.output
        columns = poles.input @ loads
        still = poles.poles == 0
        rows[:, still] = _without_rounding(rows[:, still], np.abs(poles.output[:, still]))
        columns[still] = _without_rounding(columns[still], np.abs(poles.input[still]))
        return rows, columns, rigid_rows, rigid_columns

    @cached_property
    def _poles(self) -> Poles:
        """All poles of the lattice; raises ComplianceError where they do not represent it."""
        chain = self.chain
        masses = chain.masses()
        root = 1 / np.sqrt(masses)
        stiffness = self.stiffness.toarray()
        squared, vectors = eigh(stiffness * np.outer(root, root))
        vectors = vectors * root[:, None]

        damping = chain.damping_rows(0, chain.cells)
        modal_damping = vectors.T @ (damping @ vectors)
        # "<=": masses that no springs join have squared frequencies of 0 alone, and a largest one of 0.
        still = np.abs(squared) <= RIGID * np.abs(squared).max()
        vectors[:, still] = self._without_strain(vectors[:, still])
        lossless = np.abs(modal_damping).max(axis=1) <= RIGID * np.abs(modal_damping).max(initial=0.0)
        rigid = still & lossless

        poles = _sum_over_poles(
            squared=np.where(still, 0.0, squared)[~rigid],
            damping=modal_damping[np.ix_(~rigid, ~rigid)],
            vectors=vectors[:, ~rigid],
            rigid=vectors[:, rigid],
        )
        if chain.is_damped:
            self._check(poles)
        return poles

    def _without_strain(self, motions: np.ndarray) -> np.ndarray:
        """Return rigid ``motions`` (dofs, motion) in which masses that springs join move alike to the last bit.

        Divided by omega^2, what rounding leaves between them would be larger than all strains at low frequencies.
        """
        _, bodies = connected_components(self.stiffness, directed=False)
        even = motions.copy()
        for body in range(bodies.max(initial=-1) + 1):
            members = bodies == body
            mean = motions[members].mean(axis=0)
            is_even = np.abs(motions[members] - mean).max(axis=0) <= EVEN * np.abs(motions).max(axis=0)
            even[np.ix_(members, is_even)] = mean[is_even]
        return even

    def _check(self, poles: Poles) -> None:
        """Compare the sum over ``poles`` with a direct solution; raises ComplianceError where they differ."""
        chain = self.chain
        omega = float(np.median(np.abs(poles.poles)))
        dynamic = self.stiffness + 1j * omega * chain.damping_rows(0, chain.cells)
        dynamic = dynamic - omega**2 * diags(chain.masses())
        force = self.loads.sum(axis=1)

        direct = spsolve(dynamic.tocsc(), force.astype(complex))
        u = poles.output @ ((poles.input @ force) / (1j * omega - poles.poles))
        u = u - poles.rigid @ (poles.rigid.T @ force) / omega**2
        if not np.abs(u - direct).max() <= ACCURACY * np.abs(direct).max():
            raise ComplianceError(
                "a mode is damped so close to critically that its two rates agree; change a dashpot a little"
            )


def _sum_over_poles(squared: np.ndarray, damping: np.ndarray, vectors: np.ndarray, rigid: np.ndarray) -> Poles:
    """Return the poles of q'' + ``damping`` q' + ``squared`` q = ``vectors``^T f, and of the ``rigid`` motions."""
    count = len(squared)
    if not damping.any():
        # Pairs of poles +-i Omega of residues 1/(2 i Omega).
        frequency = np.sqrt(squared)
        poles = 1j * np.concatenate([frequency, -frequency])
        output = np.hstack([vectors, vectors])
        return Poles(poles=poles, output=output, input=(output / (2 * poles)).T, rigid=rigid)

    # Displacements are scaled by the frequencies: all entries of the matrix are then of one size. A mode that dashpots
    # alone oppose has the frequency 0: a thousandth of the highest one takes its place. From 1e-5 to 1e-2 in its place
    # the compliance of 30 damped cells with free ends is the same to 1e-15, with 1e-1 to 1e-13.
    highest = np.sqrt(squared.max()) or np.abs(damping).max()
    scale = np.maximum(np.sqrt(squared), 1e-3 * highest)
    matrix = np.zeros((2 * count, 2 * count))
    matrix[:count, count:] = np.diag(scale)
    matrix[count:, :count] = np.diag(-squared / scale)
    matrix[count:, count:] = -damping
    # A mode that no spring holds stays where dashpots have stopped it: one of its poles is 0, exactly so, since the
    # column of its displacement is zero.
    poles, right = eig(matrix)
    left = np.linalg.inv(right)
    return Poles(
        poles=poles, output=vectors @ (right[:count] / scale[:, None]), input=left[:, count:] @ vectors.T, rigid=rigid
    )


def _without_rounding(motions: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the ``motions``, with 0 for those below the fraction ``UNMOVED`` of the largest of ``sizes``."""
    return np.where(np.abs(motions) < UNMOVED * sizes.max(initial=0.0), 0, motions)
