"""What wheels run on a machine follows from its facts."""

import pytest

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision.platform import Platform, greeted_platform, platform_of, wheel_rank


def a_platform(machine="aarch64", python=(3, 11), libc=36):
    return Platform(python=python, machine=machine, libc_version=(2, libc))


@pytest.mark.parametrize(
    ("machine", "bits", "expected"),
    [
        ("x86_64", 64, "x86_64"),
        ("aarch64", 64, "aarch64"),
        ("aarch64", 32, "armv7l"),  # Raspberry Pi OS, 32-bit, on its 64-bit kernel
        ("armv8l", 32, "armv7l"),
        ("armv7l", 32, "armv7l"),
        ("armv6l", 32, "armv6l"),
    ],
)
def test_architecture_is_the_interpreters_not_the_kernels(machine, bits, expected):
    found = platform_of(python=(3, 11, 2), machine=machine, bits=bits, libc="glibc 2.36")

    assert Platform(python=(3, 11), machine=expected, libc_version=(2, 36)) == found


@pytest.mark.parametrize(
    ("machine", "bits", "libc", "named"),
    [
        ("riscv64", 64, "glibc 2.36", "riscv64"),
        ("x86_64", 32, "glibc 2.36", "32-bit"),
        ("i686", 32, "glibc 2.36", "i686"),
        ("aarch64", 64, "", "GNU C library"),
        ("aarch64", 64, "musl 1.2", "musl 1.2"),
    ],
)
def test_machine_without_wheels_is_refused_by_name(machine, bits, libc, named):
    with pytest.raises(MachineFailure, match=named) as caught:
        platform_of(python=(3, 11, 2), machine=machine, bits=bits, libc=libc)

    assert caught.value.kind is FailureKind.UNSUPPORTED


def test_platform_is_read_from_a_machines_greeting():
    greeting = {"python": "3.13.5", "machine": "aarch64", "bits": 64, "libc": "glibc 2.41"}

    assert a_platform(python=(3, 13), libc=41) == greeted_platform(greeting)


@pytest.mark.parametrize(
    ("libc", "expected"),
    [
        (17, "aarch64-manylinux_2_17"),
        (24, "aarch64-manylinux_2_17"),
        (28, "aarch64-manylinux_2_28"),
        (31, "aarch64-manylinux_2_31"),
        (36, "aarch64-manylinux_2_36"),
        (41, "aarch64-manylinux_2_40"),
    ],
)
def test_resolver_is_never_told_a_newer_libc_than_there_is(libc, expected):
    assert expected == a_platform(libc=libc).resolver_name


@pytest.mark.parametrize(
    ("wheel", "platform", "runs"),
    [
        (
            "numpy-2.4.6-cp311-cp311-manylinux_2_27_aarch64.manylinux_2_28_aarch64.whl",
            a_platform(),
            True,
        ),
        ("numpy-2.4.6-cp311-cp311-manylinux_2_28_aarch64.whl", a_platform(libc=27), False),
        ("numpy-2.4.6-cp311-cp311-manylinux_2_28_x86_64.whl", a_platform(), False),
        ("numpy-2.4.6-cp312-cp312-manylinux_2_28_aarch64.whl", a_platform(), False),
        ("numpy-2.4.6-cp311-cp311-musllinux_1_2_aarch64.whl", a_platform(), False),
        ("psutil-7.2.2-cp36-abi3-manylinux2014_aarch64.whl", a_platform(), True),
        ("annotated_types-0.8.0-py3-none-any.whl", a_platform("armv6l"), True),
        ("orjson-3.13.0-cp311-cp311-manylinux2014_armv7l.whl", a_platform("armv7l"), True),
        ("orjson-3.13.0-cp311-cp311-manylinux2014_armv7l.whl", a_platform("armv6l"), False),
        ("numpy-2.0.0-cp311-cp311-linux_armv7l.whl", a_platform("armv7l"), True),
        ("msgpack-1.0-cp311-cp311-manylinux1_x86_64.whl", a_platform("x86_64"), True),
        ("nonsense.whl", a_platform(), False),
    ],
)
def test_wheel_runs_where_its_tags_say(wheel, platform, runs):
    assert runs == (wheel_rank(wheel, platform) is not None)


def test_wheel_for_the_newest_libc_is_preferred():
    names = [
        "a-1-py3-none-any.whl",
        "a-1-cp311-cp311-manylinux_2_17_aarch64.whl",
        "a-1-cp311-cp311-manylinux_2_31_aarch64.whl",
    ]

    best = min(names, key=lambda name: wheel_rank(name, a_platform()))

    assert names[2] == best
