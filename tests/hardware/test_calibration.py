"""Calibration against synthetic data with known numbers: what is found, how sure it is, and what is not observable."""

import math

import numpy as np
import pytest

from madns_runtime.hardware.calibration.rest import rest_bias
from madns_runtime.hardware.calibration.result import ChannelSamples
from madns_runtime.hardware.calibration.strength import calibrate_positions, calibrate_turned

G = 9.80665
FIELD_T = 48e-6
SCALE = np.array([1.03, 0.95, 1.10])
BIAS = np.array([0.2, -0.35, 0.5])
SOFT_IRON = np.array([[1.05, 0.04, -0.02], [0.04, 0.93, 0.06], [-0.02, 0.06, 1.1]])
"""Symmetric: what strength alone can tell."""


def samples(values, unit, *, hz=20.0, limits=None):
    return ChannelSamples(
        name="channel",
        unit=unit,
        t_s=np.arange(len(values)) / hz,
        values=np.asarray(values, dtype=float),
        limits=limits,
    )


def directions(count, seed=1):
    vectors = np.random.default_rng(seed).standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def position(up, *, noise=0.02, seed=0, scale=SCALE, bias=BIAS, unit_m_s2=1.0):
    """Return what an accelerometer with these errors gives at rest, in its unit."""
    true = G / unit_m_s2 * np.asarray(up, dtype=float) / np.linalg.norm(up)
    random = np.random.default_rng(seed)
    return (true + bias) / scale + noise * random.standard_normal((200, 3))


SIX = [np.array(sign) * axis for axis in np.eye(3) for sign in (1.0, -1.0)]


def six(**errors):
    return [samples(position(up, seed=n, **errors), "m/s2") for n, up in enumerate(SIX)]


def turned(*, noise=0.2e-6, count=600, matrix=None, bias_t=(30e-6, -12e-6, 7e-6), ways=None):
    """Return what a magnetometer gives while it is turned to all sides, T."""
    true = FIELD_T * (directions(count) if ways is None else ways)
    raw = true if matrix is None else true @ np.linalg.inv(matrix).T
    return raw + np.array(bias_t) + noise * np.random.default_rng(3).standard_normal((len(raw), 3))


def within(estimate, truth, sigmas=4.0):
    """Tell whether numbers are as near to truth as their own uncertainty says."""
    wrong = np.abs(np.array(estimate.values) - truth)
    return bool(np.all(wrong < sigmas * np.array(estimate.sigmas)))


# A gyroscope at rest


def test_the_bias_of_a_gyroscope_is_its_mean_at_rest():
    truth = np.array([0.8, -0.3, 0.05])
    noisy = truth + 0.1 * np.random.default_rng(0).standard_normal((400, 3))

    found = rest_bias(samples(noisy, "deg/s"))

    assert found.is_usable and found.remarks == ()
    assert within(found.bias, truth)
    assert max(found.bias.sigmas) < 0.02
    assert found.settings() == {"bias": [float(f"{value:.7g}") for value in noisy.mean(axis=0)]}


def test_uncertainty_knows_of_a_bias_that_wanders():
    walk = np.cumsum(0.004 * np.random.default_rng(5).standard_normal((800, 3)), axis=0)
    noisy = walk + 0.05 * np.random.default_rng(6).standard_normal((800, 3))

    found = rest_bias(samples(noisy, "deg/s"))

    white = noisy.std(axis=0) / math.sqrt(800)
    assert np.all(np.array(found.bias.sigmas) >= white)
    assert max(np.array(found.bias.sigmas) / white) > 2.0


def test_a_gyroscope_that_was_moved_is_told():
    noisy = 0.1 * np.random.default_rng(0).standard_normal((400, 3))
    noisy[150:200, 1] += 5.0

    found = rest_bias(samples(noisy, "deg/s"))

    assert not found.is_usable
    assert found.settings() == {}
    assert "it moved while it should rest: the mean of y" in found.remarks[0]


def test_too_few_samples_are_told():
    found = rest_bias(samples(np.zeros((5, 3)), "rad/s"))

    assert not found.is_usable
    assert "expected at least 20 samples, got 5" in found.remarks[0]


def test_a_gyroscope_that_never_changes_is_remarked():
    found = rest_bias(samples(np.full((100, 3), 0.01), "rad/s"))

    assert found.is_usable
    assert "not one digit changed: coarse, or frozen" in found.remarks[0]


# An accelerometer in six positions


def test_six_positions_tell_scale_and_bias_of_an_accelerometer():
    found = calibrate_positions(six())

    assert found.is_usable, found.remarks
    assert within(found.scale, SCALE)
    assert within(found.bias, BIAS)
    assert max(found.scale.sigmas) < 1e-3
    assert max(found.bias.sigmas) < 0.01
    assert found.strength == pytest.approx(G)


def test_positions_need_not_be_exact_and_more_than_six_are_used():
    random = np.random.default_rng(8)
    ways = [up + 0.15 * random.standard_normal(3) for up in SIX] + list(directions(6))
    positions = [samples(position(up, seed=n), "m/s^2") for n, up in enumerate(ways)]

    found = calibrate_positions(positions)

    assert found.is_usable, found.remarks
    assert within(found.scale, SCALE)
    assert within(found.bias, BIAS)


def test_gravity_is_known_in_the_channels_unit():
    bias_g = BIAS / G
    positions = [
        samples(position(up, seed=n, unit_m_s2=G, bias=bias_g, noise=1e-3), "g")
        for n, up in enumerate(SIX)
    ]

    found = calibrate_positions(positions)

    assert found.strength == pytest.approx(1.0)
    assert within(found.bias, bias_g)


@pytest.mark.parametrize("missing", [4, 5])
def test_an_axis_that_did_not_stand_upright_both_ways_is_named(missing):
    found = calibrate_positions([each for n, each in enumerate(six()) if n != missing])

    assert not found.is_usable
    assert [text for text in found.remarks if text.startswith("z did not stand upright")]
    assert not [text for text in found.remarks if text.startswith(("x", "y"))]


@pytest.mark.parametrize("count", [1, 6])
def test_one_position_alone_is_none(count):
    positions = [samples(position((0, 0, 1), seed=n), "m/s2") for n in range(count)]

    found = calibrate_positions(positions)

    assert [text[:1] for text in found.remarks] == ["x", "y", "z"]
    assert not found.is_usable
    assert found.settings() == {}


def test_a_position_in_which_it_moved_is_named():
    positions = six()
    positions[2].values[:60] += 1.0

    found = calibrate_positions(positions)

    assert not found.is_usable
    assert found.remarks[0].startswith("position 3: it moved while it should rest")


# A magnetometer that is turned


def test_turning_tells_hard_iron_and_scale_of_a_magnetometer():
    matrix = np.diag(SCALE)

    found = calibrate_turned(samples(turned(matrix=matrix), "T"), FIELD_T)

    assert found.is_usable, found.remarks
    assert found.alignment is None
    assert within(found.scale, SCALE)
    assert within(found.bias, SCALE * np.array([30e-6, -12e-6, 7e-6]))
    assert max(found.scale.sigmas) < 1e-3


def test_soft_iron_is_found_where_it_is_more_than_noise():
    found = calibrate_turned(samples(turned(matrix=SOFT_IRON), "T"), FIELD_T)

    assert found.is_usable, found.remarks
    assert found.scale is None
    assert np.abs(np.array(found.alignment) - SOFT_IRON).max() < 4 * np.max(found.alignment_sigmas)
    assert within(found.bias, np.array([30e-6, -12e-6, 7e-6]))
    assert set(found.settings()) == {"alignment", "bias"}


def test_corrected_readings_have_the_fields_strength():
    raw = turned(matrix=SOFT_IRON, noise=0.0)

    settings = calibrate_turned(samples(raw * 1e6, "uT"), FIELD_T).settings()

    true = (raw * 1e6 - settings["bias"]) @ np.array(settings["alignment"]).T
    assert np.linalg.norm(true, axis=1) == pytest.approx(48.0, rel=1e-6)


def test_a_compass_that_is_twenty_times_too_large_is_found():
    found = calibrate_turned(samples(20.0 * turned(), "T"), FIELD_T)

    assert found.is_usable, found.remarks
    assert within(found.scale, 0.05)


def test_without_the_fields_strength_axes_are_made_equal_and_it_is_said():
    found = calibrate_turned(samples(turned(matrix=np.diag(SCALE)), "T"), None)

    assert found.is_usable
    assert found.strength is None
    ratio = np.array(found.scale.values) / SCALE
    assert ratio == pytest.approx(np.full(3, ratio[0]), rel=3e-3)
    assert np.prod(found.scale.values) == pytest.approx(1.0)
    assert "strength is unknown" in found.remarks[-1]


def test_turning_about_one_axis_alone_is_told_with_its_axis():
    angles = np.linspace(0.0, 20.0, 400)
    ways = np.column_stack([0.8 * np.cos(angles), 0.8 * np.sin(angles), np.full(400, 0.6)])

    found = calibrate_turned(samples(turned(ways=ways), "T"), FIELD_T)

    assert not found.is_usable
    assert "turned about one axis, about z" in found.remarks[0]


def test_an_axis_that_saw_too_little_of_the_field_is_named():
    ways = directions(3000)
    ways = ways[ways[:, 2] > 0.0]

    found = calibrate_turned(samples(turned(ways=ways), "T"), FIELD_T)

    assert not found.is_usable
    assert [text for text in found.remarks if text.startswith("z: it saw")]


def test_clipped_values_are_told_by_the_channels_limits():
    raw = np.clip(turned(bias_t=(0.0, 0.0, 0.0)), -40e-6, 40e-6)

    found = calibrate_turned(samples(raw, "T", limits=(-40e-6, 40e-6)), FIELD_T)

    assert not found.is_usable
    assert "clipped" in found.remarks[0] and "at a limit of the channel" in found.remarks[0]


def test_clipped_values_show_without_limits_too():
    raw = np.clip(turned(), None, 60e-6)

    found = calibrate_turned(samples(raw, "T"), FIELD_T)

    assert not found.is_usable
    assert "x: clipped" in found.remarks[0] and "none is beyond" in found.remarks[0]


def test_coarse_digits_are_no_clipping():
    raw = np.round(turned(noise=0.0) / 1e-6) * 1e-6

    found = calibrate_turned(samples(raw, "T"), FIELD_T)

    assert found.is_usable, found.remarks


def test_iron_that_comes_and_goes_is_told():
    raw = turned()
    raw[::3] += np.array([25e-6, 0.0, 0.0])

    found = calibrate_turned(samples(raw, "T"), FIELD_T)

    assert not found.is_usable
    assert any("iron or currents nearby" in text for text in found.remarks)


def test_noise_alone_is_no_calibration():
    raw = 1e-6 * np.random.default_rng(0).standard_normal((500, 3))

    found = calibrate_turned(samples(raw, "T"), FIELD_T)

    assert not found.is_usable


def test_stated_uncertainty_is_that_of_repetition():
    truth = np.array([30e-6, -12e-6, 7e-6])
    random = np.random.default_rng(11)
    found, said = [], []
    for _ in range(60):
        raw = FIELD_T * directions(150, seed=int(random.integers(1e9))) + truth
        raw = raw + 0.5e-6 * random.standard_normal(raw.shape)
        result = calibrate_turned(samples(raw, "T"), FIELD_T)
        found.append(result.scale.values)
        said.append(result.scale.sigmas)

    spread = np.std(found, axis=0)
    assert np.mean(said, axis=0) == pytest.approx(spread, rel=0.35)
