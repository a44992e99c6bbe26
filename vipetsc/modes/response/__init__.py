"""Steady responses to a harmonic force or wave: nonlinear frequency response curves.

A curve runs over the amplitude or the frequency of the drive, or over a key of the case. ``condensation`` takes from a
case what the lattice is reduced to. ``equations`` has the residual of a steady state, its derivative and the frame of
a step; ``steady`` fills them in for one lattice, ``over_key`` for a lattice that changes along the curve. ``steps``
says how long steps are, where a curve begins and where it ends. ``state`` is a state with its measures, ``outputs``
what a case asks for beyond them, ``stability_changes`` the special points at which perturbations begin to grow.
``isolated`` looks for states on isolated curves. ``modes.branches`` follows the curves of a case and writes them.
"""

from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates
