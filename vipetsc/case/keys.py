"""Every key of a case file: as a JSON schema for editors, and as a chapter of the manual.

All of it comes from the fields of the sections (``section.described``).
"""

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic.json_schema import models_json_schema

from vipetsc.case.case import Case
from vipetsc.case.reading import Table
from vipetsc.case.schema import MULTIPLE_OF_PI
from vipetsc.case.section import unit_at
from vipetsc.case.units import NUMBER_WITH_UNIT
from vipetsc.case.verb_cases import SECTIONS
from vipetsc.case.waveforms import DEFAULT, waveform_record
from vipetsc.lattice.contact import registered_law
from vipetsc.plugins import only
from vipetsc.register import LAW, PARTS, WAVEFORM, Parameter
from vipetsc.wording import with_unit

TITLE = "Every key of a case file"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
Schema = dict[str, Any]
TEXT_WITH_UNIT: Schema = {"type": "string", "pattern": NUMBER_WITH_UNIT.pattern}


def unit_of(path: str, case: Table) -> str:
    """Return the unit of the key with that ``path``, as in "contacts.clearance", in the table of a ``case``.

    An amplitude of a drive has the unit of its waveform, or m for a wall. The unit is empty for keys without one, and
    where it depends on other keys.
    """
    parameter = _parameter_of(path, case)
    if parameter:
        return parameter.unit
    return unit_at(SECTIONS, path, case)


def _parameter_of(path: str, case: Table) -> Parameter | None:
    """Return the parameter of a registered law or waveform whose key has that ``path``; None for other keys."""
    section, _, key = path.partition(".parameters.")
    if section == "contacts":
        # The law itself may vary: the unit is that of any law that takes the key.
        for name in PARTS[LAW]:
            law = registered_law(name)
            if law and key in law.parameters:
                return law.parameters[key]
    elif section == "drive":
        name = case.get("drive", {}).get("waveform") or DEFAULT
        if name in PARTS[WAVEFORM]:
            return waveform_record(name).parameters.get(key)
    return None


def json_schema(modules: Sequence[str] = ()) -> Schema:
    """Return the JSON schema (2020-12) of a case file; units and texts are the ``description`` of each key.

    The names of parts are the shipped ones and those of imported ``modules``.
    """
    schema = _schema_with_units(modules)
    for table in schema["$defs"].values():
        for item in table.get("properties", {}).values():
            unit = item.pop("unit", "")
            if unit:
                texts = _or_text(item)
                item.clear()
                item |= texts | {"description": with_unit(texts["description"], unit)}
    return schema


def _or_text(schema: Any) -> Any:
    """Return the ``schema`` of a key with a unit in which each number may also be a text with a unit."""
    if isinstance(schema, list):
        return [_or_text(choice) for choice in schema]
    if not isinstance(schema, dict):
        return schema
    inside = {key: _or_text(value) for key, value in schema.items() if key in ("anyOf", "items")}
    if schema.get("type") != "number":
        return schema | inside
    bounds = {key: schema[key] for key in schema if key not in ("title", "description", "default", "unit")}
    about = {key: schema[key] for key in schema.keys() - bounds.keys()}
    return about | {"anyOf": [bounds, TEXT_WITH_UNIT]}


def _schema_with_units(modules: Sequence[str] = ()) -> Schema:
    """Return the schema of ``json_schema`` in which the ``unit`` of a key stands beside its ``description``."""
    of_class = {table.__name__: table for table in SECTIONS.values()}
    # One call for all sections: a class that several sections contain is defined once.
    with only(modules):
        _, whole = models_json_schema([(table, "validation") for table in of_class.values()])
    classes: Schema = whole["$defs"]
    for schema in classes.values():
        for key, item in schema.get("properties", {}).items():
            # pydantic's titles only repeat the keys.
            item.pop("title", None)
            if key == "wavenumber":
                item["anyOf"] += [{"type": "string", "pattern": f"^{MULTIPLE_OF_PI}$"}]
        # A schema shows the first paragraph of the docstring.
        schema["description"] = schema.get("description", "").partition("\n\n")[0].replace("\n", " ").replace("``", "`")
    classes["PetscTable"]["additionalProperties"] = {"type": ["string", "number", "boolean"]}
    # Keys that vary in a sweep have lists or ranges of values, of which the schema checks none.
    varied = Case.model_fields.keys() - {"name", "plugins", "analysis"} | {"disorder"}
    classes["SweepTable"]["properties"] |= {key: {"type": "object"} for key in sorted(varied)}
    sections = {key: {"$ref": f"#/$defs/{table.__name__}"} for key, table in SECTIONS.items()}
    named = {"type": "string", "description": Case.model_fields["name"].description}
    about = {"$schema": DIALECT, "title": "case file of vipetsc", "type": "object", "additionalProperties": False}
    return about | {"properties": {"name": named} | sections, "$defs": classes}


def key_paths() -> list[str]:
    """Return the paths of all keys, such as "lattice.cells"; keys of tables in lists, which have numbers, left out."""
    schema = _schema_with_units()
    paths = []
    # A class may contain itself: `above` are those around a key.
    waiting = [("", schema, frozenset[str]())]
    while waiting:
        path, table, above = waiting.pop(0)
        for key, item in table.get("properties", {}).items():
            inner = {*_references(item, in_lists=False)} - above
            if not inner:
                paths.append(f"{path}{key}")
            waiting += [(f"{path}{key}.", schema["$defs"][name], above | {name}) for name in sorted(inner)]
    return list(dict.fromkeys(paths))


def chapter() -> str:
    """Return the manual's chapter with a table of the keys of every section, those of tables within it below it."""
    schema = _schema_with_units()
    lines = [
        f"# {TITLE}",
        "",
        "The program checks case files by this list, and `vipetsc schema` passes it to editors. Keys without a",
        "default are optional, except those marked as required. Masses, cells, sites and bands are numbered from 1.",
        "",
    ]

    shown: set[str] = set()  # a table that several keys may be is shown once
    for name, reference in schema["properties"].items():
        if "$ref" in reference:
            lines += _section(name, reference["$ref"].rpartition("/")[2], schema["$defs"], shown)
    return "\n".join(lines)


def _section(path: str, name: str, classes: Schema, shown: set[str]) -> Iterator[str]:
    """Yield the table of one section, and those of the tables in it that were not shown yet."""
    # Several sections may contain the same table, and a table may contain itself.
    if name in shown:
        return
    shown.add(name)
    schema = classes[name]
    inner: list[tuple[str, str]] = []
    yield from (f"## [{path}]", "", schema["description"], "")
    rows = [(key, item) for key, item in schema.get("properties", {}).items() if "description" in item]
    if rows:
        yield from ("| key | value | unit | default | |", "|---|---|---|---|---|")
    for key, item in rows:
        default = item.get("default")
        # No default is shown for an optional key, nor for a list that is empty by default: their texts say what holds
        # without them. A table that is a default is shown by its own keys.
        shown_default = ""
        if key in schema.get("required", ()):
            shown_default = "required"
        elif default not in (None, []) and "{" not in str(default):
            shown_default = f"`{_toml(default)}`"
        yield f"| `{key}` | {_kind(item)} | {item['unit']} | {shown_default} | {item['description']} |"
        inner += [(f"{path}.{key}", reference) for reference in _references(item)]
    yield ""
    for where, reference in inner:
        yield from _section(where, reference, classes, shown)


def _references(item: Any, in_lists: bool = True) -> Iterator[str]:
    """Yield names of the classes that the schema of a key refers to, those of items of lists among them if wanted."""
    if isinstance(item, dict):
        if "$ref" in item:
            yield item["$ref"].rpartition("/")[2]
        for key, value in item.items():
            if in_lists or key != "items":
                yield from _references(value, in_lists)
    elif isinstance(item, list):
        for value in item:
            yield from _references(value, in_lists)


def _toml(value: Any) -> str:
    """Return a default in TOML, as a case file would give it."""
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return f"{value:g}"


def _kind(item: Schema) -> str:
    """Return the type of a key's value in words, with its bounds."""
    # Optional keys are a choice of their type and null, which TOML does not have.
    if "anyOf" in item:
        return " or ".join(_kind(choice) for choice in item["anyOf"] if choice.get("type") != "null")
    if "$ref" in item:
        return "table"
    if "enum" in item or "const" in item:
        return ", ".join(f"`{_toml(value)}`" for value in item.get("enum", [item.get("const")]))
    if item.get("type") == "array":
        return f"list of {_count(item)}{_kind(item['items'])}"
    if item.get("type") == "object":
        values = item["additionalProperties"]
        if values is True:
            return "table"
        return f"table of {_kind(values)}"
    if "pattern" in item:
        return "text as described"

    signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    bounds = ", ".join(f"{sign} {item[key]:.6g}" for key, sign in signs.items() if key in item)
    names = {"number": "number", "integer": "whole number", "boolean": "true, false", "string": "text"}
    return f"{names[item['type']]} {bounds}".rstrip()


def _count(item: Schema) -> str:
    """Return the number of items of a list, in words that stand before their type."""
    low = item.get("minItems", 0)
    if low == item.get("maxItems"):
        return f"{low} "
    if low:
        return f"{low} or more "
    return ""
