"""Measures on sampled fields, in plain numpy and scipy: Fourier, wavelets, band energies, entropy, power laws."""

from importlib import import_module
from typing import TYPE_CHECKING

from vipetsc.spectra.directions import band_envelopes, by_direction, wave_energies
from vipetsc.spectra.fits import FEWEST, PowerLaw, doubt, normalised, power_law
from vipetsc.spectra.fourier import (
    TAPER,
    CellWindow,
    Dispersion,
    dispersion,
    dispersions,
    kinetic_energy,
    ridge,
    taper,
    wavenumber_content,
)
from vipetsc.spectra.pooling import block_means, block_sums, blocks

if TYPE_CHECKING:
    from vipetsc.spectra.arrivals import estimated_peak, front_arrival, peak_arrival
    from vipetsc.spectra.band_energies import PartEnergies, Parts, ibtet, part_energies
    from vipetsc.spectra.entropies import Entropy, averages, entropy, local_entropy
    from vipetsc.spectra.modal_energies import ModalParts, upper_fraction
    from vipetsc.spectra.wavelet import BINS, Nodes, filter_bank, inverse, padded_length, partition, transform

# Modules with compiled kernels, which take half a second to load: a case that is only checked needs no more of this
# package than the names of measures.
COMPILED = {
    "arrivals": ("estimated_peak", "front_arrival", "peak_arrival"),
    "band_energies": ("PartEnergies", "Parts", "ibtet", "part_energies"),
    "entropies": ("Entropy", "averages", "entropy", "local_entropy"),
    "modal_energies": ("ModalParts", "upper_fraction"),
    "wavelet": ("BINS", "Nodes", "filter_bank", "inverse", "padded_length", "partition", "transform"),
}


def __getattr__(name: str) -> object:
    """Load a name of a module with compiled kernels when it is first used."""
    for module, names in COMPILED.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
