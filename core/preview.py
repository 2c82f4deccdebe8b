"""What the engine sees in a target's search bands, in the reference frame: shown while a person draws them.

The very functions that measure the frames later find the edges here, so what is drawn is what will be followed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from core.coordinates import Floats, read_only
from core.errors import InputError
from core.following import make_follower
from core.georeference import ReferenceFit
from core.motion import fit_line
from core.project import LINE_NAMES, Band, Target
from core.roof_lines import LineTracker
from core.video import Luma

# Points of a band's long side, which the lens bends in the raw frame.
_SIDE_POINTS = 17
# While one band is dragged the others stay as they are: they need not be looked for again.
_KEPT_LINES = 16


@dataclass(frozen=True, eq=False)
class LinePreview:
    """One search band and the roof line found in it; plan metres and raw pixels of the reference frame.

    Attributes:
        band_plan: (4, 2) corners.
        band_raw: (2 * 17, 2) its outline.
        edges_plan, edges_raw: (N, 2, 2) both edges at each station where they were found.
        midline_plan, midline_raw: (2, 2) ends of the fitted line within the band; None where none was found.
        rms_px: of the stations' middles about the fitted line.
        message: why there is no line; empty where there is one.
    """

    band_plan: Floats
    band_raw: Floats
    edges_plan: Floats
    edges_raw: Floats
    midline_plan: Floats | None
    midline_raw: Floats | None
    rms_px: float | None
    message: str


@dataclass(frozen=True, eq=False)
class PointPreview:
    """P1 or P2: where it appears on the ground, in the raw frame, and where it is at the target's height."""

    plan_m: Floats
    raw_px: Floats
    world_m: Floats | None


@dataclass(frozen=True, eq=False)
class TargetPreview:
    """A target as it is found in the reference frame.

    Attributes:
        lines: by name; empty for a points target.
        points_plan, points_raw: (N, 2) patches of a points target; empty for a lines target.
        region_raw: (M, 2) outline of a points target.
        p1, p2: the points whose displacement is reported; None where their lines were not found.
        message: what is wrong with the target as a whole; empty where nothing is.
        p1_p2_error: share by which P1 and P2 lie farther apart than is given; None where that cannot be told.
    """

    lines: Mapping[str, LinePreview]
    points_plan: Floats
    points_raw: Floats
    region_raw: Floats
    p1: PointPreview | None
    p2: PointPreview | None
    message: str
    p1_p2_error: float | None = None


class _Frame:
    """A frame and the fit of its pairs, equal to another that holds the very same ones."""

    def __init__(self, luma: Luma, fit: ReferenceFit) -> None:
        self.luma, self.fit = luma, fit

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Frame) and self.luma is other.luma and self.fit is other.fit

    def __hash__(self) -> int:
        return hash((id(self.luma), id(self.fit)))


def preview_target(luma: Luma, target: Target, fit: ReferenceFit) -> TargetPreview:
    """Return what is found of a target in the reference frame; what is not found is said in words.

    Args:
        luma: the reference frame.
        target: with its bands or its region.
        fit: of the clicked pairs.
    """
    if target.kind == "points" or target.lines is None:
        return _preview_points(luma, target, fit)
    bands = {name: getattr(target.lines, name) for name in LINE_NAMES}
    return preview_bands(luma, bands, fit, name=target.name, height_m=target.height_m, p1_p2_m=target.p1_p2_m)


def preview_bands(
    luma: Luma,
    bands: Mapping[str, Band],
    fit: ReferenceFit,
    *,
    name: str,
    height_m: float | None = None,
    p1_p2_m: float | None = None,
) -> TargetPreview:
    """Return what is found in the bands of a target, of which some may still be missing.

    Args:
        luma: the reference frame.
        bands: any of L1, L2 and T1.
        fit: of the clicked pairs.
        name: of the target, for messages.
        height_m: of the target, where known.
        p1_p2_m: distance of P1 and P2, where known, to compare with.
    """
    seen = _Frame(luma, fit)
    lines = {line: _preview_line(seen, band, f"targets.{name}.lines.{line}") for line, band in bands.items()}
    p1, p2 = (_crossing(lines.get(line), lines.get("T1"), height_m, fit) for line in ("L1", "L2"))
    message, error = "", None
    if p1 and p2 and p1_p2_m is not None and p1.world_m is not None and p2.world_m is not None:
        distance_m = float(np.linalg.norm(p1.world_m - p2.world_m))
        message = f"P1–P2 measures {distance_m:.3f} m; {p1_p2_m:.3f} m is given."
        error = distance_m / p1_p2_m - 1.0
    return TargetPreview(lines, np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)), p1, p2, message, error)


def band_outline(band: Band) -> Floats:
    """Return the outline of a band in plan metres, (34, 2), close enough together to bend with the lens."""
    corners = _corners(np.array([band.from_m, band.to_m]), band.width_m)
    return np.concatenate([_between(*corners[:2]), _between(*corners[2:])])


@lru_cache(maxsize=_KEPT_LINES)
def _preview_line(frame: _Frame, band: Band, name: str) -> LinePreview:
    luma, fit = frame.luma, frame.fit
    ends = np.array([band.from_m, band.to_m])
    band_plan = _corners(ends, band.width_m)
    band_raw = fit.raw_from_plan(band_outline(band))
    none = LinePreview(band_plan, band_raw, np.empty((0, 2, 2)), np.empty((0, 2, 2)), None, None, None, "")
    try:
        edges_raw = _edges(luma, ends, band=band, fit=fit, name=name)
    except InputError as error:
        return _without_line(none, str(error))
    edges_raw = edges_raw[np.isfinite(edges_raw).all(axis=(1, 2))]
    if len(edges_raw) < 4:
        return _without_line(none, f"{name} shows too few edge points; draw the band along a clearer stretch")
    edges_plan = fit.plan_from_raw(edges_raw.reshape(-1, 2)).reshape(edges_raw.shape)
    middle_raw = edges_raw.mean(axis=1)
    middle_plan = fit.plan_from_raw(middle_raw)
    normal, offset = fit_line(middle_plan, np.ones(len(middle_plan)), ends[0])
    across_m = (middle_plan - ends[0]) @ normal - offset
    midline = ends - np.outer((ends - ends[0]) @ normal - offset, normal)
    pixels_per_m = np.linalg.norm(np.diff(fit.raw_from_plan(ends), axis=0)) / np.linalg.norm(np.diff(ends, axis=0))
    return LinePreview(
        band_plan=band_plan,
        band_raw=band_raw,
        edges_plan=read_only(edges_plan),
        edges_raw=read_only(edges_raw),
        midline_plan=read_only(midline),
        midline_raw=read_only(fit.raw_from_plan(midline)),
        rms_px=float(np.sqrt(np.mean(across_m**2)) * pixels_per_m),
        message="",
    )


def _without_line(none: LinePreview, message: str) -> LinePreview:
    return LinePreview(
        none.band_plan, none.band_raw, none.edges_plan, none.edges_raw, None, None, None, message.rstrip(".") + "."
    )


def _edges(luma: Luma, ends: Floats, *, band: Band, fit: ReferenceFit, name: str) -> Floats:
    """Return (STATIONS, 2, 2) both edges at each station, raw pixels, nan where not found."""
    raw = fit.raw_from_plan(ends)
    if not np.isfinite(raw).all():
        raise InputError(f"{name} lies outside the reference frame; move it onto the roof")
    across = (ends[1] - ends[0])[::-1] * [-1.0, 1.0] / np.linalg.norm(ends[1] - ends[0])
    middle = ends.mean(axis=0)
    beside = fit.raw_from_plan(np.stack([middle - across * band.width_m / 2, middle + across * band.width_m / 2]))
    width_px = float(np.linalg.norm(beside[1] - beside[0]))
    tracker = LineTracker(luma, fit.rays_from_plan(ends), fit.lens.raw_from_rays, width_px=width_px, name=name)
    return tracker.find(luma, fit.lens.raw_from_rays).edges_raw


def _corners(ends: Floats, width_m: float) -> Floats:
    """Return (4, 2) corners of a band, going round."""
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    half = np.array([-along[1], along[0]]) * width_m / 2
    return read_only(np.stack([ends[0] + half, ends[1] + half, ends[1] - half, ends[0] - half]))


def _between(start: Floats, end: Floats) -> Floats:
    return np.asarray(start + np.linspace(0.0, 1.0, _SIDE_POINTS)[:, None] * (end - start))


def _crossing(
    line: LinePreview | None, across: LinePreview | None, height_m: float | None, fit: ReferenceFit
) -> PointPreview | None:
    if line is None or across is None or line.midline_plan is None or across.midline_plan is None:
        return None
    (a, b), (c, d) = line.midline_plan, across.midline_plan
    directions = np.column_stack([b - a, c - d])
    if abs(np.linalg.det(directions)) < 1e-9:
        return None
    plan = a + np.linalg.solve(directions, c - a)[0] * (b - a)
    world = None
    if fit.pose is not None and height_m is not None:
        world = read_only(fit.world_from_plan(plan[None], height_m)[0])
    return PointPreview(read_only(plan), read_only(fit.raw_from_plan(plan[None])[0]), world)


def _preview_points(luma: Luma, target: Target, fit: ReferenceFit) -> TargetPreview:
    region_raw = fit.raw_from_plan(np.array(target.region_m))
    try:
        raw = make_follower(luma, target, fit.rays_from_plan, fit.lens).reference_raw
    except InputError as error:
        return TargetPreview({}, np.empty((0, 2)), np.empty((0, 2)), region_raw, None, None, str(error))
    return TargetPreview({}, fit.plan_from_raw(raw), read_only(raw), region_raw, None, None, "")
