"""Names of files that are not ASCII or not valid text, and case files that are not valid or nested too deeply."""

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
from vipetsc.io.names import path_named, readable

# Without the last two variables Python would replace the locale by UTF-8.
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
# Python decodes a byte that is not valid in UTF-8 as a lone surrogate, which cannot be encoded as UTF-8 again.
NO_TEXT = os.fsdecode(b"no\xfftext")


@pytest.fixture
def by_shell(tmp_path):
    """Call the program in a temporary folder, in a locale that has only ASCII."""

    def call(*words: str | bytes) -> subprocess.CompletedProcess:
        # The program needs a process of its own: Python reads the locale once, at its start.
        command = [sys.executable, "-m", "vipetsc", *words]
        environment = clean_environment() | C_LOCALE
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, timeout=300, check=False)

    return call


def test_names_of_the_system_are_readable():
    """``readable`` decodes a name as UTF-8 in any locale, and replaces bytes that are not valid in it."""
    assert readable("grün") == "grün"
    # In an ASCII locale Python decodes the bytes of the name in this way.
    assert readable(os.fsencode("grün").decode("ascii", "surrogateescape")) == "grün"
    assert readable(NO_TEXT) == "no\ufffdtext"
    # Encoding would raise an error if a surrogate were left.
    readable(NO_TEXT).encode()


def test_a_name_becomes_a_path_in_any_locale():
    """``path_named`` creates a folder of the same name in an ASCII locale as in a locale of UTF-8."""
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
    """A folder that is named after the case, or by ``--out``, has its name in UTF-8 also in an ASCII locale."""
    (tmp_path / "größe.toml").write_text(f'name = "λ"\n{TINY}', encoding="utf-8")
    command = f"{verb} größe.toml{options} --log größe.log"
    # The words are bytes, because subprocess might encode text otherwise in this test's own locale.
    ended = by_shell(*command.encode().split())
    assert ended.returncode == 0, ended.stderr.decode()
    assert b"Traceback" not in ended.stderr
    assert (tmp_path / "größe.log").read_text(encoding="utf-8")

    result = tmp_path / file
    assert (result.parent / "case.toml").read_text(encoding="utf-8").startswith('name = "λ"')
    with h5py.File(result) as results:
        # HDF5 stores text as UTF-8, which has no surrogates.
        assert results.attrs["command"] == f"vipetsc {command}"


@pytest.mark.slow
@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.parametrize("verb", ["run", "sweep", "law", "nnm", "bands", "plot", "export"])
def test_a_folder_may_have_bytes_that_are_no_text(in_process, monkeypatch, with_figures, tmp_path, verb):
    """Verbs write results and pictures into a folder whose name is not valid text, and read them there."""
    scenario = SCENARIOS[verb]
    case = prepare(scenario, tmp_path)
    out = tmp_path / NO_TEXT
    # All pictures of a run go into one folder: one is enough.
    with_figures("ledger")
    for words in filter(None, (scenario.before, scenario.words)):
        call = words_of(words, case, out)
        # Results record the command of the process.
        monkeypatch.setattr(sys, "argv", ["vipetsc", *call])
        ended = in_process(*call, "--set", "output.figures=false") if words.startswith("run") else in_process(*call)
        assert ended.returncode == 0, ended.stderr
    assert any(out.iterdir())


def test_a_case_file_may_have_a_name_that_is_no_text(in_process, tmp_path):
    """``validate`` reads a case file whose name is not valid text, and prints the name in a readable form."""
    path = tmp_path / f"{NO_TEXT}.toml"
    path.write_text(TINY)
    ended = in_process("validate", path)
    assert ended.returncode == 0, ended.stderr
    assert "no\ufffdtext" in ended.stdout


def test_samples_may_lie_in_a_folder_whose_name_is_no_text(in_process, tmp_path):
    """Samples in a folder whose name is not valid text are not found, as the case has their path as text."""
    folder = tmp_path / NO_TEXT
    folder.mkdir()
    (folder / "samples.csv").write_text("0.0 0.0\n0.01 1.0\n0.02 0.0\n")
    (folder / "case.toml").write_text(f'{TINY}\n[drive.samples]\nfile = "samples.csv"\n'.replace("cycles = 3", ""))
    ended = in_process("validate", "case.toml", "--set", "drive.waveform=samples", cwd=folder)
    assert ended.returncode == 2
    assert "no\ufffdtext/samples.csv': no such file" in ended.stderr


def test_a_marker_that_is_no_text_is_another_case(in_process, tmp_path):
    """A folder whose case.toml is not valid text, or not TOML, is refused as that of another case until --force."""
    case = tmp_path / "tiny.toml"
    case.write_text(TINY)
    out = tmp_path / "out"
    assert in_process("run", case, "--out", out).returncode == 0
    (out / "case.toml").write_bytes(b'name = "\xff"\n')
    ended = in_process("run", case, "--out", out)
    assert ended.returncode == 2
    assert "contains another run: name = \ufffd there, tiny here" in ended.stderr
    # These bytes are not TOML.
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
    """A case file with hundreds of nested lists or tables is refused with a sentence."""
    path = tmp_path / "deep.toml"
    path.write_text(text)
    ended = in_process(verb, path)
    assert ended.returncode == 2
    # Python's parser may give up before the program's own limit is reached.
    assert "levels deep" in ended.stderr or "recursion depth" in ended.stderr


@pytest.mark.parametrize("change", [f"drive.{'a.' * 900}b=1", f"drive.amplitude={'[' * 200}{']' * 200}"])
def test_changes_without_end_are_refused(in_process, change):
    """A change by --set with hundreds of nested keys or lists is refused with a sentence."""
    ended = in_process("validate", "--set", change)
    assert ended.returncode == 2
    assert "levels deep" in ended.stderr


@pytest.mark.slow
def test_a_backend_of_windows_is_of_no_matter(vipetsc, tmp_path):
    """An unknown backend in MPLBACKEND has no effect, although matplotlib reads the variable at its import."""
    ended = vipetsc(0, "bands", "--out", tmp_path, env=clean_environment() | {"MPLBACKEND": "foo"})
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "bands.png").exists()
