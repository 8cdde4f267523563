"""
A baseline: figures of a test's runs, what is expected of each, and how far it may be off.

A figure is a value of run.json by its path, or a statistic of a recorded field over all agents that are meant. The
expected values are written by `cosmos test --update-baselines`; names, tolerances and comments are a person's.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Le, MaxLen, MinLen
from pydantic import Field, TypeAdapter, ValidationError

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document, read_document
from cosmos_cli.models.text_forms import NonBlank
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.yaml_source import YamlSource, read_source
from madns_runtime.plain_values import FORBID_EXTRA

FIGURES_MAX = 1000
_PATH_FORM = re.compile(r'[^.\[\]]+(?:\.[^.\[\]]+|\[[0-9]{1,9}\]|\["[^"]+"\])*')
_PATH_STEP = re.compile(r'([^.\[\]]+)|\[([0-9]{1,9})\]|\["([^"]+)"\]')
Statistic = Literal["count", "mean", "sd", "rms", "min", "max", "p50", "p99", "last"]
Tolerance = Annotated[float, Ge(0), Le(1e300)]


@dataclass(frozen=True, slots=True, kw_only=True)
class BaselineFigure:
    """One figure."""

    __pydantic_config__ = FORBID_EXTRA

    path: Annotated[str, Field(max_length=500)] = ""
    """Place of the value in run.json, such as timing.ticks or checks[0].got; empty for a recorded field."""
    stream: Annotated[str, Field(max_length=100)] = ""
    """Stream as its table is called, such as state."""
    field: Annotated[str, Field(max_length=100)] = ""
    """Field of the stream."""
    statistic: Statistic | None = None
    """Statistic over all records; last: the largest of the last values."""
    agents: Annotated[tuple[NonBlank, ...], MinLen(1), MaxLen(1000)] = ("*",)
    """Names or globs of the agents whose records count."""
    expected: float | bool | str | None = None
    """Expected value; none until `cosmos test --update-baselines` has written it."""
    tolerance: Tolerance = 0.0
    """Largest difference that passes, in the field's unit."""
    relative: Tolerance = 0.0
    """Largest difference that passes, as a share of the expected value; the larger of both counts."""

    @property
    def path_steps(self) -> tuple[str, ...]:
        """The path's keys and numbers in lists, from the outermost; a key with a dot stands in brackets and quotes."""
        return tuple("".join(step) for step in _PATH_STEP.findall(self.path))

    @property
    def text(self) -> str:
        """The figure in words: its path, or stream.field and statistic."""
        return self.path or f"{self.stream}.{self.field} {self.statistic}"


@dataclass(frozen=True, slots=True, kw_only=True)
class BaselineContent:
    """Content of a baseline's file."""

    __pydantic_config__ = FORBID_EXTRA

    figures: dict[str, BaselineFigure]
    """The figures by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """A file of figures, and the places of what stands in it."""

    path: Path
    figures: dict[str, BaselineFigure]
    document: Document

    def fault(self, name: str, text: str) -> Fault:
        """Return a fault at the place of a figure."""
        return self.document.fault(("figures", name), text, at_key=True)


def read_baseline(path: Path) -> Baseline:
    """
    Read a baseline.

    Raises:
        InputError: With every fault.
    """
    return parse_baseline(path, read_source(path))


def parse_baseline(path: Path, source: YamlSource) -> Baseline:
    """
    Return the baseline of a text.

    Args:
        path: Where it lies, or would.
        source: The text.

    Raises:
        InputError: With every fault.
    """
    document = read_document(source)
    try:
        content = _adapter().validate_json(json.dumps(document.value), strict=True)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        raise InputError(faults=faults_of(document, errors, BaselineContent)) from error
    faults = [*document.faults, *_faults(document, content)]
    if faults:
        raise InputError(faults=faults)
    return Baseline(path=path, figures=content.figures, document=document)


@cache
def _adapter() -> TypeAdapter[BaselineContent]:
    """Return what judges a baseline; made when there is one, for it takes milliseconds."""
    return TypeAdapter(BaselineContent)


def _faults(document: Document, content: BaselineContent) -> list[Fault]:
    faults = []
    if not 1 <= len(content.figures) <= FIGURES_MAX:
        text = f"expected 1 to {FIGURES_MAX} figures, got {len(content.figures)}"
        faults.append(document.fault(("figures",), text))
    for name, figure in content.figures.items():
        of_stream = [word for word in ("stream", "field", "statistic") if getattr(figure, word)]
        where = ("figures", name)
        if figure.path and of_stream:
            text = "expected a path of run.json, or stream, field and statistic; got both"
            faults.append(document.fault((*where, "path"), text))
        elif not figure.path and len(of_stream) < 3:
            text = "expected path, or all of stream, field and statistic"
            faults.append(document.fault(where, text, at_key=True))
        elif figure.path and not _PATH_FORM.fullmatch(figure.path):
            text = 'expected a dotted path, such as timing.ticks, checks[0].got or summaries["a key"].n'
            faults.append(document.fault((*where, "path"), text))
    return faults
