from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.errors import InputError
from core.lens import Lens, LensSigma, read_lens, require_image_size, write_lens

DRONE = Lens(
    (3840, 2160),
    [[2900.0, 0.0, 1930.0], [0.0, 2895.0, 1070.0], [0.0, 0.0, 1.0]],
    [-0.12, 0.03, 1e-3, -7e-4, -5e-3],
    readout_s=0.02,
    rms_px=0.31,
    sigma=LensSigma(5e-4, 1.2, 1e-3, 2e-3),
)

coefficients = st.tuples(
    st.floats(-0.25, 0.25),
    st.floats(-0.08, 0.08),
    st.floats(-2e-3, 2e-3),
    st.floats(-2e-3, 2e-3),
    st.floats(-0.02, 0.02),
)


def pixels(count: int = 500, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((0, 0), (3840, 2160), (count, 2))


@settings(max_examples=60, deadline=None)
@given(coefficients, st.integers(0, 1000))
def test_undistorting_and_distorting_cancel_to_float_precision(distortion, seed):
    lens = Lens(DRONE.image_size_px, DRONE.camera_matrix, distortion)
    raw = pixels(50, seed)
    und = lens.undistort(raw)
    seen = np.isfinite(und).all(axis=1)
    assert seen.mean() > 0.5
    # Near the radius of the fold a float of the ray is worth more pixels; within it 1e-8 px is what float64 leaves.
    np.testing.assert_allclose(lens.distort(und[seen]), raw[seen], atol=1e-8)


@settings(max_examples=60, deadline=None)
@given(coefficients, st.integers(0, 1000))
def test_every_ray_within_the_valid_radius_comes_back(distortion, seed):
    lens = Lens(DRONE.image_size_px, DRONE.camera_matrix, distortion)
    # Tangential terms move the fold a little off its radius, hence the margin.
    reach = 0.9 * min(lens.valid_radius, 0.9)
    random = np.random.default_rng(seed)
    angle, radius = random.uniform(0, 2 * np.pi, 50), reach * np.sqrt(random.uniform(0, 1, 50))
    rays = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    np.testing.assert_allclose(lens.rays_from_raw(lens.raw_from_rays(rays)), rays, atol=1e-11)


def test_distortion_is_opencvs_own():
    rays = DRONE.rays_from_raw(pixels())
    K, distortion = np.array(DRONE.camera_matrix), np.array(DRONE.distortion)
    projected = cv2.projectPoints(np.c_[rays, np.ones(len(rays))], np.zeros(3), np.zeros(3), K, distortion)[0]
    np.testing.assert_allclose(DRONE.raw_from_rays(rays), projected.reshape(-1, 2), atol=1e-9)


def test_jacobian_is_the_derivative():
    rays, step = DRONE.rays_from_raw(pixels(100)), 1e-5
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        slope = (DRONE.raw_from_rays(rays + shift) - DRONE.raw_from_rays(rays - shift)) / (2 * step)
        np.testing.assert_allclose(DRONE.jacobian_raw_rays(rays)[..., axis], slope, rtol=1e-6, atol=1e-3)


def test_any_leading_shape_is_kept():
    raw = pixels(24).reshape(2, 3, 4, 2)
    assert DRONE.undistort(raw).shape == raw.shape
    assert DRONE.jacobian_raw_rays(DRONE.rays_from_raw(raw)).shape == (2, 3, 4, 2, 2)
    np.testing.assert_array_equal(DRONE.undistort(raw)[1, 2, 3], DRONE.undistort(raw[1, 2, 3]))
    assert DRONE.undistort(np.empty((0, 2))).shape == (0, 2)


def test_beyond_the_fold_there_is_no_answer():
    lens = Lens(DRONE.image_size_px, DRONE.camera_matrix, [-0.3, 0.0, 0.0, 0.0, 0.0])
    assert lens.valid_radius == pytest.approx(np.sqrt(1 / 0.9))
    assert np.isnan(lens.raw_from_rays([2.0, 0.0])).all()
    assert np.isnan(lens.rays_from_raw([[1e5, 1e5], [np.nan, 3.0], [np.inf, 0.0]])).all()
    np.testing.assert_allclose(lens.rays_from_raw([1930.0, 1070.0]), 0.0, atol=1e-15)


def test_an_ideal_lens_changes_nothing():
    lens = Lens.ideal((1920, 1080), 1500.0)
    raw = pixels(10) / 2
    np.testing.assert_allclose(lens.undistort(raw), raw, atol=1e-9)
    assert lens.centre_px.tolist() == [959.5, 539.5]
    assert lens.valid_radius == np.inf


def test_lens_cannot_be_written_to():
    with pytest.raises(ValueError, match="read-only"):
        DRONE.camera_matrix[0, 0] = 1.0


def test_lens_travels_to_other_processes():
    copy = pickle.loads(pickle.dumps(DRONE))
    np.testing.assert_array_equal(copy.undistort(pixels()), DRONE.undistort(pixels()))


def test_file_returns_every_digit(tmp_path):
    write_lens(tmp_path / "linse-ä.yaml", DRONE)
    lens = read_lens(tmp_path / "linse-ä.yaml")
    np.testing.assert_array_equal(lens.camera_matrix, DRONE.camera_matrix)
    np.testing.assert_array_equal(lens.distortion, DRONE.distortion)
    assert (lens.image_size_px, lens.readout_s, lens.rms_px, lens.sigma) == (
        DRONE.image_size_px,
        DRONE.readout_s,
        DRONE.rms_px,
        DRONE.sigma,
    )


GOOD = """%YAML:1.0
---
image_width: 1920
image_height: 1080
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1500., 0., 960., 0., 1500., 540., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ 0.1, -0.05, 0., 0. ]
"""


def test_file_of_opencvs_own_samples_with_four_coefficients(tmp_path):
    (tmp_path / "lens.yaml").write_text(GOOD)
    lens = read_lens(tmp_path / "lens.yaml")
    assert lens.distortion.tolist() == [0.1, -0.05, 0.0, 0.0, 0.0]
    assert lens.sigma == LensSigma()
    assert lens.rms_px is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("image_width: 1920\n", "", "image_width is missing"),
        ("image_width: 1920", "image_width: -3", "image_width is -3; it must be a whole number"),
        ("image_width: 1920", "image_width: wide", "image_width is not a number"),
        ("camera_matrix:", "matrix:", "camera_matrix is missing"),
        ("1500., 0., 960.", ".Nan, 0., 960.", "camera_matrix holds a value that is not finite"),
        ("1500., 0., 960.", "-1500., 0., 960.", "positive fx and fy"),
        ("1500., 0., 960.", "1500., 2., 960.", "skew"),
        ("1500., 0., 960.", "1500., 0., 9600.", "centre far outside"),
        ("cols: 3", "cols: 2", "camera_matrix"),
        ("cols: 4", "cols: 3", "distortion_coefficients"),
        ("cols: 4\n   dt: d", "cols: 4\n   dt: i", "distortion_coefficients has dt: i, which cuts off its decimals"),
        ("distortion_coefficients:", "coefficients:", "distortion_coefficients is missing"),
        (
            "cols: 4\n   dt: d\n   data: [ 0.1, -0.05, 0., 0. ]",
            "cols: 8\n   dt: d\n   data: [ 1., 2., 3., 4., 5., 6., 7., 8. ]",
            "holds 8 numbers, a rational",
        ),
        (
            "cols: 4\n   dt: d\n   data: [ 0.1, -0.05, 0., 0. ]",
            "cols: 2\n   dt: d\n   data: [ 1., 2. ]",
            "holds 2 numbers; it must hold k1 k2 p1 p2",
        ),
        ("1500., 0., 960.", "3.6, 0., 960.", "focal lengths of 3.6 and .*; write them in pixels, not in millimetres"),
        ("image_width: 1920", "readout_s: 20\nimage_width: 1920", "readout_s is 20, but no camera takes 1 s"),
        (
            "image_width: 1920",
            'distortion_model: "equidistant"\nimage_width: 1920',
            "distortion_model is equidistant; calibrate with k1 k2 p1 p2 k3 only",
        ),
        (GOOD, "[1, 2]", "is not an OpenCV FileStorage file"),
        (GOOD, "", "is not an OpenCV FileStorage file"),
        (GOOD, "just words", "is not an OpenCV FileStorage file"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path, old, new, message):
    file = tmp_path / "lens.yaml"
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(InputError, match=message) as refusal:
        read_lens(file)
    assert str(file) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_matrix_of_whole_numbers_is_one(tmp_path):
    (tmp_path / "lens.yaml").write_text(GOOD.replace("dt: d", "dt: i", 1))
    np.testing.assert_array_equal(read_lens(tmp_path / "lens.yaml").focal_px, 1500)


@pytest.mark.parametrize(
    ("matrix", "coefficients"),
    [
        ("[1500, 0, 960, 0, 1500, 540, 0, 0, 1]", "[0.1, -0.05, 0, 0]"),
        ("[[1500, 0, 960], [0, 1500, 540], [0, 0, 1]]", "[0.1, -0.05, 0, 0, 0, 0, 0, 0]"),
        (
            "\n  rows: 3\n  cols: 3\n  data: [1500, 0, 960, 0, 1500, 540, 0, 0, 1]\ndistortion_model: plumb_bob",
            "\n  rows: 1\n  cols: 5\n  data: [0.1, -0.05, 0, 0, 0]",
        ),
    ],
    ids=["lists", "lists in lists, no more coefficients than five", "ROS"],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_what_other_programs_write_is_read(tmp_path, matrix, coefficients, encoding):
    file = tmp_path / "lens.yaml"
    text = (
        "# Größe\nimage_width: 1920\nimage_height: 1080\n"
        f"camera_matrix: {matrix}\ndistortion_coefficients: {coefficients}\n"
    )
    file.write_bytes(text.encode(encoding))
    lens = read_lens(file)
    np.testing.assert_array_equal(lens.camera_matrix, [[1500, 0, 960], [0, 1500, 540], [0, 0, 1]])
    np.testing.assert_array_equal(lens.distortion, [0.1, -0.05, 0, 0, 0])


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="not found; calibrate"):
        read_lens(tmp_path / "none.yaml")
    (tmp_path / "lens.yaml").write_bytes(b"\x89PNG\r\n\x1a\n\x00")
    with pytest.raises(InputError, match="cannot be read as text"):
        read_lens(tmp_path / "lens.yaml")


def test_lens_of_another_image_size_is_refused():
    require_image_size(DRONE, width=3840, height=2160, lens_file="lens.yaml", video_file="video.mp4")
    with pytest.raises(InputError, match=r"lens\.yaml.*3840 x 2160.*video\.mp4.*1920 x 1080"):
        require_image_size(DRONE, width=1920, height=1080, lens_file="lens.yaml", video_file="video.mp4")
    with pytest.raises(InputError, match="upright"):
        require_image_size(DRONE, width=2160, height=3840, lens_file="lens.yaml", video_file="video.mp4")
