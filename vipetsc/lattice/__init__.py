"""The physics of a contact lattice in plain numpy: cells, contacts, drives, Bloch bands, finite chains."""

from vipetsc.lattice.bands import Band, BlochPoint, bloch, fastest_speed, gaps, max_group_velocity, pass_bands, waves_at
from vipetsc.lattice.cell import Spring, UnitCell, diatomic, four_band
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.compliance import IncidentWave, WaveCompliance
from vipetsc.lattice.contact import Contact, contact_stiffness
from vipetsc.lattice.dense_compliance import DenseCompliance
from vipetsc.lattice.drive import Drive, Pieces, ToneBurst, Waveform
from vipetsc.lattice.modal_compliance import ModalCompliance
from vipetsc.lattice.modes import Modes, linear_modes
from vipetsc.lattice.open_compliance import OpenCompliance
from vipetsc.lattice.spring_places import SpringPlace, nonlinear_numbers, nonlinear_places
from vipetsc.lattice.variation import Coefficients, SpringTerms, Variation
