"""The linear modes of a lattice, kept between runs: they follow from the lattice alone, and take long to compute."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from vipetsc.io.kept_arrays import kept_arrays
from vipetsc.lattice import Chain, modes
from vipetsc.lattice.modes import Modes, linear_modes

LEAST_DOFS = 400  # of a lattice whose modes are kept; those of smaller ones are computed in a hundredth of a second


def kept_modes(chain: Chain) -> Modes:
    """The modes of ``chain`` as `vipetsc.lattice.modes.linear_modes`, to the last bit, from an earlier run if possible.

    Modes of lattices whose cells differ are not kept: in a sweep over samples of such lattices each has its own. Raises
    ValueError as ``linear_modes`` does.
    """
    chain = chain.linearised()
    dofs = chain.cells * chain.cell.dofs
    if chain.ends == "periodic" or not chain.is_uniform() or not LEAST_DOFS <= dofs <= modes.MOST_DOFS:
        return linear_modes(chain)
    return _kept(replace(chain, sites=(), clearances=()))


@lru_cache(maxsize=4)
def _kept(chain: Chain) -> Modes:
    """The modes of a chain without sites."""

    def compute() -> dict[str, np.ndarray]:
        computed = linear_modes(chain)
        # LAPACK leaves vectors column by column, a file holds arrays row by row. Read in another order, products with
        # them would differ in their last bits.
        return {"frequency": computed.frequency, "wavenumber": computed.wavenumber, "vectors": computed.vectors.T}

    stiffness = chain.stiffness_matrix()
    matrix = (chain.masses(), stiffness.data, stiffness.indices, stiffness.indptr)
    ends = f"{chain.cells} {chain.ends}".encode()
    arrays = kept_arrays("linear-modes", [ends, *(values.tobytes() for values in matrix)], compute)
    return Modes(
        chain=chain,
        frequency=arrays["frequency"],
        wavenumber=arrays["wavenumber"],
        vectors=arrays["vectors"].T,
        exact=True,
        cells=chain.cells,
    )
