from __future__ import annotations

import json
from functools import lru_cache

import av
import cv2
import numpy as np
import pytest

from core.errors import Cancelled, InputError
from core.lens import Lens, read_lens, write_lens
from core.lens_calibration import calibrate, calibrate_images, images_of
from core.progress import CancelToken
from tests.packets import shown_by

BOARD, SQUARE_M = (9, 6), 0.025
TRUE = Lens((720, 480), [[615.0, 0, 354.0], [0, 611.0, 244.0], [0, 0, 1]], [-0.18, 0.06, 8e-4, -5e-4, 0.0])
# Turn about x and y in radians, distance in metres, middle of the board in the image in pixels.
POSES = [
    (0.0, 0.0, 0.35, (360, 240)),
    (0.5, 0.1, 0.32, (225, 165)),
    (-0.5, 0.2, 0.33, (495, 172)),
    (0.2, 0.55, 0.34, (225, 322)),
    (0.1, -0.55, 0.34, (510, 322)),
    (-0.4, -0.4, 0.30, (360, 225)),
    (0.4, 0.4, 0.45, (150, 120)),
    (0.45, -0.4, 0.45, (570, 120)),
    (-0.4, 0.45, 0.45, (150, 367)),
    (-0.45, -0.35, 0.45, (570, 360)),
]


def photograph(pose, *, lens: Lens = TRUE, noise: float = 2.0, blur_px: float = 0.7, seed: int = 0) -> np.ndarray:
    """Look up every pixel once on the board; edges are as wide as a pixel's footprint on it."""
    turn_x, turn_y, distance_m, middle_px = pose
    R = cv2.Rodrigues(np.array([turn_x, turn_y, 0.05]))[0]
    middle = np.array([(BOARD[0] - 1) / 2 * SQUARE_M, (BOARD[1] - 1) / 2 * SQUARE_M, 0.0])
    t = distance_m * np.append(lens.rays_from_raw(np.array(middle_px, float)), 1.0) - R @ middle
    width, height = lens.image_size_px
    rays = lens.rays_from_raw(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float))
    H = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t]))
    places = np.concatenate([rays, np.ones((height, width, 1))], axis=-1) @ H.T
    x, y = (places[..., axis] / places[..., 2] / SQUARE_M for axis in range(2))

    def wave(along: np.ndarray) -> np.ndarray:
        footprint = np.hypot(*np.gradient(along)) + 1e-9
        edge = np.abs(along - np.round(along))
        sign = np.where(np.floor(along) % 2 == 0, 1.0, -1.0)
        return sign * np.clip(2 * edge / footprint, 0, 1)

    on_board = (x > -1) & (x < BOARD[0]) & (y > -1) & (y < BOARD[1])
    image = np.where(on_board, 128 + 90 * wave(x) * wave(y), 225.0)
    image = cv2.GaussianBlur(image, (0, 0), blur_px) + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


@lru_cache
def photographs() -> tuple[tuple[str, np.ndarray], ...]:
    return tuple((f"view{i}.png", photograph(pose, seed=i)) for i, pose in enumerate(POSES))


@lru_cache
def calibration():
    return calibrate_images(photographs(), BOARD, SQUARE_M)


def test_the_lens_is_found_within_its_own_uncertainty():
    found = calibration()
    assert [view.left_out for view in found.views] == [""] * len(POSES)
    # Corners in this noise are good to a few hundredths of a pixel.
    assert found.lens.rms_px < 0.1
    K, true = found.lens.camera_matrix, TRUE.camera_matrix
    errors = np.array([K[0, 0] - true[0, 0], K[1, 1] - true[1, 1], K[0, 2] - true[0, 2], K[1, 2] - true[1, 2]])
    assert (np.abs(errors) < 5 * found.deviations[:4] + 0.05).all()
    seen = np.stack(np.meshgrid(np.linspace(110, 600, 9), np.linspace(90, 390, 7)), axis=-1)
    off_px = 615 * (found.lens.rays_from_raw(seen) - TRUE.rays_from_raw(seen)).reshape(-1, 2)
    # A shift common to all is a turn of the camera; what counts is the shape that remains.
    np.testing.assert_allclose(off_px - off_px.mean(axis=0), 0.0, atol=0.2)


def test_report_tells_all_in_words_and_in_json():
    found = calibration()
    facts = json.loads(json.dumps(found.facts()))
    assert len(facts["views"]) == len(POSES)
    assert np.array(facts["views"][0]["corners_px"]).shape == (54, 2)
    assert np.sum(facts["coverage_grid"]) == 54 * len(POSES)
    assert 0.5 < found.covered_share <= 1.0
    assert "10 of 10 views used, 720 x 480" in found.report()
    assert "view3.png: RMS" in found.report()
    assert found.lens.sigma.focal_relative >= 2e-4


def test_the_lens_survives_its_file(tmp_path):
    write_lens(tmp_path / "lens.yaml", calibration().lens)
    lens = read_lens(tmp_path / "lens.yaml")
    assert lens.sigma == calibration().lens.sigma
    np.testing.assert_array_equal(lens.distortion, calibration().lens.distortion)


def test_bad_pictures_are_named_and_left_out():
    grey = np.full((480, 720), 128, np.uint8)
    blurred = photograph((0.3, 0.3, 0.35, (360, 240)), blur_px=7.0)
    bent = photographs()[5][1].copy()
    # A board bent by the wind: its upper half shifted by three pixels.
    bent[:225] = np.roll(bent[:225], 3, axis=1)
    bad = (("grey.png", grey), ("blurred.png", blurred), ("bent.png", bent))
    found = calibrate_images([*photographs(), *bad], BOARD, SQUARE_M)
    reasons = {view.name: view.left_out for view in found.views if view.left_out}
    assert set(reasons) == {"grey.png", "blurred.png", "bent.png"}
    assert reasons["grey.png"].startswith("no board of 9 x 6")
    assert reasons["blurred.png"].startswith("blurred, edges rise over")
    assert reasons["bent.png"].startswith("outlier, RMS")
    assert found.lens.focal_px == pytest.approx(calibration().lens.focal_px, rel=1e-3)


def test_a_picture_given_twice_counts_once():
    copies = [(f"copy of {name}", image) for name, image in photographs()[:3]]
    found = calibrate_images([*photographs(), *copies], BOARD, SQUARE_M)
    assert [view.left_out for view in found.views[-3:]] == [f"the same as {name}" for name, _ in photographs()[:3]]
    np.testing.assert_allclose(found.deviations, calibration().deviations, rtol=1e-4)


def test_few_frontal_views_are_warned_of():
    frontal = [
        (f"f{i}", photograph((0.02 * i, 0.03 * (i % 3), 0.4 + 0.02 * i, (320 + 20 * i, 240)), seed=i)) for i in range(4)
    ]
    warnings = " ".join(calibrate_images(frontal, BOARD, SQUARE_M).warnings)
    assert "only 4 views are used" in warnings
    assert "hold the board near its edges" in warnings
    assert "tilted by more than 12 degrees" in warnings


def test_mistakes_get_sentences(tmp_path):
    with pytest.raises(InputError, match=r"only 2 of 2 pictures can be used, 4 are needed"):
        calibrate_images(photographs()[:2], BOARD, SQUARE_M)
    with pytest.raises(InputError, match=r"view0\.png: no board of 8 x 6"):
        calibrate_images(photographs()[:1], (8, 6), SQUARE_M)
    with pytest.raises(InputError, match="no pictures"):
        calibrate_images([], BOARD, SQUARE_M)
    with pytest.raises(InputError, match="cannot tell a lens"):
        calibrate_images(photographs(), (2, 6), SQUARE_M)
    small = ("small.png", np.zeros((240, 360), np.uint8))
    with pytest.raises(InputError, match=r"small\.png: has 360 x 240 pixels, the pictures before it 720 x 480"):
        calibrate_images([photographs()[0], small], BOARD, SQUARE_M)
    with pytest.raises(InputError, match="not found"):
        calibrate([tmp_path / "none.jpg"], board=BOARD, square_m=SQUARE_M)
    with pytest.raises(InputError, match="is a folder without pictures"):
        calibrate([tmp_path], board=BOARD, square_m=SQUARE_M)
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"broken\.jpg: is no picture"):
        calibrate([tmp_path / "broken.jpg"], board=BOARD, square_m=SQUARE_M)


def test_files_are_read_and_can_be_stopped(tmp_path):
    files = []
    for name, image in photographs():
        files.append(tmp_path / name)
        cv2.imwrite(str(files[-1]), image)
    told = []
    found = calibrate(
        files, board=BOARD, square_m=SQUARE_M, progress=lambda stage, done, total: told.append((done, total))
    )
    # The bundle sums in parallel, in an order of its own: the last digits differ.
    np.testing.assert_allclose(found.lens.camera_matrix, calibration().lens.camera_matrix, rtol=1e-6)
    assert told[-1] == (10, 10)
    (tmp_path / "notes.txt").write_text("taken indoors")
    assert [name for name, _ in images_of([tmp_path])] == sorted(file.name for file in files)
    cancel = CancelToken()
    cancel.cancel()
    with pytest.raises(Cancelled):
        calibrate(files, board=BOARD, square_m=SQUARE_M, cancel=cancel)


def test_a_video_gives_its_sharp_frames(tmp_path):
    file = tmp_path / "board.mp4"
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 720, 480, "yuv420p"
        for _, image in photographs()[:6]:
            for number in range(5):
                shown = image if number == 2 else cv2.GaussianBlur(image, (0, 0), 4.0)
                frame = av.VideoFrame.from_ndarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2RGB), format="rgb24")
                container.mux(stream.encode(frame))
        container.mux(stream.encode())
    found = calibrate([file], board=BOARD, square_m=SQUARE_M)
    assert [view.name for view in found.views] == [f"board.mp4 frame {5 * i + 2}" for i in range(6)]
    assert found.lens.focal_px == pytest.approx(TRUE.focal_px, rel=0.01)
    shown_by(file, (-1, 0, 0, 1))
    with pytest.raises(InputError, match=r"board\.mp4: says that it is to be shown mirrored"):
        calibrate([file], board=BOARD, square_m=SQUARE_M)
