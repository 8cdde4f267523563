"""What dpkg says is installed: packages by their names, and names that only others provide."""

import pytest

from cosmos_cli.onboard import dpkg

SAID = {
    dpkg.DPKG_QUERY: "libasound2-dev amd64 installed 1.2.8\ngone all config-files 1.0\n",
    dpkg.PROVIDES_QUERY: (
        "installed libasound2-dev libasound-dev (= 1.2.8), libasound-headers\n"
        "config-files exim4 mail-transport-agent\n"
        "installed python3-rpi-lgpio python3-rpi.gpio\n"
        "installed bash \n"
    ),
}
POLICY = (
    "libasound-dev:\n  Installed: (none)\n  Candidate: (none)\n  Version table:\n"
    "python3-rpi.gpio:\n  Installed: (none)\n  Candidate: 0.7.1\n  Version table:\n     0.7.1 500\n"
)


class Programs:
    """Programs of a machine; `asked` has each that was run, with its names."""

    def __init__(self):
        self.asked = []

    def __call__(self, command, timeout_s):
        program = next((each for each in SAID if tuple(command[: len(each)]) == each), None)
        self.asked.append((command[0], *command[len(program or ()) or 2 :]))
        return SAID[program] if program else POLICY


@pytest.fixture
def programs():
    return Programs()


def test_name_that_an_installed_package_provides_is_there(programs):
    told = dpkg.installed_versions(
        ["libasound2-dev", "libasound-dev", "mail-transport-agent"], programs
    )

    assert told == {
        "libasound2-dev": "1.2.8",
        "libasound-dev": "libasound2-dev",
        "mail-transport-agent": None,
    }
    assert programs.asked[-1] == ("apt-cache", "libasound-dev")


def test_package_of_its_own_is_not_there_because_another_provides_its_name(programs):
    """As python3-rpi.gpio, of which python3-rpi-lgpio takes the place: who lists it wants it."""
    assert dpkg.installed_versions(["python3-rpi.gpio"], programs) == {"python3-rpi.gpio": None}


def test_package_for_any_architecture_is_there_for_each(programs):
    """As apt sees it; to dpkg, adduser:arm64 is none, and each `up` installed it again."""
    said = "adduser all installed 3.134\nlibc6 arm64 installed 2.36\n"

    told = dpkg.installed_versions(
        ["adduser:arm64", "libc6:arm64", "libc6:armhf"],
        lambda command, timeout_s: said if tuple(command[:3]) == dpkg.DPKG_QUERY else "",
    )

    assert told == {"adduser:arm64": "3.134", "libc6:arm64": "2.36", "libc6:armhf": None}
    assert dpkg.names_asked(["adduser:arm64", "git"]) == ["adduser:arm64", "adduser:all", "git"]


def test_nothing_more_is_asked_where_all_are_there(programs):
    assert dpkg.installed_versions(["libasound2-dev"], programs) == {"libasound2-dev": "1.2.8"}
    assert dpkg.installed_versions([], programs) == {}
    assert programs.asked == [("dpkg-query", "libasound2-dev")]
