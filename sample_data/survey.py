"""What surveyors and the engineer bring beside the video, with the errors they make; and the truth they never see."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
from numpy.typing import NDArray

from core.project import (
    Band,
    Correspondence,
    GpsInput,
    Inputs,
    Intervals,
    Lines,
    Orthoimage,
    Point,
    Project,
    Target,
    write_project,
)
from sample_data.exposure import Camera, shadow_outline
from sample_data.scene import Body, Measured, Plate, RoofLines, Scene, place
from sample_data.textures import blurred, look_up, sample

Floats = NDArray[np.float64]

_REFERENCE_FRAME = 0
_BOARD_CORNERS = (9, 6)
_BOARD_SQUARE_M = 0.025
_BACKDROP = np.float32(95)
_GPS_HZ = 10.0
_GPS_BASELINE_M = (51.84, -3.27)
"""From the reference station to the antenna at rest."""


def write_survey(scene: Scene, folder: Path) -> None:
    """Write `site.laz`, `lens.yaml`, `gps.csv`, checkerboards, `project.json` and the truth into a folder."""
    camera = Camera(scene)
    write_cloud(scene, folder / "site.laz")
    write_lens_file(scene, folder / "lens.yaml")
    write_gps(scene, folder / "gps.csv")
    write_checkerboards(scene, folder / "checkerboards")
    write_project(folder, finished_project(scene, camera))
    write_truth(scene, folder)


# --- LiDAR ------------------------------------------------------------------------------------------------------


def write_cloud(scene: Scene, file: Path) -> None:
    """Write the LiDAR cloud: dense near the scanner's stations, with colour and intensity one cannot rely on."""
    rng = np.random.default_rng([scene.seed, 21])
    plan = _scanned_places(scene, rng)
    points, greys = _tops(scene, plan)
    if scene.body is not None:
        walls, wall_greys = _wall_points(scene.body, rng, scene.survey.cloud_points // 12)
        points, greys = np.concatenate((points, walls)), np.concatenate((greys, wall_greys))
    points = points + rng.normal(0, [0.003, 0.003, 0.004], points.shape) + scene.survey.cloud_origin_m
    order = np.lexsort((points[:, 0], np.floor(points[:, 1] / 0.5)))  # as a scanner sweeps; packs well
    points, greys = points[order], greys[order]
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales = np.full(3, 0.002)
    header.offsets = np.floor(points.min(axis=0))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    wandering = greys * rng.normal(1, 0.1, len(greys)) + 10 * np.sin(points[:, 0] / 9) + rng.normal(0, 7, len(greys))
    cloud.intensity = (np.clip(wandering / 4, 0, 255)).astype(np.uint16) * 256
    for channel, name in zip((1.04, 1.0, 0.93), ("red", "green", "blue"), strict=True):
        setattr(cloud, name, np.clip(wandering * channel, 0, 255).astype(np.uint16) * 256)
    cloud.write(str(file))


def _scanned_places(scene: Scene, rng: np.random.Generator) -> Floats:
    """Return (n, 2) places seen by a scanner from five stations: density falls with distance, corners stay bare."""
    camera = Camera(scene)
    frame = _frame_on_ground(scene, camera)
    low, high = frame.min(axis=0) - 2, frame.max(axis=0) + 2
    stations = rng.uniform(low + 0.15 * (high - low), high - 0.15 * (high - low), (5, 2))
    count = scene.survey.cloud_points
    reach = rng.gamma(1.6, 0.2 * float((high - low).max()) / 1.6, count)
    way = rng.uniform(0, 2 * np.pi, count)
    near = stations[rng.integers(0, 5, count)] + reach[:, None] * np.column_stack((np.cos(way), np.sin(way)))
    places = np.concatenate((near, rng.uniform(low, high, (count // 3, 2))))
    return places[np.all((places > low) & (places < high), axis=1)]


def _tops(scene: Scene, plan: Floats) -> tuple[Floats, Floats]:
    """Return (n, 3) the highest surface over each place at rest, and its grey level (n,)."""
    z = scene.relief.at(plan)
    greys = look_up(scene.ground.luma, scene.ground.texels(plan))
    standing = [p for p in scene.plates if p.opacity(np.zeros(1))[0] >= 1 and not _flies(p)]
    for plate in sorted(standing, key=lambda p: p.height_m):
        c, s = np.cos(plate.heading_rad), np.sin(plate.heading_rad)
        own = (plan - plate.centre_m) @ np.array([[c, -s], [s, c]])
        texels = plate.texture.texels(own)
        assert plate.texture.cover is not None
        inside = look_up(plate.texture.cover, texels) > 0.5
        z[inside] = plate.height_m
        greys[inside] = look_up(plate.texture.luma, texels[inside])
    return np.column_stack((plan, z)), greys


def _flies(plate: Plate) -> bool:
    """Whether it crosses the scene during the clip: surveyors come on another day."""
    return plate.name.startswith("passing")


def _wall_points(body: Body, rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    corners = body.corners(-1.0, top=False)
    side = rng.integers(0, 4, count)
    share, up = rng.uniform(0, 1, (2, count))
    plan = corners[side, :2] + share[:, None] * (corners[(side + 1) % 4, :2] - corners[side, :2])
    height = body.base_m + up * (body.top_m - body.base_m)
    return np.column_stack((plan, height)), 110 + 40 * np.sin(height * 2.05)


# --- lens -------------------------------------------------------------------------------------------------------


def write_lens_file(scene: Scene, file: Path) -> None:
    """Write the lens as a calibration found it: true, but for a realistic error."""
    rng = np.random.default_rng([scene.seed, 22])
    focal, centre, k1 = scene.survey.lens_error
    lens = scene.lens
    width, height = lens.image_size_px
    scale = width / 3840
    K = lens.camera_matrix
    K[[0, 1], [0, 1]] *= 1 + focal * rng.standard_normal() + 1e-4 * rng.standard_normal(2)
    K[:2, 2] += centre * min(scale * 1.5, 1.0) * rng.standard_normal(2)
    distortion = lens.distortion + rng.standard_normal(5) * [k1, k1 * 0.8, 5e-5, 5e-5, 0.0]
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", width)
    storage.write("image_height", height)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", distortion[None])
    if scene.sensor.readout_s:
        storage.write("readout_s", scene.sensor.readout_s)
    storage.release()


def write_checkerboards(scene: Scene, folder: Path) -> None:
    """Write photographs of a checkerboard taken with the same lens, each pixel looked up once on the board."""
    if scene.survey.boards == 0:
        return
    rng = np.random.default_rng([scene.seed, 23])
    folder.mkdir(exist_ok=True)
    board, texel_m = _board_picture()
    width, height = scene.lens.image_size_px
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    rays = scene.lens.rays_from_raw(np.stack((u, v), axis=-1))
    for number in range(scene.survey.boards):
        R, t = _board_pose(scene, rng, number)
        H = np.linalg.inv(np.column_stack((R[:, 0], R[:, 1], t)))
        on_board = cv2.perspectiveTransform(rays, H) / texel_m
        texels = (on_board + np.array(board.shape[::-1]) / 2 - 0.5).astype(np.float32)
        seen = _BACKDROP + sample(board - _BACKDROP, texels, "nothing")
        seen = seen * rng.uniform(0.8, 1.05) + rng.normal(0, 1.5, seen.shape)
        picture = np.clip(seen, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"board_{number + 1:02d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])


def _board_picture() -> tuple[NDArray[np.float32], float]:
    """Return the board with a white margin, and the edge of a texel in metres."""
    per_square = 60
    columns, rows = _BOARD_CORNERS[0] + 1, _BOARD_CORNERS[1] + 1
    squares = (np.add.outer(np.arange(rows), np.arange(columns)) % 2).astype(np.float32)
    board = np.kron(25 + 200 * squares, np.ones((per_square, per_square), np.float32))
    board = np.pad(board.astype(np.float32), per_square, constant_values=225)
    return blurred(board, 2.0), _BOARD_SQUARE_M / per_square


def _board_pose(scene: Scene, rng: np.random.Generator, number: int) -> tuple[Floats, Floats]:
    """Return R and t (camera <- board) of a board held somewhere in the image, corners and edges in turn."""
    width, height = scene.lens.image_size_px
    spots = [(0.5, 0.5), (0.24, 0.28), (0.76, 0.28), (0.24, 0.72), (0.76, 0.72), (0.5, 0.28), (0.5, 0.72)]
    spot = np.array(spots[number % len(spots)]) + rng.uniform(-0.05, 0.05, 2)
    ray = scene.lens.rays_from_raw(spot * [width, height])
    extent_m = (_BOARD_CORNERS[0] + 1) * _BOARD_SQUARE_M
    distance = extent_m * float(scene.lens.focal_px[0]) / (width * rng.uniform(0.38, 0.55))
    turn = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.25, 0.25)])
    return np.asarray(cv2.Rodrigues(turn)[0]), distance * np.array([*ray, 1.0])


# --- GPS --------------------------------------------------------------------------------------------------------


def antenna_m(scene: Scene) -> tuple[Measured, Floats]:
    """Return the measured thing that carries the antenna, and where on it (own metres)."""
    first = scene.measured[0]
    return first, np.array([first.lines.t1_x_m + 0.4, (first.lines.l1_y_m + first.lines.l2_y_m) / 2])


def write_gps(scene: Scene, file: Path) -> None:
    """Write the antenna's record: 10 Hz, millimetre noise, relative to a reference station, on its own clock."""
    rng = np.random.default_rng([scene.seed, 24])
    measured, own = antenna_m(scene)
    time = np.arange(0.0, scene.duration_s, 1 / _GPS_HZ)
    at = np.array([measured.plate.world_from_own(own[None], t)[0] for t in time])
    rest = measured.plate.world_from_own(own[None], -1.0)[0]
    record = at - rest + _GPS_BASELINE_M + rng.normal(0, scene.survey.gps_noise_m, at.shape)
    with file.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(["time_s", "east_m", "north_m"])
        for t, (east, north) in zip(time + scene.survey.gps_clock_s, record, strict=True):
            rows.writerow([f"{t:.2f}", f"{east:.4f}", f"{north:.4f}"])


# --- what the engineer decided ----------------------------------------------------------------------------------


def finished_project(scene: Scene, camera: Camera) -> Project:
    """Return the project as an engineer leaves it: clicks, regions and bands with human error."""
    rng = np.random.default_rng([scene.seed, 25])
    origin = np.array(scene.survey.cloud_origin_m)
    regions = moving_regions(scene, camera)
    measured, own = antenna_m(scene)
    antenna = measured.plate.world_from_own(own[None], -1.0)[0] + origin[:2]
    return Project(
        name=scene.name,
        inputs=Inputs(
            video="video.mp4", cloud="site.laz", lens="lens.yaml", gps=GpsInput(file="gps.csv", at_m=_point(antenna, 3))
        ),
        orthoimage=Orthoimage(pixel_size_m=0.02),
        reference_frame=_REFERENCE_FRAME,
        correspondences=tuple(_clicks(scene, camera, regions=regions, rng=rng, origin=origin)),
        moving_regions_px=tuple(tuple(_point(corner, 1) for corner in region) for region in regions),
        targets=tuple(_target(scene, one, rng, origin) for one in scene.measured),
        intervals_s=Intervals(**scene.survey.intervals_s),
        method="geometric",
    )


def _point(values: Floats, digits: int) -> Point:
    return round(float(values[0]), digits), round(float(values[1]), digits)


def _frame_on_ground(scene: Scene, camera: Camera) -> Floats:
    """Return (4, 2) where the corners of the reference frame lie on the ground, world metres."""
    width, height = scene.lens.image_size_px
    return ground_under(scene, np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]]))[:, :2]


def ground_under(scene: Scene, raw_px: Floats) -> Floats:
    """Return the places (n, 3) on the ground, relief included, that the reference frame shows at raw pixels (n, 2)."""
    R, C = scene.flight.pose(scene.frame_times()[_REFERENCE_FRAME])
    rays = scene.lens.rays_from_raw(raw_px)
    directions = np.column_stack((rays, np.ones(len(rays)))) @ R[0]
    slope = directions[:, :2] / directions[:, 2:]
    height = np.zeros(len(rays))
    for _ in range(3):
        plan = C[0, :2] + (height - C[0, 2])[:, None] * slope
        height = scene.relief.at(plan)
    return np.column_stack((plan, height))


def _clicks(
    scene: Scene, camera: Camera, *, regions: list[Floats], rng: np.random.Generator, origin: Floats
) -> list[Correspondence]:
    """Return 20 well spread pairs on marks one can recognise on free ground: the best first, then the next best."""
    marks = _marks_in_frame(scene, camera, regions)
    frame = np.concatenate([of_field[:1] for of_field in marks] + [of_field[1:4] for of_field in marks])[:20]
    ground = ground_under(scene, frame)[:, :2] + rng.normal(0, scene.survey.click_m, (len(frame), 2)) + origin[:2]
    clicked = frame + rng.normal(0, scene.survey.click_px, (len(frame), 2))
    return [
        Correspondence(id=number, ground_m=_point(at, 3), frame_px=_point(px, 1))
        for number, (at, px) in enumerate(zip(ground, clicked, strict=True), start=1)
    ]


def _marks_in_frame(scene: Scene, camera: Camera, regions: list[Floats]) -> list[Floats]:
    """Return raw pixels (n, 2) of the clearest corners on flat free ground, for each of 5 by 4 fields of the frame."""
    width, height = scene.lens.image_size_px
    luma, _ = camera.expose(float(scene.frame_times()[_REFERENCE_FRAME]))
    columns, rows = np.linspace(8, width - 9, 6).astype(int), np.linspace(8, height - 9, 5).astype(int)
    marks = []
    for top, bottom in itertools.pairwise(rows):
        for left, right in itertools.pairwise(columns):
            part = cv2.GaussianBlur(luma[top:bottom, left:right], (0, 0), 1.5)
            corners = cv2.goodFeaturesToTrack(part, 30, 0.02, width / 40)
            found = np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64) + [left, top]
            marks.append(found[_on_free_ground(scene, found, regions)])
    return marks


def _on_free_ground(scene: Scene, frame_px: Floats, regions: list[Floats]) -> NDArray[np.bool_]:
    """Return (n,) whether raw pixels show ground that stays where it is: no object on it, no moving region over it."""
    if len(frame_px) == 0:
        return np.zeros(0, np.bool_)
    world = ground_under(scene, frame_px)
    beside = [(0.0, 0.0), (0.6, 0.0), (-0.6, 0.0), (0.0, 0.6), (0.0, -0.6)]
    tops = np.max([_tops(scene, world[:, :2] + away)[0][:, 2] for away in beside], axis=0)
    free = [not _inside(px, regions) for px in frame_px]
    return np.asarray(free) & (tops < 0.3)


def _inside(frame_px: Floats, regions: list[Floats]) -> bool:
    point = (float(frame_px[0]), float(frame_px[1]))
    return any(cv2.pointPolygonTest(region.astype(np.float32), point, True) > -10 for region in regions)


def moving_regions(scene: Scene, camera: Camera) -> list[Floats]:
    """Return polygons (n, 2) in raw pixels of the reference frame around all that moves, its motion included."""
    time_s = float(scene.frame_times()[_REFERENCE_FRAME])
    # A person sees the whole clip before drawing: every tenth of a second, and half a metre to spare.
    instants = np.arange(0.0, scene.duration_s, 0.1)
    regions = []
    for outline in [*_outlines(scene, instants)]:
        spread = outline[:, None, :] + [[0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, 0.5, 0], [-0.5, -0.5, 0]]
        raw = camera.project(spread.reshape(-1, 3), time_s)
        hull = cv2.convexHull(raw.astype(np.float32)).reshape(-1, 2)
        regions.append(np.asarray(cv2.approxPolyDP(hull, 2.0, True), dtype=np.float64).reshape(-1, 2))
    return regions


def _outlines(scene: Scene, instants: Floats) -> list[Floats]:
    """Return (n, 3) world points around each thing that moves with the building, over all instants."""
    outlines = []
    body = scene.body
    if body is not None:
        faces = [body.corners(t, top=top) for t in instants for top in (False, True)]
        outlines.append(np.concatenate(faces))
        shadows = np.concatenate([shadow_outline(body, scene.light.shadow_m_per_m, t) for t in instants])
        outlines.append(np.column_stack((shadows, np.zeros(len(shadows)))))
    for one in scene.measured:
        plan = np.concatenate([one.plate.world_from_own(one.plate.corners_m, t) for t in instants])
        outlines.append(np.column_stack((plan, np.full(len(plan), one.plate.height_m))))
    return outlines


def _target(scene: Scene, measured: Measured, rng: np.random.Generator, origin: Floats) -> Target:
    """Return the target with its height a little off and its bands where the lines appear on the plan."""
    lines = measured.lines
    height = measured.plate.height_m + scene.survey.height_error_m * rng.choice([-1.0, 1.0])
    distance = abs(lines.l1_y_m - lines.l2_y_m)
    if measured.kind == "points":
        region = tuple(_point(at + origin[:2], 2) for at in apparent_plan(scene, measured, _region(lines)))
        return Target(
            name=measured.name,
            kind="points",
            height_m=round(height, 3),
            region_m=region,
            relative_to=measured.relative_to,
        )
    own = {
        "L1": [(lines.along_m[0], lines.l1_y_m), (lines.along_m[1], lines.l1_y_m)],
        "L2": [(lines.along_m[0], lines.l2_y_m), (lines.along_m[1], lines.l2_y_m)],
        "T1": [(lines.t1_x_m, lines.across_m[0]), (lines.t1_x_m, lines.across_m[1])],
    }
    bands = {}
    for name, ends in own.items():
        plan = apparent_plan(scene, measured, np.array(ends)) + rng.normal(0, 0.02, (2, 2)) + origin[:2]
        bands[name] = Band(from_m=_point(plan[0], 3), to_m=_point(plan[1], 3), width_m=0.5)
    return Target(
        name=measured.name,
        height_m=round(height, 3),
        p1_p2_m=round(distance, 4),
        lines=Lines(**bands),
        relative_to=measured.relative_to,
    )


def _region(lines: RoofLines) -> Floats:
    (west, east), (south, north) = lines.along_m, lines.across_m
    return np.array([[west, south], [east, south], [east, north], [west, north]])


def apparent_plan(scene: Scene, measured: Measured, own_m: Floats) -> Floats:
    """Return where points (n, 2) of a plate appear on level ground in the reference frame, world metres."""
    time_s = float(scene.frame_times()[_REFERENCE_FRAME])
    _, C = scene.flight.pose(time_s)
    plan = measured.plate.world_from_own(own_m, time_s)
    height = measured.plate.height_m
    return plan + height / (C[0, 2] - height) * (plan - C[0, :2])


# --- truth ------------------------------------------------------------------------------------------------------


def write_truth(scene: Scene, folder: Path) -> None:
    """Write `truth.csv` (the first target) and `truth.npz` (everything).

    Displacement is that of P1 and P2 from rest in world metres, and the rotation from rest, at the frame's timestamp:
    the middle of the exposure of the image's middle row. A target relative to another has the difference. `_motion` is
    the plate's: displacement of its centre at rest (`_centre_m`) and rotation, from which any other point follows.
    """
    times = scene.frame_times()
    R, C = scene.flight.pose(times)
    arrays: dict[str, Any] = {
        "time_s": times,
        "R_camera_world": R,
        "centre_m": C,
        "camera_matrix": scene.lens.camera_matrix,
        "distortion": scene.lens.distortion,
        "cloud_origin_m": np.array(scene.survey.cloud_origin_m),
        "targets": np.array([one.name for one in scene.measured]),
        "hidden": np.any([(times >= start) & (times <= end) for start, end in [*scene.hidden_s, (1, 0)]], axis=0),
    }
    base = {one.name: one for one in scene.measured}
    for one in scene.measured:
        name = one.name
        moved, points, apparent = displacement(one, times, C)
        if one.relative_to is not None:
            base_moved, base_points, _ = displacement(base[one.relative_to], times, C)
            moved, points = moved - base_moved, points - base_points
        arrays |= {
            f"{name}_motion": moved,
            f"{name}_centre_m": np.array(one.plate.centre_m),
            f"{name}_p1_m": points[:, 0],
            f"{name}_p2_m": points[:, 1],
            f"{name}_rotation_rad": moved[:, 2],
            f"{name}_apparent_m": apparent,
            f"{name}_height_m": np.array(one.plate.height_m),
            f"{name}_rest_m": place(one.lines.points_m, one.plate.centre_m, one.plate.heading_rad, np.zeros(3)),
        }
    np.savez_compressed(folder / "truth.npz", **arrays)
    first = scene.measured[0].name
    columns = np.column_stack(
        (
            np.arange(len(times)),
            times,
            arrays[f"{first}_p1_m"],
            arrays[f"{first}_p2_m"],
            arrays[f"{first}_rotation_rad"],
        )
    )
    header = "frame,time_s,p1_dx_m,p1_dy_m,p2_dx_m,p2_dy_m,rotation_rad"
    np.savetxt(folder / "truth.csv", columns, "%d,%.6f,%.6f,%.6f,%.6f,%.6f,%.8f", header=header, comments="")


def displacement(measured: Measured, times_s: Floats, centres_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return motion (n, 3), displacement of P1 and P2 (n, 2, 2), and where both appear on the plan (n, 2, 2)."""
    plate = measured.plate
    own = measured.lines.points_m
    moved = plate.motion(times_s)
    rest = place(own, plate.centre_m, plate.heading_rad, np.zeros(3))
    world = np.array([place(own, plate.centre_m, plate.heading_rad, motion) for motion in moved])
    enlarge = (plate.height_m / (centres_m[:, 2] - plate.height_m))[:, None, None]
    return moved, world - rest, world + enlarge * (world - centres_m[:, None, :2])
