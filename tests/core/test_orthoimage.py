from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from core.camera import Pose, plan_homography
from core.cloud import Cloud, make_cloud
from core.coordinates import OrthoGrid, apply_homography
from core.errors import InputError
from core.ground_plane import fit_ground_plane
from core.lens import Lens
from core.orthoimage import (
    MAX_FILL_M,
    make_orthoimage,
    origin_of,
    read_geotiff,
    read_grid,
    read_origin,
    rectify_frame,
    write_geotiff,
    write_origin,
)
from core.project import Orthoimage as Settings

ORIGIN = np.array([651_234.0, 3_872_345.0, 113.0])
EXTENT = (ORIGIN[0] - 3.0, ORIGIN[1] - 2.0, ORIGIN[0] + 3.0, ORIGIN[1] + 2.0)
SETTINGS = Settings(pixel_size_m=0.02, extent_m=EXTENT)


def lattice(spacing_m: float = 0.02, half_m: tuple[float, float] = (4.0, 3.0)) -> np.ndarray:
    """Level ground with one point amid each pixel of the orthoimage, (N, 3) about the origin."""
    x, y = (np.arange(-half, half, spacing_m) + spacing_m / 2 for half in half_m)
    x, y = np.meshgrid(x, y)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def coloured(points: np.ndarray) -> Cloud:
    """Red grows to the east, green to the north, blue tells the roof."""
    rgb = np.column_stack([20 * (points[:, 0] + 5), 20 * (points[:, 1] + 5), 200 * (points[:, 2] > 5)])
    return make_cloud(points + ORIGIN, rgb=rgb.astype(np.uint8))


def ortho_of(points: np.ndarray, settings: Settings = SETTINGS):
    cloud = coloured(points)
    return make_orthoimage(cloud, fit_ground_plane(cloud, ground_z_m=ORIGIN[2]), settings)


def test_every_pixel_shows_what_lies_there_north_up():
    ortho = ortho_of(lattice())
    assert (ortho.grid.width, ortho.grid.height) == (300, 200)
    assert ortho.measured_share == 1.0
    u, v = np.meshgrid(np.arange(300), np.arange(200))
    world = apply_homography(ortho.grid.H_world_ortho, np.stack([u, v], axis=-1)) - ORIGIN[:2]
    # Colours were cut to whole numbers: within one.
    np.testing.assert_allclose(ortho.rgb[..., 0], 20 * (world[..., 0] + 5), atol=1.01)
    np.testing.assert_allclose(ortho.rgb[..., 1], 20 * (world[..., 1] + 5), atol=1.01)


def test_small_gaps_are_filled_and_holes_stay_empty():
    points = lattice(0.06)
    hole = (np.abs(points[:, 0] - 1.0) < 0.5) & (np.abs(points[:, 1]) < 0.5)
    ortho = ortho_of(points[~hole])
    world = apply_homography(ortho.grid.H_world_ortho, np.stack(np.meshgrid(np.arange(300), np.arange(200)), axis=-1))
    x, y = np.moveaxis(world - ORIGIN[:2], -1, 0)
    assert ortho.spacing_m == pytest.approx(0.06, abs=0.005)
    # Beside the hole the spacing is taken from what surrounds it, so the fill ends within twice as much.
    inside_hole = np.maximum(np.abs(x - 1.0), np.abs(y)) < 0.5 - 3 * 0.06
    assert ortho.empty[inside_hole].all()
    outside_hole = np.maximum(np.abs(x - 1.0), np.abs(y)) > 0.55
    assert not ortho.empty[outside_hole].any()
    assert (ortho.rgb[ortho.empty] == 0).all()
    # Filled colours lie between those of their neighbours: 20 grey levels a metre, neighbours within 6 cm.
    np.testing.assert_allclose(ortho.rgb[..., 0][outside_hole], 20 * (x[outside_hole] + 5), atol=3)
    assert ortho.measured_share + ortho.filled_share + ortho.empty.mean() == pytest.approx(1.0)


def test_a_stray_point_fills_nothing_and_sparse_ground_is_filled_to_the_limit_only():
    dense = lattice(0.05)
    stray = np.array([[-2.49, 0.01, 0.0]])
    ortho = ortho_of(np.concatenate([dense[dense[:, 0] > 0], stray]))
    assert np.count_nonzero(~ortho.empty[:, :60]) == 1
    sparse = ortho_of(lattice(0.4))
    measured = np.ones((200, 300), np.uint8)
    # Points lie 0.2 m, ten pixels, from the edges and then every 0.4 m.
    measured[10::20, 10::20] = 0
    distance = cv2.distanceTransform(measured, cv2.DIST_L2, 5) * 0.02
    assert sparse.fill_limit_m == MAX_FILL_M
    assert 0.03 < sparse.empty.mean() < 0.6
    assert distance[~sparse.empty].max() < MAX_FILL_M + 0.03


def test_the_roof_hides_the_ground_below_even_between_its_points():
    roof = lattice(0.05)
    roof = roof[(np.abs(roof[:, 0]) < 1.5) & (np.abs(roof[:, 1]) < 1.0)] + [0.0, 0.0, 18.3]
    ortho = ortho_of(np.concatenate([lattice(), roof]))
    roof_pixels = ortho.rgb[60:140, 85:215, 2]
    assert (roof_pixels > 150).all()
    assert (ortho.rgb[:45, :, 2] == 0).all()


def test_without_colour_it_shows_intensity_stretched_and_without_both_height():
    points = lattice()
    plane = fit_ground_plane(coloured(points), ground_z_m=ORIGIN[2])
    strength = 3000 + 10 * points[:, 0]
    grey = make_orthoimage(make_cloud(points + ORIGIN, intensity=strength), plane, SETTINGS).rgb
    assert np.ptp(grey[..., 0].astype(int)) > 180
    assert (grey[..., 0] == grey[..., 2]).all()
    hilly = points + np.column_stack([0 * points[:, :2], 0.1 * np.sin(points[:, 0])])
    assert np.ptp(make_orthoimage(make_cloud(hilly + ORIGIN), plane, SETTINGS).rgb.astype(int)) > 180


def test_strips_leave_no_seams(monkeypatch):
    random = np.random.default_rng(1)
    points = np.column_stack([random.uniform((-4, -3), (4, 3), (15_000, 2)), np.zeros(15_000)])
    whole = ortho_of(points)
    monkeypatch.setattr("core.orthoimage._STRIP_PIXELS", 300 * 70)
    strips = ortho_of(points)
    np.testing.assert_array_equal(strips.empty, whole.empty)
    np.testing.assert_array_equal(strips.rgb, whole.rgb)


def test_default_extent_is_where_the_ground_is():
    random = np.random.default_rng(2)
    far = np.column_stack([random.uniform(200, 300, (5, 2)), np.zeros(5)])
    ortho = ortho_of(np.concatenate([lattice(0.05), far]), Settings(pixel_size_m=0.05))
    np.testing.assert_allclose(
        np.array(ortho.grid.extent_m) - np.tile(ORIGIN[:2], 2), [-4.0, -3.0, 4.0, 3.0], atol=1.01
    )


def test_default_extent_beyond_the_limit_is_cut_and_said_so(monkeypatch):
    monkeypatch.setattr("core.orthoimage.MAX_PIXELS", 10_000)
    ortho = ortho_of(lattice(0.05), Settings(pixel_size_m=0.05))
    assert ortho.grid.width * ortho.grid.height <= 10_000
    assert "set orthoimage.extent_m or a larger pixel_size_m" in ortho.notes[0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (Settings(pixel_size_m=0.0001), r"orthoimage\.pixel_size_m: 0\.0001 is no size .* choose one of 0\.001 to 1\."),
        (Settings(pixel_size_m=10.0), r"orthoimage\.pixel_size_m: 10 is no size"),
        (
            Settings(pixel_size_m=0.01, extent_m=(0.0, 0.0, 600.0, 400.0)),
            r"60000 x 40000 pixels are too many.*0\.064 or",
        ),
        (Settings(pixel_size_m=1.0, extent_m=EXTENT), r"orthoimage: 6 x 4 pixels are too few"),
        (
            Settings(pixel_size_m=0.02, extent_m=(0.0, 0.0, 6.0, 4.0)),
            r"orthoimage\.extent_m: holds no points.*correct it",
        ),
    ],
)
def test_absurd_rasters_are_refused(settings, message):
    with pytest.raises(InputError, match=f"^project.json: .*{message}"):
        ortho_of(lattice(0.1), settings)


def test_geotiff_keeps_pixels_and_places(tmp_path):
    points = lattice(0.06)
    ortho = ortho_of(points[np.abs(points[:, 0]) > 0.5])
    write_geotiff(tmp_path / "o.tif", ortho)
    grid, rgba = read_geotiff(tmp_path / "o.tif")
    assert grid == ortho.grid == read_grid(tmp_path / "o.tif")
    np.testing.assert_array_equal(rgba[..., :3], ortho.rgb)
    np.testing.assert_array_equal(rgba[..., 3] == 0, ortho.empty)
    with tifffile.TiffFile(tmp_path / "o.tif") as file:
        keys = file.geotiff_metadata
    assert keys["ModelPixelScale"] == [0.02, 0.02, 0.0]
    assert keys["ModelTiepoint"] == [0, 0, 0, EXTENT[0], EXTENT[3], 0]
    assert keys["GTRasterTypeGeoKey"] == 1


def test_a_file_that_is_no_orthoimage_is_refused(tmp_path):
    with pytest.raises(InputError, match="make the orthoimage first"):
        read_grid(tmp_path / "none.tif")
    (tmp_path / "words.tif").write_text("words")
    tifffile.imwrite(tmp_path / "plain.tif", np.zeros((20, 20, 4), np.uint8), photometric="rgb")
    for name in ("words.tif", "plain.tif"):
        with pytest.raises(InputError, match="is no orthoimage of this program"):
            read_geotiff(tmp_path / name)


def test_a_rectified_frame_lies_where_its_homography_says():
    lens = Lens((960, 640), [[820.0, 0, 472.0], [0, 815.0, 326.0], [0, 0, 1]], [-0.18, 0.06, 8e-4, -5e-4, 0.0])
    grid = OrthoGrid(100.0, 200.0, 0.02, 500, 400)
    H_plan_und = np.array([[0.019, 0.0008, 95.0], [0.0008, -0.019, 202.0], [0.0, 0.0, 1.0]])
    u, v = np.meshgrid(np.arange(960.0), np.arange(640.0))
    # A frame whose grey level is the plan x or y of its pixels: 10 levels a metre.
    plan = apply_homography(H_plan_und, lens.undistort(np.stack([u, v], axis=-1)))
    frame = np.clip(np.stack([10 * (plan[..., 0] - 92), 10 * (plan[..., 1] - 186), 0 * u + 7], axis=-1), 0, 255)
    rectified, outside = rectify_frame(np.round(frame).astype(np.uint8), lens, H_plan_und, grid)
    world = apply_homography(grid.H_world_ortho, np.stack(np.meshgrid(np.arange(500), np.arange(400)), axis=-1))
    assert 0.3 < outside.mean() + (~outside).mean() == 1.0
    inside = ~outside
    assert inside.mean() > 0.5
    np.testing.assert_allclose(rectified[inside][:, 0], 10 * (world[inside][:, 0] - 92), atol=1.2)
    np.testing.assert_allclose(rectified[inside][:, 1], 10 * (world[inside][:, 1] - 186), atol=1.2)
    assert (rectified[outside] == 0).all()
    grey, _ = rectify_frame(np.round(frame[..., 0]).astype(np.uint8), lens, H_plan_und, grid)
    np.testing.assert_array_equal(grey, rectified[..., 0])


def test_nothing_is_drawn_behind_the_camera():
    # 15 degrees below the horizon, 40 m up, looking north from the origin; the sky is white.
    lens = Lens.ideal((960, 540), 600.0)
    down = np.radians(15.0)
    ahead, right = np.array([0.0, np.cos(down), -np.sin(down)]), np.array([1.0, 0.0, 0.0])
    pose = Pose(np.stack([right, np.cross(ahead, right), ahead]), np.array([0.0, 0.0, 40.0]))
    H_plan_und = plan_homography(pose) @ np.linalg.inv(lens.camera_matrix)
    frame = np.full((540, 960), 100, np.uint8)
    frame[: int(269.5 - 600 * np.tan(down))] = 255
    # So many rows that they are drawn in several strips, some of them wholly behind the camera.
    rectified, outside = rectify_frame(frame, lens, H_plan_und, OrthoGrid(-300.0, 600.0, 0.5, 1200, 2400))
    assert outside[1200:].all()
    assert not (rectified == 255).any()
    assert (~outside[:1150]).mean() > 0.3


def test_a_frame_shown_smaller_does_not_alias():
    lens = Lens.ideal((800, 800), 800.0)
    stripes = np.tile(np.array([0, 255], np.uint8), (800, 400))
    H_plan_und = np.array([[0.01, 0.0, 0.0], [0.0, -0.01, 8.0], [0.0, 0.0, 1.0]])
    small, outside = rectify_frame(stripes, lens, H_plan_und, OrthoGrid(0.0, 8.0, 0.05, 160, 160))
    assert np.abs(small[~outside].astype(int) - 127).max() < 20


def test_what_an_orthoimage_was_made_from_is_known_while_it_is_there(tmp_path: Path) -> None:
    file = tmp_path / "orthoimage.tif"
    origin = origin_of("cloud", SETTINGS)
    assert origin not in (origin_of("other", SETTINGS), origin_of("cloud", Settings(pixel_size_m=0.03)))
    write_origin(file, origin)
    assert read_origin(file) is None
    file.write_bytes(b"")
    assert read_origin(file) == origin
