"""Measures on sampled fields, in plain numpy and scipy: Fourier spectra and band energies."""

from vipetsc.spectra.bands import Parts, front_arrival, ibtet, part_energies, part_kinetic_energy, split
from vipetsc.spectra.fourier import TAPER, Dispersion, dispersion, kinetic_energy, ridge, taper, wavenumber_content

__all__ = [
    "TAPER",
    "Dispersion",
    "Parts",
    "dispersion",
    "front_arrival",
    "ibtet",
    "kinetic_energy",
    "part_energies",
    "part_kinetic_energy",
    "ridge",
    "split",
    "taper",
    "wavenumber_content",
]
