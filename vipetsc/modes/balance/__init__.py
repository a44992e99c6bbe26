"""Harmonic balance: periodic motions condensed onto the contacts and springs where a system is nonlinear.

Everything else is linear and enters by its compliance G(omega): the harmonics Z_k of the elongations and F_k of the
forces, k = 0..K, obey Z_k + G(k Om) F_k(Z) = Z_k^linear at the frequency Om, which ``harmonic_balance`` derives.

``harmonics`` has the forces of contacts and springs in a periodic motion, ``harmonic_balance`` the equations of a
motion's harmonics, and ``damped`` those of damped modes. ``free_motions`` follows motions that nothing drives,
``conservative`` has their starts, and ``modes.response`` the motions under a drive. All take steps in one kind of
frame, and as many harmonics as a fraction of the motion needs. ``modes.stability`` has the stability of a motion.
"""

from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
