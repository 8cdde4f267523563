"""The place in a scenario of a fault that its simulation tells by the dotted name of a value. Pure."""

from __future__ import annotations

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.overrides import parse_override


def fault_found_at(document: Document, text: str, *, section: str = "parameters") -> Fault:
    """Return a fault at the place of `dotted.name: what is wrong`; the name may leave out the section."""
    name, colon, message = text.partition(":")
    path = path_named(name, section=section) if colon else ()
    if not path:
        return document.fault((section,), text, at_key=True)
    return document.fault(path, message.strip())


def path_named(name: str, *, section: str = "parameters") -> ValuePath:
    """Return the path of a dotted name, which may leave out the section; an empty one if it is no such name."""
    if " " in name:
        return ()
    try:
        steps = parse_override(f"{name}=")[1]
    except InputError:
        return ()
    return steps if steps[:1] == (section,) else (section, *steps)
