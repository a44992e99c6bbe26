"""The program's own reference: chapters at the prompt, the schema of case files and their validator, completion."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tomllib
from functools import cache
from pathlib import Path

import jsonschema
import pytest

import vipetsc as package
from vipetsc.case import keys
from vipetsc.case.drive import DriveTable
from vipetsc.case.reading import read_section, sections_in
from vipetsc.case.section import CaseError
from vipetsc.case.verb_cases import SECTIONS, load_every
from vipetsc.cli.verbs.reference_verbs import KEYS, schema_of
from vipetsc.cli.verbs.verb_list import VERBS

ROOT = Path(package.__file__).parents[1]
CASES = sorted([*(ROOT / "vipetsc/examples").rglob("*.toml"), *(ROOT / "vipetsc/paper/cases").glob("*.toml")])


def classes() -> dict[str, set[str]]:
    """Return the keys that the validator accepts in the class of every section and of every table within it."""
    keys_of = {}
    waiting = list(SECTIONS.values())
    while waiting:
        table = waiting.pop()
        if table.__name__ in keys_of:
            continue

        keys_of[table.__name__] = {field.alias or name for name, field in table.model_fields.items()}
        for field in table.model_fields.values():
            waiting += sections_in(field.annotation)
    return keys_of


def test_schema_and_texts_have_the_keys_of_the_validator():
    """Every class of the schema has the keys that the validator accepts, and every key has a text."""
    schema = keys.json_schema()
    assert set(schema["properties"]) == {"name", *SECTIONS}

    validator = classes()
    # The schema of a sweep also has the sections whose keys may vary.
    varied = set(schema["$defs"]["SweepTable"]["properties"]) & set(SECTIONS)
    expected = validator | {"SweepTable": validator["SweepTable"] | varied}
    # The sets are equal: no key lacks a schema, and no schema describes a key that was removed.
    assert {name: set(item.get("properties", {})) for name, item in schema["$defs"].items()} == expected

    properties = [item.get("properties", {}) for item in schema["$defs"].values()]
    undescribed = [key for table in properties for key, item in table.items() if not item.get("description")]
    # Sections whose keys vary are described where they do not.
    assert set(undescribed) <= set(SECTIONS)


def test_the_chapter_on_keys_has_those_of_the_validator():
    """The manual's table of each section has the keys that the validator accepts there, each once."""
    validator = classes()
    chapter = keys.chapter()
    shown = {}
    for path, text in re.findall(r"^## \[(\S+)\]\n(.*?)(?=^## |\Z)", chapter, flags=re.M | re.S):
        shown.setdefault(path, set()).update(re.findall(r"^\| `(\w+)` \|", text, flags=re.M))
    for section, table in SECTIONS.items():
        assert shown[section] == validator[table.__name__], section
    # The numbers must agree too: a key that is listed twice would not show in the sets.
    assert sum(map(len, shown.values())) == sum(map(len, validator.values()))
    # An empty list is not shown as a default: ``nfrc.fixed`` without values takes the drive's frequency.
    assert "| `[]` |" not in chapter
    assert re.search(r"^\| `fixed` \| list of number > 0 \|  \|  \| .*default: that of the drive", chapter, flags=re.M)


def test_a_refused_key_names_those_of_the_schema():
    """The keys that a refusal proposes are those of the schema."""
    _, problems = read_section(DriveTable, {"xyzzy": 1}, "drive")
    named = set(problems[0].remedy.removeprefix("unknown key; valid keys: ").split(", "))
    assert named == set(keys.json_schema()["$defs"]["DriveTable"]["properties"])


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_every_case_file_is_valid_by_its_schema_and_by_the_program(path):
    """Every case file of the examples, of the gallery and of the paper, as an editor would check it, and as read."""
    validator_of(json.dumps(schema_of(str(path)))).validate(tomllib.loads(path.read_text(encoding="utf-8")))
    # This run begins with an orbit of a branch that another command computes.
    if path.stem != "breather-run":
        assert load_every(path)


@cache
def validator_of(schema: str) -> jsonschema.protocols.Validator:
    """Return the validator of a schema, and assert that the schema is valid; most case files have the same one."""
    table = json.loads(schema)
    kind = jsonschema.validators.validator_for(table)
    # A schema with a mistake of its own might accept everything.
    kind.check_schema(table)
    return kind(table)


@pytest.mark.parametrize(
    "text",
    [
        "lattice.cels = 3",
        "lattice.cells = 0",
        "lattice.ends = 'loose'",
        "drive.wavenumber = '5p/9'",
        # A wavenumber is at most pi.
        "drive.wavenumber = 4.0",
        "contacts.sites = [1.5]",
        "contacts.restitution = 1.5",
        "nnm.guards.turn = -1.0",
        "nnm.own.masses = 'heavy'",
        "drvie.amplitude = 1.0",
        "sweep.ranks = 0",
    ],
)
def test_what_the_validator_refuses_of_one_key_the_schema_refuses(text):
    """A key or value that is wrong by itself is refused by the schema and by the validator."""
    with pytest.raises(jsonschema.ValidationError):
        validator_of(json.dumps(keys.json_schema())).validate(tomllib.loads(text))

    key, value = text.split(" = ")
    with pytest.raises(CaseError):
        load_every(None, [f"{key}={value}"])


def test_multiples_of_pi_are_wavenumbers_in_the_schema():
    """Multiples of pi may be written as text, in any of the forms that the validator reads."""
    validator = validator_of(json.dumps(keys.json_schema()))
    for value in ("5pi/9", "pi", ".5 pi", 1.0):
        validator.validate({"drive": {"wavenumber": value}})


def test_the_verb_schema_prints_it(in_process):
    """``vipetsc schema`` prints the schema as JSON."""
    assert json.loads(in_process("schema").stdout) == json.loads(json.dumps(keys.json_schema()))


def test_bash_completes_verbs_options_and_files(in_process, tmp_path):
    """In bash the completion proposes verbs, files for a case, and the shells that have a completion."""
    script = in_process("completion", "bash").stdout
    (tmp_path / "case.toml").touch()

    def completed(*words: str) -> set[str]:
        line = f"COMP_WORDS=({' '.join(words)} '') COMP_CWORD={len(words)}; COMP_WORDS[-1]="
        # Bash sets these variables when the tabulator is pressed.
        asked = f"{script}\n{line}\n_shtab_vipetsc; printf '%s\\n' \"${{COMPREPLY[@]}}\""
        ended = subprocess.run(["bash", "-c", asked], cwd=tmp_path, capture_output=True, text=True, check=False)
        return set(ended.stdout.split())

    assert completed("vipetsc") >= set(VERBS)
    assert "case.toml" in completed("vipetsc", "run")
    assert completed("vipetsc", "completion") == {"bash", "zsh"}
    assert {"drives", "gallery/chain"} <= completed("vipetsc", "manual")
    assert {"three-mass", "gallery/strip"} <= completed("vipetsc", "examples")
    assert {"spacetime", "poincare"} <= completed("vipetsc", "plot", "runs/x", "--fig")
    assert {"drive.amplitude", "lattice.damping.mass", "nfrc.points"} <= completed("vipetsc", "run", "--set")


def test_zsh_reads_its_completion(in_process):
    """The completion for zsh is marked as such, and zsh, where it is installed, finds no error in it."""
    script = in_process("completion", "zsh").stdout

    assert script.startswith("#compdef vipetsc")
    if shutil.which("zsh"):
        subprocess.run(["zsh", "-n"], input=script, text=True, check=True)


def test_the_manual_at_the_prompt(in_process):
    """Chapters are listed and printed in Markdown; an unknown chapter is refused."""
    listed = in_process("manual").stdout
    index = (ROOT / "vipetsc/manual/index.md").read_text(encoding="utf-8")
    names = {KEYS, *re.findall(r"\]\(([\w-]+)\.md\)", index)}
    assert set(re.findall(r"^  ([\w-]+) ", listed, flags=re.M)) == names

    for topic in ("trust", "gallery/designed"):
        page = (ROOT / f"vipetsc/manual/{topic}.md").read_text(encoding="utf-8")
        assert in_process("manual", topic).stdout == page + "\n"
    assert "`frequency`" in in_process("manual", "case-keys").stdout

    wrong = in_process("manual", "cooking")
    assert wrong.returncode == 2
    assert "vipetsc manual lists" in wrong.stderr
    assert re.findall(r"^(\w[\w ]+)$", listed, flags=re.M)[:4] == ["Tutorials", "How to", "Theory", "Reference"]
