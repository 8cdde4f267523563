"""A lock: what the resolver found, read for one platform, and the key that follows from it."""

import dataclasses

import pytest

from cosmos_cli.provision.lock import (
    Distributed,
    Lock,
    Locked,
    choose,
    parse_pylock,
    with_specifiers,
)
from cosmos_cli.provision.platform import Platform

BOARD = Platform(python=(3, 11), machine="aarch64", libc_version=(2, 36))
OLD_BOARD = Platform(python=(3, 11), machine="armv7l", libc_version=(2, 31))
PYLOCK = """
lock-version = "1.0"
created-by = "uv"

[[packages]]
name = "NumPy"
version = "2.4.6"
marker = "python_full_version == '3.11.*'"
wheels = [
    { url = "https://files.example/a/numpy-2.4.6-cp311-cp311-manylinux_2_28_aarch64.whl", hashes = { sha256 = "aa" } },
    { url = "https://files.example/a/numpy-2.4.6-cp311-cp311-manylinux_2_28_x86_64.whl", hashes = { sha256 = "ab" } },
]

[[packages]]
name = "numpy"
version = "2.5.5"
marker = "python_full_version >= '3.12'"
wheels = [{ url = "https://files.example/a/numpy-2.5.5-cp312-cp312-manylinux_2_28_aarch64.whl", hashes = { sha256 = "ac" } }]

[[packages]]
name = "orjson"
version = "3.13.0+x"
wheels = [
    { url = "file:///w/orjson-3.13.0%2Bx-cp311-cp311-manylinux_2_17_aarch64.whl", hashes = { sha256 = "ba" } },
    { url = "file:///w/orjson-3.13.0%2Bx-cp311-cp311-manylinux_2_17_armv7l.whl", hashes = { sha256 = "bb" } },
]

[[packages]]
name = "rpi-gpio"
version = "0.7.1"
marker = "platform_machine == 'armv7l'"
"""


def test_best_wheel_of_each_package_is_chosen_for_a_board():
    chosen, missing = choose(parse_pylock(PYLOCK, BOARD), BOARD)

    assert [(each.locked.name, each.locked.version, each.locked.sha256) for each in chosen] == [
        ("numpy", "2.4.6", "aa"),
        ("orjson", "3.13.0+x", "ba"),
    ]
    assert chosen[1].locked.filename == "orjson-3.13.0+x-cp311-cp311-manylinux_2_17_aarch64.whl"
    assert missing == ()


def test_packages_without_a_wheel_for_the_board_are_named():
    chosen, missing = choose(parse_pylock(PYLOCK, OLD_BOARD), OLD_BOARD)

    assert [each.locked.sha256 for each in chosen] == ["bb"]
    assert [each.name for each in missing] == ["numpy", "rpi-gpio"]


def a_lock(**changes):
    wheels = (
        Locked(name="numpy", version="2.4.6", sha256="aa", filename="numpy.whl", size_bytes=1),
        Locked(name="orjson", version="3.13.0", sha256="ba", filename="orjson.whl"),
    )
    return dataclasses.replace(Lock(platform=BOARD, wheels=wheels), **changes)


def test_key_is_the_contents_alone():
    lock = a_lock()
    other_libc = dataclasses.replace(BOARD, libc_version=(2, 41))

    assert lock.key == a_lock(wheels=lock.wheels[::-1]).key
    assert lock.key == a_lock(platform=other_libc).key


@pytest.mark.parametrize(
    "changes",
    [
        {"wheels": a_lock().wheels[:1]},
        {"platform": dataclasses.replace(BOARD, python=(3, 13))},
        {"platform": dataclasses.replace(BOARD, machine="x86_64")},
        {"distributed": (Distributed(name="numpy", package="python3-numpy"),)},
        {"sees_system": True},
        {"wheels": (dataclasses.replace(a_lock().wheels[0], sha256="ff"),)},
    ],
)
def test_other_content_has_another_key(changes):
    assert a_lock().key != a_lock(**changes).key


def test_lock_is_read_back_as_it_was_written():
    lock = a_lock(distributed=(Distributed(name="numpy", package="python3-numpy", specifier=">1"),))

    assert lock == Lock.from_mapping(lock.to_mapping())


def test_every_requirement_on_the_distributions_packages_counts():
    numpy = Distributed(name="numpy", package="python3-numpy")
    requirements = [
        "numpy>=1.24",
        "NumPy<3",
        "other>=5",
        "numpy>=9; python_version >= '3.12'",
        "numpy>=8; extra == 'all'",
    ]

    (found,) = with_specifiers([numpy], requirements, OLD_BOARD)

    assert {"<3", ">=1.24"} == set(found.specifier.split(","))
