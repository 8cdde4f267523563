"""
What stands under a field in its class, for the JSON Schema alone.

pydantic can take it along itself, but then every command that reads a scenario parses our sources first.
"""

from __future__ import annotations

import ast
import functools
import inspect
import textwrap
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue


@functools.lru_cache(maxsize=256)
def field_docstrings(cls: type) -> dict[str, str]:
    """Return the texts under a class's annotated fields, by the fields' names; its own come before its bases'."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if base is not object and base.__dict__.get("__annotations__"):
            found.update(_own(base))
    return found


def _own(cls: type) -> dict[str, str]:
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError, SyntaxError):  # made without a source
        return {}
    statements = body.body if isinstance(body, ast.ClassDef) else []
    found = {}
    for statement, following in zip(statements, statements[1:], strict=False):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            match following:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    found[statement.target.id] = inspect.cleandoc(text)
    return found


class DescribedSchema(GenerateJsonSchema):
    """Schemas whose properties say what their fields' docstrings say."""

    def model_schema(self, schema: Any) -> JsonSchemaValue:
        """Return the schema of a pydantic model."""
        return _described(super().model_schema(schema), schema["cls"])

    def dataclass_schema(self, schema: Any) -> JsonSchemaValue:
        """Return the schema of a dataclass."""
        return _described(super().dataclass_schema(schema), schema["cls"])


def _described(json_schema: JsonSchemaValue, cls: type) -> JsonSchemaValue:
    texts = field_docstrings(cls)
    for name, field in json_schema.get("properties", {}).items():
        if name in texts:
            field.setdefault("description", texts[name])
    return json_schema
