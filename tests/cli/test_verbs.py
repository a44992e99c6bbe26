"""Verbs that compute results behave alike: warnings, options, lock, pictures, exit codes, recognition of results."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from vipetsc.case.verb_cases import VERB_CASES
from vipetsc.cli.verb import DONE, FAILED, STOPPED, Outcome, default_folder
from vipetsc.cli.verbs.plot_verb import pictures_of
from vipetsc.cli.verbs.verb_list import VERBS, study_verbs
from vipetsc.io.folder import FolderError
from vipetsc.io.kinds import KINDS

ROOT = Path(__file__).parents[2]
NAMES = [verb.name for verb in study_verbs()]
DRAWN = [verb.name for verb in study_verbs() if verb.pictures]
pytestmark = pytest.mark.parallel(1)


def example_case(name: str) -> Path:
    """Return the case file of a verb's example."""
    return ROOT / shlex.split(VERBS[name].example)[1]


@pytest.fixture
def drawn(monkeypatch):
    """The list of the kinds of results whose pictures are requested; nothing is drawn."""
    sources = []

    def draw(pictures, folders, comm, afresh):
        sources.append(pictures.kind.source)
        return [folders[0] / "figures" / "picture.png"]

    monkeypatch.setattr("vipetsc.cli.verb.draw_pictures", draw)
    return sources


@pytest.fixture
def call(monkeypatch, in_process, tmp_path, drawn):
    """Call a verb on its example's case with another study in its place: ``call(name, study, *arguments)``."""

    def call_with(name, study, *arguments):
        monkeypatch.setitem(VERBS, name, replace(VERBS[name], study=study))
        return in_process(name, example_case(name), "--out", tmp_path / "out", *arguments)

    return call_with


def finish(case, work) -> Outcome:
    """A study that computes nothing."""
    return Outcome()


def test_the_case_of_every_verb_is_in_the_list_of_cases():
    """Every verb with results has a class in the list of cases and a kind of folder for its results."""
    assert {verb.case for verb in study_verbs()} == set(VERB_CASES)
    for verb in study_verbs():
        assert verb.name == verb.case.verb
        assert verb.results in KINDS


@pytest.mark.parametrize("name", NAMES)
def test_warnings_are_printed_once_and_the_folder_is_locked(call, monkeypatch, name):
    """Warnings of the case and of the results are printed once each; the folder is locked while a study runs."""
    monkeypatch.setattr(VERBS[name].case, "warnings", lambda case: ["beware", "beware", "and mind the gap"])

    def study(case, work):
        assert (work.folder / ".lock").exists()
        work.warn(["beware", "of the result"])
        return Outcome()

    ended = call(name, study)

    assert ended.returncode == DONE, ended.stderr
    warnings = re.findall(r"^vipetsc: warning: (.*)$", ended.stderr, flags=re.M)
    assert warnings == ["beware", "and mind the gap", "of the result"]


@pytest.mark.parametrize("name", NAMES)
def test_petsc_options_of_what_is_simulated_are_checked(call, tmp_path, name):
    """Every verb that simulates refuses a wrong PETSc option before anything is written."""
    ended = call(name, finish, "--set", "petsc.ts_rk_type=magic")
    if VERBS[name].case.load(example_case(name)).runs():
        assert ended.returncode == 2
        assert "petsc.ts_rk_type = 'magic'" in ended.stderr
        assert not (tmp_path / "out").exists()
    else:
        # These verbs integrate nothing with PETSc.
        assert name in ("nnm", "design")
        assert ended.returncode == DONE


@pytest.mark.parametrize("name", DRAWN)
def test_pictures_are_drawn_where_they_are_wanted_and_can_be(call, drawn, name):
    """Results are drawn unless they cannot be, or the case switches pictures off."""
    ended = call(name, finish)
    assert drawn == [VERBS[name].pictures.kind.source]
    assert "figures/picture.png" in ended.stdout

    assert call(name, lambda case, work: Outcome(drawable=False)).returncode == DONE
    assert len(drawn) == 1

    # The cases of nnm and design have no section [output]; tests/cli/test_small_things.py switches their pictures off.
    if VERBS[name].case.verb not in ("nnm", "design"):
        call(name, finish, "--set", "output.figures=false")
        assert len(drawn) == 1


@pytest.mark.parametrize("name", NAMES)
def test_exit_codes_say_how_a_study_ended(call, drawn, name):
    """Failures and incomplete results end with 1 and are named; a request to stop ends with 75 and draws nothing."""

    def stop(case, work):
        work.stop.requested = True
        return Outcome()

    failed = call(name, lambda case, work: Outcome(failures=["curve 2: failed: no convergence"]))
    assert failed.returncode == FAILED
    assert failed.stderr.endswith("vipetsc: curve 2: failed: no convergence\n")
    assert call(name, lambda case, work: Outcome(complete=False)).returncode == FAILED

    drawn.clear()
    stopped = call(name, stop)
    assert stopped.returncode == STOPPED
    assert "stopped on request" in stopped.stderr
    assert drawn == []


@pytest.mark.parametrize("name", NAMES)
def test_the_help_names_the_folder_that_is_used(name):
    """The help of --out has the folder of the results: the case's name, and the verb where the name lacks it."""
    (out,) = (argument for argument in VERBS[name].arguments if argument.flag == "--out")
    assert {"runs/NAME", "runs/NAME-VERB"} <= set(out.keywords["help"].split())
    folder = "runs/chain" if name == "run" else f"runs/chain-{name}"
    assert default_folder("chain", name) == Path(folder)
    assert default_folder(f"{name}-hertz", name) == Path(f"runs/{name}-hertz")
    # A word of the name counts, not some letters of it.
    assert default_folder(f"out{name}", name).name == (f"out{name}" if name == "run" else f"out{name}-{name}")


@pytest.mark.parametrize("name", DRAWN)
def test_results_are_recognised_by_their_file(tmp_path, name):
    """Results are recognised by their folder, and by the file of the results in it."""
    pictures = VERBS[name].pictures
    file = tmp_path / pictures.kind.file.replace("*", "x")
    file.touch()
    assert pictures_of([tmp_path]) == (pictures, [tmp_path])
    assert pictures_of([file]) == (pictures, [tmp_path])


def test_a_verb_may_have_nothing_to_draw(call, monkeypatch, drawn):
    """A verb without pictures ends well and draws none."""
    monkeypatch.setitem(VERBS, "law", replace(VERBS["law"], pictures=None))
    assert call("law", finish).returncode == DONE
    assert drawn == []


def test_only_sweeps_and_branches_share_a_page(tmp_path):
    """Several folders are drawn together only if they hold branches, or branches and a sweep."""
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        folder.mkdir()
        (folder / "branch-x.h5").touch()
    assert pictures_of(folders)[0].kind.source == "branches"

    (folders[0] / "ensemble.h5").touch()
    (folders[0] / "branch-x.h5").unlink()
    assert pictures_of(folders)[0].kind.source == "sweep"

    (folders[0] / "ensemble.h5").rename(folders[0] / "law.h5")
    with pytest.raises(FolderError, match="sweeps and folders of branches, can be drawn on one page"):
        pictures_of(folders)
