"""
`${name}` in a scenario, from its `vars:`.

A value that is only `${x}` takes the variable's type; in a longer text it is put in as it is written, and `$${` stands
for `${` itself. What a plug-in replaces itself, per agent, stays: in a simulation's parameters the words that its
descriptor names (`placeholders`), in those of devices `${name}`.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import re
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Any, Final

from cosmos_cli.errors import Fault
from cosmos_cli.models.document import Document, Path, SourcePlace, did_you_mean, kind_of, may_guess
from cosmos_cli.models.extending import OF_THE_FILE

SECTION: Final = "vars"
VARIABLES_MAX: Final = 1000
REFERENCES_MAX: Final = 16
"""Variables that are made of each other, one behind the other."""
TEXT_CHARACTERS_MAX: Final = 20_000
VARIABLE: Final = r"\$\{"
"""The pattern, in a JSON Schema, of a text in which a variable stands."""
AGENT_WORD: Final = "name"
"""In devices' settings it stands for the name of whoever drives the device."""
_PLACEHOLDER: Final = re.compile(r"\$(\$?)\{([^{}]*)\}?")
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_PLUGIN_SECTIONS: Final = ("parameters", "agent_parameters")
LITERAL: Final = "$${ stands for ${ itself"


def substitute_variables(document: Document) -> None:
    """
    Replace each ${name} of a document, but for its `vars:`; faults are in the document's `faults` then.

    Texts of a simulation's parameters keep what no variable is named: see `judge_open_texts`.
    """
    variables = _Variables(document)
    document.variables = tuple(variables.written)
    _Substitution(document, variables).all_of(document.value)


def author_override_faults(document: Document, overrides: Sequence[str]) -> list[Fault]:
    """Return the faults of --set that no file's value stands for: other files, or variables that there are not."""
    written = document.value.get(SECTION)
    known = tuple(written) if isinstance(written, dict) else ()
    faults = []
    for key in (override.partition("=")[0].strip() for override in overrides):
        section, _, name = key.partition(".")
        if section in OF_THE_FILE:
            text = "expected in the file alone: it says what is read with it"
            faults.append(Fault(text=text, override=key))
        elif section == SECTION and name not in known:
            hint = did_you_mean(name, known) or "; the scenario has no vars"
            faults.append(Fault(text=f"no variable is named {name}{hint}", override=key))
    return faults


def escaped(text: str) -> str:
    """Return a text that means *text* where variables are replaced."""
    return text.replace("${", "$${")


def escaped_values(value: Any, kept: AbstractSet[Path], path: Path = ()) -> Any:
    """Return plain values with every text escaped, but for those at *kept* that a plug-in reads as they are."""
    if isinstance(value, dict):
        return {key: escaped_values(item, kept, (*path, key)) for key, item in value.items()}
    if isinstance(value, list):
        return [escaped_values(item, kept, (*path, n)) for n, item in enumerate(value)]
    return escaped(value) if isinstance(value, str) and path not in kept else value


class _Variables:
    """Variables, and their values once they were wanted."""

    def __init__(self, document: Document) -> None:
        self._document = document
        written = document.value.get(SECTION)
        self.written: dict[str, Any] = dict(written) if isinstance(written, dict) else {}
        self._values: dict[str, tuple[Any, tuple[str, ...]]] = {}
        self._told: set[str] = set()
        self._under_way: list[str] = []
        if len(self.written) > VARIABLES_MAX:
            text = f"expected at most {VARIABLES_MAX} variables, got {len(self.written)}"
            document.faults.append(document.fault((SECTION,), text))
            self.written = {}
        for name, value in self.written.items():
            self._check(name, value)

    def _check(self, name: str, value: Any) -> None:
        if not _NAME.fullmatch(name):
            text = f"expected letters, digits and _ as a variable's name, got {name!r:.80}"
            self._fault(name, text, at_key=True)
        elif name == AGENT_WORD:
            text = (
                "${name} stands for the agent's name in settings of devices and of flight software"
            )
            self._fault(name, f"{text}: choose another name", at_key=True)
        elif isinstance(value, dict | list):
            text = f"expected a text, a number, true or false, got {kind_of(value)}"
            self._fault(name, f"{text}; `extends` or an &anchor of YAML shares what is larger")
        elif value is not None and isinstance(value, str):
            self.value_of(name)

    def _fault(self, name: str, text: str, *, at_key: bool = False) -> None:
        if name not in self._told:
            self._told.add(name)
            document = self._document
            document.faults.append(document.fault((SECTION, name), text, at_key=at_key))

    def value_of(self, name: str) -> tuple[Any, tuple[str, ...]] | None:
        """Return a variable's value, and the names of those that it is made of; None if it has a fault."""
        if name in self._values:
            return self._values[name]
        if name in self._told:
            return None
        if name in self._under_way or len(self._under_way) > REFERENCES_MAX:
            chain = (
                [*self._under_way[self._under_way.index(name) :], name]
                if name in self._under_way
                else []
            )
            shown = " -> ".join(f"${{{each}}}" for each in chain)
            text = f"expected a value that does not need itself, got {shown}"
            if not chain:
                text = f"expected at most {REFERENCES_MAX} variables that are made of each other"
            self._fault(name, text)
            self._told.update(self._under_way)
            return None
        value = self.written[name]
        if value is None:
            text = f"expected a value, here or with --set {SECTION}.{name}=VALUE, got nothing"
            self._fault(name, text)
            return None
        found: tuple[Any, tuple[str, ...]] | None = (value, (name,))
        if isinstance(value, str) and "${" in value:
            self._under_way.append(name)
            found = self._made(name, value)
            self._under_way.pop()
        if found is not None and name not in self._told:
            self._values[name] = found
            return found
        return None

    def _made(self, name: str, text: str) -> tuple[Any, tuple[str, ...]] | None:
        replaced = replace_words(text, self, keeps_unknown=False)
        for fault in replaced.faults:
            self._fault(name, fault)
        return None if replaced.is_faulty else (replaced.value, (name, *replaced.variables))

    def text_of(self, name: str, value: Any) -> str:
        """Return a variable's value as it stands in a longer text: as it is written."""
        if isinstance(value, str):
            return value
        made_of = self.written[name]
        if isinstance(made_of, str):  # ${x} alone, as its value is no text
            return self.text_of(made_of[2:-1], value)
        return self._document.texts.get((SECTION, name)) or kind_of(value)

    def hint(self, word: str, more: tuple[str, ...] = ()) -> str:
        """Return what was meant by a word that no variable is named."""
        known = (*self.written, *more)
        if not may_guess(len(self._document.faults), len(known)):
            return ""
        return did_you_mean(word, known) or "; vars names none"


@dataclasses.dataclass(slots=True)
class _Replaced:
    value: Any
    variables: tuple[str, ...] = ()
    faults: list[str] = dataclasses.field(default_factory=list)
    is_open: bool = False
    """Whether some ${...} was left."""
    is_faulty: bool = False
    """Whether it has no value; its faults may be told elsewhere."""


def replace_words(
    text: str, variables: _Variables, *, keeps_unknown: bool, words: tuple[str, ...] = ()
) -> _Replaced:
    """
    Replace the variables in one text.

    Args:
        text: As written.
        variables: All that there are.
        keeps_unknown: Whether other ${...} stays, and $${ with it; what is put in is then escaped.
        words: Further names that stay.
    """
    found = _Replaced(text)
    whole = _PLACEHOLDER.fullmatch(text)
    if whole and not whole[1] and text.endswith("}") and whole[2] in variables.written:
        value = variables.value_of(whole[2])
        if value is None:
            return _Replaced(None, is_faulty=True)
        is_text = keeps_unknown and isinstance(value[0], str)
        return _Replaced(
            escaped(value[0]) if is_text else value[0],
            value[1],
            is_open=is_text and "${" in value[0],
        )

    def replaced(match: re.Match[str]) -> str:
        if match[1]:
            found.is_open = True
            return match[0] if keeps_unknown else match[0][1:]
        name = match[2]
        if match[0].endswith("}") and name in variables.written:
            value = variables.value_of(name)
            if value is None:
                found.is_faulty = True
                return ""
            found.variables += value[1]
            shown = variables.text_of(name, value[0])
            return escaped(shown) if keeps_unknown else shown
        found.is_open = True
        if not keeps_unknown and name not in words:
            found.is_faulty = True
            found.faults.append(unknown_text(match[0], variables.hint(name, words)))
        return match[0]

    found.value = _PLACEHOLDER.sub(replaced, text)
    if len(found.value) > TEXT_CHARACTERS_MAX and found.variables:
        found.is_faulty = True
        found.faults.append(f"expected at most {TEXT_CHARACTERS_MAX} characters with its variables")
    return found


def unknown_text(written: str, hint: str) -> str:
    """Return the fault of a ${...} that stands for nothing."""
    shown = written if len(written) <= 80 else f"{written[:77]}..."
    if not written.endswith("}"):
        return f"expected ${{name}}, got {shown} without its closing }}; {LITERAL}"
    if not _NAME.fullmatch(written[2:-1]):
        return f"expected ${{name}}, got {shown}; {LITERAL}"
    return f"no variable is named {written[2:-1]}{hint}; {LITERAL}"


class _Substitution:
    def __init__(self, document: Document, variables: _Variables) -> None:
        self._document, self._variables = document, variables

    def all_of(self, value: dict[str, Any]) -> None:
        for key in value:
            if key != SECTION:
                value[key] = self._inside(value[key], (key,))

    def _inside(self, value: Any, path: Path) -> Any:
        if isinstance(value, dict):
            for key in value:
                if "${" in key:
                    text = f"expected a key as it is, got {key!r:.80}: variables are for values"
                    fault = self._document.fault((*path, key), text, at_key=True)
                    self._document.faults.append(fault)
                value[key] = self._inside(value[key], (*path, key))
        elif isinstance(value, list):
            value[:] = [self._inside(item, (*path, index)) for index, item in enumerate(value)]
        elif isinstance(value, str) and "${" in value:
            return self._text(value, path)
        return value

    def _text(self, text: str, path: Path) -> Any:
        document = self._document
        is_plugins = path[0] in _PLUGIN_SECTIONS
        words = (
            (AGENT_WORD,) if path[:2] == ("hardware", "devices") and "parameters" in path else ()
        )
        found = replace_words(text, self._variables, keeps_unknown=is_plugins, words=words)
        document.faults += [document.fault(path, fault) for fault in found.faults]
        place = document.value_places.get(path, SourcePlace())
        if found.is_faulty:
            document.without_value.append(path)
            return None
        document.value_places[path] = dataclasses.replace(place, variables=found.variables)
        if is_plugins and found.is_open:
            document.open_texts.append(path)
        if not isinstance(found.value, str):
            document.texts[path] = kind_of(found.value)
        return found.value


def judge_open_texts(
    document: Document, placeholders: Mapping[str, tuple[str, ...]]
) -> list[Fault]:
    """
    See that what is left of ${...} in a simulation's parameters is a word of its own, where it knows it.

    Args:
        document: The scenario; what is literal is unescaped where the simulation replaces nothing.
        placeholders: Of the descriptor: words by the dotted keys of fields, as globs.
    """
    words = sorted({word for known in placeholders.values() for word in known})
    faults = [
        document.fault(
            (SECTION, name),
            f"${{{name}}} is a word of the simulation's own, with a value per agent: choose another name",
            at_key=True,
        )
        for name in document.variables
        if name in words
    ]
    for path in document.open_texts:
        faults += _judge(document, path, placeholders)
    return faults


def texts_with_words(
    document: Document, placeholders: Mapping[str, tuple[str, ...]]
) -> frozenset[Path]:
    """Return the texts that the simulation reads for words of its own."""
    return frozenset(path for path in document.open_texts if words_at(path, placeholders))


def words_at(path: Path, placeholders: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Return the words that the simulation reads at a place of its parameters, or of those of a rule."""
    below = path[1:] if path[:1] == ("parameters",) else path[3:]
    field = ".".join(step for step in below if isinstance(step, str))
    fits = [words for glob, words in placeholders.items() if fnmatch.fnmatchcase(field, glob)]
    return tuple(word for words in fits for word in words)


def _judge(
    document: Document, path: Path, placeholders: Mapping[str, tuple[str, ...]]
) -> Iterator[Fault]:
    known = words_at(path, placeholders)
    holder: Any = document.value
    for step in path[:-1]:
        holder = holder[step]
    text: str = holder[path[-1]]
    for match in _PLACEHOLDER.finditer(text):
        if match[1] or (match[0].endswith("}") and match[2] in known):
            continue
        names = (*document.variables, *known)
        yield document.fault(path, unknown_text(match[0], did_you_mean(match[2], names)))
    if not known:
        holder[path[-1]] = text.replace("$${", "${")
