"""Groups of contact DoFs: DoFs that are solved for together, and groups that a step need not solve for."""

import numpy as np

from tests.conftest import small_case
from tests.unit.propagator_parts import chain_parts
from vipetsc.dynamics.propagator.dof_tables import create_dof_tables, create_responses, expand_free_motion
from vipetsc.dynamics.propagator.groups import Groups, group_dofs
from vipetsc.dynamics.propagator.stencil import exchange


def as_lists(groups: Groups) -> list[list[int]]:
    """Return a list of the DoFs of each group: sites count from 0, drives from -1 downwards."""
    return [part.tolist() for part in np.split(groups.numbers, groups.first[1:-1])]


def test_clusters_that_cannot_touch_are_left_alone():
    """A cluster is expanded when the series of its free motion may reach the clearance, or is not a number."""
    model, layout, series, halo = chain_parts("fixed", 1e-4, 1e-14, sites=(4, 12, 20))
    groups = group_dofs(model, series.reach)
    assert as_lists(groups) == [[-1], [0], [1], [2]]

    tables = create_dof_tables(groups, model, layout, series, halo)
    halo = halo.bind_columns([])
    taylor = np.zeros((4, 2 * series.terms))
    state = np.zeros((2 * layout.dofs, layout.cells))
    resonator = model.chain.cell.resonator
    clearance = model.chain.sites[1].clearance
    for displacement, expected in ((0.9 * clearance, []), (1.001 * clearance, [2]), (np.nan, [2])):
        # The cell with index 11 holds the second site, whose group is the third one.
        state[resonator, 11] = displacement
        exchange(halo, 0, state)
        expanded = [c for c in range(4) if expand_free_motion(tables, c, halo.columns, taylor)]
        assert expanded == expected


def test_a_rank_far_from_contacts_and_drives_has_empty_tables():
    """A rank without groups has tables and responses without entries."""
    model, layout, series, halo = chain_parts("fixed", 1e-4, 1e-14, sites=(4, 12, 20))
    nothing = Groups(numbers=np.zeros(0, np.int64), first=np.zeros(1, np.int64))

    tables = create_dof_tables(nothing, model, layout, series, halo)

    assert tables.rows.shape[0] == 0
    assert tables.clearance.size == 0
    assert tables.sites.size == 0
    assert create_responses(nothing, tables, model, series).size == 0


def test_dofs_within_reach_are_grouped_across_a_periodic_end():
    """Sites two cells apart are one group if motions reach 2 cells; in a ring, the last cell is next to the first."""

    def grouped(ends: str, reach: int) -> list[list[int]]:
        model = small_case(lattice={"ends": ends}, contacts={"sites": [2, 12, 14, 23]}).model()
        return as_lists(group_dofs(model, reach))

    # The drive of cell 1 is one cell from the first site.
    assert grouped("fixed", 1) == [[0, -1], [1], [2], [3]]
    assert grouped("fixed", 2) == [[0, -1], [1, 2], [3]]
    assert grouped("periodic", 1) == [[0, -1], [1], [2], [3]]
    assert grouped("periodic", 2) == [[0, 3, -1], [1, 2]]


def test_dofs_whose_next_cells_are_within_reach_are_grouped():
    """A site between neighbouring cells is in both: the sites at 12 and 13 and at 14 and 15 are one cell apart."""

    def grouped(ends: str, reach: int) -> list[list[int]]:
        contacts = {"sites": [2, 12, 14, 22], "pair": [1, 1], "next_cell": True}
        return as_lists(group_dofs(small_case(lattice={"ends": ends}, contacts=contacts).model(), reach))

    assert grouped("fixed", 1) == [[0, -1], [1, 2], [3]]
    assert grouped("periodic", 1) == [[0, -1], [1, 2], [3]]
    assert grouped("periodic", 2) == [[0, 3, -1], [1, 2]]
