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


@pytest.fixture
def asked(monkeypatch):
    """Return the programs that were asked, each with its names."""
    found = []

    def said(command, timeout_s=0.0):
        program = next((each for each in SAID if tuple(command[: len(each)]) == each), None)
        found.append((command[0], *command[len(program or ()) or 2 :]))
        return SAID[program] if program else POLICY

    monkeypatch.setattr(dpkg, "_said", said)
    return found


def test_name_that_an_installed_package_provides_is_there(asked):
    told = dpkg.installed_versions(["libasound2-dev", "libasound-dev", "mail-transport-agent"])

    assert told == {
        "libasound2-dev": "1.2.8",
        "libasound-dev": "libasound2-dev",
        "mail-transport-agent": None,
    }
    assert asked[-1] == ("apt-cache", "libasound-dev")


def test_package_of_its_own_is_not_there_because_another_provides_its_name(asked):
    """As python3-rpi.gpio, of which python3-rpi-lgpio takes the place: who lists it wants it."""
    assert dpkg.installed_versions(["python3-rpi.gpio"]) == {"python3-rpi.gpio": None}


def test_nothing_more_is_asked_where_all_are_there(asked):
    assert dpkg.installed_versions(["libasound2-dev"]) == {"libasound2-dev": "1.2.8"}
    assert dpkg.installed_versions([]) == {}
    assert asked == [("dpkg-query", "libasound2-dev")]
