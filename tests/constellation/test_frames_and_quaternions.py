"""Attitude algebra: one convention, scalar last and inertial to body, held by every function."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from madns_runtime.simulations.constellation.orbit.frames import (
    rtn_to_inertial,
    vector_to_inertial,
)
from madns_runtime.simulations.constellation.orbit.quaternions import (
    IDENTITY,
    conjugate,
    from_matrix,
    from_rotation,
    multiply,
    normalised,
    rotate,
    rotate_back,
    rotation_between,
)

numbers = st.floats(-1.0, 1.0)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers)
    .filter(lambda q: sum(x * x for x in q) > 1e-6)
    .map(normalised)
)
vectors = st.tuples(numbers, numbers, numbers)
QUARTER_ABOUT_Z = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))


def to_matrix(q):
    """Return the 3x3 matrix that takes inertial components to body components; *q* of unit length."""
    x, y, z, w = (float(number) for number in q)
    return np.array(
        (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)),
            (2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)),
            (2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)),
        )
    )


def test_a_body_turned_about_z_sees_inertial_x_along_minus_y():
    assert rotate(QUARTER_ABOUT_Z, (1.0, 0.0, 0.0)) == pytest.approx((0.0, -1.0, 0.0), abs=1e-15)
    assert rotate_back(QUARTER_ABOUT_Z, (1.0, 0.0, 0.0)) == pytest.approx(
        (0.0, 1.0, 0.0), abs=1e-15
    )


def test_turning_at_a_body_rate_is_a_product_from_the_right():
    turned = multiply(QUARTER_ABOUT_Z, from_rotation((math.pi / 2.0, 0.0, 0.0)))

    # Body x, along inertial y, stays; body z goes where -body y was: inertial x.
    assert rotate_back(turned, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0), abs=1e-15)
    assert rotate_back(turned, (0.0, 0.0, 1.0)) == pytest.approx((1.0, 0.0, 0.0), abs=1e-15)


@given(quaternions, quaternions, vectors)
def test_matrix_product_and_rotation_agree(p, q, v):
    assert to_matrix(q) @ v == pytest.approx(rotate(q, v), abs=1e-14)
    assert rotate(multiply(p, q), v) == pytest.approx(rotate(q, rotate(p, v)), abs=1e-14)
    assert rotate_back(q, rotate(q, v)) == pytest.approx(v, abs=1e-14)
    assert rotate(conjugate(q), v) == pytest.approx(rotate_back(q, v), abs=1e-14)


@given(quaternions)
def test_a_matrix_gives_its_quaternion_back(q):
    back = from_matrix(to_matrix(q))

    assert back[3] >= 0.0
    assert abs(sum(a * b for a, b in zip(q, back, strict=True))) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_give_their_quaternion_back(axis):
    q = tuple(1.0 if index == axis else 0.0 for index in range(4))
    assert from_matrix(to_matrix(q)) == pytest.approx(q)


@given(quaternions, vectors)
def test_the_rotation_between_two_attitudes_leads_from_one_to_the_other(p, vector):
    q = multiply(p, from_rotation(vector))

    assert rotation_between(p, q) == pytest.approx(vector, abs=1e-14)
    assert rotation_between(p, tuple(-x for x in q)) == pytest.approx(vector, abs=1e-14)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-13, 1e-9, 0.99e-4, 1.01e-4, 3.0])
def test_rotation_vectors_keep_their_digits_at_every_size(angle_rad):
    q = from_rotation((0.0, angle_rad, 0.0))

    assert math.hypot(*q) == pytest.approx(1.0, abs=1e-15)
    assert rotation_between(IDENTITY, q)[1] == pytest.approx(angle_rad, rel=1e-14)


def test_a_quaternion_without_length_is_refused():
    with pytest.raises(ValueError, match="length"):
        normalised((0.0, 0.0, 0.0, 0.0))


def test_radial_along_track_and_normal_are_where_they_belong():
    r, v = (7e6, 0.0, 0.0), (100.0, 0.0, 7500.0)
    matrix = rtn_to_inertial(r, v)

    assert matrix @ (1.0, 0.0, 0.0) == pytest.approx((1.0, 0.0, 0.0))
    assert matrix @ (0.0, 1.0, 0.0) == pytest.approx((0.0, 0.0, 1.0))
    assert matrix @ (0.0, 0.0, 1.0) == pytest.approx((0.0, -1.0, 0.0))
    assert np.linalg.det(matrix) == pytest.approx(1.0)


def test_vectors_of_every_frame_become_inertial():
    r, v = (7e6, 1e6, -2e6), (100.0, 5000.0, 5500.0)
    given_vector = (1.0, 2.0, 3.0)

    assert vector_to_inertial(given_vector, "inertial", r, v) == given_vector
    assert vector_to_inertial(given_vector, "rtn", r, v) == pytest.approx(
        tuple(rtn_to_inertial(r, v) @ given_vector)
    )
    assert vector_to_inertial(given_vector, "body", r, v, QUARTER_ABOUT_Z) == pytest.approx(
        (-2.0, 1.0, 3.0)
    )


def test_frames_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="plane"):
        rtn_to_inertial((7e6, 0.0, 0.0), (1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="point mass"):
        vector_to_inertial((1.0, 0.0, 0.0), "body", (7e6, 0.0, 0.0), (0.0, 7e3, 0.0))
