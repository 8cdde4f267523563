"""Whatever a machine answers is one machine's clear failure, or an answer of the shape that was asked for."""

import hashlib
import itertools
import random
import re
import sys
from pathlib import Path

import pytest
from tampered import RAW, TamperedConnection, at, frame

import cosmos_cli
from cosmos_cli.fleet.answers import reader, verbs
from cosmos_cli.fleet.answers.reader import AnswerReader, ExpectedAnswer
from cosmos_cli.fleet.answers.shapes import anything, whole
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.target import Target
from cosmos_cli.fleet.transfer_limits import RATE_BYTES_S_MIN

ONBOARD = Path(cosmos_cli.__file__).parent / "onboard"
VERB = re.compile(r'^@verb\("([^"]+)"\)', re.MULTILINE)
PARTS = [
    "dpkg",
    "facts",
    "content_store",
    "installed",
    "runtime_check",
    "content_changes",
    "trees",
    "wheels",
    "environment",
    "scratch",
    "system",
    "apt",
    "records",
    "deletion",
    "files",
    "madns_runtime.processes",
    "processes",
    "power",
    "log_tail",
    "links",
    "cpu_load",
    "timer_latency",
    "udp_probe",
    "interfaces",
    "doctor",
    "apt_words",
    "timing_floor",
]
EMPTY = hashlib.sha256().hexdigest()
NOT_TRIED = {
    "reboot": "it would reboot this computer",
    "sample_devices": "it wants an environment: test_device_sampling holds its pieces to their shape",
    "wheel": "its answer is null, as a tree's",
}
SEEDS = 40
ROUND_TRIPS = {"address": "127.0.0.1", "port": 9, "nonce_hex": "00" * 16, "count": 2}
WAKE_UPS = {"count": 2, "rate_hz": 100.0, "policy": "normal", "priority": 1}
SYSTEM = {"services": ["ssh"], "units": ["ssh.service"], "packages": ["bash"], "sudo": False}
A_TREE = {"hash": EMPTY, "label": "l", "files": [["a", EMPTY, 0o444]]}


def call(verb: str, arguments: dict) -> dict:
    return {"verb": verb, "arguments": arguments}


def questions(root: Path) -> dict[str, dict]:
    """A question for every verb, harmless below *root*, in an order in which each finds something."""
    own, run, state = str(root), str(root / "runs" / "r-1"), str(root / "state")
    where = {"directory": run, "state": state}
    folders = {kind: f"{own}/{kind}" for kind in ("trees", "environments", "wheels")}
    wanted = {"trees": ["t"], "environments": ["e"], "compiled": f"{own}/c"}
    look = {"files": {own: "look", f"{own}/f": "text"}, "conditions": {"k": {"creates": own}}}
    ended = {"clean_s": 0.0, "forced_s": 0.0}
    return {
        "make_directories": {"paths": [own, run, state]},
        "write_file": {"path": f"{run}/log"},
        "edit_line": {"path": f"{own}/f", "line": "x", "is_present": True, "create": True},
        "set_values": {"values": [[f"{own}/f", "1"]]},
        "facts": {"root": own, **SYSTEM, **look},
        "look": look,
        "installed": {"folders": folders, **wanted},
        "several": {"calls": [call("look", look), call("living", {})]},
        "tree": {"folder": f"{own}/trees", **A_TREE},
        "blobs": {"folder": f"{own}/trees", "blobs": []},
        "blob": {"folder": f"{own}/trees", "sha256": EMPTY, "size": 1, "offset": 0, "length": 0},
        "environment": {
            "folder": f"{own}/environments",
            "wheels_folder": f"{own}/wheels",
            "key": "k",
            "python": list(sys.version_info[:2]),
            "sees_system": False,
            "wheels": [{"sha256": EMPTY, "filename": "a", "size": 3}],
        },
        "versions": {"names": ["pip"]},
        "prune_installed": {"folders": folders, **wanted},
        "check_runtime": {
            "depth": "look",
            "modules": [],
            "python": sys.executable,
            "path": [str(ONBOARD.parents[2])],
            "timeout_s": 60.0,
        },
        "command": {"run": "true", "creates": f"{own}/never", "timeout_s": 30.0},
        "service": {"name": "none", "do": [], "timeout_s": 30.0},
        "packages": {"action": "install", "names": ["bash"], "is_check": True},
        "processes": {"state": state, "ages": True},
        "boot": {"state": state, "root": own},
        "group": {"group": 999_999_999, "directory": run},
        "signal_group": {"group": 999_999_999, "directory": run, "signal": 0},
        "end_run": {**where, **ended},
        "last_words": {"path": f"{own}/f", "bytes": 100, "lines": 5},
        "living": where,
        "tail": {**where, "offsets": {}},
        "inventory_runs": {"runs": f"{own}/runs", "state": state},
        "sizes": {**where, "patience_s": 0.0},
        "manifest": {**where, "patience_s": 0.0, "bytes_max": 1_000_000},
        "fetch": {**where, "files": [["log", 0, 3]]},
        "doctor": {
            "root": own,
            "runs": f"{own}/runs",
            "state": state,
            "environments": f"{own}/environments",
            "wake_ups": WAKE_UPS,
            "round_trips": ROUND_TRIPS,
        },
        "round_trips": ROUND_TRIPS,
        "timing_floor": {**WAKE_UPS, "link": None},
        "root_content": {"root": own, "state": state},
        "release": {**where, "manifest_sha256": "unknown"},
        "discard": {**where, "shown": {}},
        "remove_root": {"root": own, "state": state},
        "remove_file": {"path": f"{own}/f"},
        "lock": {"path": f"{own}/lock"},
    }


STREAMED = {"command", "service", "packages", "manifest", "sizes", "fetch"}


def ask(board, verb, arguments):
    body = b"abc" if verb == "write_file" else b"x\x9c\x03\x00\x00\x00\x00\x01"
    if verb in STREAMED:
        return [piece.value for piece in board.pieces(verb, arguments, timeout_s=60.0)]
    return board.call(verb, arguments, body=body, timeout_s=60.0).value


def all_verbs():
    return {found for path in ONBOARD.glob("*.py") for found in VERB.findall(path.read_text())}


def target(tmp_path):
    return Target(name="pi01", address="192.0.2.1", root=str(tmp_path / "root"))


def test_every_verb_has_a_shape_and_a_question_here(tmp_path):
    assert {verb for verb in all_verbs() if not verbs.is_known(verb)} == set()
    assert all_verbs() - set(questions(tmp_path)) == set(NOT_TRIED)


@pytest.mark.process
def test_real_answers_have_the_shapes_that_are_expected(tmp_path):
    connection = TamperedConnection(target(tmp_path), lambda n, header, body: frame(header, body))
    refused = {}
    with Helper.start(connection, PARTS) as board:
        for verb, arguments in questions(tmp_path / "root").items():
            try:
                ask(board, verb, arguments)
            except MachineFailure as failure:
                assert "a faulty answer" not in failure.text, (verb, failure.text)
                refused[verb] = failure.text

    assert set(refused) <= {"release", "discard", "several", "remove_root"}, refused


@pytest.mark.process
@pytest.mark.parametrize("verb", sorted(questions(Path("/nowhere"))))
def test_altered_answer_is_that_machines_failure_or_of_its_shape(tmp_path, verb):
    told = {"values": 0, "failures": 0}
    real = _real_frames(tmp_path, verb)
    asked = questions(tmp_path / "root")[verb]
    expected = ExpectedAnswer(
        shape=verbs.answer_shape(verb, asked),
        what=verb,
        is_streamed=verb in STREAMED,
        body_bytes_max=verbs.BODY_BYTES_MAX.get(verb, 0),
    )
    for seed, (header, body) in itertools.product(range(SEEDS), real):
        data = at(0, random.Random(seed))(0, header, body)
        try:
            got, _ = AnswerReader(Canned(data)).read(expected, timeout_s=30.0)
            told["values"] += 1
            if got["ok"]:
                shape = expected.shape if not expected.is_streamed or got.get("piece") else anything
                shape(got["value"], "")
        except MachineFailure as failure:
            assert failure.kind is FailureKind.DATA, failure
            assert len(str(failure)) < 2000
            told["failures"] += 1

    assert told["failures"] > SEEDS // 4, told


@pytest.mark.process
@pytest.mark.parametrize("number", [0, 1])
def test_line_that_is_no_answer_is_that_machines_failure(tmp_path, number):
    for line in RAW:

        def instead(index, header, body, line=line):
            return line if index == number else frame(header, body)

        connection = TamperedConnection(target(tmp_path), instead)
        with pytest.raises(MachineFailure) as caught, Helper.start(connection) as board:
            board.call("lock", {"path": str(tmp_path / "lock")})
            board.call("lock", {"path": str(tmp_path / "lock")})

        assert caught.value.kind in (FailureKind.DATA, FailureKind.STEP, FailureKind.LOST), line[
            :80
        ]
        assert len(str(caught.value)) < 2000


@pytest.mark.process
def test_after_an_answer_that_cannot_be_meant_nothing_more_is_asked(tmp_path):
    def twice(index, header, body):
        return frame(header, body) * (2 if index == 1 else 1)

    with Helper.start(TamperedConnection(target(tmp_path), twice), ()) as board:
        board.call("lock", {"path": str(tmp_path / "lock")})
        with pytest.raises(MachineFailure, match="belongs to no question"):
            board.call("lock", {"path": str(tmp_path / "lock")})


class Canned:
    def __init__(self, data):
        self.data = data

    def read_some(self, count, *, timeout_s):
        data, self.data = self.data[:count], self.data[count:]
        return data

    def errors(self):
        return ""


class Clocked:
    """A machine that says *piece* every *pause_s* of a simulated clock, for ever."""

    def __init__(self, piece, pause_s):
        self.piece, self.pause_s, self.now_s, self.read_bytes = piece, pause_s, 0.0, 0

    def read_some(self, count, *, timeout_s):
        if self.pause_s > timeout_s:
            self.now_s += timeout_s
            raise MachineFailure(FailureKind.TIMEOUT, "no answer")
        self.now_s += self.pause_s
        self.read_bytes += len(self.piece)
        return self.piece

    def errors(self):
        return ""


ANY = ExpectedAnswer(shape=anything, what="`x`")


def read(machine, timeout_s=30.0, expected=ANY):
    with pytest.raises(MachineFailure) as caught:
        AnswerReader(machine, now_s=lambda: machine.now_s).read(expected, timeout_s=timeout_s)
    return caught.value


def test_dripping_machine_fails_at_its_deadline_as_a_whole():
    machine = Clocked(b"x", 1.0)

    failure = read(machine)

    assert failure.kind is FailureKind.TIMEOUT
    assert machine.now_s < 31.0
    assert re.fullmatch(
        r"its answer was not whole after 30 s: only 30 bytes of it had come", failure.text
    )


def test_endless_answer_fails_at_its_bound():
    machine = Clocked(b"x" * 262_144, 0.001)

    failure = read(machine)

    assert failure.kind is FailureKind.DATA
    assert machine.read_bytes <= reader.HEADER_BYTES_MAX + 2 * 262_144
    assert len(failure.text) < 500


def test_machine_as_slow_as_is_allowed_is_bounded_too():
    machine = Clocked(b"x" * RATE_BYTES_S_MIN, 1.0)

    failure = read(machine)

    assert failure.kind is FailureKind.DATA
    assert machine.now_s < 30.0 + 2 * reader.HEADER_BYTES_MAX / RATE_BYTES_S_MIN


def test_body_that_never_comes_fails_at_the_deadline():
    data = frame({"ok": True, "value": None, "body": 1000})
    machine = Clocked(data, 1.0)
    machine_reads = iter([data, *[b"y"] * 1000])
    machine.read_some, slow = lambda count, *, timeout_s: next(machine_reads), machine.read_some

    def drip(count, *, timeout_s):
        slow(count, timeout_s=timeout_s)
        return next(machine_reads)

    machine.read_some = drip
    expected = ExpectedAnswer(shape=anything, what="`x`", body_bytes_max=1000)

    failure = read(machine, expected=expected)

    assert failure.kind is FailureKind.TIMEOUT
    assert machine.now_s < 32.0


def test_silent_machine_is_told_of_with_the_deadline_that_was_given():
    assert read(Clocked(b"x", 1e9), 0.04).text == "no answer in 0.04 s"
    assert read(Clocked(b"x", 1e9), 30.0).text == "no answer in 30 s"


def test_body_larger_than_the_verb_may_have_is_refused_before_it_is_read():
    data = frame({"ok": True, "value": 1, "body": 10**12})

    with pytest.raises(MachineFailure, match="expected at most 0 bytes"):
        AnswerReader(Canned(data)).read(ExpectedAnswer(shape=whole(), what="`x`"), timeout_s=1.0)


def _real_frames(tmp_path, verb):
    """Return what the real helper answers to a question, each frame's header and body."""
    seen = []

    def keep(index, header, body):
        seen.append((header, body))
        return frame(header, body)

    asked = questions(tmp_path / "root")
    with Helper.start(TamperedConnection(target(tmp_path), keep), PARTS) as board:
        for before in ("make_directories", "write_file"):
            ask(board, before, asked[before])
        del seen[:]
        try:
            ask(board, verb, asked[verb])
        except MachineFailure:
            assert seen, "it came to no answer"
    return seen[:3]
