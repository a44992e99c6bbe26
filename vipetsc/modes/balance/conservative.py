"""Branches of conservative motions by harmonic balance: their equations, special points, and starts.

*Conservative* means that no force depends on a velocity and that nothing drives the system. A *pair* is a contact or a
smooth spring, contacts first; z (pairs,) are the elongations of all pairs. In a
motion of frequency Om that is at rest at phase 0 each elongation is a sum of cosines,

    z(theta) = sum_k Z_k cos(k theta),    theta = Om t,    k = 0..K,

with real Z_k. K is the *order* of the motion. Motions without an instant of rest, such as travelling waves, are not
among them. Where all forces are odd, symmetric motions alone are sought, z(theta + pi) = -z(theta), which have odd k:
branches of motions that break this symmetry are not found.

**Equations.** A motion solves Z_k + G(k Om) F_k(Z) = 0, in the shifted form of ``harmonic_balance``, with the forces
sum_k F_k(Z) cos(k theta) that the pairs exert against z(theta).

**Starts.** A branch begins at a linear mode, or at a frequency in a gap between or beyond the lattice's pass bands. A
motion in a gap, which falls off with the distance from the pairs in contact, is a *breather*. It is found in three
stages.

1. *Each pair alone.* A describing function gives the motion z_p = b_p + a_p cos(Om t) of each pair p that is to have
   contact. With the mean F_p0 and the first harmonic F_p1 of the force along this motion, a_p and b_p solve

       b_p + G_pp(0) F_p0(a_p, b_p) = 0,    a_p + G_pp(Om) F_p1(a_p, b_p) = 0.

   (N. M. Krylov and N. N. Bogoliubov, Introduction to Non-Linear Mechanics, Princeton 1947; ``describing_motion``). The
   first equation gives b_p for every a_p, and a_p is a root above the amplitude at which the pair begins to feel
   its force: for a contact the clearance. If there are several roots, any one of them may be found; for a contact that
   is pressed at rest it is one in the lowest of the brackets that are tried.
2. *All pairs together.* From there Newton's method solves the equations of the mean and the first harmonic, K = 1. A
   solution in which a pair moves with another sign than it is to have is not taken: the third stage then tries from
   the motions of the first.
3. *All harmonics.* Z_k + w G(k Om) F_k = 0 for k > 1, with K = ``FEWEST`` and Om fixed, has the motion of the second
   stage as its solution at w = 0. The weight w grows to 1 in steps in which the motion changes by less than
   ``FURTHEST``. The signs are not looked at again.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from vipetsc.case.nnm import NnmTable
from vipetsc.modes.balance.free_motions import FEWEST, FreeMotions, is_at_rest
from vipetsc.modes.balance.harmonic_balance import Compliance, HarmonicBalance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError

# Amplitudes are sought up to this multiple of ``SiteForces.amplitude_scale``, the clearance of a contact, and means up
# to this multiple of the amplitude. By Hertz's law amplitudes grow without bound as the compliance goes to 0.
LARGEST = 1e3
# A mean below this fraction of the amplitude is rounding, and taken to be 0.
LEAST_MEAN = 1e-14
# The force of a contact that is pressed at rest softens as it opens and hardens beyond, so that its balance may change
# sign twice. It is evaluated at TRIED_OF_PRESSED amplitudes from this multiple of the depth to ``LARGEST``.
LEAST_OF_PRESSED = 1e-2
TRIED_OF_PRESSED = 41


class PairCompliance(NamedTuple):
    """Compliance in m/N of one pair: ``static``, which the mean of a force meets, and ``dynamic``, at a frequency."""

    static: float
    dynamic: float


class DescribedMotion(NamedTuple):
    """A motion ``mean`` + ``amplitude`` cos(theta) of one pair, in m."""

    mean: float
    amplitude: float


def describing_motion(forces: SiteForces, pair: int, g: PairCompliance, omega: float) -> DescribedMotion:
    """Return the motion z = b + a cos(Om t) of a ``pair`` with one of the ``forces``, of which two harmonics balance.

    ``pair`` is its number, ``g`` are the compliances of the pair at 0 and at ``omega`` (rad/s). The equations are those
    of the module. Raises ContinuationError where they have no solution.
    """
    spring = pair - len(forces.contacts)
    if spring >= 0 and forces.springs[spring].cubic == 0:
        raise ContinuationError(
            f"no breather starts at {omega:g} rad/s on a spring without a cubic part: of a harmonic motion its "
            "quadratic force has a mean and a second harmonic alone; give it a cubic part, or begin at another place"
        )
    is_pressed = pair < len(forces.contacts) and forces.contacts[pair].is_pressed
    z = np.zeros((forces.pairs, 2), complex)

    def force(mean: float, amplitude: float) -> np.ndarray:
        """Return F_0, F_1 and F_2 in N: the motion is even in time, so that they are real."""
        z[pair] = mean, amplitude
        return forces.series(z, omega).forces[pair].real

    def mean_of(amplitude: float) -> float:
        """Return the mean b in m for an amplitude a in m."""

        def static_balance(mean: float) -> float:
            return mean + g.static * float(force(mean, amplitude)[0])

        without = static_balance(0.0)
        if forces.odd or abs(without) <= LEAST_MEAN * amplitude:
            return 0.0
        # A force that grows with the elongation opposes the mean: b lies between 0 and -G(0) F_0(a, 0), the mean that
        # the force at b = 0 would cause. The force of a contact that is pressed at rest softens: its mean may be
        # larger.
        furthest = -without
        while is_pressed and static_balance(furthest) * without > 0 and abs(furthest) < LARGEST * amplitude:
            furthest *= 2
        if static_balance(furthest) * without >= 0:
            # No mean within the bound balances the force. 0 is then a guess: the balance of all harmonics decides.
            return 0.0
        return float(brentq(static_balance, furthest, 0.0))

    def balance(amplitude: float) -> float:
        """Return a + G(Om) F_1 in m."""
        return amplitude + g.dynamic * float(force(mean_of(amplitude), amplitude)[1])

    size = forces.amplitude_scale(pair, g.dynamic)
    sizes = [size, LARGEST * size]
    if is_pressed:
        sizes = (size * np.geomspace(LEAST_OF_PRESSED, LARGEST, TRIED_OF_PRESSED)).tolist()
    for low, high in itertools.pairwise(sizes):
        if balance(low) * balance(high) < 0:
            amplitude = float(brentq(balance, low, high, rtol=1e-12))
            return DescribedMotion(mean=mean_of(amplitude), amplitude=amplitude)

    needs = "a force that hardens needs a negative one of moderate size"
    if is_pressed:
        needs = "the force of a contact that is pressed at rest balances it at no amplitude"
    raise ContinuationError(
        f"no breather starts at {omega:g} rad/s: the compliance of its site is {g.dynamic:.4g} m/N there, and "
        f"{needs}; change nnm.start_frequency"
    )


# A guess whose residual is below this fraction of its size solves the equations of the mean and the first harmonic.
BALANCED = 1e-6
# As the harmonics above the first are brought in: first step of their weight; how far the motion may change in one
# step, over the largest harmonic of the first guess; factors of the step after success and failure; the smallest step.
# Small changes are the safer: a motion that changes much may be another one.
FIRST_WEIGHT = 0.1
FURTHEST = 0.1
LONGER = 1.6
SHORTER = 0.4
SMALLEST_WEIGHT = 1e-4


class ConservativeMotions(FreeMotions[HarmonicBalance]):
    """Branches of conservative motions of ``forces`` at pairs whose ``compliance`` is given (``FreeMotions``)."""

    # What is guarded from point to point, besides the changes that all problems have in common, is the truncation: at
    # the highest order the harmonics left out may become too large.
    guards = frozenset({"truncation"})

    def __init__(self, compliance: Compliance, forces: SiteForces, control: NnmTable) -> None:
        super().__init__(forces, control)
        self.compliance = compliance

    def new_equations(self, order: int) -> HarmonicBalance:
        """Return the equations of motions with harmonics up to ``order``."""
        return HarmonicBalance(self.compliance, self.forces, order=order, odd=self.forces.odd, cosines=True)

    def from_mode(self, z: np.ndarray, omega: float) -> Point:
        """Return motion near a linear mode of frequency ``omega`` (rad/s) with the elongations ``z`` (pairs,) in m."""
        return self.refined(self.guess(self.one_harmonic(z), omega))

    def in_gap(self, omega: float, signs: np.ndarray) -> Point:
        """Return motion of ``omega`` (rad/s) in a gap, with contact at the pairs whose ``signs`` (pairs,) are +1 or -1.

        A pair of the sign -1 moves half a period later than one of +1: its cosine has the other sign, its mean the
        same. Raises ContinuationError where a pair has no motion with one harmonic, or where no motion is reached by
        bringing in the others; ValueError if all ``signs`` are 0.
        """
        if not np.any(signs):
            raise ValueError("signs are 0 for all pairs: a motion in a gap needs contact at one pair at least")
        x = self._pairs_together(self._pairs_alone(omega, signs), omega, signs)
        x = self._bring_in_harmonics(x, omega)
        return self.refined(self.guess(x, omega), keep_frequency=True)

    def _pairs_alone(self, omega: float, signs: np.ndarray) -> np.ndarray:
        """Return the first stage: unknowns (n,) of a mean and one harmonic, by each pair's describing function."""
        # A harmonic motion of forces that are odd has no mean, and the static compliance need not be there.
        static_at = 0.0
        if self.forces.odd:
            static_at = omega
        static, dynamic = self.compliance.at(np.array([static_at, omega]))
        z = np.zeros(len(signs))
        mean = np.zeros(len(signs))
        for pair in np.nonzero(signs)[0].tolist():
            g = PairCompliance(static=float(static[pair, pair]), dynamic=float(dynamic[pair, pair]))
            described = describing_motion(self.forces, pair, g, omega)
            mean[pair] = described.mean
            z[pair] = signs[pair] * described.amplitude
            # The force at this pair p moves a pair j without a force of its own by z_j = G_jp/G_pp z_p. What it adds to
            # the motion of the other pairs with contact, and to all means, is left to the second stage.
            z += np.where(signs == 0, dynamic[:, pair] / g.dynamic * z[pair], 0.0)
        return self.one_harmonic(z, mean)

    def _pairs_together(self, x: np.ndarray, omega: float, signs: np.ndarray) -> np.ndarray:
        """Return the second stage: the unknowns ``x`` (n,) corrected to the solution with a mean and one harmonic.

        They are returned as they are where they solve the equations, or where Newton's method finds no motion with the
        ``signs`` (pairs,): the third stage then tries from them.
        """
        balance = self.balance(1)
        first = balance.resized(x)
        frame = self.frame_at(balance, first, omega, float(np.abs(first).max()))
        if np.abs(frame.residual(frame.xi)).max() < BALANCED:
            return x
        attempt = frame.solve(frame.xi, frame.along_frequency, 1.0)
        corrected, _ = frame.motion(attempt.xi)
        keeps_signs = np.all(signs * balance.unpack(corrected)[:, 1].real >= 0)
        if attempt.converged and keeps_signs and not is_at_rest(attempt):
            return self.balance(FEWEST).resized(corrected)
        return x

    def _bring_in_harmonics(self, x: np.ndarray, omega: float) -> np.ndarray:
        """Return the third stage: the solution (n,) with ``FEWEST`` harmonics, from ``x`` with a mean and one harmonic.

        Raises ContinuationError where Newton's method fails, or the motion changes too much, however small the step.
        """
        size = float(np.abs(x).max())
        weight = 0.0
        step = FIRST_WEIGHT
        # The solution changes smoothly with the weight. With all harmonics at once Newton's method would diverge.
        while weight < 1:
            tried = min(weight + step, 1.0)
            # The weight multiplies G itself, and the shift is chosen for the product.
            frame = self.frame_at(self.balance(FEWEST).weighted(tried), x, omega, size)
            attempt = frame.solve(frame.xi, frame.along_frequency, 1.0)
            # Over ``size``, as the unknowns are.
            moved = np.linalg.norm(attempt.xi[:-1] - x / size)
            if attempt.converged and moved < FURTHEST:
                x, _ = frame.motion(attempt.xi)
                weight = tried
                step = LONGER * step
                continue

            # The step that failed is shorter than ``step`` if it was cut at the weight 1.
            step = SHORTER * min(step, 1.0 - weight)
            if step < SMALLEST_WEIGHT:
                why = f"Newton's method ends ({attempt.reason}); change nnm.start_frequency or raise nnm.max_newton"
                if attempt.converged:
                    why = f"the motion changes by more than {FURTHEST:g} of its size; change nnm.start_frequency"
                raise ContinuationError(
                    f"no breather at {omega:g} rad/s: with {weight:.3g} of the harmonics above the first, {why}"
                )
        return x

    def one_harmonic(self, z: np.ndarray, mean: np.ndarray | float = 0.0) -> np.ndarray:
        """Return unknowns with the fewest harmonics of a motion ``mean`` + z cos(theta), ``z`` (pairs,) in m."""
        balance = self.balance(FEWEST)
        harmonics = z[:, None] * (np.arange(balance.order + 1) == 1)
        harmonics[:, 0] = mean
        return balance.pack(harmonics)
