"""Case files with random changes yield a case, or an error that names the key, and no other exception."""

from __future__ import annotations

from itertools import islice

import pytest

from tests.faults.mutations import judge, known_keys, mutations, parents
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


@pytest.mark.slow
def test_spoilt_cases_are_read_or_refused(tmp_path):
    """Each of 150 case files with random changes is read, or refused by a sentence; both occur often."""
    spoilt = list(islice(mutations(11, without=SWEEPS), 150))
    verdicts = [judge(mutation, tmp_path / "case.toml") for mutation in spoilt]

    defects = []
    for mutation, verdict in zip(spoilt, verdicts, strict=True):
        if verdict.defect:
            defects.append((mutation.parent, mutation.changes, verdict.defect))
    assert defects == []

    # Both outcomes must occur: of thousands of files one in seven is read. A new key or a new example leads to other
    # random changes.
    assert sum(bool(verdict.refusal) for verdict in verdicts) > 75
    assert sum(bool(verdict.cases) for verdict in verdicts) > 8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[nnm]\nmodes = [2, 2]", "nnm.modes = [2, 2]: names 2 more than once"),
        ("[sweep.drive]\namplitude = { linear = [1, 2], count = 1000000000 }", "n from 1 to 10000"),
        ("[time]\nend = 1e40", "time.end = 1e+40: makes 5e+43 samples"),
        ("[lattice]\neta = 1e-320", "lattice.eta = 1e-320: must have a magnitude"),
        ("[output]\nfields = ['velocity', 'velocity']", "names 'velocity' more than once"),
        ("name = '../../evil'", "name = '../../evil': names the output folder"),
        ("name = '.hidden'", "no dot or dash at the start"),
        ("name = 'a\\b'", "no / or \\"),
        ("[lattice]\ncells = 100000\n[contacts]\nsites = 1\n[nnm]\nsystem = 'chain'", "makes 400000 masses"),
        ("x = " + "[" * 5000, "not a TOML file"),
        ("x = " + "9" * 5000, "not a TOML file"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_named_with_its_remedy(tmp_path, text, message):
    """An impossible case is refused with its key, its value and a remedy."""
    with pytest.raises(CaseError) as caught:
        load(tmp_path / "case.toml", text)
    assert message in str(caught.value)


def test_a_byte_order_mark_is_no_key(tmp_path):
    """A file that Windows editors begin with a byte order mark is read as if it had none."""
    (case,) = load(tmp_path / "case.toml", "\ufeff[lattice]\ncells = 40\n")
    assert case.lattice.cells == 40


def test_a_standing_wave_may_be_driven_for_a_given_time(tmp_path):
    """A given end of the run is accepted at kappa = pi, where no end follows from the group velocity, 0."""
    (case,) = load(tmp_path / "case.toml", "[drive]\nband = 2\nwavenumber = 'pi'\n[time]\nend = 0.1\n")
    # The frequency is the upper edge of band 2, (k2/m)^(1/2) = (1e4/0.005)^(1/2).
    assert case.drive.frequency == pytest.approx(1414.2136)


def test_a_key_can_be_taken_out(tmp_path):
    """``--set key=`` removes a key, so that another one can take its place; a key that is not there is refused."""
    text = "[drive]\nband = 2\nwavenumber = 1.0\n"
    (case,) = load(tmp_path / "case.toml", text, "drive.wavenumber=", "drive.band=", "drive.frequency=1000")
    assert case.drive.frequency == 1000

    with pytest.raises(CaseError, match=r"--set drive\.bnad: is not in the case"):
        load(tmp_path / "case.toml", text, "drive.bnad=")


def test_a_cell_of_ones_own_needs_no_contacts(tmp_path):
    """A lattice with a cell of its own needs no section [contacts] and has no sites then; tests/verify runs one."""
    (case,) = load(tmp_path / "case.toml", TIED + "[drive]\nfrequency = 1.0\n[time]\nend = 10.0\n")
    assert case.model().chain.sites == ()


def test_a_sweep_may_give_what_a_run_lacks(tmp_path):
    """A key without a default may stand in [sweep] alone: the run of the same file takes its first value."""
    text = TIED + "[time]\nend = 1.0\nsample_interval = 0.1\n[sweep.drive]\nfrequency = [0.5, 1.0]\n"

    run, sweep = load(tmp_path / "case.toml", text)

    assert run.drive.frequency == 0.5
    assert sweep.shape == (2,)


@pytest.mark.parametrize("kind", VERB_CASES, ids=lambda kind: kind.verb or "run")
def test_every_key_of_every_verb_is_spoilt(kind):
    """All sections of all verbs are among the changed keys, also those of a verb that is added."""
    sections = {path[0] for path in known_keys()}
    assert kind.sections().keys() <= sections

    # Each verb has a file of its own among those that are spoilt.
    if kind.section:
        assert any(kind.section in table for table in parents().values())


def test_every_verb_that_reads_a_case_has_its_case_among_them():
    """The verbs of the command line read exactly the cases in VERB_CASES."""
    assert {verb.case for verb in study_verbs()} == {*VERB_CASES}
