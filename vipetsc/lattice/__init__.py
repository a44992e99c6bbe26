"""The physics of a contact lattice in plain numpy: cells, contacts, drives, Bloch bands, finite chains.

What a lattice is: ``cell``, ``variation`` (cells that differ), ``topology`` (what lies beyond the ends), ``chain``,
``elements`` (what joins its masses), ``sites``, ``contact`` (with ``registered_law``), ``drive``. Its waves: ``bands``
(at real wavenumbers), ``waves`` (at given frequencies), ``damped`` (with dashpots), ``packet``. Its modes: ``modes``,
``inertia``. What its ends send back: ``ends``, ``sent``.

Its ``compliance``, the motion per harmonic force, is a folder with one module for each way to compute it.

Symbols throughout: displacements u, masses M, stiffness K, damping C, u = Re U exp(i omega t), omega in rad/s,
kappa in rad per cell, and w = u_resonator - u_host of a contact. The docstring of each module has its method.
"""

from vipetsc.lattice.bands import (
    Band,
    BlochPoint,
    bloch,
    fastest_speed,
    gaps,
    max_group_velocity,
    modes_of_a_cell,
    pass_bands,
    wave_bands,
    waves_at,
)
from vipetsc.lattice.cell import Spring, UnitCell, diatomic, four_band
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.compliance.base import ComplianceError
from vipetsc.lattice.compliance.by_modes import ModalCompliance
from vipetsc.lattice.compliance.by_waves import IncidentWave, WaveCompliance
from vipetsc.lattice.compliance.dense import DenseCompliance
from vipetsc.lattice.compliance.open_ends import OpenCompliance
from vipetsc.lattice.contact import Contact, contact_stiffness
from vipetsc.lattice.drive import Drive, Pieces, ToneBurst, Waveform
from vipetsc.lattice.elements import Elements, contacts, nonlinear_springs, spring_laws
from vipetsc.lattice.modes import Modes, linear_modes
from vipetsc.lattice.sites import NO_SITES, Pair, Site, Sites, sites_at
from vipetsc.lattice.topology import Topology
from vipetsc.lattice.variation import Coefficients, SpringTerms, Variation
