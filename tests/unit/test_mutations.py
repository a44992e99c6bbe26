"""Case files with random changes yield a case, or an error that names the key, and no other exception."""

from __future__ import annotations

from itertools import islice

import pytest

from tests.faults.mutations import judge, mutations
from vipetsc.case import CaseError
from vipetsc.case.verb_cases import VERB_CASES, load_every
from vipetsc.cli.verbs.verb_list import study_verbs

# Sweeps of thousands of members, each of which takes seconds to resolve.
SWEEPS = ("interband", "scattering", "scattering-neighbours")
CELL = "[lattice]\ncells = 20\n[lattice.cell]\nmasses = [1.0, 2.0, 3.0]\ncontact = [1, 2]\nsprings = [{}]\n"
CHAIN = "{ start = 1, end = 1, stiffness = 3.0, next_cell = true }, { start = 1, end = 2, stiffness = 4.0 }"
TIED = CELL.format(CHAIN + ", { start = 1, end = 3, stiffness = 4.0 }")


def load(path, text, *overrides):
    """Write a case file and return the cases of all verbs that read it."""
    path.write_text(text, encoding="utf-8")
    return load_every(path, overrides)


def test_spoilt_cases_are_read_or_refused(tmp_path):
    """Each of 60 case files with random changes is read, or refused by a sentence; both occur often."""
    spoilt = list(islice(mutations(11, without=SWEEPS), 60))
    verdicts = [judge(mutation, tmp_path / "case.toml") for mutation in spoilt]

    defects = []
    for mutation, verdict in zip(spoilt, verdicts, strict=True):
        if verdict.defect:
            defects.append((mutation.parent, mutation.changes, verdict.defect))
    assert defects == []

    # Both outcomes must occur: of thousands of files one in seven is read. A new key or a new example leads to other
    # random changes.
    assert sum(bool(verdict.refusal) for verdict in verdicts) > 30
    assert sum(bool(verdict.cases) for verdict in verdicts) > 3


def test_a_key_can_be_taken_out(tmp_path):
    """``--set key=`` removes a key, so that another one can take its place; a key that is not there is refused."""
    text = "[drive]\nband = 2\nwavenumber = 1.0\n"
    (case,) = load(tmp_path / "case.toml", text, "drive.wavenumber=", "drive.band=", "drive.frequency=1000")
    assert case.drive.frequency == 1000

    with pytest.raises(CaseError, match=r"--set drive\.bnad: is not in the case"):
        load(tmp_path / "case.toml", text, "drive.bnad=")


def test_a_sweep_may_give_what_a_run_lacks(tmp_path):
    """A key without a default may stand in [sweep] alone: the run of the same file takes its first value."""
    text = TIED + "[time]\nend = 1.0\nsample_interval = 0.1\n[sweep.drive]\nfrequency = [0.5, 1.0]\n"

    run, sweep = load(tmp_path / "case.toml", text)

    assert run.drive.frequency == 0.5
    assert sweep.shape == (2,)


def test_every_verb_that_reads_a_case_has_its_case_among_them():
    """The verbs of the command line read exactly the cases in VERB_CASES."""
    assert {verb.case for verb in study_verbs()} == {*VERB_CASES}
