"""How far the drive's linear wave moves a contact site, beside its clearance."""

import numpy as np

from vipetsc.case.model import Model
from vipetsc.lattice import ToneBurst, UnitCell, bloch, waves_at
from vipetsc.lattice.sites import Pair


def sends_one_wave(model: Model) -> bool:
    """Return whether the first drive of a ``model`` sends a wave of one frequency, for ``wave_over_clearance``."""
    return model.first_drive_acts and (isinstance(model.drive, ToneBurst) or model.drive.repeats)


def wave_over_clearance(model: Model) -> np.ndarray:
    """Return the largest |w| of the linear wave over each clearance (site, stop), for the first drive of a ``model``.

    Beyond 1 the wave closes the stop. The ratio is 0 of a stop that is not there and without a wave, infinite of one
    that touches. The wave's largest displacement is ``model.scale``; the ratio of |w| to it is that of the Bloch wave
    that moves the pair most. Waves that return from an end, and what other sites scatter, are not in it.
    """
    chain = model.chain
    drive = model.drive
    gaps = chain.sites.gaps
    waves = waves_at(chain.cell, drive.frequency)
    if not (waves and drive.amplitude):
        return np.zeros(gaps.shape)

    pairs = chain.sites.pairs
    largest = {pair: max(_relative_amplitude(chain.cell, pair, wave) for wave in waves) for pair in set(pairs)}
    amplitudes = model.scale * np.array([largest[pair] for pair in pairs])
    ratios = np.full(gaps.shape, np.inf)
    return np.divide(amplitudes[:, None], gaps, out=ratios, where=gaps > 0)


def _relative_amplitude(cell: UnitCell, pair: Pair, wave: tuple[int, float, float]) -> float:
    """Return the amplitude of w of a ``pair`` in a ``wave`` of ``waves_at``, over that of the mass that moves most."""
    band, kappa, _ = wave
    shape = bloch(cell, kappa).vectors[:, band - 1]
    w = shape[pair.resonator] * np.exp(1j * kappa * pair.offset)
    # Ground, number -1, does not move.
    if pair.host >= 0:
        w -= shape[pair.host]
    return float(abs(w) / np.abs(shape).max())
