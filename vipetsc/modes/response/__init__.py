"""Steady responses to a harmonic force or wave, over its amplitude or frequency: nonlinear frequency response curves.

``steady`` has their equations, on those of harmonic balance; ``nfrc`` follows the curves of a case and writes them.
"""

from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates
