"""What `cosmos up` prints: plans, differences, a line per machine, the verdict; and its progress."""

import io
import json
import subprocess
import sys

import pytest
from provision_machines import facts_of, wanted

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision import up_table, up_view
from cosmos_cli.provision.step import Change, Done, Kind, Step
from cosmos_cli.provision.steps import plan_steps
from cosmos_cli.provision.up_table import MachineResult
from cosmos_cli.provision.up_view import UpView
from cosmos_cli.ui.console import Console

FACTS = facts_of()
STEPS = plan_steps(
    FACTS,
    wanted(
        packages=("htop",),
        provision=({"become": False, "file": {"content": "a=1\nb=2\n", "dest": "/etc/a"}},),
    ),
)
FAILURE = MachineFailure(FailureKind.STEP, "package htop: install:\nno\nsuch", "check the name")


def result(machine, *, steps=(), failure=None, **changes):
    return MachineResult(
        machine=machine,
        duration_s=0.5,
        facts=None if failure and not steps else FACTS,
        planned=tuple(steps),
        done=[Done(step=step, changed=True) for step in steps],
        failure=failure,
        **changes,
    )


def words(one, **options):
    return one.row(is_check=options.get("is_check", False))[-1]


def test_each_machine_has_one_line():
    assert result("a").row(is_check=False) == ("a", "Raspberry Pi 4 Model B Rev 1.4", "ok")
    assert words(result("a", steps=STEPS)) == "changed (2)"
    assert words(result("a", steps=STEPS), is_check=True) == "would change (2)"
    assert words(result("a", is_local=True)).startswith("ok (local")
    assert words(result("a", failure=FAILURE)) == (
        "failed: package htop: install: no such; check the name"
    )
    assert words(result("a", steps=STEPS[:1], failure=FAILURE)).startswith("failed after 1 change:")


def test_long_failure_is_cut_in_the_table_and_whole_in_json():
    failure = MachineFailure(FailureKind.STEP, "x" * 5000)
    one = result("a", failure=failure)

    assert len(words(one)) < 700
    assert one.to_mapping()["failure"]["text"] == "x" * 5000


def test_long_failure_keeps_its_step_its_last_words_and_what_to_do():
    traceback = "  File x, in y\n" * 200
    failure = MachineFailure(
        FailureKind.STEP,
        f"command make: exit status 2:\n{traceback}OSError: no libusb",
        "install it",
    )

    shown = words(result("a", failure=failure))

    assert shown.startswith("failed: command make: exit status 2: File x")
    assert shown.endswith("File x, in y OSError: no libusb; install it")
    assert len(shown) == len("failed: ") + up_table.FAILURE_CHARACTERS_MAX


def test_verdict_counts_machines():
    results = [result("a"), result("b", steps=STEPS), result("c", failure=FAILURE)]

    assert up_table.verdict(results, is_check=False, duration_s=1.23) == (
        "3 machines: 1 changed, 1 ok, 1 failed in 1.2 s"
    )
    assert up_table.verdict(results[:1], is_check=True, duration_s=1) == (
        "1 machine: 0 would change, 1 ok, 0 failed in 1.0 s"
    )


def test_json_is_stable():
    document = up_table.document([result("b", steps=STEPS)], is_check=False)

    assert document["changed"] == 1
    assert document["failed"] == 0
    (machine,) = json.loads(json.dumps(document))["machines"]
    assert machine["status"] == "changed"
    assert machine["steps"] == [
        {"kind": "package", "title": "package htop: install", "changed": True},
        {"kind": "file", "title": "file /etc/a: create", "changed": True},
    ]
    assert machine["facts"]["model"].startswith("Raspberry")
    assert machine["failure"] is None


def test_machines_with_the_same_plan_share_it():
    results = [result(name, steps=STEPS) for name in ("pi01", "pi02", "pi03")]
    results += [result("pi04"), result("pi05", steps=STEPS[:1])]

    assert list(up_table.plan_lines(results, has_diffs=False)) == [
        "pi[01:03]:",
        "  package htop: install [root]",
        "  file /etc/a: create",
        "pi05:",
        "  package htop: install [root]",
    ]


def test_differences_are_shown_as_diff_does():
    lines = list(up_table.plan_lines([result("a", steps=STEPS)], has_diffs=True))

    assert lines[2:] == [
        "  file /etc/a: create",
        "    --- /etc/a (missing)",
        "    +++ /etc/a (then)",
        "    @@ -0,0 +1,2 @@",
        "    +a=1",
        "    +b=2",
    ]


@pytest.mark.parametrize("after", ["\0\1", "caf\udce9\n"])
def test_difference_of_bytes_that_are_no_text_can_be_printed(after):
    lines = list(up_table.diff_lines(Change(path="/a", before="x\n", after=after)))

    assert "\n".join(lines).encode()


def test_notes_are_told_once_with_all_their_machines():
    results = [result(f"pi{n:02}", notes=["its clock is late"]) for n in range(1, 5)]

    assert list(up_table.note_lines(results)) == ["pi[01:04]: its clock is late"]


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    now_s = 0.0

    def __call__(self):
        return self.now_s


def test_progress_is_one_plain_line_for_each_machine_when_it_is_done_where_nobody_looks(
    monkeypatch,
):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    said = []
    with UpView(Console(), ["a", "b"]) as view:
        for step in range(20):
            for name in ("a", "b"):
                view.teller(name).step(f"package {step}: install")
                view.teller(name).detail("50%")
        said.append(stream.getvalue())
        view.done("b", "failed after 3 changes: no room")
        said.append(stream.getvalue())
        view.teller("a").step("checking")
        view.done("a", "changed (20)")
        said.append(stream.getvalue())

    failed = "b: failed after 3 changes: no room\n"
    assert said == ["", failed, f"{failed}a: changed (20)\n"]


def test_who_is_still_at_work_is_told_now_and_then_machines_at_the_same_together(monkeypatch):
    stream, clock = io.StringIO(), Clock()
    monkeypatch.setattr(sys, "stderr", stream)
    names = [f"pi{number:02}" for number in range(1, 8)]
    with UpView(Console(), names, now_s=clock) as view:
        for name in names[:5]:
            view.teller(name).step("environment: build")
        view.teller("pi06").step("package htop: install")
        view.done("pi07", "ok")
        for second in range(40):
            clock.now_s = float(second)
            view.look()

    at_work = "pi[01:05]: environment: build; pi06: package htop: install"
    assert stream.getvalue().splitlines() == [
        "pi07: ok",
        f"after 15 s: {at_work}",
        f"after 30 s: {at_work}",
    ]


def test_interrupt_tells_how_far_it_came_and_how_to_go_on(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with pytest.raises(KeyboardInterrupt), UpView(Console(), ["a", "b", "c"]) as view:
        view.done("a", "ok")
        view.teller("b").step("package htop: install")
        raise KeyboardInterrupt

    assert stream.getvalue().splitlines()[1:] == [
        "1 of 3 machines done; b: package htop: install; c: waiting for its answer",
        "the same command goes on from there: what is done is not done again",
    ]


def test_quiet_view_says_nothing(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with UpView(Console(quiet=True), ["a"]) as view:
        view.teller("a").step("package htop: install")

    assert stream.getvalue() == ""


def test_terminal_shows_a_line_a_machine_once_it_takes_long(monkeypatch):
    stream, clock = Terminal(), Clock()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    with UpView(Console(), ["pi01", "pi02"], now_s=clock) as view:
        view.teller("pi01").step("package htop: install")
        assert stream.getvalue() == ""

        clock.now_s = up_view.QUIET_S + 0.1
        view.teller("pi02").step("directory: make")

        shown = stream.getvalue()
        assert "package htop: install" in shown
        assert "directory: make" in shown


def test_check_step_is_no_change():
    step = Step(kind=Kind.CHECK, title="runtime starts")
    done = [Done(step=step, changed=False)]

    assert MachineResult(machine="a", facts=FACTS, done=done).status == "ok"


@pytest.mark.process
def test_up_imports_only_what_it_needs_before_it_logs_in():
    heavy = ("pydantic", "yaml", "numpy", "scipy", "rich", "pyarrow", "paramiko", "asyncio")
    code = (
        "import sys, cosmos_cli.commands.up;"
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"

    code = (
        "import sys, cosmos_cli.provision.up;"
        "print([name for name in ('numpy', 'scipy', 'rich', 'pyarrow', 'asyncio',"
        " 'cosmos_cli.models.scenario') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
