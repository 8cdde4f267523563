from pathlib import Path

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.inventory import load_machines
from cosmos_cli.models.provision_steps import FileContent, LineInFile, ShellCommand, SystemdService

HEAD = "all:\n  hosts: {m: }\n  vars:\n    cosmos_provision:\n"


@pytest.fixture
def read(tmp_path):
    def read_steps(*steps):
        path = tmp_path / "i.yaml"
        path.write_text(HEAD + "".join(f"      - {step}\n" for step in steps))
        return load_machines(path)[0].variables.cosmos_provision

    return read_steps


def faults_of(read, *steps):
    with pytest.raises(InputError) as caught:
        read(*steps)
    return [
        (fault.line, fault.path.removeprefix("all.vars.cosmos_provision"), fault.text)
        for fault in caught.value.faults
    ]


def test_steps_of_every_kind_are_typed(read, tmp_path):
    (tmp_path / "motd").write_text("hello\n")

    steps = read(
        "packages: [i2c-tools, python3-numpy]",
        '{name: greet, file: {src: motd, dest: /etc/motd, mode: "0644", owner: root}}',
        "file: {content: x, dest: ~/.profile}",
        "line: {path: /boot/config.txt, line: dtoverlay=rpi-sense, create: true}",
        "service: {name: hciuart, enabled: false, state: stopped}",
        "{command: {run: usermod -aG i2c pi, unless: id -nG pi | grep -q i2c}, become: false}",
    )

    assert [step.kind for step in steps] == [
        "packages",
        "file",
        "file",
        "line",
        "service",
        "command",
    ]
    assert [step.action for step in steps] == [
        ("i2c-tools", "python3-numpy"),
        FileContent(src=str(tmp_path / "motd"), dest="/etc/motd", mode="0644", owner="root"),
        FileContent(content="x", dest="~/.profile"),
        LineInFile(path="/boot/config.txt", line="dtoverlay=rpi-sense", create=True),
        SystemdService(name="hciuart", enabled=False, state="stopped"),
        ShellCommand(run="usermod -aG i2c pi", unless="id -nG pi | grep -q i2c"),
    ]
    assert [step.become for step in steps] == [True, True, True, True, True, False]
    assert [step.name for step in steps] == [None, "greet", None, None, None, None]


def test_source_is_found_from_the_inventorys_folder(read, tmp_path, monkeypatch):
    (tmp_path / "motd").write_text("hello\n")
    monkeypatch.chdir(Path("/"))

    (step,) = read("file: {src: ./motd, dest: /etc/motd}")

    assert Path(step.file.src).read_text() == "hello\n"
    assert Path(step.file.src).is_absolute()


@pytest.mark.parametrize(
    ("step", "path", "told"),
    [
        ("5", "", "expected a mapping, got 5"),
        ("name: x", "", "expected exactly one of packages, file, line, service, command in a step, got none of them"),
        ("{packages: [ab], command: {run: x, creates: /x}}", "",
         "expected exactly one of packages, file, line, service, command in a step, got packages and command"),
        ("comand: {run: x}", ".comand", "unknown key, did you mean command?"),
        ("packages: []", ".packages", "expected at least one item, got a list"),
        ("packages: [-o]", ".packages[0]", "expected the name of a Debian package such as i2c-tools, got '-o'"),
        ("file: {dest: /x}", ".file", "expected exactly one of src and content, got neither"),
        ("file: {dest: /x, src: i.yaml, content: y}", ".file",
         "expected exactly one of src and content, got src and content"),
        ("file: {content: y}", ".file.dest", "missing; expected a text"),
        ('file: {dest: /x, content: y, owner: "4294967295"}', ".file.owner",
         "expected the name of a user or group, or a number of at most 4294967294, got '4294967295'"),
        ('file: {dest: /x, content: y, group: "99999999999"}', ".file.group",
         "expected the name of a user or group, or a number of at most 4294967294, got '99999999999'"),
        ("file: {dest: x, content: y}", ".file.dest",
         "expected an absolute path or one that starts with ~/, got 'x'"),
        ("file: {dest: /x/, content: y}", ".file.dest",
         "expected an absolute path or one that starts with ~/, got '/x/'"),
        ("file: {dest: /x, content: y, mode: 644}", ".file.mode",
         'expected an octal mode in quotes such as "0644", got 644'),
        ('file: {dest: /x, content: y, mode: "u+x"}', ".file.mode",
         'expected an octal mode in quotes such as "0644", got \'u+x\''),
        ("line: {path: /x}", ".line", "expected line: the line that is to be present"),
        ("line: {path: /x, state: absent}", ".line",
         "expected exactly one of line and regexp with state: absent"),
        ("line: {path: /x, line: a, state: absnt}", ".line.state",
         "expected present or absent, got 'absnt', did you mean absent?"),
        ('line: {path: /x, line: "a\\nb"}', ".line.line", "expected one line of text, got 'a\\nb'"),
        ('line: {path: /x, line: a, regexp: "("}', ".line.regexp",
         "not a regular expression: missing ), unterminated subpattern at position 0"),
        ('line: {path: /x, line: a, regexp: "a{99999999999}"}', ".line.regexp",
         "not a regular expression: the repetition number is too large"),
        ("service: {name: x}", ".service", "expected enabled, state or both: nothing is asked of the service"),
        ("service: {name: -x, enabled: true}", ".service.name", "expected the name of a systemd unit, got '-x'"),
        ("command: {run: x}", ".command",
         "expected exactly one of creates and unless, got neither: it tells whether the command was done already"),
        ("command: {creates: /x}", ".command.run", "missing; expected a text"),
        ("command: {run: x, creates: /x, unless: y}", ".command",
         "expected exactly one of creates and unless, got creates and unless: it tells whether the command"
         " was done already"),
    ],
)  # fmt: skip
def test_step_that_is_not_understood_is_told_with_its_place(read, step, path, told):
    assert faults_of(read, step) == [(5, f"[0]{path}", told)]


def test_line_that_its_expression_does_not_find_is_refused(read):
    step = 'line: {path: /x, line: dtoverlay=a, regexp: "^#?dtparam="}'

    ((_, path, told),) = faults_of(read, step)

    assert path == "[0].line.regexp"
    assert told.startswith("expected it to be found in the line 'dtoverlay=a', too")


def test_missing_source_and_folder_are_refused_with_where_they_were_looked_for(read, tmp_path):
    (tmp_path / "folder").mkdir()

    faults = faults_of(read, "file: {src: nope, dest: /x}", "file: {src: folder, dest: /x}")

    assert [told for *_, told in faults] == [
        f"no such file: {tmp_path}/nope; it is looked for from the inventory's folder",
        f"{tmp_path}/folder: expected a file, got a folder",
    ]


def test_source_at_nobodys_home_is_missing_as_any_other(read):
    ((*_, told),) = faults_of(read, "file: {src: ~no-such-user/a, dest: /x}")

    assert told.startswith("no such file: ")


def test_faults_of_all_steps_are_told_at_once(read):
    faults = faults_of(read, "packages: [A]", "name: x", "command: {run: x}")

    assert [line for line, *_ in faults] == [5, 6, 7]
