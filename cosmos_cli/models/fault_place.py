"""The place in a scenario of a fault that its simulation tells by the dotted name of a value. Pure."""

from __future__ import annotations

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.overrides import parse_override


def fault_found_at(document: Document, text: str, *, section: str = "parameters") -> Fault:
    """Return a fault at the place of `dotted.name: what is wrong`; the name may leave out the section."""
    name, colon, message = text.partition(":")
    path: ValuePath = (section,)
    if not colon or " " in name:
        return document.fault(path, text, at_key=True)
    try:
        steps = parse_override(f"{name}=")[1]
    except InputError:
        return document.fault(path, text, at_key=True)
    path = steps if steps[:1] == path else path + steps
    return document.fault(path, message.strip())
