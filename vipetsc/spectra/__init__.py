"""Measures on sampled fields, in plain numpy and scipy: Fourier, wavelets, band energies, entropy, power laws."""

from vipetsc.spectra.band_energies import Parts, front_arrival, ibtet, part_energies, part_maps
from vipetsc.spectra.directions import band_envelopes, by_direction, wave_energies
from vipetsc.spectra.entropies import Entropy, averages, entropy, local_entropy
from vipetsc.spectra.fits import FEWEST, PowerLaw, doubt, normalised, power_law
from vipetsc.spectra.fourier import TAPER, Dispersion, dispersion, kinetic_energy, ridge, taper, wavenumber_content
from vipetsc.spectra.modal_energies import ModalParts, upper_share
from vipetsc.spectra.pooling import block_means, block_sums, blocks
from vipetsc.spectra.wavelet import BINS, Nodes, filter_bank, inverse, padded_length, partition, transform
