"""
The report of a run as one self-contained HTML file: no request leaves it.

Every text of a run is foreign to the page (cleaned and escaped by the template's environment, and by `_figure_text`
within figures): a check's name or a line of a log may hold markup, a template's placeholder, the end of a script or
characters that turn text round.
"""

from __future__ import annotations

import base64
import functools
import html
import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
from markupsafe import Markup
from numpy.typing import NDArray

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.report.build import build_sections, figures_of
from cosmos_cli.report.cells import format_cell, format_measured
from cosmos_cli.report.plotly_figures import to_plotly
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui.foreign_text import clean_text
from cosmos_cli.ui.plural import counted
from madns_runtime.analysis.values import (
    Block,
    Figure,
    ReportRemark,
    Section,
    SpaceFigure,
    TableBlock,
)
from madns_runtime.errors import MissingExtraError
from madns_runtime.partial_file import write_whole
from madns_runtime.plain_values import mapping_at

if TYPE_CHECKING:
    import jinja2

RESOLUTION = 1e-3
"""Numbers are drawn in 4 bytes each if that moves none by more than this share of the curve's height."""
ROWS_OPEN_MAX = 26
"""A longer table starts folded."""
_OWN_MARKUP = "<extra></extra>"
"""The only markup that a figure's texts hold: it leaves out the second part of a label."""


def write_report(run: RunDirectory, document: Mapping[str, Any], path: Path | None = None) -> Path:
    """
    Write the report of a gathered run.

    Args:
        run: The run; its tables are written.
        document: run.json.
        path: Where to; by default report.html of the run.

    Raises:
        OSError: The file cannot be written.
    """
    target = path or run.report_html
    write_whole(target, render_page(document, build_sections(run, document)).encode())
    return target


def render_page(document: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Return the whole page of a run."""
    return render_sections(
        "page.html",
        sections,
        document=document,
        facts=list(_facts(document)),
        tiles=figures_of(document),
        gaps=_gaps(document),
        versions=mapping_at(document, "versions"),
    )


def render_sections(template: str, sections: Sequence[Section], **texts: Any) -> str:
    """
    Return a whole page.

    Args:
        template: Name of a template that extends layout.html, which shows the sections and draws their figures.
        sections: Chapters.
        texts: Values for the template's own part.
    """
    drawn = _Drawn()
    told = [
        {"title": s.title, "intro": s.intro, "blocks": [drawn.block(block) for block in s.blocks]}
        for s in sections
    ]
    environment = _environment()
    loader = environment.loader
    assert loader is not None
    css, script = (loader.get_source(environment, f"page.{kind}")[0] for kind in ("css", "js"))
    return environment.get_template(template).render(
        **texts,
        sections=told,
        rows_open_max=ROWS_OPEN_MAX,
        css=Markup(css),
        script=Markup(script),
        plotly=Markup(_plotly()) if drawn.figures else "",
        figures=Markup(drawn.data()),
    )


@functools.cache
def _environment() -> jinja2.Environment:
    with IMPORT_TURN:
        import jinja2  # 0.04 s that only a page needs, at the end of a run

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("cosmos_cli.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: value if isinstance(value, Markup) else clean_text(str(value)),
    )
    environment.filters |= {
        "cell": format_cell,
        "measured": format_measured,
        "breakable": _breakable,
    }
    return environment


class _Drawn:
    """Collects the figures' data while the page's blocks are made."""

    def __init__(self) -> None:
        self.figures: list[dict[str, Any]] = []
        self._arrays: list[dict[str, str]] = []
        self._known: dict[int, tuple[int, NDArray[Any]]] = {}

    def data(self) -> str:
        """Return the figures as JSON that may stand inside a script element."""
        text = orjson.dumps(
            {"figures": self.figures, "arrays": self._arrays}, option=orjson.OPT_SERIALIZE_NUMPY
        ).decode()
        return text.replace("<", "\\u003c")

    def block(self, block: Block) -> tuple[str, Any]:
        """Return a block's kind and what the template shows of it."""
        if isinstance(block, ReportRemark):
            return "remark", block
        if isinstance(block, TableBlock):
            return "table", block
        try:
            return "figure", self._figure(block)
        except Exception as error:  # noqa: BLE001 - a figure of anybody's must not cost a run its report
            text = f"The figure {block.title} could not be drawn: {type(error).__name__}: {error}"
            return "remark", ReportRemark(text=text)

    def _figure(self, figure: Figure | SpaceFigure) -> dict[str, Any]:
        with np.errstate(all="ignore"):  # numbers of anybody's, as large as they may be
            made = to_plotly(figure)
        group = getattr(figure, "group", "")
        choices = [{"name": name, "traces": self._encode(traces)} for name, traces in made.choices]
        layout = self._encode(made.layout)
        self.figures.append({"choices": choices, "layout": layout, "group": group})
        height = f"{made.height_px}px"
        return {
            "title": figure.title,
            "note": figure.note,
            "group": group,
            "number": len(self.figures) - 1,
            "choices": [name for name, _ in made.choices],
            "height": f"min({height}, 90vw)" if made.is_square else height,
        }

    def _encode(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return self._array(value)
        if isinstance(value, Mapping):
            return {str(key): self._encode(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [self._encode(item) for item in value]
        return _figure_text(value) if isinstance(value, str) else value

    def _array(self, values: NDArray[Any]) -> dict[str, int]:
        """Store an array once, however many traces share it, and return the reference to it."""
        known = self._known.get(id(values))
        if known is None:
            known = (len(self._arrays), values)  # kept, so that its id stays its own
            self._known[id(values)] = known
            self._arrays.append(encode_array(values))
        return {"$": known[0]}


def encode_array(values: NDArray[Any]) -> dict[str, str]:
    """Return numbers as plotly.js reads typed arrays: 4 bytes each where that is fine enough, else 8."""
    wide = np.ascontiguousarray(values, dtype="<f8")
    with np.errstate(over="ignore", invalid="ignore"):
        narrow = wide.astype("<f4")
        finite = wide[np.isfinite(wide)]
        spread = float(np.ptp(finite)) if finite.size else 0.0
        error = float(np.abs(finite - finite.astype("<f4")).max()) if finite.size else 0.0
    # A spread that is no float itself allows no error: all that is too large for 4 bytes would become infinite.
    is_fine = error <= RESOLUTION * spread < np.inf
    chosen: NDArray[Any] = narrow if is_fine else wide
    return {
        "dtype": "f4" if is_fine else "f8",
        "bdata": base64.b64encode(chosen.tobytes()).decode("ascii"),
    }


def _facts(document: Mapping[str, Any]) -> Iterator[str]:
    agents = mapping_at(document, "agents")
    yield f"scenario {document.get('scenario')}"
    count = agents.get("count")
    yield counted(count, "agent") if isinstance(count, int) else "agents not counted"
    duration_s = document.get("duration_s")
    if isinstance(duration_s, int | float):
        # The key tells what was to be run: one that was aborted has not come so far.
        yield f"{duration_s:g} s {'simulated' if document.get('status') == 'complete' else 'planned'}"
    yield f"started {str(document.get('started_utc'))[:19].replace('T', ' ')} UTC"
    yield f"seed {document.get('seed')}"


def _gaps(document: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [
        ("Data that are missing", mapping_at(document, "data").get("missing")),
        (
            "What did not go as it should",
            [problem.get("text") for problem in document.get("problems", ())],
        ),
    ]


def _breakable(name: object) -> Markup:
    """Return a name that may go on in the next line behind each of its parts."""
    text = html.escape(clean_text(str(name)))
    return Markup(text.replace("_", "_<wbr>").replace(".", ".<wbr>"))


def _figure_text(text: str) -> str:
    """Return a text within a figure; plotly.js reads some tags and all entities, and draws them as letters then."""
    own = _OWN_MARKUP if text.endswith(_OWN_MARKUP) else ""
    return html.escape(clean_text(text.removesuffix(own)), quote=False) + own


def _plotly() -> str:
    """Return the library for browsers; the package that it comes in is not imported, as that takes 0.2 s."""
    found = importlib.util.find_spec("plotly")
    if found is None or not found.submodule_search_locations:
        raise MissingExtraError("plotly", "host")
    path = Path(found.submodule_search_locations[0]) / "package_data/plotly.min.js"
    # A script element ends at the first of these, wherever it stands.
    return path.read_text(encoding="utf-8").replace("</script", "<\\/script")
