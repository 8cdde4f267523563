"""
Drives devices of a machine without a run, in an environment that `cosmos up` made, and hands over what they gave.

While they are driven, a piece is sent twice per second: when nobody takes it any more, they are made safe and closed.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping

from cosmos_cli.onboard import content_store
from cosmos_cli.onboard.request_loop import (
    AnswerPiece,
    HelperRefusal,
    PlainValue,
    VerbRequest,
    last_words,
    verb,
)

MODULE = "madns_runtime.hardware.sampling"
PREFIX = "devices-"
SIGN_OF_LIFE_S = 0.5
SAFE_S = 10.0
"""For devices to be made safe and closed, once they are told to end."""
GUARDIAN_S = 3.0
"""For the guardian to do that, where the program itself did not."""
LEFT_OVER_S = 7200.0
"""A folder of records so old was left by a power cut: no sampling takes as long."""
PIECE_BYTES = 512 * 1024
FILES_MAX = 2000
RECORDS_BYTES_MAX = 256 * 1024 * 1024


@verb("sample_devices")
def sample_devices(request: VerbRequest) -> Iterator[AnswerPiece]:
    """
    Drive devices as the order says; the last pieces hold files: the answer, and records if these are wanted.

    Raises:
        Refusal: TIMEOUT, and it was ended; STEP: it cannot be started, or failed.
    """
    asked = request.arguments
    parent = content_store.expand(asked["directory"])
    _remove_left_overs(parent)
    folder = tempfile.mkdtemp(prefix=PREFIX, dir=parent)
    try:
        yield from _driven(asked, folder)
        yield from _file(folder, "answer.json")
        if asked["has_records"]:
            yield from _records(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _driven(asked: Mapping[str, PlainValue], folder: str) -> Iterator[AnswerPiece]:
    """Run the program to its end, with signs of life."""
    order = {**asked["order"], "directory": folder, "ends_with_input": True}
    with open(f"{folder}/answer.json", "wb") as answer, open(f"{folder}/said", "w+b") as said:
        try:
            process = subprocess.Popen(
                [content_store.expand(asked["python"]), "-P", "-m", MODULE],
                stdin=subprocess.PIPE,
                stdout=answer,
                stderr=said,
                env={**os.environ, **asked["variables"]},
                cwd=folder,
                start_new_session=True,
            )
        except FileNotFoundError as error:
            text = f"{error.filename}: no such program"
            raise HelperRefusal("step", text, "run `cosmos up` first") from None
        end_s = time.monotonic() + asked["timeout_s"]
        try:
            _order(process, order)
            while (status := _wait(process, SIGN_OF_LIFE_S)) is None:
                if time.monotonic() > end_s:
                    text = f"what drives the devices did not end within {asked['timeout_s']:g} s and was ended"
                    raise HelperRefusal("timeout", text, "look at its driver and its device")
                yield AnswerPiece(value={"is_running": True})
        finally:
            _end(process)
        said.seek(max(0, said.seek(0, os.SEEK_END) - PIECE_BYTES))
        words = last_words(said.read())
        if status:
            text = f"what drives the devices ended with {status}: {words or 'without a word'}"
            raise HelperRefusal("step", text)
        yield AnswerPiece(value={"said": words})


def _order(process: subprocess.Popen[bytes], order: Mapping[str, PlainValue]) -> None:
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # its status tells
        process.stdin.write(json.dumps(order).encode() + b"\n")
        process.stdin.flush()


def _end(process: subprocess.Popen[bytes]) -> None:
    """End what still runs: it makes devices safe when its input ends, else its guardian does when it is gone."""
    assert process.stdin is not None
    with contextlib.suppress(OSError):
        process.stdin.close()
    if _wait(process, SAFE_S) is None:
        process.kill()
        _wait(process, GUARDIAN_S)
        time.sleep(GUARDIAN_S)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _wait(process: subprocess.Popen[bytes], timeout_s: float) -> int | None:
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return None


def _records(folder: str) -> Iterator[AnswerPiece]:
    """Yield all that was recorded, within bounds."""
    names = sorted(
        os.path.relpath(os.path.join(top, name), folder)
        for top, _, files in os.walk(f"{folder}/devices")
        for name in files
    )
    size_bytes = sum(os.path.getsize(f"{folder}/{name}") for name in names)
    if len(names) > FILES_MAX or size_bytes > RECORDS_BYTES_MAX:
        text = f"{len(names)} files with {size_bytes / 1e6:.0f} MB of records are more than are brought"
        raise HelperRefusal("step", text, "record for a shorter time, or at a lower rate_hz")
    for name in names:
        yield from _file(folder, name)


def _file(folder: str, name: str) -> Iterator[AnswerPiece]:
    """Yield a file in pieces, each with the file's name; one that is empty as one piece."""
    with open(f"{folder}/{name}", "rb") as file:
        piece = file.read(PIECE_BYTES)
        while True:
            yield AnswerPiece(value={"file": name}, body=piece)
            piece = file.read(PIECE_BYTES)
            if not piece:
                return


def _remove_left_overs(parent: str) -> None:
    now_s = time.clock_gettime(time.CLOCK_REALTIME)
    for entry in list(os.scandir(parent)):
        is_ours = entry.name.startswith(PREFIX) and entry.is_dir(follow_symlinks=False)
        if is_ours and now_s - entry.stat(follow_symlinks=False).st_mtime > LEFT_OVER_S:
            shutil.rmtree(entry.path, ignore_errors=True)
