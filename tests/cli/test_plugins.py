"""Laws, waveforms, measures and figures of users' modules: those of the manual's chapter *extend*, and refusals."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import tomllib
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from tests.manual_modules import CHAPTER, write_modules
from vipetsc import Case, CaseError, Sweep, open, plugins, sweep
from vipetsc.case import case_id
from vipetsc.case.keys import json_schema
from vipetsc.io.export import write_curves
from vipetsc.lattice import Contact
from vipetsc.lattice.drive import Pieces

EXAMPLE = CHAPTER.parents[1] / "examples/own-law.toml"
# The coefficient b in 1/m^2 of the force F = k x (1 + b x^2): at x = 1 mm it is 40 % above that of a linear stop.
RATE = 4e5
# The sweep is read from the chapter's own text.
SWEEP = re.compile(r"^```toml\n(\[sweep\].*?)^```$", flags=re.M | re.S)
CASE = f"""
[plugins]
modules = ["stops.py", "factors.py", "pulses.py", "durations.py", "pictures.py"]

[lattice]
preset = "four-band"
cells = 12

[contacts]
law = "hardening"
stiffness = 2e5
parameters = {{ b = {RATE} }}
damping = "herbert-mcwhannell"
restitution = 0.6
sites = [4, 6]
clearance = 1e-3

[drive]
waveform = "ricker"
amplitude = 500.0
frequency = 1000.0
parameters = {{ delay = 0.01 }}

[time]
end = 0.03
engine = "propagator"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with the modules of the chapter, and with a case that uses all of them."""
    folder = tmp_path_factory.mktemp("plugins")
    write_modules(folder)
    (folder / "case.toml").write_text(CASE)
    return folder


@pytest.fixture(scope="module")
def out(folder, tmp_path_factory) -> Path:
    """The results of a run of the case in ``folder``; the run is started in another folder."""
    from vipetsc.cli.main import main

    out = tmp_path_factory.mktemp("results") / "out"
    # The current folder is another one: paths of modules are relative to the case file.
    assert main(["run", str(folder / "case.toml"), "--out", str(out), "--quiet"], {}) == 0
    return out


def test_a_run_uses_and_records_the_parts(folder, out):
    """The results use every registered part, record its module and hash, and have the registered figure."""
    with open(out / "run.h5") as run:
        case = Case.of(run)
        law = case.model().chain.sites[0].law
        # Without contacts the law and the measure would not be used.
        assert len(run["impacts/onset"]) > 4
        longest = float((run["impacts/separation"] - run["impacts/onset"]).max())
    with open(out / "analysis.h5") as analysis:
        assert float(analysis["longest_contact"]) == longest
        assert analysis["longest_contact"].attrs["units"] == "s"
    assert law == Contact("hardening", 2e5, restitution=0.6, factor="herbert-mcwhannell", parameters=(RATE,))
    # Herbert and McWhannell's factor, 6 (1 - r)/[(2 r - 1)^2 + 3], at r = 0.6.
    assert law.damping == pytest.approx(6 * 0.4 / (0.2**2 + 3))

    sources = case.plugins.sources
    assert [*sources] == [str(folder / file) for file in ("stops.py", "factors.py", "pulses.py", "durations.py")]
    for file, source in sources.items():
        assert source.sha256 == hashlib.sha256(Path(file).read_bytes()).hexdigest()
    # An empty picture takes fewer bytes.
    assert (out / "figures/kinetic.png").stat().st_size > 5000

    summary = json.loads((out / "summary.json").read_text())
    assert summary["case"]["plugins"] == case.plugins.model_dump()
    assert summary["measures"]["longest_contact"] == longest


def test_a_registered_measure_is_exported(out):
    """The CSV of a run's measures has a row for a registered measure, with its unit and its description."""
    write_curves(out)
    with open(out / "analysis.h5") as analysis:
        longest = float(analysis["longest_contact"])
    with (out / "curves/analysis-measures.csv").open(newline="") as file:
        rows = {row["measure"]: row for row in csv.DictReader(file)}
    row = rows["longest_contact"]
    assert float(row.pop("value")) == longest
    assert {"s", "duration of the longest contact"} <= set(row.values())


def test_validate_lists_the_parts_that_a_case_uses(folder, in_process):
    """Each part that the case uses has a row with its kind, module and version; an unused part has no row."""
    # The case uses a damping factor of the package: the one of the module is registered but not used.
    shown = in_process("validate", folder / "case.toml", "--set", "contacts.damping=exact").stdout
    rows = re.findall(r"^  (\w+) +(\S+), registered by (\S+?)(?:, version (\S+))?$", shown, flags=re.M)
    assert {(kind, name): (module, version) for kind, name, module, version in rows} == {
        ("law", "hardening"): (str(folder / "stops.py"), ""),
        ("waveform", "ricker"): (str(folder / "pulses.py"), ""),
        ("measure", "longest_contact"): (str(folder / "durations.py"), ""),
        ("figure", "kinetic"): (str(folder / "pictures.py"), ""),
    }
    example = in_process("validate", EXAMPLE).stdout
    assert f" rubber-stop, registered by {EXAMPLE.with_name('own_law.py')}, version 1.0\n" in example


def test_the_waveform_is_the_formula(folder):
    """The registered waveform is Ricker's wavelet about its delay, with the amplitude of the case."""
    waveform = Case.load(folder / "case.toml").model().drive
    assert isinstance(waveform, Pieces)
    t = np.linspace(0.002, 0.018, 33)
    # Ricker's wavelet is (1 - 2 p) exp(-p) with p = (omega (t - delay)/2)^2; its spectrum is largest at omega.
    phase = (1000.0 * (t - 0.01) / 2) ** 2
    assert waveform.force(t) == pytest.approx(500.0 * (1 - 2 * phase) * np.exp(-phase), abs=1e-2)


def edited_copy(out: Path, target: Path, before: str, after: str) -> Path:
    """Copy a run to ``target``, with ``before`` replaced by ``after`` in the text of its case; returns ``target``."""
    text = (out / "case.toml").read_text()
    assert before in text
    target.mkdir()
    (target / "case.toml").write_text(text.replace(before, after))
    (target / "run.h5").write_bytes((out / "run.h5").read_bytes())
    return target


def test_results_of_another_source_are_not_continued(folder, out, tmp_path, in_process):
    """--resume refuses results whose law has another hash, with both hashes, and leaves the folder as it is."""
    digest = hashlib.sha256((folder / "stops.py").read_bytes()).hexdigest()
    # A hash of zeros stands for that of an earlier source.
    old = edited_copy(out, tmp_path / "old", digest, "0" * 64)
    ended = in_process("run", folder / "case.toml", "--out", old, "--resume")
    assert ended.returncode == 2
    assert f"stops.py.sha256 = {'0' * 16}... there, {digest[:16]}... here" in ended.stderr
    # The case is refused before anything is written; the lock, whose name begins with a dot, may stay.
    assert {path.name for path in old.iterdir() if path.name[0] != "."} == {"case.toml", "run.h5"}


def test_a_changed_source_is_warned_of_where_results_are_read(folder, out, caplog):
    """Reading results that record another hash of a module warns once, and names the module."""
    digest = hashlib.sha256((folder / "factors.py").read_bytes()).hexdigest()
    text = (out / "case.toml").read_text().replace(digest, "0" * 64)
    # Reading twice gives one warning: a sweep reads the case of every member.
    for _ in range(2):
        assert Case.from_toml(text).plugins.sources[str(folder / "factors.py")].sha256 == digest
    warned = [line for line in caplog.messages if "has changed" in line]
    assert warned == [f"vipetsc: {folder / 'factors.py'} has changed since the case was resolved that used it"]


def test_modules_of_one_name_in_two_folders_keep_their_own_records(tmp_path, caplog):
    """Neither is taken for the other one, changed, where results are read; without its file each keeps its hash."""
    text = "from vipetsc import register\n"
    text += "register.measure('of_{0}', unit='1', text='one', power=0.0)(lambda record: 1.0)\n"
    modules = []
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "same.py").write_text(text.format(name))
        modules.append(str(tmp_path / name / "same.py"))
    case = Case.from_table({"plugins": {"modules": modules}})
    assert Case.from_toml(case.to_toml()).plugins == case.plugins
    assert not [line for line in caplog.messages if "has changed" in line]

    moved = case.to_toml().replace(str(tmp_path), str(tmp_path / "moved"))
    sources = Case.from_toml(moved).plugins.sources
    assert [source.sha256 for source in sources.values()] == [s.sha256 for s in case.plugins.sources.values()]


def test_a_source_that_changes_within_a_process_is_refused(folder, tmp_path):
    """A module that changes after its import is refused: results would be recorded with the hash of the new source."""
    # The law gets another name, because names are registered for the whole process.
    (tmp_path / "stop.py").write_text((folder / "stops.py").read_text().replace('"hardening"', '"changing"'))
    table = {"plugins": {"modules": [str(tmp_path / "stop.py")]}}
    Case.from_table(table)
    with (tmp_path / "stop.py").open("a") as file:
        file.write("# changed\n")
    with pytest.raises(CaseError, match="has changed since this process imported it"):
        Case.from_table(table)


@pytest.mark.parametrize(("file", "needed"), [("stops.py", True), ("durations.py", False)])
def test_results_need_the_modules_of_their_physics(out, file, needed, caplog):
    """Results are not read without the module of their law or waveform; one of a measure or figure may be missing."""
    # The path is changed in the text of the case, because other tests need the file.
    text = (out / "case.toml").read_text().replace(f"/{file}", f"/gone-{file}")
    if needed:
        with pytest.raises(CaseError, match=rf"gone-{file}, which registers parts of this case"):
            Case.from_toml(text)
    else:
        assert Case.from_toml(text).contacts.law == "hardening"
        assert "its parts are left out" in caplog.text
        with open(out / "run.h5") as run:
            assert Case.of(run.assign_attrs(case=text)).contacts.law == "hardening"


def test_a_module_that_was_moved_is_found(tmp_path, monkeypatch):
    """A module whose file is gone is one beside the case file, in the current folder, or imported, in this order."""
    beside, here, imported = places = [tmp_path / name for name in ("beside", "here", "imported")]
    for place in places:
        place.mkdir()
        (place / "moved.py").write_text(
            "from vipetsc import register\n"
            "register.measure('of_moved', unit='1', text='one', power=0.0)(lambda record: 1.0)\n"
        )
    monkeypatch.chdir(here)
    plugins.load(str(imported / "moved.py"))
    for place in places:
        assert plugins.located("/elsewhere/moved.py", beside) == str(place / "moved.py")
        (place / "moved.py").unlink()
    assert plugins.located("/elsewhere/never.py", beside) == "/elsewhere/never.py"


def test_moved_results_are_continued(folder, out, tmp_path, in_process):
    """A run that was moved with its case and modules is that of its case; names of members and runs do not change."""
    old = edited_copy(out, tmp_path / "old", str(folder), "/elsewhere")
    ended = in_process("run", folder / "case.toml", "--out", old, "--resume")
    assert ended.returncode == 0, ended.stderr

    case = Case.load(folder / "case.toml")
    table = json.loads(json.dumps(case.model_dump(by_alias=True, exclude_none=True)).replace(str(folder), "/elsewhere"))
    moved = case.model_copy(update={"plugins": type(case.plugins)(**table["plugins"])})
    assert case_id(moved) == case_id(case)

    plan = Sweep.from_table({**table, "plugins": case.plugins.model_dump(), "sweep": {"drive": {"amplitude": [1.0]}}})
    assert plan.model_copy(update={"table": plan.table | {"plugins": table["plugins"]}}).ids() == plan.ids()


def test_results_whose_law_is_gone_name_its_module(out, tmp_path, in_process, caplog):
    """Verbs that read results name the module, and not the file of results; a measure's module is named once."""
    gone = edited_copy(out, tmp_path / "gone", "/stops.py", "/gone.py")
    for verb in ("plot", "analyse"):
        ended = in_process(verb, gone)
        assert ended.returncode == 2
        assert "plugins.modules[1]" in ended.stderr and "/gone.py" in ended.stderr
        assert "is not a run" not in ended.stderr

    text = (out / "case.toml").read_text()
    for folder in ("there", "elsewhere"):
        Case.from_toml(re.sub(r"[^\"]*/durations.py", f"/{folder}/unheard.py", text))
    assert len([line for line in caplog.messages if "unheard.py" in line]) == 1


@pytest.mark.parametrize("key", ["plugins.sources={}", "plugins.sources.other=1"])
def test_what_is_filled_in_cannot_be_set(folder, key):
    with pytest.raises(CaseError, match=r"--set plugins\.sources.*filled in"):
        Case.load(folder / "case.toml", [key])


def test_names_are_those_of_the_modules_that_a_case_names(folder):
    """A case does not know a part whose module it does not name, although another case has imported that module."""
    # This case imports all modules: their names are then registered in the process.
    Case.load(folder / "case.toml")
    others = [str(folder / name) for name in ("factors.py", "pulses.py")]
    with pytest.raises(
        CaseError, match="'hardening': must be 'hertz', 'bilinear', 'power' or 'rigid'; other names come from modules"
    ):
        Case.load(folder / "case.toml", [f"plugins.modules={others}"])
    with pytest.raises(CaseError, match="did you mean 'hardening'"):
        Case.load(folder / "case.toml", ["contacts.law=hardenin"])


def test_the_schema_of_a_case_has_the_names_of_its_modules(folder, in_process):
    """``schema CASE`` allows the registered names, the schema of all cases does not."""
    table = tomllib.loads(CASE)
    jsonschema.validate(table, json.loads(in_process("schema", folder / "case.toml").stdout))
    # The schema of all cases has only the laws of the package.
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(table, json_schema())


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        (None, "there is no file"),
        ("x = 1 / 0\n", r"cannot be imported: ZeroDivisionError: division by zero \(\S+part.py, line 1\)"),
        ("x = 1\n", "registers nothing"),
        ("from vipetsc import register\nregister.figure('printed')(print)\n", "is no function written in Python"),
        (
            "from vipetsc import register\n\n@register.dissipation_factor('exact')\ndef c(r):\n    return 0\n",
            "there is a dissipation 'exact' of vipetsc already",
        ),
        (
            "from vipetsc import register\n\n@register.dissipation_factor('half')\ndef c():\n    return 0\n",
            r"c of the dissipation factor 'half' must take \(restitution\)",
        ),
    ],
)
def test_a_module_that_cannot_be_used_is_refused(source, sentence, tmp_path, in_process):
    """A missing or failing module is one problem, with exit code 2, and nothing is written."""
    if source is not None:
        (tmp_path / "part.py").write_text(source)
    (tmp_path / "case.toml").write_text('[plugins]\nmodules = ["part.py"]\n')
    # The program gives the exit code; the call in Python below gives the sentence.
    ended = in_process("run", tmp_path / "case.toml", "--out", tmp_path / "out")
    assert ended.returncode == 2
    assert "1 problem\n  plugins.modules[1] = " in ended.stderr
    with pytest.raises(CaseError, match=sentence):
        Case.load(tmp_path / "case.toml")
    assert not (tmp_path / "out").exists()


def test_a_module_that_fails_halfway_leaves_no_parts(tmp_path):
    """A part that a module registered before it failed is not available."""
    text = "from vipetsc import register\n\n@register.dissipation_factor('halfway')\ndef c(r):\n    return 0\n\n1 / 0\n"
    (tmp_path / "part.py").write_text(text)
    with pytest.raises(CaseError, match="line 7"):
        Case.from_table({"plugins": {"modules": [str(tmp_path / "part.py")]}})
    assert "halfway" not in plugins.registered("dissipation")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("plugins={}", "plugins.modules: missing"),
        ("contacts.parameters.b=", r'contacts.parameters.b: missing; needed for the law "hardening" \(1/m\^2\)'),
        ("contacts.parameters.b=-1.0", r"parameters.b = -1.0: must be from 0 to 1e\+50 \(1/m\^2\)"),
        ("contacts.law=bilinear", 'contacts.parameters.b = 400000.0: the law "bilinear" takes no parameters'),
        ("nfrc.range=[0.5,2.0]", "a steady state needs a sine"),
    ],
)
def test_keys_of_parts_are_checked(folder, change, sentence):
    """Parameters are checked by the names and bounds of the part; verbs of steady states refuse its waveform."""
    from vipetsc.case.verb_cases import load_every

    with pytest.raises(CaseError, match=sentence):
        load_every(folder / "case.toml", [change])


def test_a_sweep_varies_laws_and_their_parameters(folder):
    """A sweep varies laws together with their parameters, as in the chapter; for b = 0 the law is the linear one."""
    table = tomllib.loads(CASE)
    table["plugins"]["modules"] = [str(folder / name) for name in table["plugins"]["modules"]]
    varied = tomllib.loads(SWEEP.search(CHAPTER.read_text(encoding="utf-8"))[1])["sweep"]
    assert varied["contacts"]["parameters"] == [{}, {"b": 1e5}, {"b": RATE}]
    # The chapter's sweep gets one member more: the law with b = 0.
    varied["contacts"]["law"].append("hardening")
    varied["contacts"]["parameters"].append({"b": 0.0})
    varied["measures"] = ["transfer", "motion"]
    ensemble = sweep(Sweep(**table, sweep=varied)).dataset
    assert (ensemble["longest_contact"] > 0).all()
    linear, little, hardened, unhardened = ensemble["ibtet"].values
    assert unhardened == pytest.approx(linear, rel=1e-6)
    # The compiled kernel uses the parameter: changes grow with it, and are far above rounding.
    assert abs(hardened / linear - 1) > abs(little / linear - 1) > 1e-4
    assert "[plugins.sources." in ensemble.attrs["case"]


PLAIN = """
import os

from vipetsc import register

def force(x, k):
    return k * x

def slope(x, k):
    return k

def energy(x, k):
    return 0.5 * k * x * x

register.elastic_law("plain", force, slope, energy, onset_exponent=1.0)

@register.measure("abrupt", unit="1", text="a measure that ends the process")
def abrupt(run):
    os._exit(9)
"""


def test_a_part_that_ends_the_process_is_named_before(tmp_path, vipetsc):
    """Whatever a module does, the last line says which of its parts does it."""
    file = tmp_path / "part.py"
    file.write_text(PLAIN)
    case = tmp_path / "case.toml"
    case.write_text(
        '[plugins]\nmodules = ["part.py"]\n[lattice]\npreset = "four-band"\ncells = 12\n'
        '[contacts]\nlaw = "plain"\nstiffness = 2e5\nsites = [4]\nclearance = 1e-3\n'
        "[drive]\namplitude = 1.0\n[time]\nend = 1e-3\n[output]\nfigures = false\n"
    )
    ended = vipetsc(0, "run", case, "--out", tmp_path / "out")
    assert ended.returncode == 9
    lines = [line for line in ended.stderr.splitlines() if str(file) in line]
    reported = ["importing", "compiling the law 'plain' of", "calling the measure 'abrupt' of"]
    assert lines == [f"vipetsc: {what} {file}" for what in reported]
    assert ended.stderr.endswith(f"{lines[-1]}\n")
