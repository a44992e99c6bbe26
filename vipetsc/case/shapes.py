"""Keys whose values may have several shapes: a number, a text, a list, a table.

A value is read as the type of its own shape, so that a mistake within it is one problem and not one for every type that
the key may have.
"""

from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import core_schema

# A mark at the beginning of the names of shapes, which stand in the paths of pydantic's errors: no key begins with it.
MARK = "~"
NAMES = {
    "flag": "true or false",
    "whole": "a whole number",
    "number": "a number",
    "text": "text",
    "list": "a list",
    "table": "a table",
}


class ByShape:
    """Mark of a union, as in ``Annotated[float | list[float], BY_SHAPE]``: a value is of the type of its shape.

    Of several tables it is the one that has most of the value's keys.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        """Return the schema that pydantic reads the union by."""
        types: dict[str, Any] = {}
        tables: dict[str, type[BaseModel]] = {}
        texts: list[Any] = []
        names = []
        for kind in get_args(source):
            bare = get_args(kind)[0] if get_origin(kind) is Annotated else kind
            shape, name = _shape_of_type(bare)
            if isinstance(bare, type) and issubclass(bare, BaseModel):
                shape = bare.__name__
                tables[shape] = bare
            if get_origin(bare) is Literal:
                texts += get_args(bare)
            types[MARK + shape] = handler.generate_schema(kind)
            names.append(name)

        def shape_of(value: Any) -> str:
            # A section that has been read is asked for when it is written.
            if isinstance(value, BaseModel):
                return MARK + type(value).__name__
            shape = _shape_of_value(value)
            # Another text is of no type, rather than a wrong word: the message then names all types.
            if texts and shape == "text" and value not in texts:
                return f"{MARK}another"
            if shape == "table" and tables:
                shape = max(tables, key=lambda table: len(value.keys() & tables[table].model_fields.keys()))
            return MARK + shape

        expected = list(dict.fromkeys(names))
        listed = " or ".join(filter(None, [", ".join(expected[:-1]), expected[-1]]))
        return core_schema.tagged_union_schema(
            types,
            shape_of,
            custom_error_type="shape",
            custom_error_message=f"Input should be {listed}",
            custom_error_context={"expected": ", ".join(map(repr, texts))},
        )

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Return the JSON schema: that of any union."""
        return handler(core_schema.union_schema(list(schema["choices"].values())))


BY_SHAPE = ByShape()


def _shape_of_type(kind: Any) -> tuple[str, str]:
    """Return the shape of the values of a type, and what a message calls them."""
    origin = get_origin(kind) or kind
    if origin is Literal:
        return "text", " or ".join(map(repr, get_args(kind)))
    if origin in (int, float):
        return "number", NAMES["whole" if origin is int else "number"]
    if origin is str:
        return "text", NAMES["text"]
    if origin is bool:
        return "flag", NAMES["flag"]
    if origin is list:
        return "list", NAMES["list"]
    return "table", NAMES["table"]


def _shape_of_value(value: Any) -> str:
    """Return the shape of a ``value``."""
    # A boolean is an ``int`` for Python.
    if isinstance(value, bool):
        return "flag"
    if isinstance(value, int | float):
        return "number"
    if isinstance(value, str):
        return "text"
    if isinstance(value, list):
        return "list"
    if isinstance(value, dict):
        return "table"
    return "another"
