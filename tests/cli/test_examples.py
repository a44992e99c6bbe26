"""The case files of the package: they are listed, copied with their data, and read alike from any folder."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import vipetsc as package
from vipetsc import plugins
from vipetsc.case import Case, CaseError, Sweep
from vipetsc.cli.verbs.verb_list import VERBS

EXAMPLES = Path(package.__file__).parent / "examples"
SAMPLES = '[lattice]\npreset = "four-band"\n[drive]\nwaveform = "samples"\namplitude = 8.0\n'


def test_every_case_file_is_listed_with_its_verb_and_a_sentence(in_process, monkeypatch):
    """The list has a line for each file: its name, a verb that reads it, a whole sentence; no module is imported."""
    monkeypatch.delattr(plugins, "load")
    ended = in_process("examples", "--quiet")
    assert ended.returncode == 0
    *lines, remedy = ended.stdout.splitlines()
    # The first line of a file is the whole sentence.
    assert [line for line in lines if not line.endswith(".")] == []
    listed = dict(re.fullmatch(r"  (\S+) +([\w, ]+?)  +[A-Z].*", line).groups() for line in lines)

    assert listed.keys() == {path.relative_to(EXAMPLES).with_suffix("").as_posix() for path in EXAMPLES.rglob("*.toml")}
    assert {verb for verbs in listed.values() for verb in verbs.split(", ")} <= VERBS.keys()
    assert [listed[name] for name in ("three-mass", "interband", "nnm-chain", "gallery/designed")] == [
        "run",
        "sweep",
        "nnm",
        "optimise",
    ]
    assert remedy.startswith("vipetsc examples NAME copies")


def test_a_copied_case_reads_its_data_wherever_it_is_and_wherever_it_is_called(in_process, tmp_path, monkeypatch):
    """The case and the file that it names are copied together, and the case is the same from another folder."""
    ended = in_process("examples", "waveform", "three-mass.toml", "--out", tmp_path / "mine", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert {path.name for path in (tmp_path / "mine").iterdir()} == {"waveform.toml", "waveform.csv", "three-mass.toml"}

    shipped = Case.load(EXAMPLES / "waveform.toml").drive.samples
    for folder, name in ((tmp_path, "mine/waveform.toml"), (tmp_path / "mine", "waveform.toml")):
        monkeypatch.chdir(folder)
        samples = Case.load(name).drive.samples
        assert (samples.sha256, samples.time, samples.value) == (shipped.sha256, shipped.time, shipped.value)
        assert samples.file == str(tmp_path / "mine/waveform.csv")


def test_a_copied_case_has_its_modules(in_process, tmp_path, monkeypatch):
    """The module that a case names is copied with it, without being imported, and is the one that the copy uses."""
    with monkeypatch.context() as context:
        context.delattr(plugins, "load")
        assert in_process("examples", "own-law", "--out", tmp_path / "mine", cwd=tmp_path).returncode == 0
    assert {path.name for path in (tmp_path / "mine").iterdir()} == {"own-law.toml", "own_law.py"}

    copied = Case.load(tmp_path / "mine/own-law.toml")
    shipped = Case.load(EXAMPLES / "own-law.toml")
    assert [*copied.plugins.sources] == [str(tmp_path / "mine/own_law.py")]
    assert copied.contacts == shipped.contacts
    # The comment in the case says that at this depth the force is twice that of the linear law, k x.
    depth = 0.32e-3
    law = copied.model().chain.sites[0].law
    assert law.elastic_force(depth) == pytest.approx(2 * 2e5 * depth, rel=0.02)
    # The force at a number is a number, and the force at an array has the array's shape.
    assert np.shape(law.elastic_force(depth)) == ()
    assert law.elastic_force(np.full((2, 1), depth)).shape == (2, 1)


def test_a_file_that_differs_is_replaced_on_request_alone(in_process, tmp_path):
    """A different file of the same name is refused before anything is written; an equal file is no obstacle."""
    (tmp_path / "waveform.csv").write_text("0,0\n")
    refused = in_process("examples", "beads", "waveform", cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr == "vipetsc: waveform.csv: exists and differs; --force replaces it\n"
    assert [path.name for path in tmp_path.iterdir()] == ["waveform.csv"]

    for words in (["--force"], []):
        assert in_process("examples", "beads", "waveform", *words, cwd=tmp_path).returncode == 0
        assert (tmp_path / "waveform.csv").read_bytes() == (EXAMPLES / "waveform.csv").read_bytes()


def test_a_relative_name_is_that_of_a_file_next_to_the_case_before_one_of_the_current_folder(tmp_path, monkeypatch):
    """A relative name in a case file is sought next to it, then in the current folder; --set uses the latter only."""
    (tmp_path / "cases").mkdir()
    case = tmp_path / "cases/mine.toml"
    case.write_text(SAMPLES + 'samples = { file = "force.csv" }\n')
    (tmp_path / "force.csv").write_text("".join(f"{i * 1e-3},{(-1) ** i}\n" for i in range(9)))
    monkeypatch.chdir(tmp_path)
    assert len(Case.load(case).drive.samples.time) == 9

    (tmp_path / "cases/force.csv").write_text("".join(f"{i * 1e-3},{(-1) ** i}\n" for i in range(6)))
    assert len(Case.load(case).drive.samples.time) == 6
    assert len(Case.load(case, ["drive.samples.file=force.csv"]).drive.samples.time) == 9

    case.write_text(SAMPLES + 'samples = { file = "nowhere.csv" }\n')
    with pytest.raises(CaseError, match=r"samples\.file = 'nowhere\.csv': no such file, neither in the folder of the"):
        Case.load(case)


def test_a_sweep_over_files_goes_on_from_its_own_folder(tmp_path, monkeypatch):
    """The case file in a sweep's results names data files by absolute paths, and is the same from another folder."""
    (tmp_path / "cases").mkdir()
    for name in "ab":
        (tmp_path / f"cases/{name}.csv").write_text("".join(f"{i * 1e-3},{(-1) ** i}\n" for i in range(9)))
    case = tmp_path / "cases/mine.toml"
    case.write_text(SAMPLES + '[sweep]\n"initial.path" = ["b.csv"]\n[sweep.drive.samples]\nfile = ["a.csv", "b.csv"]\n')
    monkeypatch.chdir(tmp_path)
    plan = Sweep.load(case)

    (tmp_path / "results").mkdir()
    monkeypatch.chdir("results")
    Path("case.toml").write_text(plan.to_toml())
    again = Sweep.load("case.toml")
    assert again.to_toml() == plan.to_toml()
    assert again.axes[1]["drive.samples.file"] == tuple(str(tmp_path / f"cases/{name}.csv") for name in "ab")
    assert again.axes[0]["initial.path"] == (str(tmp_path / "cases/b.csv"),)
