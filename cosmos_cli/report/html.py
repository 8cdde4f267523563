"""The report of a run as one self-contained HTML file: no request leaves it."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from cosmos_cli.counted import counted
from cosmos_cli.expectation import mapping_at
from cosmos_cli.report.build import build_sections, figures_of, open_source
from cosmos_cli.report.model import Figure, Remark, Section, TableBlock, format_cell
from cosmos_cli.rundir import RunDirectory, write_atomically

RESOLUTION = 1e-3
"""Numbers are drawn in 4 bytes each if that moves none by more than this share of the curve's height."""
ROWS_OPEN_MAX = 26
TEMPLATES = files("cosmos_cli.report") / "templates"


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
    sections = build_sections(open_source(run, document))
    write_atomically(target, render_page(document, sections).encode())
    return target


def render_page(document: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Return the whole page."""
    page = _Page()
    body = "\n".join([_head(document), *(page.section(section) for section in sections)])
    values = {
        "title": html.escape(str(document.get("run", "run"))),
        "css": _template("page.css"),
        "body": body + _foot(document),
        "plotly": _plotly() if page.figures else "",
        "figures": page.data(),
        "script": _template("page.js"),
    }
    text = _template("page.html")
    for name, value in values.items():
        text = text.replace("{{" + name + "}}", value, 1)
    return text


class _Page:
    """Collects the figures' data while the body is written."""

    def __init__(self) -> None:
        self.figures: list[dict[str, Any]] = []
        self._arrays: list[dict[str, str]] = []
        self._known: dict[int, tuple[int, NDArray[Any]]] = {}

    def section(self, section: Section) -> str:
        intro = f"<p>{html.escape(section.intro)}</p>" if section.intro else ""
        blocks = "\n".join(self._block(block) for block in section.blocks)
        return f"<section><h2>{html.escape(section.title)}</h2>{intro}{blocks}</section>"

    def data(self) -> str:
        """Return the figures as JSON that may stand inside a script element."""
        text = orjson.dumps(
            {"figures": self.figures, "arrays": self._arrays}, option=orjson.OPT_SERIALIZE_NUMPY
        ).decode()
        return text.replace("<", "\\u003c")

    def _block(self, block: Figure | TableBlock | Remark) -> str:
        if isinstance(block, Remark):
            return f'<p class="remark">{html.escape(block.text)}</p>'
        if isinstance(block, TableBlock):
            return render_table(block)
        return self._figure(block)

    def _figure(self, figure: Figure) -> str:
        number = len(self.figures)
        self.figures.append(
            {
                "choices": [
                    {"name": choice.name, "traces": self._encode(list(choice.traces))}
                    for choice in figure.choices
                ],
                "layout": self._encode(dict(figure.layout)),
                "group": figure.group,
            }
        )
        select = _select(figure, number) if len(figure.choices) > 1 else ""
        note = f'<p class="note">{html.escape(figure.note)}</p>' if figure.note else ""
        height = f"{figure.height_px}px"
        if figure.is_square:
            height = f"min({height}, 90vw)"
        return (
            f"<figure><figcaption><h3>{html.escape(figure.title)}</h3>{select}{note}</figcaption>"
            f'<div class="plot" id="plot{number}" style="height:{height}"></div></figure>'
        )

    def _encode(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return self._array(value)
        if isinstance(value, Mapping):
            return {str(key): self._encode(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [self._encode(item) for item in value]
        return value

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
    is_fine = error <= RESOLUTION * spread
    chosen: NDArray[Any] = narrow if is_fine else wide
    return {
        "dtype": "f4" if is_fine else "f8",
        "bdata": base64.b64encode(chosen.tobytes()).decode("ascii"),
    }


def render_table(table: TableBlock) -> str:
    """Return a table; a long one starts folded."""
    head = "".join(
        f'<th class="{"n" if h.is_number else ""}">{html.escape(h.text)}</th>'
        for h in table.headings
    )
    rows = "".join(
        "<tr>"
        + "".join(
            f'<td class="{"n" if h.is_number else ""}">{html.escape(format_cell(cell))}</td>'
            for h, cell in zip(table.headings, row, strict=True)
        )
        + "</tr>"
        for row in table.rows
    )
    is_open = " open" if len(table.rows) <= ROWS_OPEN_MAX else ""
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    return (
        f"<details{is_open}><summary>{html.escape(table.title)}</summary>{note}"
        f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
        "</details>"
    )


def _select(figure: Figure, number: int) -> str:
    options = "".join(
        f'<option value="{index}">{html.escape(choice.name)}</option>'
        for index, choice in enumerate(figure.choices)
    )
    label = figure.group or "view"
    return (
        f'<label class="choice">{html.escape(label)} '
        f'<select data-figure="{number}">{options}</select></label>'
    )


def _head(document: Mapping[str, Any]) -> str:
    exit_code = document.get("exit_code")
    state = "good" if exit_code == 0 else "bad"
    tiles = "".join(
        f'<div class="tile"><span>{html.escape(name)}</span><b>{html.escape(value)}</b>'
        f"<small>{html.escape(remark)}</small></div>"
        for name, value, remark in figures_of(document)
    )
    facts = " · ".join(html.escape(fact) for fact in _facts(document))
    return (
        f'<header><p class="kind">COSMoS run report</p><h1>{html.escape(str(document.get("run")))}</h1>'
        f'<p class="facts">{facts}</p></header>'
        f'<div class="verdict {state}"><b>{html.escape(str(document.get("verdict")))}</b>'
        f"<span>status {html.escape(str(document.get('status')))}, exit code {exit_code}</span></div>"
        f'<div class="tiles">{tiles}</div>{_checks(document)}{_gaps(document)}'
    )


def _facts(document: Mapping[str, Any]) -> Iterator[str]:
    agents = mapping_at(document, "agents")
    yield f"scenario {document.get('scenario')}"
    count = agents.get("count")
    yield counted(count, "agent") if isinstance(count, int) else "agents not counted"
    duration_s = document.get("duration_s")
    if isinstance(duration_s, int | float):
        yield f"{duration_s:g} s simulated"
    yield f"started {str(document.get('started_utc'))[:19].replace('T', ' ')} UTC"
    yield f"seed {document.get('seed')}"


def _checks(document: Mapping[str, Any]) -> str:
    rows = []
    for check in document.get("checks", ()):
        passed = check.get("passed") is True
        mark = '<td class="mark good">holds</td>' if passed else '<td class="mark bad">broken</td>'
        rows.append(
            f"<tr><td>{_breakable(str(check.get('name')))}</td>"
            f'<td class="n">{html.escape(_measured(check.get("got")))}</td>'
            f'<td class="n">{html.escape(format_cell(check.get("limit")))}</td>{mark}</tr>'
        )
    remarks = "".join(f"<p>{html.escape(str(text))}</p>" for text in document.get("remarks", ()))
    return (
        '<section><h2>Checks</h2><div class="wide"><table class="checks"><thead><tr><th>check</th>'
        '<th class="n">measured</th><th class="n">limit</th><th></th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>{remarks}</section>"
    )


def _breakable(name: str) -> str:
    """Return a name that may go on in the next line behind each of its parts."""
    return html.escape(name).replace("_", "_<wbr>").replace(".", ".<wbr>")


def _measured(value: object) -> str:
    return "not measured" if value is None else format_cell(value)


def _gaps(document: Mapping[str, Any]) -> str:
    parts = []
    problem_texts = [problem.get("text") for problem in document.get("problems", ())]
    for title, lines in (
        ("Data that are missing", mapping_at(document, "data").get("missing")),
        ("What did not go as it should", problem_texts),
    ):
        if lines:
            items = "".join(f"<li>{html.escape(str(item))}</li>" for item in lines)
            parts.append(f'<section class="gaps"><h2>{title}</h2><ul>{items}</ul></section>')
    return "".join(parts)


def _foot(document: Mapping[str, Any]) -> str:
    versions = mapping_at(document, "versions")
    listed = " · ".join(f"{html.escape(str(k))} {html.escape(str(v))}" for k, v in versions.items())
    return (
        "<footer><p>Statistics are made of all samples; curves are thinned for drawing and keep every "
        f"peak. The samples are in tables/*.parquet and *.jsonl of the run.</p><p>{listed}</p></footer>"
    )


def _template(name: str) -> str:
    return (TEMPLATES / name).read_text(encoding="utf-8")


def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    # A script element ends at the first of these, wherever it stands.
    return str(get_plotlyjs()).replace("</script", "<\\/script")
