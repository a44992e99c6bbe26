"""The package as a user installs it: an sdist, a wheel from the sdist, and its programs outside the source tree."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pydantic
import pytest

import vipetsc as package
from tests.conftest import clean_environment, set_words
from tests.manual_modules import write_modules
from vipetsc.__main__ import BUILT_FOR_MPI

ROOT = Path(package.__file__).parents[1]
# pip calls the same functions, but in copies of the source and in processes of their own.
BUILD = "import sys; from setuptools.build_meta import build_sdist; print(build_sdist(sys.argv[1]))"
BUILD_WHEEL = "import sys; from setuptools.build_meta import build_wheel; print(build_wheel(sys.argv[1]))"
PIP = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-cache-dir")
TOP = {
    "pyproject.toml", "vipetsc", "tests", "runs", "scripts", "README.md",
    "LICENSE", "CITATION.cff", "CHANGELOG.md", "MANIFEST.in", ".gitignore", ".ci",
}  # fmt: skip
# The engine with fewer kernels, since an installed package compiles its own.
TINY = set_words(
    "lattice.cells=40",
    "contacts.sites=[6,12]",
    "contacts.clearance=1e-4",
    "time.end=0.08",
    "time.engine=ts",
    "output.figures=false",
)

# One of the tests calls mpirun; in the same process as that one the others find the sdist and the wheel made.
needs_the_wheel = pytest.mark.mpirun


def tracked() -> list[str]:
    """Return the names of the files that git tracks and that exist."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    # A file that was removed is tracked until its removal is committed.
    return [name for name in listed.stdout.splitlines() if (ROOT / name).exists()]


def call(*command: object, cwd: Path, site: Path | None = None) -> subprocess.CompletedProcess:
    """Call a command and assert that it ends with 0; it finds the package in ``site``, if given, never the source."""
    environment = clean_environment()
    if site:
        environment["PYTHONPATH"] = str(site)

    words = list(map(str, command))
    ended = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 0, f"{words}\n{ended.stdout}\n{ended.stderr}"
    return ended


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """Build an sdist of what git tracks, and a wheel from that sdist."""
    folder = tmp_path_factory.mktemp("built")
    for name in tracked():
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        # The link to the folder of the examples stays a link.
        shutil.copy2(ROOT / name, folder / "source" / name, follow_symlinks=not (ROOT / name).is_dir())

    # The wheel is built from the sdist, and therefore lacks what the sdist lacks.
    call(sys.executable, "-c", BUILD, folder, cwd=folder / "source")
    (sdist,) = folder.glob("*.tar.gz")
    call("tar", "-xzf", sdist, cwd=folder)
    (unpacked,) = folder.glob("vipetsc-*/")
    call(sys.executable, "-c", BUILD_WHEEL, folder, cwd=unpacked)
    (wheel,) = folder.glob("*.whl")
    return sdist, wheel


@pytest.fixture(scope="module")
def site(built, tmp_path_factory) -> Path:
    """Install the wheel into a folder of its own, next to the libraries of this environment."""
    folder = tmp_path_factory.mktemp("site")
    call(*PIP, "install", "--no-deps", "--no-compile", "--target", folder, built[1], cwd=folder)
    take_compiled(folder)
    return folder


def take_compiled(site: Path) -> None:
    """Give an installed package the kernels that the source tree has compiled: to compile them again takes a minute.

    Numba takes a compiled kernel for one of a source that has the same size and time.
    """
    for path in sorted((site / "vipetsc").rglob("*.py")):
        source = ROOT / path.relative_to(site)
        assert path.read_bytes() == source.read_bytes(), path
        shutil.copystat(source, path)
    for kept in sorted((ROOT / "vipetsc").rglob("__pycache__")):
        shutil.copytree(kept, site / kept.relative_to(ROOT), dirs_exist_ok=True)


@needs_the_wheel
def test_the_sdist_is_the_source_and_the_wheel_is_the_package(built):
    """The sdist has all tracked files that are not hidden; the wheel has all of the package's, and its version."""
    sdist, wheel = built
    with tarfile.open(sdist) as file:
        # All names begin with the folder of the archive.
        packed = {name.partition("/")[2] for name in file.getnames()}
    assert {name for name in tracked() if not name.startswith(".")} <= packed

    with zipfile.ZipFile(wheel) as file:
        assert {name for name in tracked() if name.startswith("vipetsc/")} <= set(file.namelist())
    assert wheel.name == f"vipetsc-{package.__version__}-py3-none-any.whl"


def test_the_top_level_holds_what_it_may():
    """The top of the source tree holds only the files and folders of ``TOP``."""
    assert {name.partition("/")[0] for name in tracked()} <= TOP


@needs_the_wheel
def test_the_wheel_runs_away_from_the_source(site, tmp_path):
    """The console script of the wheel prints its version, runs on two ranks, draws, and lists the paper's steps."""
    program = site / "bin" / "vipetsc"
    mpirun = ["mpirun", "--oversubscribe", "-n", "2"]
    printed = call(sys.executable, "-c", "import vipetsc; print(vipetsc.__file__)", cwd=tmp_path, site=site)
    assert Path(printed.stdout.strip()).is_relative_to(site)
    assert call(program, "--version", cwd=tmp_path, site=site).stdout == f"vipetsc {package.__version__}\n"

    ended = call(*mpirun, program, "run", *TINY, cwd=tmp_path, site=site)
    assert ended.stdout.count("complete: ") == 1

    call(program, "plot", "runs/four-band", "--fig", "ledger", cwd=tmp_path, site=site)
    assert (tmp_path / "runs/four-band/figures/ledger.png").exists()
    assert "scattering" in call(program, "paper", "--list", cwd=tmp_path, site=site).stdout
    # The manual asks for this folder: its commands name case files in it.
    call(program, "examples", "--all", "--out", "runs/examples", cwd=tmp_path, site=site)
    read = call(program, "validate", "runs/examples/waveform.toml", cwd=tmp_path, site=site).stdout
    assert "308 samples (monotone), at most" in read
    shutil.copy2(ROOT / "tests/cli/tiny_paper.py", tmp_path)
    call(sys.executable, "tiny_paper.py", "paper", "C10", cwd=tmp_path, site=site)
    for path in ("design/design.h5", "report.html"):
        assert (tmp_path / "paper" / path).exists()


@needs_the_wheel
def test_an_installed_package_registers_a_law(site, tmp_path):
    """A package with an entry point registers the manual's law; its version and hash are in the results."""
    write_modules(tmp_path, site / "vipetsc/manual/extend.md")
    about = site / "stops_of_a_user-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: stops-of-a-user\nVersion: 1.2\n")
    (about / "entry_points.txt").write_text("[vipetsc.plugins]\nusers-stops = stops_of_a_user\n")
    source = (tmp_path / "stops.py").read_bytes()
    (site / "stops_of_a_user.py").write_bytes(source)

    laws = set_words(
        "plugins.modules=['users-stops']",
        "contacts={law='hardening',stiffness=2e5,parameters={b=4e5},sites=[6,12],clearance=1e-4}",
    )
    call(site / "bin/vipetsc", "run", *laws, *TINY, cwd=tmp_path, site=site)
    case = tomllib.loads((tmp_path / "runs/four-band/case.toml").read_text(encoding="utf-8"))
    record = {"version": "1.2", "sha256": hashlib.sha256(source).hexdigest()}
    assert case["plugins"]["sources"] == {"users-stops": record}
    assert case["contacts"]["law"] == "hardening"


@needs_the_wheel
def test_the_folder_above_a_clone_does_not_hide_the_package(tmp_path):
    """With the package installed as scripts/setup does it, ``python -m vipetsc`` works beside a clone named vipetsc."""
    clone = tmp_path / "vipetsc"
    shutil.copytree(ROOT / "vipetsc", clone / "vipetsc", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy2(ROOT / name, clone)
    # pip records nothing of the package in this environment, but in one of its own.
    python = tmp_path / "venv/bin/python"
    call(sys.executable, "-m", "venv", "--without-pip", "--system-site-packages", tmp_path / "venv", cwd=tmp_path)
    found = [
        re.search(r"(--config-settings \S+)", (ROOT / "scripts" / script).read_text(encoding="utf-8"))[1]
        for script in ("setup", "recipes/pip")
    ]
    settings = found[0]
    assert found == [settings] * 2
    options = ["--no-deps", "--no-build-isolation", *settings.split(), "--editable", clone]
    call(*PIP, "--python", python, "install", *options, cwd=tmp_path)

    # The libraries are those of this environment.
    libraries = Path(pydantic.__file__).parents[1]
    answer = call(python, "-m", "vipetsc", "--version", cwd=tmp_path, site=libraries).stdout
    assert answer == f"vipetsc {package.__version__}\n"


@needs_the_wheel
def test_what_pip_cannot_bring_is_named(site, tmp_path):
    """Without the libraries that are built for MPI, ``doctor`` names them and their remedy, without a traceback."""
    # An import of a module that is None in sys.modules fails.
    code = (
        f"import sys; sys.path.insert(0, {str(site)!r}); sys.modules.update(dict.fromkeys({BUILT_FOR_MPI}));"
        " from vipetsc.__main__ import main; sys.exit(main(['doctor']))"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "petsc4py" in ended.stderr
    assert "apt install" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_recipes_and_citation_say_what_the_package_says():
    """Citation, recipe and changes have the package's version, and the recipe its dependencies and their bounds."""
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    recipe = (ROOT / "scripts/recipes/recipe.yaml").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    for text in (citation, recipe):
        assert re.findall(r"^ *version: (\d\S*)$", text, flags=re.M) == [package.__version__]
    assert re.search(r"^## (\S+)", changes, flags=re.M)[1] == package.__version__

    # An environment of conda has what single verbs need, too, except for the movies that ffmpeg writes.
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    lines = list(project["dependencies"])
    for extra in ("h5py", "completion", "optimise", "paper", "xarray"):
        lines += extras[extra]
    needed = dict(line.split(">=", 1) for line in lines)

    # Conda names some packages after their smaller variant, and needs Python, PETSc and SLEPc besides pip's packages.
    run = recipe.split("\n  run:\n")[1].split("\n\n")[0]
    bounds = {name.removesuffix("-base"): bound for name, bound in re.findall(r"- ([\w-]+) >=(\S+)", run)}
    assert {name: bound for name, bound in bounds.items() if name not in ("python", "petsc", "slepc4py")} == needed
    # Every package that the program imports is below a version that nobody has tried.
    assert all("<" in line for line in [*lines, *extras["movie"]])
    assert "- petsc * real_*\n" in run
