"""OpenSSH's configuration files, as ssh itself reads them."""

import getpass
import shutil
import subprocess

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.ssh.config import matches, read_config


@pytest.fixture
def config(tmp_path):
    def write(text, name="config"):
        file = tmp_path / name
        file.write_text(text, encoding="utf-8")
        return file

    return write


def lookup(file, host, **given):
    found = read_config([file]).lookup(host, given)
    return {keyword: values[0] for keyword, values in found.items()}


def test_first_value_of_a_keyword_wins(config):
    file = config("Host pi1\n  User first\nHost pi*\n  User second\n  Port 2222\n")

    assert lookup(file, "pi1") == {"user": "first", "port": "2222"}
    assert lookup(file, "pi2") == {"user": "second", "port": "2222"}
    assert lookup(file, "other") == {}


def test_what_is_given_wins_over_the_file(config):
    file = config("User file\nHost *\n  Port 2222\n")

    assert lookup(file, "pi", user="inventory") == {"user": "inventory", "port": "2222"}


def test_lines_before_any_section_count_for_all_hosts(config):
    assert lookup(config("User = pi\n"), "any") == {"user": "pi"}


def test_negated_pattern_excludes(config):
    file = config("Host pi* !pi9\n  User pi\n")

    assert lookup(file, "pi1") == {"user": "pi"}
    assert lookup(file, "pi9") == {}


def test_identity_files_add_up_in_their_order(config):
    file = config("Host pi\n  IdentityFile ~/a\nHost *\n  IdentityFile ~/b\n  IdentityFile ~/a\n")

    assert read_config([file]).lookup("pi")["identityfile"] == ("~/a", "~/b")


def test_host_patterns_see_the_alias_and_match_host_the_name_behind_it(config):
    text = "Host alias\n  HostName pi.lab\nHost pi.lab\n  User wrong\n"
    file = config(text + "Match host pi.lab\n  User right\nMatch originalhost alias\n  Port 7\n")

    assert lookup(file, "alias") == {"hostname": "pi.lab", "user": "right", "port": "7"}


def test_match_with_several_criteria_needs_all(config):
    text = "Match host pi user root\n  Port 1\nMatch host pi !user root\n  Port 2\n"
    file = config(text + "Match all\n  HostKeyAlias known\n")

    assert lookup(file, "pi", user="root") == {"user": "root", "port": "1", "hostkeyalias": "known"}
    assert lookup(file, "pi", user="pi") == {"user": "pi", "port": "2", "hostkeyalias": "known"}


def test_match_localuser_is_who_runs_the_command(config):
    file = config(f"Match localuser {getpass.getuser()}\n  Port 3\n")

    assert lookup(file, "pi") == {"port": "3"}


@pytest.mark.process
def test_match_exec_asks_a_command_with_tokens_filled_in(config):
    text = 'Match exec "test %h = pi1"\n  User yes\n'

    assert lookup(config(text), "pi1") == {"user": "yes"}
    assert lookup(config(text), "pi2") == {}


def test_match_exec_is_not_run_when_the_line_cannot_match(config, tmp_path):
    file = config(f'Match host other exec "touch {tmp_path}/ran"\n  User yes\n')

    assert lookup(file, "pi1") == {}
    assert not (tmp_path / "ran").exists()


def test_section_of_an_included_file_in_a_section_that_does_not_apply_is_not_reached(
    config, tmp_path
):
    inner = config(f'Match exec "touch {tmp_path}/ran"\n  User yes\n', "inner")

    assert lookup(config(f"Host other\n  Include {inner}\n"), "pi") == {}
    assert not (tmp_path / "ran").exists()


def test_match_final_sees_what_all_else_has_decided(config):
    file = config("Match final user pi\n  Port 5\nHost *\n  User pi\n")

    assert lookup(file, "any") == {"hostname": "any", "user": "pi", "port": "5"}


def test_included_file_keeps_to_the_section_that_includes_it(config):
    inner = config("User included\nHost pi2\n  Port 2\n", "inner")
    file = config(f"Host pi*\n  Include {inner}\n  HostKeyAlias after\nHost *\n  Port 9\n")

    assert lookup(file, "pi1") == {"user": "included", "hostkeyalias": "after", "port": "9"}
    assert lookup(file, "pi2") == {"user": "included", "hostkeyalias": "after", "port": "2"}
    assert lookup(file, "other") == {"port": "9"}


def test_included_names_are_sorted_globs_beside_the_users_configuration(config, home):
    (home / ".ssh" / "conf.d").mkdir()
    (home / ".ssh" / "conf.d" / "b").write_text("User b\n")
    (home / ".ssh" / "conf.d" / "a").write_text("User a\n")

    assert lookup(config("Include conf.d/*\n"), "pi") == {"user": "a"}


def test_file_that_includes_itself_is_told(config, tmp_path):
    file = config(f"Include {tmp_path}/config\n")

    with pytest.raises(InputError, match=r"config:1: more than 16 files"):
        read_config([file])


def test_tokens_are_filled_in(config, home):
    text = "HostName %h.lab\nPort 22\nUser pi\nProxyCommand gate %h %p %r %n 100%%\n"
    found = lookup(config(text + "IdentityFile %d/keys/%r\nProxyJump %r@gate\n"), "pi1")

    assert found["proxycommand"] == "gate pi1.lab 22 pi pi1 100%"
    assert f"{home}/keys/pi" == found["identityfile"]
    assert found["proxyjump"] == "pi@gate"


def test_unknown_token_is_told(config):
    with pytest.raises(InputError, match="token %Z"):
        lookup(config("IdentityFile %Z\n"), "pi")


def test_unknown_criterion_is_told_with_its_place(config):
    file = config("Match phase moon\n  User pi\n")

    with pytest.raises(InputError, match=r"config:1: criterion of Match .* phase"):
        lookup(file, "pi")


def test_line_without_a_value_is_told_with_its_place(config):
    with pytest.raises(InputError, match=r"config:2: expected a keyword and a value, got 'User'"):
        read_config([config("Port 1\nUser\n")])


def test_unbalanced_quote_is_told_with_its_place(config):
    with pytest.raises(InputError, match=r"config:1: No closing quotation"):
        lookup(config('Host "pi\n'), "pi")


def test_quotes_comments_and_other_keywords_are_passed_over(config):
    file = config('# a\n\nHost "pi" # b\n  IdentityFile "my key"\n  ControlMaster auto\n')

    assert lookup(file, "pi") == {"identityfile": "my key"}


def test_missing_file_is_no_configuration(tmp_path):
    assert read_config([tmp_path / "none"]).lookup("pi") == {}


@pytest.mark.parametrize(
    ("patterns", "name", "expected"),
    [
        (["pi?"], "pi1", True),
        (["pi?"], "pi12", False),
        (["*"], "", True),
        (["10.0.[0-9].*"], "10.0.1.1", False),
        (["PI1"], "pi1", True),
        (["!pi1", "*"], "pi1", False),
        (["!pi1"], "pi2", False),
    ],
)
def test_patterns_know_star_and_question_mark_only(patterns, name, expected):
    assert expected is matches(patterns, name)


CASES = """
Host a b
  HostName %h.example.com
  User one
Match host *.example.com user one
  Port 2200
Host *
  User two
  IdentityFile ~/x
Match originalhost c
  ProxyJump g1,u@g2:23
"""


FINAL = """
Host 10.0.0.*
  ProxyJump gate
Host a b
  HostName 10.0.0.7
Host b c 10.0.0.7
  Port 2200
Match final
  HostName elsewhere
  User two
Host *
  User one
"""
"""Read twice, the second time with what the first has made of the host; some distributions ask for it of everybody."""


CAPITALS = """
Host A
  Port 2200
Host alias
  HostName Board
  User Pi
Match final
Match host BOARD user Pi
  ProxyJump gate
Match user pi
  Port 2201
Host board
  Port 2202
Host *
  User Pi
"""
"""Names of hosts after Match have no case; those after Host, and users, have one."""


@pytest.mark.process
@pytest.mark.parametrize("host", ["a", "b", "c", "d", "A", "alias", "Board"])
@pytest.mark.parametrize("text", [CASES, FINAL, CAPITALS])
def test_same_as_ssh_itself_says(config, host, text):
    if shutil.which("ssh") is None:
        pytest.skip("needs OpenSSH's ssh")
    file = config(text)
    said = subprocess.run(
        ["ssh", "-G", "-F", str(file), host], capture_output=True, text=True, check=True
    ).stdout
    theirs = dict(line.split(" ", 1) for line in said.splitlines() if " " in line)

    ours = lookup(file, host)

    assert theirs["hostname"] == ours.get("hostname", host).lower()
    assert theirs["user"] == ours["user"]
    assert theirs["port"] == ours.get("port", "22")
    assert theirs.get("proxyjump") == ours.get("proxyjump")


@pytest.mark.process
@pytest.mark.parametrize(
    "value", ["a#b", "a #b", r"a\b", r"a\\b", r"a\ b", r'"a b"c', r'"a\"b"', "'a#b' # c", r'"a\ b"']
)
def test_words_are_those_of_ssh_itself(config, value):
    if shutil.which("ssh") is None:
        pytest.skip("needs OpenSSH's ssh")
    file = config(f"User {value}\n")
    said = subprocess.run(
        ["ssh", "-G", "-F", str(file), "pi"], capture_output=True, text=True, check=True
    ).stdout

    assert f"user {lookup(file, 'pi')['user']}\n" in said
