"""Roof lines measured in the frame's own pixels: search band -> both edges of the strip -> mid-line points.

A strip runs mostly along image rows or mostly along columns. Its cross profiles are taken along the other axis, so
every sample is a pixel as the camera delivered it: nothing is warped and nothing interpolated. Columns are pooled into
stations that stay on the same piece of roof in every frame.

The mid-line of two opposite edges does not move when blur or exposure change; a single edge does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from core.coordinates import Floats
from core.errors import InputError
from core.video import Luma

Singles = NDArray[np.float32]
# A function that leads from the band's own coordinates to raw pixels of a frame: (N, 2) -> (N, 2).
Mapping = Callable[[Floats], Floats]

STATIONS = 64
# Least strength of an edge, grey levels per pixel, below which noise decides where it is.
LEAST_EDGE = 1.5
# Correlation of the cross profile below which something else lies in the band.
LEAST_CORRELATION = 0.5
HALLEY_STEPS = 3
# How far an edge may lie beside its strip's mid-line and all of the kernel still falls on pixels, pixels.
ASIDE_PX = 2
# The two edges of a strip, on either side of its mid-line.
SIDES = np.array([[-1.0], [1.0]])
# Parts of a band whose cross profiles are compared one by one, so that one hidden part does not decide.
QUARTERS = 4


@dataclass(frozen=True)
class StripProfile:
    """What a strip looks like in the reference frame, across itself, in raw pixels.

    Attributes:
        offset_px, tilt_px: of the strip's mid-line from the band's axis: offset + tilt * x, x from -1 to 1.
        width_px: between its two edges.
        polarity: +1 for a strip brighter than its surroundings, -1 for a darker one.
        edge: mean strength of its edges, grey levels per pixel.
        signature: (m,) mean cross profile around the mid-line, zero mean, unit norm.
    """

    offset_px: float
    tilt_px: float
    width_px: float
    polarity: float
    edge: float
    signature: Singles

    @property
    def scale_px(self) -> float:
        """Width of the Gaussian whose derivative finds an edge: near a sharp picture's blur, under half the strip."""
        return float(np.clip(self.width_px / 5.0, 0.8, 1.5))

    @property
    def capture_px(self) -> float:
        """How far an edge may lie from where the mid-line says."""
        return min(3.0, 0.6 * self.width_px)


@dataclass(frozen=True)
class LineMatch:
    """One roof line in one frame.

    Attributes:
        edges_raw: (STATIONS, 2, 2) the two edges at each station, raw pixels u, v; nan where not measured.
        correlation: of the cross profile with the reference's.
    """

    edges_raw: Floats
    correlation: float

    @property
    def midline_raw(self) -> Floats:
        """(STATIONS, 2) raw pixels."""
        return np.asarray(self.edges_raw.mean(axis=1))

    @property
    def measured(self) -> int:
        """Number of stations at which both edges were found."""
        return int(np.isfinite(self.edges_raw).all(axis=(1, 2)).sum())


NOT_FOUND = LineMatch(edges_raw=np.full((STATIONS, 2, 2), np.nan), correlation=0.0)


@dataclass(frozen=True)
class _Section:
    """Cross profiles of a band in one frame.

    Attributes:
        along, across: (n,) positions of the profiles' middles: whole pixels along, predicted line across.
        values: (n, 2 w + 1) grey levels around `rint(across)`.
        place: (n,) from 0 to 1 along the band.
        axis: 0 if the line runs along u, 1 if along v.
    """

    along: Floats
    across: Floats
    values: Singles
    place: Floats
    axis: int

    @property
    def half(self) -> int:
        """Pixels on either side of the middle."""
        return (self.values.shape[1] - 1) // 2

    @property
    def x(self) -> Floats:
        """(n,) from -1 to 1 along the band."""
        return 2.0 * self.place - 1.0


class LineTracker:
    """Follows one strip.

    Args:
        luma: the reference frame.
        ends: (2, 2) the band's axis in any frame that `mapping` leads from.
        to_raw: mapping of that frame to the reference frame's raw pixels.
        width_px: full width of the search band, raw pixels.
        name: for messages.

    Raises:
        InputError: the band leaves the frame or holds no strip.
    """

    def __init__(self, luma: Luma, ends: Floats, to_raw: Mapping, *, width_px: float, name: str) -> None:
        self.axis_points = ends[0] + np.linspace(0.0, 1.0, 33)[:, None] * (ends[1] - ends[0])
        # Kept for good: near 45 degrees the axis must not change from one frame to the next.
        span = np.abs(np.subtract(*to_raw(ends)))
        self._axis = 0 if span[0] >= span[1] else 1
        self._half_band = max(6, int(np.ceil(width_px / 2)))
        section = self._section(luma, to_raw(self.axis_points), self._half_band + 4)
        if section is None:
            raise InputError(f"{name} lies outside the reference frame or is too short; lay it along a strip.")
        self.profile = _find_strip(section, self._half_band, name)
        context = (len(self.profile.signature) - 1) // 2
        self._reach = self._half_band + context + int(np.ceil(abs(self.profile.tilt_px))) + 1

    def find(self, luma: Luma, to_raw: Mapping, *, search_px: float | None = None) -> LineMatch:
        """Return the line in a frame; see `find_strips`."""
        return find_strips([self], luma, to_raw, search_px=search_px)[0]

    def search(self, luma: Luma, path: Floats, search_px: float | None) -> _Strip | LineMatch:
        """Return the strip as it lies in a frame, good to a tenth of a pixel; where it is not recognised, no edges.

        Args:
            path: (n, 2) where its axis should lie, raw pixels.
            search_px: as for `find_strips`.
        """
        section = self._section(luma, path, self._reach)
        if section is None:
            return NOT_FOUND
        reach = min(self._half_band, int(np.ceil(search_px if search_px is not None else self._half_band)))
        offset, correlation = self._locate(section, reach)
        if correlation < LEAST_CORRELATION:
            return LineMatch(NOT_FOUND.edges_raw, correlation)
        line = section.across + self.profile.offset_px + self.profile.tilt_px * section.x + offset
        return _Strip(section, line, self.profile, correlation)

    def _section(self, luma: Luma, raw: Floats, half: int) -> _Section | None:
        """Cut the band about raw pixels (n, 2) out of a frame, or None where it leaves the frame almost everywhere."""
        if not np.isfinite(raw).all():
            return None
        axis = self._axis
        order = 1 if raw[-1, axis] > raw[0, axis] else -1
        path = raw[::order]
        length, breadth = (luma.shape[1], luma.shape[0]) if axis == 0 else luma.shape
        first, last = int(np.ceil(path[0, axis])), int(np.floor(path[-1, axis]))
        along = np.arange(max(first, 0), min(last, length - 1) + 1, dtype=np.float64)
        if len(along) < STATIONS // 2:
            return None
        across = np.interp(along, path[:, axis], path[:, 1 - axis])
        place = np.interp(along, path[:, axis], np.linspace(0.0, 1.0, len(path))[::order])
        middle = np.rint(across).astype(np.int64)
        inside = (middle >= half) & (middle < breadth - half)
        if inside.sum() < STATIONS // 2:
            return None
        along, across, place, middle = along[inside], across[inside], place[inside], middle[inside]
        return _Section(along, across, _profiles(luma, along, middle, half, axis), place, axis)

    def _locate(self, section: _Section, search: int) -> tuple[float, float]:
        """Return the strip's offset from its expected place, good to a tenth of a pixel, and its correlation there."""
        expected = self.profile.offset_px + self.profile.tilt_px * section.x
        fraction = section.across + expected - np.rint(section.across)
        signature = self.profile.signature
        reach = search + (len(signature) - 1) // 2
        first = np.arange(QUARTERS) * len(fraction) // QUARTERS
        count = np.append(first[1:], len(fraction)) - first
        middle = np.add.reduceat(fraction, first) / count
        columns = section.half + np.rint(middle).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
        mean = np.add.reduceat(section.values, first, axis=0, dtype=np.float64) / count[:, None]
        windows = mean[np.arange(QUARTERS)[:, None], np.clip(columns, 0, mean.shape[1] - 1)]
        scores = _correlations(windows, signature)
        score = _median_of_quarters(scores)
        shifts = np.arange(-search, search + 1)
        # Among equals the nearest wins; a look-alike must be clearly better to be preferred.
        best = int(np.argmax(score - 0.1 * (shifts / max(search, 1)) ** 2))
        inner = min(max(best, 1), 2 * search - 1)
        vertex = np.clip(_vertex(scores.T, inner) - best, -1.0, 1.0)
        return float(shifts[best] + _median_of_quarters(vertex + np.rint(middle) - middle)), float(score[best])


@dataclass(frozen=True)
class _Strip:
    """A strip that has been found in a frame.

    Attributes:
        line: (n,) its mid-line in each column of the section, good to a tenth of a pixel.
        correlation: of its cross profile with the reference's.
    """

    section: _Section
    line: Floats
    profile: StripProfile
    correlation: float

    @cached_property
    def members(self) -> Floats:
        """(STATIONS, n) share of each column that belongs to each station."""
        return _membership(self.section.place)

    def matched(self, shift: Floats, strength: Floats) -> LineMatch:
        """Return the match that shifts (2, STATIONS) of both edges make, where they can be believed."""
        profile, axis, members = self.profile, self.section.axis, self.members
        count = members.sum(axis=1)
        filled = np.maximum(count, 1e-9)
        along, middle = members @ self.section.along / filled, members @ self.line / filled
        good = (
            (count >= 0.5 * np.median(count[count > 0]))
            & (np.abs(shift) < profile.capture_px)
            & (strength > 0.25 * profile.edge)
        )
        found = np.full((STATIONS, 2, 2), np.nan)
        found[..., axis] = np.where(good, along, np.nan).T
        found[..., 1 - axis] = np.where(good, middle + SIDES * profile.width_px / 2 + shift, np.nan).T
        width = found[:, 1, 1 - axis] - found[:, 0, 1 - axis]
        found[~(np.abs(width - profile.width_px) < 0.3 * profile.width_px + 0.7)] = np.nan
        return LineMatch(edges_raw=found, correlation=self.correlation)


def find_strips(
    trackers: Sequence[LineTracker], luma: Luma, to_raw: Mapping, *, search_px: float | None = None
) -> list[LineMatch]:
    """Return the lines in a frame; all at once, since a frame's few hundred columns are little work.

    Args:
        luma: the frame.
        to_raw: where the bands should lie, as predicted.
        search_px: how far the prediction may be wrong; None for half each band's width.
    """
    paths = to_raw(np.concatenate([tracker.axis_points for tracker in trackers])).reshape(len(trackers), -1, 2)
    found = [tracker.search(luma, path, search_px) for tracker, path in zip(trackers, paths, strict=True)]
    strips = [one for one in found if isinstance(one, _Strip)]
    shift, strength = _extremes(strips) if strips else (np.empty((0, 2, STATIONS)),) * 2
    extremes = iter(zip(shift, strength, strict=True))
    return [one.matched(*next(extremes)) if isinstance(one, _Strip) else one for one in found]


def _profiles(luma: Luma, along: Floats, middle: NDArray[np.int64], half: int, axis: int) -> Singles:
    """Return pixels (n, 2 half + 1) across the line, as they are."""
    first, last = int(along[0]), int(along[-1]) + 1
    low, high = int(middle.min()) - half, int(middle.max()) + half + 1
    block = luma[low:high, first:last].T if axis == 0 else luma[first:last, low:high]
    block = np.ascontiguousarray(block)
    start = (along.astype(np.int64) - first) * block.shape[1] + middle - half - low
    return block.ravel().take(start[:, None] + np.arange(2 * half + 1)).astype(np.float32)


def _correlations(windows: Floats, signature: Singles) -> Floats:
    """Return the normalised correlation of a signature (m,) at every shift in windows (n, m + shifts - 1)."""
    pieces = np.lib.stride_tricks.sliding_window_view(windows, len(signature), axis=1)
    variation = (pieces**2).sum(axis=-1) - pieces.sum(axis=-1) ** 2 / len(signature)
    norm = np.sqrt(np.maximum(variation, 0.0))
    return np.asarray((pieces @ signature) / np.maximum(norm, 1e-6 + 0.5 * np.sqrt(len(signature))))


def _median_of_quarters(values: Floats) -> Floats:
    """Return the median along the first axis, which has `QUARTERS` places."""
    return np.asarray(np.sort(values, axis=0)[QUARTERS // 2 - 1 : QUARTERS // 2 + 1].mean(axis=0))


def _membership(place: Floats) -> Floats:
    """Return the share (STATIONS, n) of each column that belongs to each station.

    A column on the border between two stations belongs to both: where it lies is predicted, and what is measured must
    not jump with the last digit of a prediction.
    """
    n = np.arange(len(place))
    width = STATIONS * abs(place[-1] - place[0]) / max(len(place) - 1, 1)
    low = STATIONS * place - 0.5 * width
    first, second = (np.clip(np.floor(end), 0, STATIONS - 1).astype(np.int64) for end in (low, low + width))
    beyond = np.where(second > first, (low + width - second) / width, 0.0)
    share = np.zeros((STATIONS, len(place)))
    share[first, n] = 1.0 - beyond
    share[second, n] += beyond
    return share


def _extremes(strips: Sequence[_Strip]) -> tuple[Floats, Floats]:
    """Return how far each edge lies from where its strip's mid-line says, and its grey levels per pixel.

    All columns of a station share one shift; it makes their summed response to a derivative of a Gaussian extreme.
    Found by Halley's method, which triples the correct digits with each step.

    Returns:
        Shift and strength, (strips, 2, STATIONS).
    """
    columns = [len(strip.line) for strip in strips]
    values, start, width = _side_by_side([strip.section for strip in strips])
    expected = np.concatenate([_expected_edges(strip) for strip in strips], axis=1)
    scales = np.array([strip.profile.scale_px for strip in strips])
    # Pixels about where the edge is expected are taken once, with room for an edge that lies beside that.
    half = int(np.ceil(3.0 * scales.max())) + ASIDE_PX
    nearest = np.clip(np.rint(expected).astype(np.int64), half, width - 1 - half)
    taps = np.arange(-half, half + 1)
    sample = values.take(start + nearest + taps[:, None, None])
    powers = (taps ** np.arange(5)[:, None]).astype(np.float32)
    scale = np.repeat(scales, columns)
    distance = (taps[:, None, None] / scale).astype(np.float32)
    units = np.repeat((scales ** -np.arange(5.0)[:, None]).astype(np.float32), columns, axis=1)[:, None]
    pooling = [strip.members.astype(np.float32) for strip in strips]
    by_station = scales[:, None, None]
    slope_sign = -SIDES * np.array([strip.profile.polarity for strip in strips])[:, None, None]
    shift = np.zeros((len(strips), 2, STATIONS))
    for _ in range(HALLEY_STEPS):
        past = ((nearest - expected - _to_columns(shift, pooling)) / scale).astype(np.float32)
        gauss = np.exp(-0.5 * (past + distance) ** 2)
        own = units[:3] * _moments(powers[:3], gauss)
        by_column = _responses(past, units * _moments(powers, gauss * sample), own)
        response, first, second, third, power = _to_stations(by_column, pooling)
        strength = slope_sign * response / np.maximum(power * by_station, 1e-9)
        curved = second * slope_sign < 0
        denominator = 2.0 * second**2 - first * third
        usable = curved & (denominator > 0.5 * second**2)
        halley = -2.0 * first * second / np.where(usable, denominator, 1.0)
        newton = -first / np.where(curved, second, 1.0)
        step = np.where(usable, halley, np.where(curved, newton, 0.0)) * by_station
        shift += np.clip(step, -1.0, 1.0)
    return shift, np.where(curved & (np.abs(step) < 0.05), strength, 0.0)


def _side_by_side(sections: Sequence[_Section]) -> tuple[Singles, NDArray[np.int64], NDArray[np.int64]]:
    """Return the grey levels of sections one after another, and where each column of n begins and how long it is."""
    values = np.concatenate([section.values.ravel() for section in sections])
    width = np.repeat([section.values.shape[1] for section in sections], [len(one.across) for one in sections])
    return values, np.cumsum(width) - width, width


def _expected_edges(strip: _Strip) -> Floats:
    """Return where both edges (2, n) should lie within the columns of the strip's section."""
    return strip.line + SIDES * strip.profile.width_px / 2 - (np.rint(strip.section.across) - strip.section.half)


def _to_columns(by_station: Floats, pooling: Sequence[Singles]) -> Singles:
    """Return (2, n) of values (strips, 2, STATIONS), shared out among the columns of each strip."""
    parts = zip(by_station.astype(np.float32), pooling, strict=True)
    return np.concatenate([part @ members for part, members in parts], axis=1)


def _to_stations(by_column: Singles, pooling: Sequence[Singles]) -> Floats:
    """Return (m, strips, 2, STATIONS) of values (m, 2, n), summed over the columns of each station."""
    ends = np.cumsum([members.shape[1] for members in pooling])
    # As one matrix: products of many small ones take several times as long.
    parts = zip(np.split(by_column.reshape(-1, ends[-1]), ends[:-1], axis=1), pooling, strict=True)
    sums = [(part @ members.T).reshape(-1, 2, STATIONS) for part, members in parts]
    return np.stack(sums, axis=1).astype(np.float64)


def _moments(powers: Singles, weighted: Singles) -> Singles:
    """Return the sums (P, 2, n) of powers (P, taps) times weights (taps, 2, n)."""
    return (powers @ weighted.reshape(len(weighted), -1)).reshape(-1, *weighted.shape[1:])


def _responses(past: Singles, moments: Singles, own: Singles) -> Singles:
    """Return the response to a derivative of a Gaussian, its three derivatives and the kernel's power, (5, 2, n).

    The response is the sum of f(s) s exp(-s^2 / 2); it and its derivatives by the kernel's position are sums of powers
    of s, which follow from powers about the nearest pixel. Lengths are in units of the Gaussian's width.

    Args:
        past: (2, n) how far the nearest pixel lies past the kernel's middle.
        moments: (5, 2, n) of the Gaussian times the picture, about the nearest pixel, from the zeroth on.
        own: (3, 2, n) of the Gaussian alone.
    """
    m0, m1, m2, m3, m4 = moments
    p = past
    s1 = m1 + p * m0
    s2 = m2 + p * (2 * m1 + p * m0)
    s3 = m3 + p * (3 * m2 + p * (3 * m1 + p * m0))
    s4 = m4 + p * (4 * m3 + p * (6 * m2 + p * (4 * m1 + p * m0)))
    power = own[2] + p * (2 * own[1] + p * own[0])
    return np.stack([s1, s2 - m0, s3 - 3 * s1, s4 - 6 * s2 + 3 * m0, power])


def _find_strip(section: _Section, half_band: int, name: str) -> StripProfile:
    """Find the strip of a band in the reference frame: two opposite edges, near the axis, along the whole band.

    Raises:
        InputError: there is none.
    """
    best: tuple[float, float, float, float, float, float] | None = None
    for tilt in np.linspace(-4.0, 4.0, 17):
        profile = _mean_profile(section, 0.0, tilt)
        for score, middle, width, polarity, edge in _edge_pairs(profile, half_band):
            if best is None or score > best[0]:
                best = (score, middle, tilt, width, polarity, edge)
    if best is None:
        raise InputError(
            f"{name} holds no line with two edges in the reference frame; draw the band along a strip or joint, "
            "a few pixels wide, that stands out from the roof."
        )
    _, offset, tilt, width, polarity, edge = best
    context = round(1.2 * width + 4)
    signature = _mean_profile(section, offset, tilt)
    middle_index = (len(signature) - 1) // 2
    context = min(context, middle_index)
    signature = signature[middle_index - context : middle_index + context + 1]
    signature = signature - signature.mean()
    unit = (signature / np.linalg.norm(signature)).astype(np.float32)
    return StripProfile(offset, tilt, width, polarity, edge, unit)


def _mean_profile(section: _Section, offset: float, tilt: float) -> Singles:
    """Return the mean cross profile along the band sheared by offset + tilt x, linearly interpolated, odd length."""
    position = section.across - np.rint(section.across) + offset + tilt * section.x + section.half
    half = section.half - int(np.ceil(abs(offset) + abs(tilt))) - 1
    s = position[:, None] + np.arange(-half, half + 1)
    low = np.clip(np.floor(s).astype(np.int64), 0, section.values.shape[1] - 2)
    part = (s - low).astype(np.float32)
    rows = np.arange(len(position))[:, None]
    values = section.values[rows, low] * (1 - part) + section.values[rows, low + 1] * part
    return np.asarray(np.median(values.reshape(len(values), -1), axis=0) * 0.5 + values.mean(axis=0) * 0.5)


def _edge_pairs(profile: Singles, half_band: int) -> list[tuple[float, float, float, float, float]]:
    """Return candidate strips of a mean profile: (score, middle, width, polarity, edge strength)."""
    gradient = np.gradient(profile.astype(np.float64))
    middle_index = (len(profile) - 1) / 2
    peaks = [
        i
        for i in range(1, len(gradient) - 1)
        if abs(gradient[i]) >= LEAST_EDGE
        and abs(gradient[i]) >= abs(gradient[i - 1])
        and abs(gradient[i]) > abs(gradient[i + 1])
    ]
    refined = [(float(_vertex(np.abs(gradient), i)), gradient[i]) for i in peaks]
    widest = max(8.0, half_band * 0.9)
    found = []
    for number, (left, rise) in enumerate(refined):
        for right, fall in refined[number + 1 :]:
            width, middle = right - left, (left + right) / 2 - middle_index
            if rise * fall >= 0 or not 1.5 <= width <= widest or abs(middle) > half_band:
                continue
            strength = min(abs(rise), abs(fall))
            # A person draws the band around the line: what lies near its axis is meant.
            nearness = np.exp(-0.5 * (middle / (0.45 * half_band)) ** 2)
            # Of nested pairs the narrow one is the strip; the wide one spans two strips.
            slenderness = 1.0 / (1.0 + (width / (0.6 * half_band)) ** 2)
            found.append((strength * nearness * slenderness, middle, width, float(np.sign(rise)), strength))
    return found


def _vertex(values: Floats, i: int) -> Floats:
    """Return where the parabola through three neighbours along the first axis has its vertex, `i` the middle one."""
    curvature = values[i - 1] - 2 * values[i] + values[i + 1]
    flat = curvature == 0
    return np.asarray(i + np.where(flat, 0.0, 0.5 * (values[i - 1] - values[i + 1]) / np.where(flat, 1.0, curvature)))
