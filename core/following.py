"""Following a target from frame to frame in pictures alone: where to look next, and what to do when it is lost.

While following, positions are *rays of the reference frame*: a frame's ground homography H_ray_ray0 takes out the
camera, and what remains is the target's apparent motion (its own, and parallax). None of this enters the result; it
only has to be good to a few pixels, and the measurement then finds its own place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from core.apparent import Apparent
from core.coordinates import Floats, apply_homography, finite_rows, rotation_2d
from core.errors import InputError
from core.ground import ALIKE_SCORE, NOISY_ROUNDS, Regions, View, choose_features_within
from core.lens import Lens
from core.motion import (
    LineSet,
    RigidFit,
    fit_line,
    is_determined,
    is_determined_as_whole,
    rigid_from_points,
    rigid_with_weights,
)
from core.patches import Singles
from core.project import LINE_NAMES, Target
from core.robust import finite_median
from core.roof_lines import NOT_FOUND, STATIONS, LineMatch, LineTracker, find_strips
from core.texture import LEAST_PATCHES, Texture
from core.video import Luma

# Correlation of the whole target's picture below which it is not recognised.
LEAST_LIKENESS = 0.35
# How far a target is searched for around its place in the reference frame, plan metres: 0.8 m of motion, enlarged by
# its height, and as much parallax.
SEARCH_M = 2.4
# How far around where strips were found their neighbours lie: what is taken for the target instead of it.
NEIGHBOURS_M = 1.4
# Roof motion between two frames changes by up to some 8 cm when it shakes hardest (3 Hz at 4 m/s, 30 Hz video).
LINE_SEARCH_M = 0.14
# Every so many frames the whole picture confirms that no neighbouring strip has been taken.
CONFIRM_EVERY = 15
# A step that predicts nothing, plan metres: shorter than the noise of the cleanest frame, as in a picture shown again,
# or longer than a roof goes between two frames, as in the picture that follows it.
NO_STEP_M = 5e-5
TOO_LONG_STEP_M = 0.3
# Another place than where strips were found must show this part of them at least.
AS_WELL = 0.8
# Stations of a line that must be seen for it to count.
LEAST_STATIONS = STATIONS // 4
# Patches of a points target, and the fewest that make one.
POINTS = 160
LEAST_POINTS = 6
# Patches about the lines of a lines target, and how far the rectangle in which they lie reaches, as multiple of the
# lines' own: spread over more of the roof they share less of what compression gets wrong. More tell hardly more.
ABOUT_LINES = 80
REACH_OF_LINES = 1.5


@dataclass(frozen=True)
class TargetMatch:
    """A target in one frame.

    Attributes:
        raw: measured raw pixels: (L, STATIONS, 2, 2) edges of lines, or (N, 2) patches of points; nan where none.
        apparent: its motion, or None where it could not be determined.
        texture_raw: (M, 2) patches about the lines, nan where not found; (0, 2) for points.
    """

    raw: Floats
    apparent: Apparent | None
    texture_raw: Floats = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def measured(self) -> int:
        """Number of coordinates that were measured."""
        return int(np.isfinite(self.raw).sum())


class Follower(Protocol):
    """Finds one target in a frame, given the camera.

    Attributes:
        reference_raw: what is looked for, as `TargetMatch.raw`, in the reference frame.
        reference_texture_raw: likewise, as `TargetMatch.texture_raw`.
        texture: the patches of either.
    """

    reference_raw: Floats
    reference_texture_raw: Floats
    texture: Texture

    def views(self, view: View) -> Singles:
        """Return the patches as a view shows them; see `PatchTracker.views`."""

    def find(
        self, luma: Luma, H_ray_ray0: Floats, predicted: Apparent | None, *, confirm: bool, is_view: bool = False
    ) -> TargetMatch:
        """Return the target in a frame, searched for without a prediction where that is None or misleads.

        Args:
            luma: the frame.
            H_ray_ray0: of the camera.
            predicted: where the target should be.
            confirm: whether to make sure that nothing beside it has been taken for it.
            is_view: as for `PatchTracker.track`.
        """


@dataclass(frozen=True)
class Scale:
    """How large plan metres appear in the reference frame near a target."""

    rays_per_m: float
    pixels_per_m: float


def make_follower(
    luma: Luma, target: Target, to_ray0: Callable[[Floats], Floats], lens: Lens, moving_regions_px: Regions = ()
) -> Follower:
    """Return a follower for a target.

    Args:
        luma: the reference frame.
        to_ray0: from plan metres (N, 2) to rays of the reference frame.
        moving_regions_px: polygons, raw pixels, beyond which nothing moves; anything may where there are none.

    Raises:
        InputError: a band holds no line, or a region no texture.
    """
    if target.lines is not None and target.kind == "lines":
        bands = [getattr(target.lines, name) for name in LINE_NAMES]
        corners = np.array([[band.from_m, band.to_m] for band in bands])
        scale = _scale(corners.reshape(-1, 2), to_ray0, lens)
        widths = [band.width_m * scale.pixels_per_m for band in bands]
        names = [f"project.json: targets.{target.name}.lines.{name}" for name in LINE_NAMES]
        ends = to_ray0(corners.reshape(-1, 2)).reshape(-1, 2, 2)
        return LinesFollower(
            luma, ends, lens, widths_px=widths, scale=scale, names=names, moving_regions_px=moving_regions_px
        )
    region = np.array(target.region_m)
    scale = _scale(region, to_ray0, lens)
    return PointsFollower(luma, to_ray0(region), lens, scale=scale, name=f"project.json: targets.{target.name}")


def _scale(plan_m: Floats, to_ray0: Callable[[Floats], Floats], lens: Lens) -> Scale:
    centre = plan_m.mean(axis=0)
    rays = to_ray0(centre + np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]]))
    raw = lens.raw_from_rays(rays)
    along = [float(np.linalg.norm(points[1] - points[0])) for points in (rays[:2], rays[2:], raw[:2], raw[2:])]
    return Scale(rays_per_m=(along[0] + along[1]) / 2, pixels_per_m=(along[2] + along[3]) / 2)


class LinesFollower:
    """Follows L1, L2 and T1 of a target together, and patches of what lies about them.

    Args:
        luma: the reference frame, (height, width).
        ends: (3, 2, 2) both ends of each band's axis, rays of the reference frame.
        widths_px: full width of each band, raw pixels.
        names: of the bands, for messages.
        moving_regions_px: as for `make_follower`.

    Attributes:
        reference_raw: (3, STATIONS, 2, 2) edges in the reference frame, raw pixels; nan where not found.
        reference_texture_raw: (M, 2) patches about the lines, raw pixels; none where it is plain there.
        texture: the same.

    Raises:
        InputError: a band leaves the frame or shows no line.
    """

    def __init__(
        self,
        luma: Luma,
        ends: Floats,
        lens: Lens,
        *,
        widths_px: list[float],
        scale: Scale,
        names: list[str],
        moving_regions_px: Regions = (),
    ) -> None:
        self._lens = lens
        self._scale = scale
        self._search_px = LINE_SEARCH_M * scale.pixels_per_m
        self._centre = ends.reshape(-1, 2).mean(axis=0)
        still = self._mapping(np.eye(3), Apparent.none())
        self.trackers = [
            LineTracker(luma, end, still, width_px=width, name=name)
            for end, width, name in zip(ends, widths_px, names, strict=True)
        ]
        matches = find_strips(self.trackers, luma, still)
        for match, name in zip(matches, names, strict=True):
            if match.measured < LEAST_STATIONS:
                raise InputError(
                    f"{name} shows a line with two edges in only {match.measured} of {STATIONS} places of the "
                    "reference frame; draw the band along a strip or joint, or choose another reference_frame."
                )
        self.reference_raw = np.stack([match.edges_raw for match in matches])
        rays = lens.rays_from_raw(self.reference_raw.mean(axis=2))
        lines = [fit_line(points, np.ones(STATIONS), self._centre) for points in rays]
        self._lines = LineSet(np.array([n for n, _ in lines]), np.array([o for _, o in lines]), self._centre)
        self._whole = self._rigid(matches, np.eye(3)).normal[0]
        ends_raw = lens.raw_from_rays(ends.reshape(-1, 2)).reshape(ends.shape)
        self.reference_texture_raw = _about(luma, ends_raw, moving_regions_px)
        self.texture = Texture(luma, self.reference_texture_raw, lens, self._centre)
        self._finder = TargetFinder(luma, ends.reshape(-1, 2), lens, scale)

    def views(self, view: View) -> Singles:
        """Return the patches as a view shows them; see `PatchTracker.views`."""
        seen = self._finder.search(view.luma, view.H_ray_ray0)
        found = None if seen is None else self._measure(view.luma, view.H_ray_ray0, Apparent(seen, 0.0)).apparent
        return self.texture.views(view.luma, view.H_ray_ray0, found)

    def find(
        self, luma: Luma, H_ray_ray0: Floats, predicted: Apparent | None, *, confirm: bool, is_view: bool = False
    ) -> TargetMatch:
        """Return the lines in a frame and what lies about them; see `Follower.find`."""
        lines = self._lines_in(luma, H_ray_ray0, predicted, confirm=confirm)
        if lines.apparent is None:
            return replace(lines, texture_raw=np.full_like(self.reference_texture_raw, np.nan))
        return replace(lines, texture_raw=self.texture.find(luma, H_ray_ray0, lines.apparent, is_view=is_view))

    def _lines_in(self, luma: Luma, H_ray_ray0: Floats, predicted: Apparent | None, *, confirm: bool) -> TargetMatch:
        found = self._measure(luma, H_ray_ray0, predicted) if predicted is not None else None
        confirm = confirm or (predicted is not None and self._may_mislead(predicted))
        if found is not None and self._may_be_kept(luma, H_ray_ray0, found.apparent, confirm):
            return found
        seen = self._finder.search(luma, H_ray_ray0)
        if seen is None:
            return found or TargetMatch(np.full_like(self.reference_raw, np.nan), None)
        rotation = predicted.rotation_rad if predicted is not None else 0.0
        there = self._measure(luma, H_ray_ray0, Apparent(seen, rotation))
        if found is not None and found.apparent is not None and there.measured < AS_WELL * found.measured:
            # The picture is mistaken: something else that looks alike lies there.
            return found
        return there

    def _may_mislead(self, predicted: Apparent) -> bool:
        step_m = None if predicted.step is None else predicted.step / self._scale.rays_per_m
        return step_m is not None and not NO_STEP_M < step_m < TOO_LONG_STEP_M

    def _may_be_kept(self, luma: Luma, H_ray_ray0: Floats, apparent: Apparent | None, confirm: bool) -> bool:
        return apparent is not None and (not confirm or self._finder.agrees(luma, H_ray_ray0, apparent))

    def _measure(self, luma: Luma, H_ray_ray0: Floats, predicted: Apparent) -> TargetMatch:
        to_raw = self._mapping(H_ray_ray0, predicted)
        matches = find_strips(self.trackers, luma, to_raw, search_px=self._search_px)
        fit = self._rigid(matches, H_ray_ray0)
        apparent = _apparent_of(fit) if is_determined_as_whole(fit.normal, self._whole)[0] else None
        return TargetMatch(np.stack([match.edges_raw for match in matches]), apparent)

    def _rigid(self, matches: list[LineMatch], H_ray_ray0: Floats) -> RigidFit:
        """Return the lines' motion as well as following needs it, from a few points and by two steps."""
        usable = [match if match.measured >= LEAST_STATIONS else NOT_FOUND for match in matches]
        rays = self._lens.rays_from_raw(_middles_of_halves(np.stack([match.midline_raw for match in usable])))
        rays0 = apply_homography(np.linalg.inv(H_ray_ray0), rays)
        weight = np.ones((1, *rays0.shape[:2]))
        return rigid_with_weights(rays0[None], weight, self._lines, self._centre, iterations=2)

    def _mapping(self, H_ray_ray0: Floats, apparent: Apparent) -> Callable[[Floats], Floats]:
        def to_raw(rays0: Floats) -> Floats:
            return self._lens.raw_from_rays(apply_homography(H_ray_ray0, apparent.apply(rays0, self._centre)))

        return to_raw


def _about(luma: Luma, ends_raw: Floats, moving_regions_px: Regions) -> Floats:
    """Return patches (M, 2) of what lies about lines with ends (3, 2, 2), raw pixels; none where it is plain."""
    u, v = ends_raw[0, 1] - ends_raw[0, 0]
    along_l1 = rotation_2d(-float(np.arctan2(v, u)))
    places = ends_raw.reshape(-1, 2) @ along_l1.T
    low, high = places.min(axis=0), places.max(axis=0)
    corners = (low + high) / 2 + REACH_OF_LINES * (high - low) / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    points = choose_features_within(luma, corners @ along_l1, ABOUT_LINES, bounds=moving_regions_px)
    return points if len(points) >= LEAST_PATCHES else points[:0]


def _middles_of_halves(midlines_raw: Floats) -> Floats:
    """Return the median points (L, 2, 2) of both halves of mid-lines (L, STATIONS, 2); nan of those hardly seen."""
    halves = midlines_raw.reshape(len(midlines_raw), 2, -1, 2).swapaxes(2, 3)
    seen = np.isfinite(halves).sum(axis=-1) >= LEAST_STATIONS // 4
    return np.where(seen, finite_median(halves), np.nan)


class PointsFollower:
    """Follows a textured target by patches spread over its region.

    Args:
        luma: the reference frame, (height, width).
        region: (M, 2) its corners, rays of the reference frame.
        name: of the target, for messages.

    Attributes:
        reference_raw: (N, 2) centres of the patches in the reference frame, raw pixels.
        reference_texture_raw: (0, 2), since there are no lines to lie between.
        texture: the patches.

    Raises:
        InputError: the region shows too little texture.
    """

    def __init__(self, luma: Luma, region: Floats, lens: Lens, *, scale: Scale, name: str) -> None:
        self._lens = lens
        self.reference_raw = choose_features_within(luma, lens.raw_from_rays(region), POINTS)
        if len(self.reference_raw) < LEAST_POINTS:
            raise InputError(f"{name}.region_m shows too little texture to follow; enlarge it, or mark lines instead.")
        self.reference_texture_raw = np.empty((0, 2))
        self.texture = Texture(luma, self.reference_raw, lens)
        self._finder = TargetFinder(luma, region, lens, scale)

    def views(self, view: View) -> Singles:
        """Return the patches as a view shows them; see `PatchTracker.views`."""
        found = TargetMatch(np.full_like(self.reference_raw, np.nan), None)
        seen = self._finder.search(view.luma, view.H_ray_ray0)
        if seen is not None:
            found = self._measure(view.luma, view.H_ray_ray0, Apparent(seen, 0.0), least_score=ALIKE_SCORE)
            found = self._settled(view.luma, view.H_ray_ray0, found, NOISY_ROUNDS, least_score=ALIKE_SCORE)
        return self.texture.views(view.luma, view.H_ray_ray0, found.apparent)

    def find(
        self, luma: Luma, H_ray_ray0: Floats, predicted: Apparent | None, *, confirm: bool, is_view: bool = False
    ) -> TargetMatch:
        """Return the patches in a frame; see `Follower.find`."""
        found = self._measure(luma, H_ray_ray0, predicted, is_view=is_view) if predicted is not None else None
        if found is not None and found.apparent is not None:
            rounds = NOISY_ROUNDS if self.texture.patches.is_averaged else 0
            return self._settled(luma, H_ray_ray0, found, rounds, is_view=is_view)
        seen = self._finder.search(luma, H_ray_ray0)
        if seen is None:
            return TargetMatch(np.full_like(self.reference_raw, np.nan), None)
        rotation = predicted.rotation_rad if predicted is not None else 0.0
        coarse = self._measure(luma, H_ray_ray0, Apparent(seen, rotation), is_view=is_view)
        return self._settled(luma, H_ray_ray0, coarse, 1, is_view=is_view)

    def _settled(
        self,
        luma: Luma,
        H_ray_ray0: Floats,
        found: TargetMatch,
        rounds: int,
        *,
        least_score: float | None = None,
        is_view: bool = False,
    ) -> TargetMatch:
        """Return the patches looked for so many times more, each time where they have been found."""
        for _ in range(rounds):
            if found.apparent is not None:
                found = self._measure(luma, H_ray_ray0, found.apparent, least_score=least_score, is_view=is_view)
        return found

    def _measure(
        self,
        luma: Luma,
        H_ray_ray0: Floats,
        predicted: Apparent,
        *,
        least_score: float | None = None,
        is_view: bool = False,
    ) -> TargetMatch:
        raw = self.texture.find(luma, H_ray_ray0, predicted, least_score=least_score, is_view=is_view)
        rays0 = apply_homography(np.linalg.inv(H_ray_ray0), self._lens.rays_from_raw(raw))
        if finite_rows(raw).sum() < max(LEAST_POINTS, len(raw) // 4):
            return TargetMatch(np.full_like(raw, np.nan), None)
        fit = rigid_from_points(rays0[None], np.ones((1, len(rays0))), self.texture.rays0, self.texture.pivot)
        return TargetMatch(raw, _apparent_of(fit) if is_determined(fit.normal)[0] else None)


def _apparent_of(fit: RigidFit) -> Apparent:
    return Apparent(fit.shift[0], float(fit.rotation_rad[0]))


class TargetFinder:
    """Recognises a whole target by its picture, wherever it has moved.

    Hatches, cables and corners tell apart what equal strips do not.

    Args:
        luma: the reference frame, (height, width).
        outline: (M, 2) places that bound the target, rays of the reference frame.
    """

    def __init__(self, luma: Luma, outline: Floats, lens: Lens, scale: Scale) -> None:
        self._lens = lens
        # About a strip's width per sample, so that strips still show and the search stays small.
        self._factor = max(1, round(0.035 * scale.pixels_per_m))
        self._step = self._factor / float(lens.focal_px.mean())
        self._reach, self._near = (
            int(np.ceil(far_m * scale.rays_per_m / self._step)) for far_m in (SEARCH_M, NEIGHBOURS_M)
        )
        self._tolerance = 0.15 * scale.rays_per_m
        low, high = outline.min(axis=0), outline.max(axis=0)
        self._low = low
        self._size = np.maximum(np.ceil((high - low) / self._step).astype(np.int64) + 1, 8)
        self._template = self._picture(luma, np.eye(3), np.zeros(2), 0)

    def search(self, luma: Luma, H_ray_ray0: Floats) -> Floats | None:
        """Return the target's apparent shift (2,) in rays of the reference frame, or None if it is not recognised."""
        return self._likest(luma, H_ray_ray0, np.zeros(2), self._reach)

    def agrees(self, luma: Luma, H_ray_ray0: Floats, apparent: Apparent) -> bool:
        """Whether the whole picture shows the target where it was tracked to, and not one of its neighbours there."""
        shift = self._likest(luma, H_ray_ray0, apparent.shift, self._near)
        return shift is not None and bool(np.linalg.norm(shift - apparent.shift) < self._tolerance)

    def _likest(self, luma: Luma, H_ray_ray0: Floats, around: Floats, reach: int) -> Floats | None:
        """Return the shift within `reach` samples around one at which the target's picture is found, or None."""
        wide = self._picture(luma, H_ray_ray0, around, reach)
        likeness = cv2.matchTemplate(wide, self._template, cv2.TM_CCOEFF_NORMED)
        _, best, _, (u, v) = cv2.minMaxLoc(likeness)
        if best < LEAST_LIKENESS:
            return None
        return around + (np.array([u, v], dtype=np.float64) - reach) * self._step

    def _picture(self, luma: Luma, H_ray_ray0: Floats, shift: Floats, reach: int) -> NDArray[np.uint8]:
        """Return the reduced picture of the shifted target's surroundings, in the reference frame's geometry."""
        size = self._size + 2 * reach
        low = self._low + shift - reach * self._step
        # The map is smooth: computed at some places and interpolated in between.
        knots = [np.linspace(0.0, float(n - 1), 17) for n in size]
        u, v = np.meshgrid(*knots)
        rays0 = low + np.stack([u, v], axis=-1) * self._step
        raw = self._lens.raw_from_rays(apply_homography(H_ray_ray0, rays0))
        raw = np.nan_to_num(raw, nan=-1e4).astype(np.float32)
        columns, rows = np.meshgrid(*[np.arange(n, dtype=np.float32) * np.float32(16 / (n - 1)) for n in size])
        return _reduced(luma, cv2.split(cv2.remap(raw, columns, rows, cv2.INTER_LINEAR)), self._factor)


def _reduced(luma: Luma, raw: Sequence[NDArray[Any]], factor: int) -> NDArray[np.uint8]:
    """Sample a frame at raw pixels u and v, (h, w) each, as means of squares of `factor` pixels; grey beyond it."""
    size = np.array(luma.shape[::-1])
    low = np.clip([int(np.floor(each.min())) - factor for each in raw], 0, size - 1)
    high = np.clip([int(np.ceil(each.max())) + factor + 1 for each in raw], low + 1, size)
    block = cv2.blur(np.ascontiguousarray(luma[low[1] : high[1], low[0] : high[0]]), (factor, factor))
    u, v = (each - np.float32(first) for each, first in zip(raw, low, strict=True))
    sampled = cv2.remap(block, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128)
    return np.asarray(sampled, dtype=np.uint8)
