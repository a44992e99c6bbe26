"""Harmonic balance: periodic motions condensed onto the contacts and springs where a system is nonlinear.

``stops`` says where a contact acts, ``arcs`` on which intervals of phase it does, ``harmonics`` the forces of contacts
and springs in a periodic motion. ``shifted_compliance`` is the linear system between them, and ``harmonic_balance`` the
equations of a motion's harmonics. ``conservative`` has branches of conservative motions, ``harmonic_frame`` the
unknowns in which a step of such a branch is taken, ``describing_function`` a pair's first guess in a gap, ``hill`` the
stability of a motion by Hill's determinant.
"""

from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
from vipetsc.modes.balance.hill import Hill
from vipetsc.modes.balance.stops import Stops
