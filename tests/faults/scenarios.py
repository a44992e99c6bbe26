"""Tiny cases of every verb: the calls of the program, and the comparison of two outcomes."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np

from vipetsc.cli.verb import Verb
from vipetsc.cli.verbs.verb_list import VERBS

EXAMPLES = Path(__file__).parents[2] / "vipetsc" / "examples"
RUN = """
[lattice]
preset = "diatomic"
cells = 40
[contacts]
sites = 2
clearance = 1e-4
[drive]
cycles = 5
amplitude = 10.0
[time]
engine = "propagator"
samples = 101
rtol = 1e-8
"""
TS = RUN.replace("propagator", "ts") + "[output]\nfigures = false\n"
SWEEP = """
[lattice]
preset = "diatomic"
cells = 40
[drive]
cycles = 5
[contacts]
clearance = 1e-4
[time]
samples = 101
rtol = 1e-7
[output]
figures = false
[sweep]
measures = ["entropy"]
[sweep.contacts]
sites = [1]
[sweep.drive]
amplitude = [0.1, 5.0, 10.0]
"""
TEAM = SWEEP.replace("[sweep]", "[sweep]\nranks = 2\nfields = true")
FOLLOW = SWEEP.replace("[sweep]", '[sweep]\nfields = true\nfollow = "up"')
BRANCHES = """
[nnm]
system = "own"
modes = [1, 2]
start_energy = 1.0
energy = [0.5, 50.0]
first_step = 0.05
switch = ["symmetry-breaking"]
switch_points = 3
[nnm.own]
masses = [1.0, 1.0]
springs = [
    { start = 0, end = 1, stiffness = 1.0 },
    { start = 1, end = 2, stiffness = 1.0 },
    { start = 0, end = 2, stiffness = 1.0 },
]
smooth = [{ start = 0, end = 1, cubic = 0.5 }]
"""
# A branch of a lattice by shooting, and branches of a longer one by harmonic balance of its sites.
SHOT = """
[lattice]
preset = "four-band"
cells = 4
[contacts]
restitution = 1.0
sites = [2]
[nnm]
system = "chain"
modes = [3]
energy = [0.0, 10.0]
points = 3
"""
CONDENSED = """
[lattice]
preset = "four-band"
[contacts]
restitution = 1.0
sites = [100]
[nnm]
system = "condensed"
start_frequency = [1420.0, 3700.0]
direction = "down"
energy = [1e-4, 0.3]
points = 3
first_step = 1e-2
harmonics = 41
truncation = 1e-3
"""
DESIGN = """
[design]
lambda = { first = 0.1, last = 1.0, count = 2 }
eta = { count = 3 }
wavenumbers = 11
"""
# One site of the four-band lattice, under a burst that is short enough for few cells.
LAW = """
[lattice]
preset = "four-band"
[contacts]
sites = [6]
clearance = 2e-4
[drive]
cycles = 8
amplitude = 8.0
[time]
end = 0.06
rtol = 1e-7
[law]
largest = 2.0
tolerance = 0.5
finest = 0.5
samples = 1
"""
# There are two curves, one for each of two ranks.
NFRC = """
[lattice]
preset = "four-band"
[contacts]
sites = [100]
clearance = 1.8e-3
[nfrc]
restitutions = [1.0, 0.7]
range = [0.97, 1.01]
harmonics = 3
points = 5
"""
# The parameter of the curves is a key of the case, and masses are named, whose harmonics are stored.
OVER_KEY = NFRC.replace("range = [0.97, 1.01]", 'over = "contacts.clearance"\nrange = [1.2e-3, 1.8e-3]\nfixed = [2.0]')
OVER_KEY += "[[output.points]]\nname = 'before'\ncell = 98\n[[output.points]]\nname = 'behind'\ncell = 102\nmass = 3\n"
FAMILY = NFRC.replace("restitutions = [1.0, 0.7]\n", "") + "[nfrc.family.contacts]\nsites = [[100], [101]]\n"
PREDICT = LAW + "[predict]\namplitudes = [4.0, 8.0]\npoints = 16\n"
OPTIMISE = LAW.partition("[law]")[0] + "[optimise]\nbudget = 8\ncurve = [10.0]\nvariables.clearance = [1e-5, 1e-3]\n"
# The energy that is transmitted is to be large at one amplitude, and small at another one.
FRONT = (
    OPTIMISE
    + """
population = 4
[[optimise.objective]]
measure = "transmitted"
amplitudes = [5.0]
[[optimise.objective]]
measure = "transmitted"
goal = "minimise"
"""
)
# An absorber with stops: its mass meets them at 2 N, and does not reach them at 1 N.
ABSORBER = """
[lattice]
cells = 1
[lattice.cell]
masses = [1.0, 0.05]
springs = [
    { start = 1, end = 1, stiffness = 0.5, next_cell = true },
    { start = 1, end = 2, stiffness = 0.06, damping = 0.01 },
]
[contacts]
law = "bilinear"
stiffness = 20.0
sites = [1]
pair = [0, 1]
clearance = 14.0
[drive]
waveform = "harmonic"
amplitude = 1.0
frequency = 1.0
[time]
end = 10.0
[[output.points]]
name = "mass"
cell = 1
[nfrc]
source = "force"
over = "frequency"
range = [0.84, 0.9]
fixed = [1.0, 2.0]
harmonics = 1
largest_step = 1.0
points = 40
[optimise]
budget = 4
population = 4
[optimise.variables.lattice.cell]
"springs[2]" = { stiffness = { log = [0.02, 0.1] } }
[[optimise.objective]]
measure = "response/peak_displacement/mass"
goal = "minimise"
"""
# One clearance is identified from a record with contacts, in two starts: one for each of two ranks.
IDENTIFY = f"""
[lattice]
preset = "four-band"
cells = 12
[contacts]
sites = [3]
clearance = 1e-3
[drive]
cycles = 6
[identify]
starts = 2
steps = 2
profile = 0
[[identify.records]]
file = "{EXAMPLES / "identify.csv"}"
time = "time (s)"
end = 0.008
[[identify.records.sensors]]
quantity = "velocity"
column = "near (m/s)"
cell = 4
mass = 1
[[identify.unknowns]]
quantity = "clearance"
bounds = [3e-4, 5e-3]
"""
# One picture for each kind of results is enough: these are the cheapest ones.
DRAWN = ("ledger", "branch", "deflections", "amplitudes")
# A run of 101 samples then has several chunks.
SAMPLES_A_CHUNK = 20
# Attributes of HDF5 files in which two outcomes of one command differ, and why.
OF_ONE_CALL = {
    "date": "when the file was written",
    "ranks": "which team of a sweep, of two ranks or one, was free for a member",
    "revision": "the commit, if git answers in time",
    "cpu_seconds": "time that the call took",
    "sources": "hashes of files with a date in them",
}
# Attributes that are addresses within the file. The dimensions of datasets, which they say, are compared by name.
ADDRESSES = {"DIMENSION_LIST", "REFERENCE_LIST"}

# The steps that remain in the tiny paper, and the changes that shorten them.
PAPER = {
    "design": ("design.lambda.count=2", "design.eta.count=3"),
    "nnm-hertz-calibrated": ("nnm.energy=[0.0, 1.0]", "nnm.locate_grazing=false"),
    "interband": (
        'sweep.contacts.law=["hertz"]', "sweep.contacts.sites=[1]", "sweep.drive.cycles=[5]",
        "sweep.drive.amplitude=[0.5, 5.0, 10.0]", "time.end=0.05",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Scenario:
    """A call of the program: ``words`` with the places {case} and {out} for paths.

    ``before`` are the words of an earlier call without a fault; at its step ``stop``, if not 0, it is asked to stop.
    The short test causes faults in a call that ``is_short``; only the campaign does in others.
    """

    name: str
    case: str
    words: str
    before: str = ""
    stop: int = 0
    is_short: bool = False

    @property
    def verb(self) -> Verb:
        """The verb that is called."""
        return VERBS[self.words.split()[0]]


OUT = "{case} --out {out}"
PLAIN = "--set output.figures=false"
SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        Scenario("run", RUN, f"run {OUT}", is_short=True),
        Scenario("run-ts", TS, f"run {OUT}", is_short=True),
        Scenario("run-resumed", TS, f"run {OUT}", before=f"run {OUT}", stop=70),
        Scenario(
            "run-force",
            RUN,
            f"run {OUT} {PLAIN} --force",
            before=f"run {OUT} {PLAIN} --set drive.amplitude=9.0",
            is_short=True,
        ),
        Scenario("sweep", SWEEP, f"sweep {OUT}"),
        Scenario("sweep-follow", FOLLOW, f"sweep {OUT}", is_short=True),
        Scenario("sweep-team", TEAM, f"sweep {OUT}", is_short=True),
        Scenario("nnm", BRANCHES, f"nnm {OUT}", is_short=True),
        Scenario("nnm-chain", SHOT, f"nnm {OUT} {PLAIN}"),
        Scenario("nnm-condensed", CONDENSED, f"nnm {OUT} {PLAIN}"),
        Scenario("nfrc", NFRC, f"nfrc {OUT} {PLAIN}", is_short=True),
        Scenario("nfrc-family", FAMILY, f"nfrc {OUT} {PLAIN}"),
        Scenario("nfrc-over-key", OVER_KEY, f"nfrc {OUT} {PLAIN}"),
        Scenario("design", DESIGN, f"design {OUT}", is_short=True),
        Scenario("law", LAW, f"law {OUT} {PLAIN}", is_short=True),
        Scenario("predict", PREDICT, f"predict {OUT} {PLAIN}", is_short=True),
        Scenario("optimise", OPTIMISE, f"optimise {OUT} {PLAIN}", is_short=True),
        Scenario("optimise-front", FRONT, f"optimise {OUT} {PLAIN}"),
        Scenario("optimise-team", OPTIMISE.replace("[optimise]", "[optimise]\nranks = 2"), f"optimise {OUT} {PLAIN}"),
        Scenario("optimise-responses", ABSORBER, f"optimise {OUT} {PLAIN}"),
        Scenario("identify", IDENTIFY, f"identify {OUT} {PLAIN}", is_short=True),
        Scenario("analyse", TEAM.replace("ranks = 2", ""), "analyse {out}", before=f"sweep {OUT}"),
        Scenario("plot", RUN, "plot {out}", before=f"run {OUT} {PLAIN}"),
        Scenario("movie", RUN, "plot {out} --movie --format gif --width 320", before=f"run {OUT} {PLAIN}"),
        Scenario("export", RUN, "export {out}", before=f"run {OUT} {PLAIN}"),
        Scenario("bands", RUN, f"bands {OUT}"),
        Scenario("bands-modes", RUN, f"bands {OUT} --modes 2 --near 300"),
        Scenario("validate", SWEEP, "validate {case}"),
        Scenario("schema", RUN, "schema {case}"),
        Scenario("examples", "", "examples waveform own-law --out {out}"),
        Scenario("paper", "", "paper --quick --out {out}", is_short=True),
    )
}


def shrink_pictures() -> None:
    """Reduce the program's pictures and the size of its chunks, as the cases are tiny."""
    # Only workers call this function: its replacements remain in the process.
    from vipetsc.dynamics import recorded_sizes
    from vipetsc.figures import measure_pages, registry

    registry.FIGURES = {name: spec for name, spec in registry.FIGURES.items() if name in DRAWN}
    measures_of = measure_pages.measures_of
    measure_pages.measures_of = lambda ensemble: measures_of(ensemble)[:1]
    recorded_sizes.CHUNK_SAMPLES = SAMPLES_A_CHUNK


@cache
def shrink_paper() -> None:
    """Replace the paper's plan by the steps of ``PAPER``, shortened, and one figure."""
    import vipetsc.paper.plan as plan
    from tests.cli.tiny_paper import tiny_plan

    small = tiny_plan()
    steps = []
    for step in small.steps:
        if step.name in PAPER:
            steps.append(replace(step, changes=(*step.changes, *PAPER[step.name])))
    figures = [figure for figure in small.figures if figure.id == "fig10"]
    small = replace(small, steps=tuple(steps), figures=tuple(figures))
    plan.paper_plan = lambda grid: small


def words_of(text: str, case: Path, out: Path) -> list[str]:
    """Return the words of a scenario's call ``text``, with paths for {case} and {out}."""
    return [word.format(case=case, out=out) for word in text.split()]


def prepare(scenario: Scenario, work: Path) -> Path:
    """Write the scenario's case into ``work``; return its path."""
    case = work / f"{scenario.name}.toml"
    case.write_text(scenario.case)
    return case


def unreadable(folder: Path) -> list[str]:
    """Return the files of results in ``folder`` that cannot be read, each with its error."""
    broken = []
    for path in sorted(folder.rglob("*")):
        # Hidden files are parts of results that are not finished.
        if any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue
        try:
            if path.suffix == ".h5":
                h5py.File(path).close()
            elif path.suffix == ".json":
                json.loads(path.read_text())
        except (OSError, ValueError) as error:
            broken.append(f"{path.relative_to(folder)}: {error}")
    return broken


def difference(wanted: Path, found: Path) -> str:
    """Return the difference between two outcomes of the same case, in words; "" if they agree.

    The function compares the names of files, every bit of datasets, tables and claims, the attributes of HDF5 files
    except those in ``OF_ONE_CALL``, and the numbers of summaries except durations. The state at the end of a run has a
    file for each rank: it is compared where both outcomes have it.
    """
    names_wanted = {str(path.relative_to(wanted)) for path in wanted.rglob("*")}
    names_found = {str(path.relative_to(found)) for path in found.rglob("*")}
    if not any(name.startswith("end-state/state-") for name in names_wanted & names_found):
        names_wanted = {name for name in names_wanted if not name.startswith("end-state/state-")}
        names_found = {name for name in names_found if not name.startswith("end-state/state-")}
    if names_wanted != names_found:
        return f"files {sorted(names_wanted ^ names_found)[:5]}"

    for name in sorted(names_wanted):
        before = _content(wanted / name)
        after = _content(found / name)
        if before != after:
            keys = sorted(before.keys() | after.keys())
            return f"{name}: {[key for key in keys if before.get(key) != after.get(key)][:5]}"
    return ""


def _content(path: Path) -> dict:
    """Return the content of a file that must be the same; pictures have none."""
    found: dict = {}
    if path.suffix == ".h5":
        values_of = _bits
        if path.name == "modes.h5":
            values_of = _digits
        with h5py.File(path) as file:
            found = _attributes("", file)
            file.visititems(lambda name, item: found.update(_attributes(name, item) | values_of(name, item)))
    elif path.suffix == ".csv" or path.name == "claims.json":
        found["text"] = path.read_bytes()
    elif path.suffix == ".jsonl":
        rows = map(json.loads, path.read_text().splitlines())
        for row in rows:
            if "key" in row:
                # Records are compared as text, in which NaN equals NaN.
                statistics = _timeless(row.get("statistics") or {})
                found[str(row["key"])] = repr(row | {"cpu_seconds": None, "crc32": None, "statistics": statistics})
            else:
                found[row.get("id") or row["linear"]] = (row.get("status"), row.get("measures"))
    elif path.name == "summary.json":
        found = _timeless(json.loads(path.read_text())["statistics"])
    return found


def _timeless(statistics: dict) -> dict:
    """Return the ``statistics`` of a run without its durations."""
    return {key: value for key, value in statistics.items() if not key.endswith("_seconds")}


def _attributes(name: str, item: h5py.Dataset | h5py.Group) -> dict:
    """Return the attributes of the group or dataset ``name`` that must be the same, and the dimensions of a dataset.

    The file itself has the name "".
    """
    found: dict = {}
    for key, value in item.attrs.items():
        if key in OF_ONE_CALL or key in ADDRESSES:
            continue
        if key == "statistics":
            found[f"{name}@{key}"] = _timeless(json.loads(value))
        elif key == "case":
            # A member that follows another one names the file of that one: its folder is that of this outcome, and its
            # hash differs by the durations in it.
            case = re.sub(r'path = ".*/(\w+/run\.h5)"', r"\1", str(value))
            found[f"{name}@{key}"] = re.sub(r'(/run\.h5\ntime = \S+)\nsha256 = "\w+"', r"\1", case)
        else:
            found[f"{name}@{key}"] = _content_of(np.asarray(value))
    if isinstance(item, h5py.Dataset):
        found[f"{name}@dimensions"] = [[scale.name for scale in axis.values()] for axis in item.dims]
    return found


def _bits(name: str, item: h5py.Dataset | h5py.Group) -> dict:
    """Return the content of the dataset ``name``, or that it is a group."""
    if isinstance(item, h5py.Dataset):
        return {name: _content_of(item[...])}
    return {name: "group"}


def _content_of(values: np.ndarray) -> tuple:
    """Return the type, the shape and the bytes of an array."""
    # The bytes of an array of texts are addresses.
    content = values.tolist() if values.dtype == object else values.tobytes()
    return str(values.dtype), values.shape, content


def _digits(name: str, item: h5py.Dataset | h5py.Group) -> dict:
    """Return linear modes to six digits: their solver on three ranks adds in the order in which messages arrive."""
    # Residuals are rounding errors.
    if not isinstance(item, h5py.Dataset) or name == "residual":
        return {}
    values = item[...]
    if values.dtype.kind != "f":
        return {name: values.tolist()}
    largest = np.abs(values).max() or 1.0
    # The sum makes -0 a 0, whose bytes differ.
    return {name: (np.round(values / largest, 6) + 0.0).tobytes()}


def copy(source: Path, target: Path) -> None:
    """Make ``target`` a copy of the folder ``source``, or remove it if there is no ``source``."""
    shutil.rmtree(target, ignore_errors=True)
    if source.exists():
        shutil.copytree(source, target)
