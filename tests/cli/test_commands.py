"""Command lines and how they end: the exit code and a telling word. What is refused writes nothing."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import h5py
import pytest

from tests.faults.scenarios import NFRC, RUN, SWEEP

ROOT = Path(__file__).parents[2]
NNM = '[lattice]\npreset = "four-band"\n[contacts]\nlaw = "bilinear"\nmodulus = 1e8\n[nnm]\nmodes = [2]\n'
FOLDED = "[" * 900 + "]" * 900
# Files of the folder in which all commands are called; a part of a name before the slash is a folder.
FILES = {
    "run.toml": RUN,
    "sweep.toml": SWEEP,
    "nnm.toml": NNM,
    "nfrc.toml": NFRC,
    "several.toml": NNM + "[design]\nwavenumbers = 11\n[sweep.drive]\namplitude = [1.0, 2.0]\n",
    "lists.toml": f"[drive]\namplitude = {FOLDED}\n",
    "dots.toml": f"[drive]\n{'a.' * 900}b = 1\n",
    "thesis/thesis.tex": "years of work",
    "text/run.h5": "not HDF5 at all",
    "paper/plan.json": '{"grid": "full"}',
    "differing/waveform.csv": "0,0\n",
}


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    """A folder with ``FILES``, a case file that is no text, and a file of another program in the place of a branch."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "bytes.toml").write_bytes(b"\x89HDF\r\n\x1a\n\xff\xfe")
    (tmp_path / "foreign").mkdir()
    with h5py.File(tmp_path / "foreign/branch-x.h5", "w") as file:
        file["energy"] = [1.0]
    return tmp_path


# A blank separates the words of a line, unless they are quoted; the word after "->" must be in the message.
REFUSED = """
run nowhere.toml -> nowhere.toml
validate '' -> directory
schema '' -> directory
validate bytes.toml -> TOML
validate lists.toml -> recursion
validate dots.toml -> recursion
run --set time.end -> section.key=value
run --set time.sample_interval=0.01 -> coarse
run --set lattice.cell.masses=[1.0,-1.0] -> lattice.cell
run --force --resume -> exclude
run --resume --out new -> resume
run --log no/run.log -> --log
run run.toml --out thesis -> --out
run run.toml --out thesis --force -> --out
fly -> fly
plot nowhere -> no such folder
plot text -> run.h5
plot foreign -> branch
analyse thesis -> run.h5
bands --set lattice.cells=40 --out new --near 2034 -> --near
bands --set lattice.cells=40 --out new --modes 161 -> --modes
bands --set lattice.cells=40 --out new --modes 2 --near -1 -> --near
run sweep.toml --member 3 --out new -> --member
run sweep.toml --member x --out new -> member
run thesis --member 0 --out new -> case
sweep sweep.toml --out new --set sweep.drive.amplitud=[1.0] -> amplitude
sweep sweep.toml --out new --set sweep.feilds=true -> fields
sweep sweep.toml --out new --set sweep.drive.amplitude=[0.0] -> amplitude
nnm nnm.toml --out new --set nnm.modes=[7] -> modes
nnm nnm.toml --out new --set nmn.map=1 -> nnm
nfrc nfrc.toml --out new --set nfrc.range=[2.0,1.0] -> nfrc.range
design --out new --set design.lambda.last=0.1 --set design.lambda.first=0.2 -> design.lambda.first
design --out new --set design.lambda.count=1000000 -> most
design --out new --set "design.readings=['printed','printed']" -> once
design --out new --set "design.readings=['printd']" -> printed
design --out new --set lattice.preset=diatomic -> four-band
design --out new --set design=3 -> section
validate several.toml --set petsc.ts_rk_type=magic -> petsc.ts_rk_type
examples wavefrm -> waveform
examples x -> examples
examples --out new -> --all
examples beads --out run.toml -> --out
examples beads waveform --out differing -> --force
manual cooking -> manual
paper --only fig99 C7 --out new -> fig99
paper --only fig10 --out thesis -> --out
paper --quick --only fig10 --out paper -> full
"""
# What ``validate`` shows of a case that is valid.
SHOWN = {
    "validate": ["GB per rank", "3214.90-3644.75", "1023.27", "428.68", "4421", "75, 106, 138, 169, 200"],
    "validate --set drive.frequency=650.0": ["no pass band"],
    "validate several.toml": ["0.768", "2 members", "modes 2", "37 lambda x 36 eta"],
    "validate sweep.toml --set sweep.contacts.sites=[[20],[41]]": ["6 members (2 x 3)", "3 of them impossible"],
    "validate {examples}/nfrc.toml": ["nfrc", "3 curves", "0.4 to 1.6", "infinite"],
    "validate {examples}/predict.toml": ["19 amplitudes", "17 to 1500 N", "24 runs"],
    "validate {examples}/disorder.toml": ["deviation 1 %", "0.99"],
    "validate {examples}/packet.toml": ["packet", "927.0256", "0.7 s"],
    "bands {examples}/beads.toml --out new": ["no pass bands"],
    "validate --quiet": ["GB per rank"],
}


def rows() -> list[tuple[list[str], str]]:
    """Return the words of each refused command with its telling word, and those of names that are no text."""
    found = []
    for line in REFUSED.strip().splitlines():
        command, telling = line.rsplit(" -> ", 1)
        found.append((shlex.split(command), telling))
    no_text = os.fsdecode(b"no\xfftext")
    return [*found, (["validate", f"{no_text}.toml"], "UTF-8"), (["run", "--out", no_text], "UTF-8")]


def everything(folder: Path) -> dict[Path, int]:
    """Return the files and folders below a folder, with the sizes of the files."""
    return {path: path.stat().st_size if path.is_file() else 0 for path in folder.rglob("*") if path.name[0] != "."}


@pytest.mark.parametrize(("words", "telling"), rows())
def test_what_is_refused_is_named_and_writes_nothing(in_process, desk, words, telling):
    """The exit code is 2, the message has the telling word and no traceback, and the folder is as it was."""
    before = everything(desk)
    ended = in_process(*words, cwd=desk)
    assert ended.returncode == 2, ended.stdout + ended.stderr
    assert telling in ended.stderr
    assert "Traceback" not in ended.stderr
    assert everything(desk) == before


@pytest.mark.parametrize("command", SHOWN)
def test_what_follows_from_a_case_is_shown(in_process, desk, command):
    """The exit code is 0, and the answer has the numbers that follow from the case."""
    ended = in_process(*shlex.split(command.format(examples=ROOT / "runs/examples")), cwd=desk)
    assert ended.returncode == 0, ended.stderr
    for text in SHOWN[command]:
        assert text in ended.stdout


def test_everything_wrong_with_a_case_is_said_at_once(in_process, tmp_path):
    """Every wrong key and value is named once, and nothing is written."""
    path = tmp_path / "bad.toml"
    path.write_text(
        '[lattice]\npreset = "fourband"\ncels = 3\n[contacts]\nsites = [3, 3, 400]\n'
        'clearance = -1.0\nrestitution = 1.5\n[drive]\namplitude = "big"\n[time]\nsample_interval = 1.0\n[drvie]\n'
    )
    ended = in_process("run", path, "--out", tmp_path / "out")
    assert ended.returncode == 2
    for text in ("lattice.preset = 'fourband'", "mean 'four-band'", "lattice.cels = 3", "mean lattice.cells", "[400]",
                 "twice", "contacts.clearance = -1.0", "contacts.restitution = 1.5", "drive.amplitude = 'big'",
                 "drvie", "mean drive"):  # fmt: skip
        assert ended.stderr.count(text) == 1, text
    assert not (tmp_path / "out").exists()
