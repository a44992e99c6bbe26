"""Harmonic balance: periodic motions condensed onto the contacts and springs where a system is nonlinear.

``harmonics`` gives the forces of contacts and springs in a periodic motion, ``harmonic_balance`` the equations of its
harmonics, ``breather`` branches of conservative motions, ``hill`` the stability of a motion by Hill's determinant.
"""

from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
from vipetsc.modes.balance.hill import Hill
from vipetsc.modes.balance.stops import Stops
