"""The first orbit of a branch, near a linear mode."""

import numpy as np

from vipetsc.modes.point import Point
from vipetsc.modes.problem import StartError
from vipetsc.modes.shared_frequencies import check_start
from vipetsc.modes.shooting.shooting_equations import A, ShootingEquations


def linear_start(problem: ShootingEquations[A], mode: int, energy: float) -> Point:
    """The periodic orbit of linear mode ``mode`` (0-based) at a small ``energy`` in J, corrected.

    Raises StartError if the mode has no stiffness, if other modes share its frequency, or if Newton's method does not
    converge from the linear mode at that energy.
    """
    omega, shapes = problem.system.linear_modes()
    if not omega[mode] > 0:
        raise StartError(f"mode {mode + 1} is a rigid-body motion; it has no period")
    check_start(problem.system, mode, energy)
    # The energy of a mass-normalised mode q is (q'^2 + omega^2 q^2)/2: from rest all of it is potential, from the
    # centre, where the initial values are velocities, all of it is kinetic.
    amplitude = np.sqrt(2 * energy)
    if problem.map.starts_at_rest:
        amplitude /= omega[mode]
    x = shapes[:, mode] * amplitude
    frame = problem.frame_at("relative", x, 2 * np.pi / omega[mode], np.empty(0))
    row = np.append(x / np.linalg.norm(x), 0.0)  # keep the amplitude
    attempt = frame.solve(frame.xi, row, row @ frame.xi)
    if not attempt.converged:
        why = f"({attempt.reason}; residuals {attempt.residuals}): lower nnm.start_energy or increase nnm.tolerance"
        raise StartError(f"no periodic orbit near linear mode {mode + 1} at E = {energy:g} J {why}")
    return frame.measures(attempt)
