"""What holds for every study, whatever it computes: nothing that was computed is lost, and nothing is computed twice.

One undisturbed call is the measure: after a stop, a kill, a fault, a file that was cut off or a line that was damaged
the same call leaves the same files to the bit.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import StopAt, modified
from tests.faults.inject import strike
from tests.faults.scenarios import difference
from tests.studies import OTHERWISE, STUDIES, Undisturbed, case_of, compute, phases, some, undisturbed
from vipetsc.cli.verbs.verb_list import study_verbs
from vipetsc.io.folder import FolderError
from vipetsc.io.kinds import BRANCHES, KINDS
from vipetsc.parallel import StoppedError

# One study of each verb: claims of folders and faults come through the frame that its studies share.
ONE_OF_EACH = list({scenario.verb.name: name for name, scenario in reversed(STUDIES.items())}.values())


@pytest.fixture(scope="module")
def calls(tmp_path_factory):
    """Return a function that gives the undisturbed call of a study, computed once."""
    done: dict[str, Undisturbed] = {}

    def call(name: str) -> Undisturbed:
        if name not in done:
            done[name] = undisturbed(name, tmp_path_factory.mktemp(name))
        return done[name]

    return call


@pytest.fixture(params=STUDIES)
def name(request) -> str:
    """The name of each study."""
    return request.param


@pytest.fixture
def whole(name, calls) -> Undisturbed:
    """The undisturbed call of the study."""
    return calls(name)


@pytest.fixture
def out(whole, tmp_path) -> Path:
    """A copy of the results of the undisturbed call."""
    return shutil.copytree(whole.folder, tmp_path / "out")


def result_of(name: str, folder: Path) -> list[Path]:
    """Return the files of the study's results in ``folder``, the newest last."""
    return sorted(folder.glob(STUDIES[name].verb.results.file))


def test_every_verb_that_computes_results_is_here():
    """A new verb gets a tiny case in ``tests/faults/scenarios.py``, and another one in ``OTHERWISE``."""
    verbs = {verb.name for verb in study_verbs()}
    assert {scenario.verb.name for scenario in STUDIES.values()} == verbs
    assert OTHERWISE.keys() == verbs


def test_a_second_call_computes_nothing(name, whole, out):
    """The same call passes no phase of computing, and changes no file; neither does one that resumes."""
    before = modified(out)
    for resume in (False, True):
        passed: list[str] = []
        with phases().watched(passed.append):
            assert compute(name, out, resume=resume).complete
        assert not {"step", "flush", "append", "analyse"} & set(passed)
        # Branches that have used up their points are written again: the case may allow more of them.
        assert modified(out) == before or STUDIES[name].verb.results is BRANCHES
    assert difference(whole.folder, out) == ""


@pytest.mark.parametrize("name", ONE_OF_EACH, indirect=True)
def test_results_are_resumed_only_where_there_are_some(name, tmp_path):
    with pytest.raises(FolderError, match="resume"):
        compute(name, tmp_path / "out", resume=True)
    assert not any((tmp_path / "out").glob("[!.]*"))


def test_a_stop_is_gone_on_with(name, whole, tmp_path):
    """A request is granted at the look in the middle; the next call leaves the same files, and repeats nothing.

    Requests that are granted at the first look are in tests/mpi/test_studies.py.
    """
    if not whole.looks:
        return
    out = tmp_path / "out"
    passed: list[str] = []
    with phases().watched(passed.append):
        with pytest.raises(StoppedError):
            compute(name, out, stop=StopAt(whole.looks // 2))
        compute(name, out)
    assert passed.count("append") == whole.passed.count("append")
    assert difference(whole.folder, out) == ""


def test_whatever_a_kill_leaves_is_gone_on_with(name, whole, tmp_path):
    """A kill leaves the folder as it is at one of the phases, and may leave a part of the last line of records."""
    for number, left in enumerate(some(whole.kills, 2)):
        out = shutil.copytree(left, tmp_path / str(number))
        # The file of all records is written at once.
        for path in out.glob("*-0.jsonl") if number % 2 else ():
            os.truncate(path, path.stat().st_size - 20)
        compute(name, out)
        assert difference(whole.folder, out) == ""


def test_a_result_that_was_cut_off_is_computed_again_or_refused(name, whole, out, caplog, capsys):
    """From its records, where there are some, without another run. A run alone is refused: it may be all there is."""
    for path in result_of(name, out):
        os.truncate(path, path.stat().st_size // 2)
    passed: list[str] = []
    if name.startswith("run"):
        with pytest.raises(FolderError, match="--force"):
            compute(name, out)
        return

    records = {path: path.read_bytes() for path in out.glob("*.jsonl")}
    with phases().watched(passed.append):
        compute(name, out)
    assert "computed again" in caplog.text + capsys.readouterr().err
    assert difference(whole.folder, out) == ""
    assert {path: path.read_bytes() for path in records} == records
    if records and name != "sweep-team":
        assert "append" not in passed


def test_damaged_records_are_computed_again(name, whole, out):
    """A byte of the first and of the last record has changed, and their checksums have not: no other is computed."""
    files = list(out.glob("*.jsonl"))
    # The first record of an identification is a part of its last one.
    damaged = (-1,) if name == "identify" else (0, -1)
    for path in result_of(name, out) if files else ():
        path.unlink()
    for path in files:
        lines = path.read_bytes().splitlines(keepends=True)
        for number in damaged:
            lines[number] = lines[number].replace(b"2", b"3", 1)
        path.write_bytes(b"".join(lines))

    passed: list[str] = []
    with phases().watched(passed.append):
        compute(name, out)
    assert passed.count("append") == len(damaged) * len(files)
    assert difference(whole.folder, out) == ""


@pytest.mark.parametrize("name", ONE_OF_EACH, indirect=True)
def test_results_of_another_case_are_replaced_by_force_alone(name, whole, out):
    """They are refused, and named; ``--force`` keeps them beside the folder until the new ones are complete."""
    other = case_of(STUDIES[name], OTHERWISE[STUDIES[name].verb.name])
    (out / "case.toml").write_text(other.to_toml())
    before = modified(out)
    with pytest.raises(FolderError, match=OTHERWISE[STUDIES[name].verb.name].partition("=")[0]):
        compute(name, out)
    assert modified(out) == before

    aside = out.with_name("out.old")
    kept: list[bool] = []

    def look(phase: str) -> None:
        if phase in ("step", "member"):
            kept.append(all((aside / path.name).exists() for path in result_of(name, whole.folder)))

    with phases().watched(look):
        compute(name, out, force=True)
    assert kept and all(kept)
    assert not aside.exists()
    assert difference(whole.folder, out) == ""


@pytest.mark.parametrize("name", ONE_OF_EACH, indirect=True)
def test_results_of_other_verbs_are_never_replaced(name, tmp_path):
    """Not even by ``--force``: neither those of another kind, nor files that belong to nobody."""
    kind = STUDIES[name].verb.results
    for other in KINDS:
        out = tmp_path / other.source
        out.mkdir()
        file = out / other.file.replace("*", "x")
        file.write_text("results")
        (out / other.marker).touch()
        if other is kind:
            (out / kind.marker).unlink()
        for force in (False, True):
            with pytest.raises(FolderError, match="choose another --out"):
                compute(name, out, force=force)
        assert file.read_text() == "results"


@pytest.mark.parametrize("name", ONE_OF_EACH, indirect=True)
@pytest.mark.parametrize("kind", ["full-disk", "exception"])
def test_a_fault_at_any_phase_loses_nothing(name, whole, tmp_path, kind):
    """A full disk ends a study, and an error ends it or is an outcome of one run; the next call leaves the same files.

    The disk is full at the first file and at the last one; the error comes in the first run and in the last one.
    """
    within = ("step", "member", "analyse") if kind == "exception" else ("append", "write", "replace", "flush")
    places = [number for number, phase in enumerate(whole.passed) if phase in within]
    for place in some(places, 2):
        out = tmp_path / str(place)
        left = iter(range(place, -1, -1))

        def fault(phase: str, left: Iterator[int] = left) -> None:
            if next(left, None) == 0:
                strike(kind, phase)

        with phases().watched(fault):
            try:
                outcome = compute(name, out)
            except Exception as error:
                # Other ranks get copies of the error, which have its text.
                assert {"full-disk": "No space left on device", "exception": "a fault at"}[kind] in str(error)
            else:
                # The outcome of one run of many, or of one start of several.
                assert kind == "exception"
                assert outcome.failures or not outcome.complete or name == "identify"
        compute(name, out)
        assert difference(whole.folder, out) == ""
