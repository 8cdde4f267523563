"""Hand-over of a host's result: to the operator, and beside the records, where no operator is needed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import orjson

from madns_runtime.partial_file import write_whole
from madns_runtime.reactor.operator_link import OperatorLink

RESULT_FILE = "result.json"
"""Beside the host's records: the result, also of a run whose operator is gone, stopped or slow."""
RESULT_BYTES_MAX = 1024 * 1024
"""A longer result is not sent to the operator, only named."""
FLUSH_TIMEOUT_S = 5.0


def leave(result: Mapping[str, Any], directory: Path) -> int:
    """Write the result beside the records and return its bytes; 0 if the disk refuses."""
    text = orjson.dumps(result, option=orjson.OPT_SERIALIZE_NUMPY)
    path = directory / RESULT_FILE
    try:
        write_whole(path, text, is_durable=False)
    except OSError:  # a full disk, say: then the line to the operator is all there is
        return 0
    return len(text)


def hand_over(result: dict[str, Any], directory: Path, operator: OperatorLink) -> int:
    """Leave the result, tell it to the operator, close that line, and return the process's exit code."""
    result["events_dropped"] = operator.dropped_count
    if leave(result, directory) > RESULT_BYTES_MAX:
        operator.emit({"event": "finished", "result": None, "file": RESULT_FILE})
    else:
        operator.emit({"event": "finished", "result": result})
    operator.flush(FLUSH_TIMEOUT_S)
    operator.close()
    return 0 if result["status"] == "complete" else 1
