"""Options that PETSc has renamed: a case may use either name with any version of PETSc."""

from __future__ import annotations

from petsc4py import PETSc

import pytest

from tests.conftest import small_case
from vipetsc.case import CaseError
from vipetsc.dynamics.options import check_options, given_first_step, name_in_petsc, petsc_options


def in_database() -> dict[str, str]:
    """Return the options of time stepping in PETSc's database."""
    return {name: value for name, value in PETSc.Options().getAll().items() if name.startswith("ts_")}


def test_both_names_are_refused():
    with pytest.raises(CaseError, match=r"petsc\.ts_time_step = .*is another name of ts_dt: give only one"):
        check_options(small_case(petsc={"ts_time_step": 1e-5, "ts_dt": 1e-5}))


@pytest.mark.parametrize("name", ["ts_dt", "ts_time_step"])
@pytest.mark.parametrize("value", ["0", "-1e-5", "nan", "inf"])
def test_a_step_that_is_not_positive(name, value):
    """A first step that is not a positive number is refused under the earlier name."""
    with pytest.raises(CaseError, match=r"petsc\.ts_dt = .*must be positive"):
        check_options(small_case(petsc={name: value}))


def test_the_database_has_the_name_of_its_version():
    """Before PETSc 3.25 the options have their earlier names, and from then on the later ones."""
    assert name_in_petsc("ts_dt", version=(3, 24, 5)) == "ts_dt"
    assert name_in_petsc("ts_dt", version=(3, 25, 0)) == "ts_time_step"
    assert name_in_petsc("ts_max_reject", version=(3, 26, 1)) == "ts_max_step_rejections"
    assert name_in_petsc("ts_rk_type", version=(3, 26, 1)) == "ts_rk_type"


@pytest.mark.parametrize("name", ["ts_dt", "ts_time_step"])
def test_the_first_step_is_read_by_either_name(name):
    options = PETSc.Options()
    assert given_first_step(default=2.0) == 2.0
    options[name] = 1e-5
    try:
        assert given_first_step(default=2.0) == 1e-5
        # The options of a case take precedence, and leave the database as it was.
        with petsc_options({"ts_dt": "1e-3"}):
            PETSc.TS().create(PETSc.COMM_SELF).setFromOptions()
            assert given_first_step(default=2.0) == 1e-3
            assert in_database() == {name_in_petsc("ts_dt"): "1e-3"}
        assert in_database() == {name: "1e-05"}
    finally:
        options.delValue(name)
