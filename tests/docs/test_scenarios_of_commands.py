"""The files and settings that the guides' commands name: they are there, and the scenarios are right with them."""

import pytest
from guides import GUIDES, ROOT, commands

from cosmos_cli import app
from cosmos_cli.models.loading import load_scenario

EMULATED = "scenarios/hwil_"
"""Scenarios that want firmware, which must be built first."""


def named():
    """Yield each guide's name with a command's words, its scenarios and what is set of them."""
    for guide in GUIDES:
        for words in commands(guide.read_text("utf-8")):
            files = [word for word in words if word.startswith(("scenarios/", "inventory/"))]
            given = [
                after for word, after in zip(words, words[1:], strict=False) if word == "--set"
            ]
            yield guide.name, words, files, given


def test_every_file_that_a_command_names_is_there():
    missing = {
        f"{guide}: {file}"
        for guide, _, files, _ in named()
        for file in files
        if not (ROOT / file).exists()
    }

    assert missing == set()


@pytest.mark.process
def test_every_setting_of_a_command_fits_its_scenarios(capsys):
    tried = 0
    for guide, words, files, given in named():
        scenarios = [str(ROOT / file) for file in files if file.endswith(".yaml")]
        if not given or not scenarios or any(file.startswith(EMULATED) for file in files):
            continue
        settings = [part for each in given for part in ("--set", each)]
        assert app.run(["validate", *scenarios, *settings]) == 0, (
            guide,
            words,
            capsys.readouterr().err,
        )
        tried += 1

    assert tried >= 10


def test_every_scenario_by_which_a_command_judges_has_checks():
    judged = 0
    for guide, words, files, _ in named():
        if words[1] == "judge" and files:
            assert load_scenario(ROOT / files[0]).expectations, f"{guide}: {' '.join(words)}"
            judged += 1
        if words[1:3] == ["judge", "last"] and "-s" in words and not files:
            shown = (ROOT / "docs" / guide).read_text("utf-8")
            name = words[words.index("-s") + 1].removesuffix(".yaml")
            assert f"```yaml\nname: {name}\n" in shown
            judged += 1

    assert judged
