r"""Steady states of a lattice's sites under a harmonic force or an incident Bloch wave, followed over a parameter.

These are the equations of ``equations`` with the compliance, the forces and the drive of a case: the motion w by the
drive alone is that by the force (1 N), the wall (1 m) or the wave (1 clearance of the first site).

**Energy.** A wave of the flux P a^2 in W comes in. What leaves at Om on the side that it goes to is transmitted (T), on
the other reflected (R); what leaves at k Om, k > 1, on both sides is U; contacts lose L. T + R + U + L = 1 for any
number of harmonics, as the loss is that of the harmonics kept. A force with the amplitude f puts in the mean power
Re(i Om f* u)/2 at the displacement u of its mass. Fractions are over this power, and T is what leaves to higher cells.
"""

from collections.abc import Iterable

import numpy as np

from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import ComplianceError, ModalCompliance, WaveCompliance
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
from vipetsc.modes.cache import BoundedCache
from vipetsc.modes.problem import FlowError
from vipetsc.modes.response.condensation import compliance_of, driven_points, forces_of
from vipetsc.modes.response.equations import ContinuationParameter, LinearMotion, SteadyEquations
from vipetsc.modes.response.outputs import HarmonicMotion, ResponseOutputs, largest_values
from vipetsc.modes.response.state import Measures
from vipetsc.modes.stability import Hill, Stability

# The power of a force counts as rounding below this fraction of amplitude times frequency times displacement, as in a
# finite lattice without loss: nothing comes in, of which there could be fractions.
LEAST_WORK = 1e-12
# Frequencies of a range among which the largest linear motion is looked for, a unit.
TRIED = 33
# Frequencies whose linear motions are kept: those of a step and of its differences.
KEPT_MOTIONS = 9


class SteadyStates(SteadyEquations):
    """Steady states of the sites of a ``case`` over the amplitude or the frequency, with a ``restitution``.

    ``fixed`` is the frequency in rad/s of a curve over the amplitude, the amplitude of one over the frequency
    (``NfrcTable``). ``compliance`` is that of the case, if it has been computed already; ``forces`` take the place of
    the case's. ``like`` are equations with the same linear lattice, drive and orders: what they have computed of the
    lattice, also at the frequencies of perturbations, is not computed again.
    """

    def __init__(
        self,
        case: NfrcCase,
        restitution: float,
        fixed: float,
        compliance: WaveCompliance | ModalCompliance | None = None,
        forces: SiteForces | None = None,
        like: "SteadyStates | None" = None,
    ) -> None:
        options = case.nfrc
        self.case = case
        self.options = options
        self.restitution = restitution
        self.wave = options.source == "wave"
        if forces is None:
            forces = forces_of(case, restitution)
        if like is not None:
            compliance = like.compliance
        if compliance is None:
            compliance = compliance_of(case)
        self.forces = forces
        self.points, self.weights = driven_points(case)
        self.compliance: WaveCompliance | ModalCompliance = compliance
        self.outputs = ResponseOutputs(case, self.compliance, self.forces.contacts)

        # Along a curve over the amplitude all states have one linear motion and one Hill's determinant.
        self._motions = BoundedCache[float, LinearMotion](KEPT_MOTIONS)
        self._hill: Hill | None = None
        shifted = None
        if like is not None:
            self._hill = like._hill
            shifted = like.balance.shifted
            # The amplitude of a wave counts in clearances, which may be other ones.
            if not self.wave:
                self._motions = like._motions

        clearance = self._unit()
        super().__init__(
            options,
            balance=HarmonicBalance(
                self.compliance,
                self.forces,
                order=options.harmonics,
                odd=bool(options.symmetric),
                cosines=False,
                shifted=shifted,
            ),
            clearance=clearance,
            parameter=ContinuationParameter(options.over, fixed, self._scale(clearance)),
        )

    def _unit(self) -> float:
        """Return the unit of displacements in m: the first clearance that is positive.

        Without one, as where all contacts are pressed at rest, it is the size of the linear motion: over the amplitude
        at the upper end of the range, over the frequency at its beginning, or the largest in it if there are springs.
        Raises FlowError where the drive moves no pair.
        """
        for stops in self.forces.contacts:
            for gap in (stops.plus, stops.minus):
                if 0 < gap < np.inf:
                    return gap
        over_amplitude = self.options.over == "amplitude"
        has_springs = bool(self.forces.springs) or any(stops.spring for stops in self.forces.contacts)
        if has_springs and not over_amplitude:
            # The range of frequencies may have a resonance, at which motions are much larger than at its beginning.
            low, high = self.options.range
            return self.options.fixed[0] * self._largest_motion(np.linspace(low, high, TRIED))
        amplitude = self.options.fixed[0]
        if over_amplitude:
            amplitude = self.options.range[1]
        return amplitude * self._largest_motion([self.case.frequency])

    def _scale(self, clearance: float) -> float:
        """Return the unit of the parameter: half the range of frequencies, or the amplitude that reaches 1 clearance.

        The amplitude of a wave is in clearances already. Raises FlowError where the drive moves no pair.
        """
        low, high = self.options.range
        if self.options.over == "frequency":
            return (high - low) / 2
        if self.wave:
            return 1.0
        return clearance / self._largest_motion([self.case.frequency])

    def _largest_motion(self, omegas: Iterable[float]) -> float:
        """Return the largest elongation in m of linear motions at ``omegas`` in rad/s, for the amplitude 1.

        Raises FlowError where all elongations are 0.
        """
        largest = max(float(np.abs(self.linear_motion(omega).harmonics).max()) for omega in omegas)
        if largest == 0:
            raise FlowError("the drive moves no contact and no nonlinear spring; drive another mass")
        return largest

    def with_order(self, order: int) -> "SteadyStates":
        """Return the same equations with harmonics up to another ``order``."""
        case = self.case.model_copy(update={"nfrc": self.options.model_copy(update={"harmonics": order})})
        return SteadyStates(
            case, self.restitution, self.parameter.fixed, compliance=self.compliance, forces=self.forces
        )

    def linear_motion(self, omega: float) -> LinearMotion:
        """Return the motion of the linear lattice for the amplitude 1 at ``omega`` in rad/s.

        Raises FlowError outside a wave's band.
        """
        return self._motions.get(omega, lambda: self._evaluate_linear(omega))

    def _evaluate_linear(self, omega: float) -> LinearMotion:
        pairs = self.forces.pairs
        z = np.zeros((pairs, self.options.harmonics + 1), complex)
        if not self.wave:
            # Columns beyond the pairs are those of the driven masses.
            z[:, self.options.subharmonic] = self.compliance.response(omega)[0, :, pairs:] @ self.weights
            return LinearMotion(z, None)
        assert isinstance(self.compliance, WaveCompliance)
        try:
            wave = self.compliance.incident(omega, self.options.band or 0, self.options.towards)
        except ComplianceError as error:
            raise FlowError(str(error)) from None
        z[:, self.options.subharmonic] = wave.relative * self._unit()
        return LinearMotion(z, wave)

    def measured(self, xi: np.ndarray, stability: Stability | None = None) -> Measures:
        """Return the measures of the state ``xi`` (n + 1,) for its file.

        Its ``stability`` is looked for unless it is given.
        """
        omega, amplitude = self.drive(xi[-1])
        z = self.balance.unpack(xi[:-1] * self.clearance)
        # Forces are those at the harmonics that the state has, which the equations balance.
        states = self.of_state(xi)
        inner = states.resized(xi)
        series = states.balance.series(inner[:-1] * self.clearance, self.motion_frequency(xi))
        forces = np.zeros_like(z)
        forces[:, : states.balance.order + 1] = series.forces[:, : states.balance.order + 1]

        if stability is None:
            stability = self.stability(xi)
            # The count is cheaper than the exponents themselves, and most states are stable.
            if stability.unstable:
                hill, _ = self.hill_at(xi)
                stability = stability._replace(fastest=hill.fastest(series))
        rate = complex(np.nan, np.nan)
        if stability.fastest is not None:
            rate = stability.fastest
        sites = len(self.forces.contacts)
        return Measures(
            frequency=omega,
            amplitude=amplitude,
            largest=largest_values(z[:sites]),
            fractions=self._fractions(omega, amplitude, forces, float(series.loss[:sites].sum())),
            unstable=stability.unstable,
            growth=rate.real,
            sideband=rate.imag,
            closed=series.closed[:sites],
            episodes=len(series.episodes),
            truncation=states.truncation(inner),
            harmonics=z[:sites],
            outputs=self.outputs.of(self._harmonic_motion(omega, amplitude, z, forces, series)),
        )

    def _harmonic_motion(
        self, omega: float, amplitude: float, z: np.ndarray, forces: np.ndarray, series: ForceSeries
    ) -> HarmonicMotion:
        """Return a state as ``ResponseOutputs`` takes it.

        Its pairs have the harmonics ``z`` in m and ``forces`` in N, both (pairs, K + 1).
        """
        wave = self.linear_motion(omega).wave
        incident: np.ndarray | float = 0.0
        if wave is not None and self.outputs.cells:
            # A wave's amplitude counts in clearances of the first site.
            incident = wave.field(self.outputs.cells) * (amplitude * self.clearance)
        return HarmonicMotion(
            omega=omega / self.periods,
            drive_order=self.periods,
            amplitude=amplitude,
            relative=z,
            forces=forces,
            driving=amplitude * self.weights,
            episodes=series.episodes,
            incident=incident,
        )

    def hill_at(self, xi: np.ndarray) -> tuple[Hill, ForceSeries]:
        """Return Hill's determinant of motions near the state ``xi`` (n + 1,), and the forces there.

        The latest is kept, since it keeps the compliances at the frequencies of perturbations.
        """
        states = self.of_state(xi)
        if states is not self:
            return states.hill_at(states.resized(xi))
        omega = self.motion_frequency(xi)
        if self._hill is None or self._hill.omega != omega:
            options = self.options
            decay = 0.0
            if isinstance(self.compliance, ModalCompliance):
                decay = self.compliance.slowest / omega
            self._hill = Hill(
                compliance=self.compliance,
                omega=omega,
                order=options.harmonics,
                odd=bool(options.symmetric),
                finite=not (options.infinite or options.open_ends),
                decay=decay,
            )
        return self._hill, self.balance.series(xi[:-1] * self.clearance, omega)

    def _fractions(self, omega: float, amplitude: float, forces: np.ndarray, loss: float) -> np.ndarray:
        """Return T, R, U and L (4,) of the module's docstring: powers over the power that comes in.

        ``forces`` (pairs, K + 1) in N are those of the pairs, ``loss`` in J is what contacts lose in a period. T, R and
        U are NaN unless the lattice is infinite; all four are NaN where nothing comes in.
        """
        wave = self.linear_motion(omega).wave
        first = forces[:, self.periods]
        if wave is not None:
            # A wave's amplitude counts in clearances of the first site.
            amplitude = amplitude * self.clearance
            given = amplitude**2 * wave.flux
        else:
            first = np.append(first, amplitude * self.weights)
            # The displacement that the force does work on: those of the driven masses, by their weights.
            moved = 0.0
            for (cell, mass), weight in zip(self.points, self.weights.tolist(), strict=True):
                moved = moved + weight * self.compliance.field(omega, first, [cell])[0, mass]
            given = 0.5 * amplitude * float((1j * omega * moved).real)
            if not given > LEAST_WORK * amplitude * omega * abs(moved):
                given = 0.0

        # T, R and U need waves that leave, which only an infinite lattice has.
        powers = np.full(4, np.nan)
        if isinstance(self.compliance, WaveCompliance) and self.options.infinite:
            # The powers that leave to higher cells and to lower ones; the wave's side comes first.
            outgoing = self.compliance.outgoing(omega, first, wave, amplitude).sum(axis=1)
            if self.options.towards < 0:
                outgoing = outgoing[::-1]
            powers[:2] = outgoing
            powers[2] = 0.0
            for k in [k for k in range(1, forces.shape[1]) if k != self.periods]:
                # Even orders of a symmetric motion have no force, and need no solution for their waves.
                if np.any(forces[:, k]):
                    powers[2] += self.compliance.outgoing(k * omega / self.periods, forces[:, k]).sum()
        # From J a period to W.
        powers[3] = loss * (omega / self.periods / (2 * np.pi))
        if not given > 0:
            return np.full(4, np.nan)
        return powers / given
