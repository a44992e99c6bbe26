"""The physics of a contact lattice in plain numpy: cells, contacts, drives, Bloch bands, finite chains.

What a lattice is: ``cell``, ``variation`` (cells that differ), ``topology`` (what lies beyond the ends), ``chain``,
``elements`` (what joins its masses), ``contact`` (with ``registered_law``), ``drive``. Its waves: ``bands`` (at real
wavenumbers), ``waves`` (at given frequencies), ``damped`` (with dashpots), ``packet``. Its modes: ``modes``,
``inertia``. What its ends send back: ``ends``, ``sent``.

Its compliance, the motion per harmonic force, has one module for each way to compute it: ``compliance`` (Bloch waves,
equal cells without dashpots), ``moments`` (far above the bands), ``modal_compliance`` (poles, any cells),
``open_compliance`` (ends that reflect nothing), ``direct_compliance`` (elimination), ``dense_compliance`` (few masses).

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
from vipetsc.lattice.compliance import IncidentWave, WaveCompliance
from vipetsc.lattice.contact import Contact, contact_stiffness
from vipetsc.lattice.dense_compliance import DenseCompliance
from vipetsc.lattice.drive import Drive, Pieces, ToneBurst, Waveform
from vipetsc.lattice.elements import Elements, contacts, nonlinear_springs, spring_laws
from vipetsc.lattice.modal_compliance import ComplianceError, ModalCompliance
from vipetsc.lattice.modes import Modes, linear_modes
from vipetsc.lattice.open_compliance import OpenCompliance
from vipetsc.lattice.topology import Topology
from vipetsc.lattice.variation import Coefficients, SpringTerms, Variation
