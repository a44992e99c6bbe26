"""The stencil of a linear step: the matrix exponential within its bound, and the same sum in every cell."""

from mpi4py import MPI

import numpy as np
import pytest

from tests.exact_lattices import exponential
from tests.unit.propagator_parts import chain_parts
from vipetsc.case import Case
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import CHUNK, HaloRegions, apply_propagator, create_stencil, exchange


def stencil_matrix(layout: Layout, series: StepSeries, halo: HaloRegions) -> np.ndarray:
    """Return the matrix of a step, column by column from unit states."""
    stencil = create_stencil(series, layout, halo)
    bound = halo.bind_columns([])
    shape = (2 * layout.dofs, layout.cells)
    size = shape[0] * shape[1]

    matrix = np.empty((size, size))
    for column in range(size):
        state = np.zeros(shape)
        state.ravel()[column] = 1.0
        out = np.empty(shape)
        exchange(bound, 0, state)
        apply_propagator(stencil, state, bound.columns, out)
        matrix[:, column] = out.ravel()
    return matrix


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize(("interval", "tolerance"), [(1e-4, 1e-14), (5e-4, 1e-10)])
def test_the_stencil_is_the_exponential_within_its_bound(ends, interval, tolerance):
    """The stencil differs from the matrix exponential by no more than the truncation that its series states."""
    _, layout, series, halo = chain_parts(ends, interval, tolerance)
    matrix = stencil_matrix(layout, series, halo)

    # The bound is one of amplitudes, for which displacements are multiplied by omega_max.
    is_displacement = np.arange(len(matrix)) < len(matrix) // 2
    scale = np.where(is_displacement, series.omega_max_h / interval, 1.0)
    difference = np.abs(matrix - exponential(series.chain, interval))
    error = (difference * scale[:, None] / scale).sum(axis=1).max()

    # The last term is for rounding, which exceeds the finest tolerance.
    assert error <= series.truncation + 2e-14
    assert series.truncation < tolerance
    # A bound a thousand times too large would pass as well, and cost needless cells of reach.
    if tolerance > 1e-12:
        assert error > 1e-3 * series.truncation


# Numbers of cells for one and a half vectors of cells, for a last vector that overlaps the one before it, and for
# single cells at both borders.
@pytest.mark.parametrize("cells", [24, CHUNK + 12])
@pytest.mark.parametrize("name", ["diatomic", "three-mass", "four-band"])
def test_every_cell_is_the_same_sum_to_the_last_bit(name, cells):
    """Every cell of a ring gets the sum of the interior stencil in the same order, in vectors of cells or alone."""
    case = Case.load(
        f"runs/examples/{name}.toml", [f"lattice.cells={cells}", "lattice.ends=periodic", "contacts.sites=[5]"]
    )
    model = case.model()
    layout = Layout(model, MPI.COMM_SELF)
    series = StepSeries(model.chain, 2e-4, 1e-10)
    halo = HaloRegions(layout)
    stencil = create_stencil(series, layout, halo)
    # Dense rows are summed four outputs at a time: compiled code would read and write beyond arrays with fewer.
    assert stencil.borders.shape[-1] == stencil.total.size == 4 * -(-2 * layout.dofs // 4)
    halo = halo.bind_columns([])

    state = np.random.default_rng(3).normal(size=(2 * layout.dofs, cells))
    out = np.full_like(state, np.nan)
    exchange(halo, 0, state)
    apply_propagator(stencil, state, halo.columns, out)

    expected = np.zeros_like(state)
    for total, entry in zip(expected, series.interior(), strict=True):
        for row, column in np.argwhere(entry):
            total += entry[row, column] * np.roll(state[row], series.reach - column)
    assert out.tobytes() == expected.tobytes()
