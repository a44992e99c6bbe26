"""Names of folders and files that are not ASCII, or no text at all, and files that are not what their names say."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from tests.conftest import clean_environment
from tests.faults.scenarios import SCENARIOS, prepare, words_of
from vipetsc.figures.registry import FIGURES
from vipetsc.io.names import path_named, readable

# Without the last two Python would replace the locale by UTF-8 itself.
C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
TINY = """
[lattice]
preset = "diatomic"
cells = 12
[contacts]
sites = [4]
clearance = 1e-4
[drive]
cycles = 3
[time]
end = 0.02
engine = "propagator"
[output]
figures = false
[sweep.drive]
amplitude = [1.0, 2.0]
"""
# A byte that UTF-8 does not have becomes a lone surrogate, which no file can be written with.
NO_TEXT = os.fsdecode(b"no\xfftext")


@pytest.fixture
def by_shell(tmp_path):
    """Call the program in a folder of its own, in a locale that has but ASCII."""

    def call(*words: str | bytes) -> subprocess.CompletedProcess:
        # In a process: the locale is read once, at its start.
        command = [sys.executable, "-m", "vipetsc", *words]
        environment = clean_environment() | C_LOCALE
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, timeout=300, check=False)

    return call


def test_names_of_the_system_are_readable():
    assert readable("grün") == "grün"
    # As Python hands over the name in a locale of ASCII.
    assert readable(os.fsencode("grün").decode("ascii", "surrogateescape")) == "grün"
    assert readable(NO_TEXT) == "no\ufffdtext"
    # Would raise with a surrogate left.
    readable(NO_TEXT).encode()


def test_a_name_becomes_a_path_in_any_locale():
    script = "from vipetsc.io.names import path_named; path_named('gr\\u00fcn').mkdir(); path_named('plain').mkdir()"
    environment = clean_environment() | C_LOCALE
    ended = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, check=False)
    folders = Path("grün"), Path("plain")
    try:
        assert ended.returncode == 0, ended.stderr.decode()
        assert all(folder.is_dir() for folder in folders)
    finally:
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)
    assert path_named("grün") == Path("grün")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "options", "file"), [("run", "", "runs/λ/run.h5"), ("sweep", " --out hülle", "hülle/ensemble.h5")]
)
def test_an_ascii_locale_takes_names_in_utf_8(by_shell, tmp_path, verb, options, file):
    """The folder has the name of the case or that of ``--out``, which the verbs read by the same code."""
    (tmp_path / "größe.toml").write_text(f'name = "λ"\n{TINY}', encoding="utf-8")
    command = f"{verb} größe.toml{options} --log größe.log"
    # As bytes, since in this test's own locale subprocess might encode them otherwise.
    ended = by_shell(*command.encode().split())
    assert ended.returncode == 0, ended.stderr.decode()
    assert b"Traceback" not in ended.stderr
    assert (tmp_path / "größe.log").read_text(encoding="utf-8")

    result = tmp_path / file
    assert (result.parent / "case.toml").read_text(encoding="utf-8").startswith('name = "λ"')
    with h5py.File(result) as results:
        # HDF5 stores text as UTF-8: a surrogate in it would have failed.
        assert results.attrs["command"] == f"vipetsc {command}"


@pytest.mark.slow
@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize("verb", ["run", "sweep", "law", "nnm", "bands", "plot", "export"])
def test_a_folder_may_have_bytes_that_are_no_text(in_process, monkeypatch, tmp_path, verb):
    scenario = SCENARIOS[verb]
    case = prepare(scenario, tmp_path)
    out = tmp_path / NO_TEXT
    # All pictures of a run go into one folder: one is enough.
    for name in FIGURES.keys() - {"ledger"}:
        monkeypatch.delitem(FIGURES, name)
    for words in filter(None, (scenario.before, scenario.words)):
        call = words_of(words, case, out)
        # The recorded command is that of the process.
        monkeypatch.setattr(sys, "argv", ["vipetsc", *call])
        ended = in_process(*call, "--set", "output.figures=false") if words.startswith("run") else in_process(*call)
        assert ended.returncode == 0, ended.stderr
    assert any(out.iterdir())


def test_a_case_file_may_have_a_name_that_is_no_text(in_process, tmp_path):
    path = tmp_path / f"{NO_TEXT}.toml"
    path.write_text(TINY)
    ended = in_process("validate", path)
    assert ended.returncode == 0, ended.stderr
    assert "no\ufffdtext" in ended.stdout


def test_samples_may_lie_in_a_folder_whose_name_is_no_text(in_process, tmp_path):
    folder = tmp_path / NO_TEXT
    folder.mkdir()
    (folder / "samples.csv").write_text("0.0 0.0\n0.01 1.0\n0.02 0.0\n")
    (folder / "case.toml").write_text(f'{TINY}\n[drive.samples]\nfile = "samples.csv"\n'.replace("cycles = 3", ""))
    ended = in_process("validate", "case.toml", "--set", "drive.waveform=samples", cwd=folder)
    assert "surrogates" not in ended.stderr
    # Whether such a case is valid is not the question: that it ends without a traceback is.
    assert ended.returncode in (0, 2)


def test_a_marker_that_is_no_text_is_another_case(in_process, tmp_path):
    case = tmp_path / "tiny.toml"
    case.write_text(TINY)
    out = tmp_path / "out"
    assert in_process("run", case, "--out", out).returncode == 0
    (out / "case.toml").write_bytes(b'name = "\xff"\n')
    ended = in_process("run", case, "--out", out)
    assert ended.returncode == 2
    assert "contains another run: name = \ufffd there, tiny here" in ended.stderr
    # No TOML at all.
    (out / "case.toml").write_bytes(b"\x89HDF")
    assert "its case.toml cannot be read" in in_process("run", case, "--out", out).stderr
    assert in_process("run", case, "--out", out, "--force").returncode == 0


@pytest.mark.parametrize("verb", ["validate", "run", "nnm", "sweep"])
@pytest.mark.parametrize(
    "text",
    [
        f"[drive]\namplitude = {'[' * 900}{']' * 900}\n",
        f"[drive]\namplitude = {'[' * 300}{']' * 300}\n",
        f"[{'.'.join(['drive'] * 900)}]\n",
        f"[drive]\namplitude = {'{a = ' * 200}1{'}' * 200}\n",
    ],
    ids=["lists", "fewer lists", "dots", "tables"],
)
def test_tables_in_tables_without_end_are_refused(in_process, tmp_path, verb, text):
    path = tmp_path / "deep.toml"
    path.write_text(text)
    ended = in_process(verb, path)
    assert ended.returncode == 2
    # By the program's own limit, or by Python's parser, which gives up first.
    assert "levels deep" in ended.stderr or "recursion depth" in ended.stderr


@pytest.mark.parametrize("change", [f"drive.{'a.' * 900}b=1", f"drive.amplitude={'[' * 200}{']' * 200}"])
def test_changes_without_end_are_refused(in_process, change):
    ended = in_process("validate", "--set", change)
    assert ended.returncode == 2
    assert "levels deep" in ended.stderr


@pytest.mark.slow
def test_a_backend_of_windows_is_of_no_matter(vipetsc, tmp_path):
    # Matplotlib reads the variable as it is imported, and would fail on a backend that it does not have.
    ended = vipetsc(0, "bands", "--out", tmp_path, env=clean_environment() | {"MPLBACKEND": "foo"})
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "bands.png").exists()
