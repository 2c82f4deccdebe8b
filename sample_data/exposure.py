"""One exposure of a scene: for every raw pixel, which place it sees, looked up once in a texture finer than the image.

No image is ever warped from another image. The way from a pixel to the ground is smooth, so it is computed exactly on a
lattice of a few pixels and interpolated between (error below 0.002 px); the lattice's rows carry their own time, which
is what a rolling shutter does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from sample_data.scene import Body, Plate, Scene
from sample_data.textures import CHROMA_STEP, Texture, blurred, sample

Image = NDArray[np.float32]
Floats = NDArray[np.float64]
Window = tuple[slice, slice]
"""Lattice rows and columns."""

_LATTICE_ERROR_PX = 0.002
_BLUR_STEP_PX = 0.45
_MOST_SAMPLES = 24
_LOW_M = 3.0
"""Plates up to this height lie in the building's shadow; the walls stand over them."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Rays at every few raw pixels, one node beyond the image on each side.

    Attributes:
        step: pixels between nodes.
        rays: (rows, columns, 2) of node n at raw pixel (n - 1/2) step - 1/2, plus the sample's offset.
        row_px: (rows,) raw v of the nodes.
    """

    step: int
    rays: Floats
    row_px: Floats

    @classmethod
    def of(cls, scene: Scene, offset_px: tuple[float, float]) -> Lattice:
        """Return the lattice for samples this far from the pixels' centres."""
        width, height = scene.lens.image_size_px
        # Distortion bends like k r / f per pixel, and linear interpolation errs by step² / 8 of that.
        bend = 6 * 0.15 / float(scene.lens.focal_px.mean())
        step = 8 if bend * 64 / 8 < _LATTICE_ERROR_PX * 2 else 4
        columns = np.arange(-0.5, width // step + 2) * step - 0.5
        rows = np.arange(-0.5, height // step + 2) * step - 0.5
        u, v = np.meshgrid(columns + offset_px[0], rows + offset_px[1])
        return cls(step, scene.lens.rays_from_raw(np.stack((u, v), axis=-1)), rows)

    def window(self, corners_px: Floats, size_px: tuple[int, int]) -> Window | None:
        """Return the nodes around a box of raw pixels, (n, 2) corners, or None if it is not in the image."""
        low, high = np.nanmin(corners_px, axis=0) - 3, np.nanmax(corners_px, axis=0) + 3
        low, high = np.maximum(low, 0), np.minimum(high, np.array(size_px) - 1.0)
        if np.any(high < low):
            return None
        # Windows start at even pixels and span whole cells, so that brightness and colour stay in step.
        first = np.floor((low + 0.5) / self.step).astype(int)
        last = np.minimum(np.floor((high + 0.5) / self.step).astype(int), np.array(size_px) // self.step)
        return slice(first[1], last[1] + 3), slice(first[0], last[0] + 3)

    @property
    def whole(self) -> Window:
        """Every node."""
        return slice(0, self.rays.shape[0]), slice(0, self.rays.shape[1])


def fill(nodes: NDArray[np.floating], cell_px: int) -> Image:
    """Return values at every pixel between nodes (rows, columns, channels): without the outer half cells."""
    nodes = nodes.astype(np.float32)
    rows, columns = nodes.shape[:2]
    full = cv2.resize(nodes, (columns * cell_px, rows * cell_px), interpolation=cv2.INTER_LINEAR)
    return cast(Image, full[cell_px:-cell_px, cell_px:-cell_px])


def pixels_of(window: Window, cell_px: int, limit: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of an image of (rows, columns) that a window of nodes fills, `cell_px` a node."""
    rows, columns = (
        slice(part.start * cell_px, min((part.stop - 2) * cell_px, most))
        for part, most in zip(window, limit, strict=True)
    )
    return rows, columns


class Camera:
    """Exposes a scene: brightness and colour as light falls on the sensor, before noise."""

    def __init__(self, scene: Scene):
        self.scene = scene
        across, down = scene.sensor.samples
        self._lattices = [
            Lattice.of(scene, ((i + 0.5) / across - 0.5, (j + 0.5) / down - 0.5))
            for j in range(down)
            for i in range(across)
        ]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the image."""
        width, height = self.scene.lens.image_size_px
        return height, width

    @cached_property
    def _vignette(self) -> Image:
        """(rows, columns) share of the light that arrives."""
        rows, columns = self.shape
        v, u = np.linspace(-1, 1, rows, dtype=np.float32), np.linspace(-1, 1, columns, dtype=np.float32)
        return 1 - np.float32(self.scene.sensor.vignetting / 2) * np.add.outer(v * v, u * u)

    @cached_property
    def _low_plates(self) -> list[Plate]:
        return sorted((p for p in self.scene.plates if p.height_m <= _LOW_M), key=lambda plate: plate.height_m)

    @cached_property
    def _high_plates(self) -> list[Plate]:
        return sorted((p for p in self.scene.plates if p.height_m > _LOW_M), key=lambda plate: plate.height_m)

    def expose(self, time_s: float) -> tuple[Image, Image]:
        """Return luma (rows, columns) and chroma offsets (rows / 2, columns / 2, 2) of the exposure around a time."""
        luma, chroma = self._ground(time_s)
        for plate in self._low_plates:
            self._lay(plate, time_s, luma, chroma)
        if self.scene.body is not None:
            self._shade(self.scene.body, time_s, luma)
            for quad, texture in _walls_seen(self.scene.body, time_s, self.scene.flight.pose(time_s)[1][0]):
                self._stand(quad, texture, time_s, luma=luma, chroma=chroma)
        for plate in self._high_plates:
            self._lay(plate, time_s, luma, chroma)
        if self.scene.light.cloud is not None:
            lattice = self._lattices[0]
            plan = self._plan(lattice, lattice.whole, time_s, 0.0)
            shade = fill(self.scene.light.cloud(time_s, plan)[..., None], lattice.step)
            luma *= shade[: self.shape[0], : self.shape[1]]
        luma *= self._vignette
        return luma, chroma

    # --- geometry -----------------------------------------------------------------------------------------------

    def _row_times(self, lattice: Lattice, window: Window, time_s: float) -> Floats:
        """Return the (rows,) middle of the exposure of each node row; the timestamp is the middle row's."""
        height = self.shape[0]
        share = (lattice.row_px[window[0]] - (height - 1) / 2) / (height - 1)
        return time_s + self.scene.sensor.readout_s * share

    def _directions(self, lattice: Lattice, window: Window, time_s: float) -> tuple[Floats, Floats]:
        """Return world directions (rows, columns, 3) of the nodes' rays and camera centres (rows or 1, 1, 3)."""
        rays = lattice.rays[window]
        if self.scene.sensor.readout_s:
            R, C = self.scene.flight.pose(self._row_times(lattice, window, time_s))
        else:
            R, C = self.scene.flight.pose(time_s)
        directions = rays[..., :1] * R[:, None, 0] + rays[..., 1:] * R[:, None, 1] + R[:, None, 2]
        return directions, C[:, None]

    def _plan(self, lattice: Lattice, window: Window, time_s: float, height_m: float) -> Floats:
        """Return where the nodes' rays meet a level plane, (rows, columns, 2) world metres."""
        directions, C = self._directions(lattice, window, time_s)
        reach = (height_m - C[..., 2:]) / directions[..., 2:]
        return C[..., :2] + reach * directions[..., :2]

    def _ground_plan(self, lattice: Lattice, time_s: float) -> Floats:
        """Return where the nodes' rays meet the uneven ground: the plane first, then its height twice over."""
        directions, C = self._directions(lattice, lattice.whole, time_s)
        slope = directions[..., :2] / directions[..., 2:]
        plan = C[..., :2] - C[..., 2:] * slope
        for _ in range(2):
            plan = C[..., :2] + (self.scene.relief.at(plan)[..., None] - C[..., 2:]) * slope
        return plan

    def project(self, world_m: Floats, time_s: float) -> Floats:
        """Return raw pixels (..., 2) of world points (..., 3) for the middle row's time."""
        R, C = self.scene.flight.pose(time_s)
        camera = (world_m - C[0]) @ R[0].T
        return self.scene.lens.raw_from_rays(camera[..., :2] / camera[..., 2:])

    def _sampling(self, motion_px: float, time_s: float) -> list[tuple[Lattice, float]]:
        """Return lattices and instants whose mean is the exposure, as many as the motion needs."""
        count = int(np.clip(np.ceil(motion_px / _BLUR_STEP_PX), 1, _MOST_SAMPLES))
        count = max(count, len(self._lattices))
        instants = time_s + self.scene.sensor.exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        # Neighbouring instants take distant sub-pixel places, so that neither is tied to the other.
        order = (np.arange(count) * 5) % len(self._lattices) if len(self._lattices) % 5 else np.arange(count)
        return [(self._lattices[order[i] % len(self._lattices)], float(instants[i])) for i in range(count)]

    # --- layers -------------------------------------------------------------------------------------------------

    def _ground(self, time_s: float) -> tuple[Image, Image]:
        """Return the ground's luma and chroma, blurred by the camera's motion during the exposure."""
        height, width = self.shape
        texture = self.scene.ground
        half = self.scene.sensor.exposure_s / 2
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [width / 2, height / 2]])
        probes = self.scene.lens.rays_from_raw(corners)
        motion = np.abs(self._image_motion(probes, time_s - half, time_s + half)).max()
        luma, chroma = np.zeros((height, width), np.float32), np.empty((0, 0, 2), np.float32)
        sampling = self._sampling(float(motion), time_s)
        for lattice, instant in sampling:
            texels = texture.texels(self._ground_plan(lattice, instant))
            luma += sample(texture.luma, fill(texels, lattice.step)[:height, :width], "mirror")
            if chroma.size == 0:
                chroma = _colour(texture, texels, lattice.step)[: height // 2, : width // 2].copy()
        luma /= len(sampling)
        return luma, chroma

    def _image_motion(self, rays: Floats, start_s: float, end_s: float) -> Floats:
        """Return how far ground points seen along rays (n, 2) at the start move in the image until the end, pixels."""
        R, C = self.scene.flight.pose([start_s, end_s])
        directions = np.column_stack((rays, np.ones(len(rays)))) @ R[0]
        ground = C[0] - directions * (C[0, 2] / directions[:, 2:])
        later = (ground - C[1]) @ R[1].T
        motion: Floats = (later[:, :2] / later[:, 2:] - rays) * self.scene.lens.focal_px
        return motion

    def _lay(self, plate: Plate, time_s: float, luma: Image, chroma: Image) -> None:
        """Lay a plate over what was seen so far."""
        opacity = float(plate.opacity(np.array([time_s]))[0])
        if opacity <= 0:
            return
        half = self.scene.sensor.exposure_s / 2 + self.scene.sensor.readout_s / 2
        corners = [self._plate_corners(plate, when) for when in (time_s - half, time_s, time_s + half)]
        window = self._lattices[0].window(np.concatenate(corners), self.scene.lens.image_size_px)
        if window is None:
            return
        sampling = self._sampling(float(np.abs(corners[2] - corners[0]).max()), time_s)
        step = self._lattices[0].step
        rows, columns = pixels_of(window, step, self.shape)
        sums = np.zeros((2, rows.stop - rows.start, columns.stop - columns.start), np.float32)
        for lattice, instant in sampling:
            texels = self._plate_texels(plate, lattice, window, instant)
            full = fill(texels, step)[: sums.shape[1], : sums.shape[2]]
            for k, layer in enumerate((plate.texture.luma, plate.texture.cover)):
                assert layer is not None, "a plate has an edge"
                sums[k] += sample(layer, full, "nothing")
        sums *= opacity / len(sampling)
        luma[rows, columns] = luma[rows, columns] * (1 - sums[1]) + sums[0]
        self._colour_over(chroma, window, _colour(plate.texture, texels, step), sums[1])

    def _plate_corners(self, plate: Plate, time_s: float) -> Floats:
        plan = plate.world_from_own(plate.corners_m, time_s)
        return self.project(np.column_stack((plan, np.full(4, plate.height_m))), time_s)

    def _plate_texels(self, plate: Plate, lattice: Lattice, window: Window, time_s: float) -> Image:
        """Return the texel seen at each node, each node row at its own time."""
        plan = self._plan(lattice, window, time_s, plate.height_m)
        when = self._row_times(lattice, window, time_s) if self.scene.sensor.readout_s else np.array([time_s])
        moved = plate.motion(when)[:, None]
        turn = plate.heading_rad + moved[..., 2]
        c, s = np.cos(turn), np.sin(turn)
        away = plan - plate.centre_m - moved[..., :2]
        own = np.stack((c * away[..., 0] + s * away[..., 1], -s * away[..., 0] + c * away[..., 1]), axis=-1)
        return plate.texture.texels(own)

    def _stand(self, quad: Floats, texture: Texture, time_s: float, *, luma: Image, chroma: Image) -> None:
        """Draw a wall, (4, 3) world corners: foot left, foot right, top right, top left seen from outside."""
        window = self._lattices[0].window(self.project(quad, time_s), self.scene.lens.image_size_px)
        if window is None:
            return
        lattice = self._lattices[0]
        R, C = self.scene.flight.pose(time_s)
        camera = (quad - C[0]) @ R[0].T
        rows, columns = texture.luma.shape
        texture_corners = np.array([[0, rows - 1], [columns - 1, rows - 1], [columns - 1, 0], [0, 0]], np.float32)
        H = cv2.getPerspectiveTransform((camera[:, :2] / camera[:, 2:]).astype(np.float32), texture_corners)
        texels = cv2.perspectiveTransform(lattice.rays[window], H).astype(np.float32)
        full = fill(texels, lattice.step)
        area = pixels_of(window, lattice.step, self.shape)
        full = full[: area[0].stop - area[0].start, : area[1].stop - area[1].start]
        u, v = cv2.split(full)
        inside = np.minimum(np.minimum(u + 1, columns - u), np.minimum(v + 1, rows - v))
        cover = np.clip(inside, 0, 1).astype(np.float32)
        seen = sample(texture.luma, full, "edge")
        luma[area] = luma[area] * (1 - cover) + seen * cover
        self._colour_over(chroma, window, _colour(texture, texels, lattice.step), cover)

    def _colour_over(self, chroma: Image, window: Window, colour: Image, cover: Image) -> None:
        half = self._lattices[0].step // 2
        rows, columns = pixels_of(window, half, (self.shape[0] // 2, self.shape[1] // 2))
        weight = cv2.resize(cover, (cover.shape[1] // 2, cover.shape[0] // 2), interpolation=cv2.INTER_AREA)[..., None]
        weight = weight[: rows.stop - rows.start, : columns.stop - columns.start]
        colour = colour[: weight.shape[0], : weight.shape[1]]
        part = chroma[rows.start : rows.start + weight.shape[0], columns.start : columns.start + weight.shape[1]]
        part += weight * (colour - part)

    def _shade(self, body: Body, time_s: float, luma: Image) -> None:
        """Darken the ground where the building stands between it and the sun."""
        outline = shadow_outline(body, self.scene.light.shadow_m_per_m, time_s)
        corners = self.project(np.column_stack((outline, np.zeros(len(outline)))), time_s)
        window = self._lattices[0].window(corners, self.scene.lens.image_size_px)
        if window is None:
            return
        lattice = self._lattices[0]
        texel, margin = 0.04, 0.6
        low, high = outline.min(axis=0) - margin, outline.max(axis=0) + margin
        columns, rows = np.ceil((high - low) / texel).astype(int)
        mask = np.zeros((rows, columns), np.uint8)
        corner_texels = np.round(((outline - low) / texel - 0.5) * 256).astype(np.int32)
        cv2.fillConvexPoly(mask, corner_texels, 255, cv2.LINE_AA, 8)
        dark = blurred(mask.astype(np.float32) / np.float32(255), 1.5)
        plan = self._plan(lattice, window, time_s, 0.0)
        area = pixels_of(window, lattice.step, self.shape)
        texels = fill((plan - low) / texel - 0.5, lattice.step)
        texels = texels[: area[0].stop - area[0].start, : area[1].stop - area[1].start]
        share = sample(dark, texels, "nothing")
        luma[area] *= 1 - (1 - self.scene.light.shadow_share) * share


def _colour(texture: Texture, texels: Image, step: int) -> Image:
    """Return chroma offsets (rows / 2, columns / 2, 2) at the half-size pixels between nodes."""
    at = (fill(texels, step // 2) + 0.5) / CHROMA_STEP - 0.5
    return sample(texture.chroma, at.astype(np.float32, copy=False), "mirror")


def _walls_seen(body: Body, time_s: float, centre_m: Floats) -> list[tuple[Floats, Texture]]:
    """Return corners (4, 3) and texture of each wall that faces the camera."""
    foot, top = body.corners(time_s, top=False), body.corners(time_s, top=True)
    seen = []
    for side in range(4):
        left, right = side, (side + 1) % 4
        along = foot[right] - foot[left]
        outward = np.array([along[1], -along[0]])
        if outward @ (centre_m - foot[left])[:2] > 0:
            seen.append((np.array([foot[left], foot[right], top[right], top[left]]), body.walls[side]))
    return seen


def shadow_outline(body: Body, shadow_m_per_m: tuple[float, float], time_s: float) -> Floats:
    """Return the convex outline (n, 2) of the building's shadow on level ground, foot included."""
    corners = np.concatenate((body.corners(time_s, top=False), body.corners(time_s, top=True)))
    cast = corners[:, :2] + corners[:, 2:] * np.array(shadow_m_per_m)
    return np.asarray(cv2.convexHull(cast.astype(np.float32)), dtype=np.float64).reshape(-1, 2)
