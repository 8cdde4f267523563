"""What devices need on a machine: asked as conditions, told as what is missing with its cure."""

import subprocess
import sys

import pytest

from cosmos_cli.doctor.device_needs import conditions_of, missing_of, need_questions
from cosmos_cli.models.device_needs import DeviceNeeds, MachineNeeds
from madns_runtime.hardware.contract import Needs

NEEDS = Needs(
    packages=("sense-hat",),
    groups=("i2c",),
    boot_lines=("dtparam=i2c_arm=on",),
    files=("/dev/i2c-1",),
    requirements=("smbus2>=0.4",),
    system_modules=("RTIMU",),
)
USER = {"executable": sys.executable, "uid": 1000}


def asked(needs, environments=("/there/abc",), greeting=USER):
    devices = (DeviceNeeds(device="hat", kind="sense_hat", needs=needs),)
    machine = MachineNeeds(devices=devices)
    questions = need_questions("pi22", machine, greeting=greeting, environments=environments)
    return machine, questions


def missing(needs, answer, **how):
    machine, questions = asked(needs, **how)
    answers = dict.fromkeys(conditions_of(questions), answer)
    ((device, found),) = (
        (each["device"], [item["found"] for item in each["missing"]])
        for each in missing_of("pi22", machine, questions, answers)
    )
    assert device == "pi22/hat"
    return found


def test_everything_that_is_missing_is_told():
    assert missing(NEEDS, False) == [
        "no package sense-hat",
        "who logs in is not in the group i2c",
        "no file /dev/i2c-1",
        "no Python module RTIMU",
        "no environment with smbus2>=0.4",
    ]
    assert missing(NEEDS, True) == []
    assert missing(NEEDS, None) == missing(NEEDS, False)  # what nobody could tell counts as missing


def test_each_has_a_cure():
    _, questions = asked(NEEDS)

    cures = {question.found: question.cure for question in questions}

    assert "then `cosmos reboot`" in cures["no file /dev/i2c-1"]
    assert all("cosmos up" in cure for cure in cures.values())
    (question,) = asked(Needs(files=("/dev/gauge",)))[1]
    assert question.cure == "is it connected?"


def test_root_needs_no_group_and_an_environment_that_was_never_prepared_is_missing():
    root = {**USER, "uid": 0}

    assert missing(Needs(groups=("i2c",)), False, greeting=root) == []
    never = missing(Needs(requirements=("a",)), True, environments=())
    assert never == ["no environment with a"]


def test_a_device_whose_needs_are_not_known_is_told():
    device = DeviceNeeds(device="hat", kind="x", needs=Needs(), fault="no kind of device named 'x'")

    ((found,),) = (
        each["missing"] for each in missing_of("pi22", MachineNeeds(devices=(device,)), (), {})
    )

    assert found["found"] == "no kind of device named 'x'"


@pytest.mark.process
def test_conditions_mean_what_they_say_in_a_shell(tmp_path):
    (tmp_path / "gauge 1").touch()
    here = Needs(files=(f"{tmp_path}/gauge*",), system_modules=("json.tool",))
    gone = Needs(files=(f"{tmp_path}/$(touch x)",), system_modules=("no_such_module",))

    def answers(needs):
        return [
            subprocess.run(["/bin/sh", "-c", each["unless"]], check=False, cwd=tmp_path).returncode
            for each in conditions_of(asked(needs)[1]).values()
        ]

    assert answers(here) == [0, 0]
    assert 0 not in answers(gone)
    assert not (tmp_path / "x").exists()
