"""The pictures in a scene: ground, roofs, shake table, cars and other things, different with every seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sample_data.scene import RoofLines
from sample_data.textures import Canvas, Colour, Texture

Floats = NDArray[np.float64]
Rng = np.random.Generator

CONCRETE: Colour = (-3.0, 2.0)
ASPHALT: Colour = (1.0, -1.0)
SOIL: Colour = (-14.0, 9.0)
GRASS: Colour = (-12.0, -8.0)
YELLOW: Colour = (-55.0, 12.0)
BLUE: Colour = (38.0, -16.0)
RED: Colour = (-16.0, 48.0)


# --- ground -----------------------------------------------------------------------------------------------------


def paint_ground(
    rng: Rng, extent_m: tuple[float, float, float, float], *, texel_m: float, blur_m: float, contrast: float
) -> Texture:
    """Return concrete with joints, cracks, stains, paint marks, asphalt and gravel; `contrast` scales all of it."""
    base = rng.uniform(118, 146)
    canvas = Canvas(extent_m, texel_m, base, CONCRETE)
    west, south, east, north = extent_m
    _slabs(canvas, rng, base, contrast)
    _fields(canvas, rng, base, contrast)
    for _ in range(70):
        place = rng.uniform([west, south], [east, north])
        stain = blob(rng, place, rng.uniform(0.15, 1.6))
        canvas.polygon(stain, base * (1 + contrast * rng.normal(-0.12, 0.22)), CONCRETE, opacity=rng.uniform(0.25, 0.8))
    for _ in range(26):
        crack = _wander(rng, rng.uniform([west, south], [east, north]), steps=24, step_m=0.35)
        canvas.line(crack, rng.uniform(0.008, 0.03), base * (1 - 0.4 * contrast))
    _marks(canvas, rng, base, contrast)
    for size_m, share in ((0.015, 0.035), (0.05, 0.035), (0.18, 0.03), (0.7, 0.025), (3.5, 0.035)):
        if size_m >= texel_m:
            canvas.grain(rng, size_m=size_m, contrast=share * contrast, colour=1.5 if size_m > 1 else 0.0)
    return canvas.finish(blur_m, has_edge=False)


def _slabs(canvas: Canvas, rng: Rng, base: float, contrast: float) -> None:
    """Paint slabs of slightly different grey with dark joints, turned a little against the axes."""
    slab, turn = rng.uniform(3.8, 6.0), rng.uniform(-0.12, 0.12)
    along = np.array([np.cos(turn), np.sin(turn)])
    across = np.array([-along[1], along[0]])
    reach = int(90 / slab) + 2
    offset = rng.uniform(-slab, slab, 2)
    for i in range(-reach, reach):
        for j in range(-reach, reach):
            corner = offset + i * slab * along + j * slab * across
            square = [corner, corner + slab * along, corner + slab * (along + across), corner + slab * across]
            canvas.polygon(square, base * (1 + contrast * rng.normal(0, 0.045)), CONCRETE)
    joint = base * (1 - 0.38 * contrast)
    for i in range(-reach, reach):
        for way, side in ((along, across), (across, along)):
            start = offset + i * slab * side
            canvas.line([start - 100 * way, start + 100 * way], rng.uniform(0.010, 0.022), joint)


def _fields(canvas: Canvas, rng: Rng, base: float, contrast: float) -> None:
    """Paint larger areas of other ground: asphalt, soil, grass."""
    middle = (
        np.array([canvas.west_m, canvas.north_m])
        + np.array([1, -1]) * canvas.texel_m * np.array(canvas.luma.shape[::-1]) / 2
    )
    reach = canvas.texel_m * max(canvas.luma.shape) / 2
    for colour, tone in ((ASPHALT, -0.42), (SOIL, -0.1), (GRASS, -0.3)):
        way = rng.uniform(0, 2 * np.pi)
        place = middle + rng.uniform(0.55, 0.9) * reach * np.array([np.cos(way), np.sin(way)])
        shape = blob(rng, place, rng.uniform(0.15, 0.3) * reach, corners=40)
        canvas.polygon(shape, base * (1 + contrast * tone), colour, opacity=0.9)
        for _ in range(500):
            tuft = place + rng.normal(0, 0.16 * reach, 2)
            canvas.polygon(
                blob(rng, tuft, rng.uniform(0.03, 0.14), corners=7),
                base * (1 + contrast * rng.normal(tone, 0.25)),
                colour,
                opacity=rng.uniform(0.4, 1),
            )


def _marks(canvas: Canvas, rng: Rng, base: float, contrast: float) -> None:
    """Paint parking lines, survey crosses, manholes and small boxes."""
    west, north = canvas.west_m, canvas.north_m
    rows, columns = canvas.luma.shape
    size = np.array([columns, -rows]) * canvas.texel_m
    white = base + contrast * (225 - base)
    for _ in range(3):
        corner, turn = np.array([west, north]) + rng.uniform(0.1, 0.8, 2) * size, rng.uniform(0, np.pi)
        along, side = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        for bay in range(rng.integers(4, 8)):
            foot = corner + 2.6 * bay * along
            canvas.line([foot, foot + 5 * side], 0.1, white * rng.uniform(0.85, 1))
    for _ in range(26):
        at, turn, arm = (
            np.array([west, north]) + rng.uniform(0, 1, 2) * size,
            rng.uniform(0, np.pi),
            rng.uniform(0.1, 0.4),
        )
        way = arm * np.array([np.cos(turn), np.sin(turn)])
        grey = white if rng.random() < 0.6 else base * (1 - 0.6 * contrast)
        canvas.line([at - way, at + way], arm * 0.25, grey)
        canvas.line([at - way[::-1] * [1, -1], at + way[::-1] * [1, -1]], arm * 0.25, grey)
    for _ in range(40):
        at, half = np.array([west, north]) + rng.uniform(0, 1, 2) * size, rng.uniform(0.06, 0.5, 2)
        grey = base * (1 + contrast * rng.uniform(-0.6, 0.7))
        colour = (CONCRETE, BLUE, RED, YELLOW)[rng.integers(0, 4)]
        canvas.box((at[0] - half[0], at[1] - half[1], at[0] + half[0], at[1] + half[1]), grey, colour)


def blob(rng: Rng, centre_m: Floats, radius_m: float, corners: int = 18) -> Floats:
    """Return the (corners, 2) outline of a random rounded shape."""
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    radius = radius_m * (
        1 + sum(rng.normal(0, 0.22 / k) * np.cos(k * angle + rng.uniform(0, 6.3)) for k in (1, 2, 3, 5))
    )
    return np.asarray(
        centre_m + np.column_stack((radius * np.cos(angle), radius * rng.uniform(0.6, 1) * np.sin(angle)))
    )


def _wander(rng: Rng, start_m: Floats, *, steps: int, step_m: float) -> Floats:
    way = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.35, steps))
    return np.asarray(start_m + np.cumsum(step_m * np.column_stack((np.cos(way), np.sin(way))), axis=0))


# --- roofs ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RoofLook:
    """Brightness of a roof and its strips, grey levels.

    Attributes:
        sheet: of the boards between the strips.
        along, across: of the strips along x (L1, L2 and their like) and along y.
        unlike: how differently boards turn out, relative, one standard deviation.
    """

    sheet: float
    along: float
    across: float
    unlike: float = 0.05

    @classmethod
    def random(cls, rng: Rng) -> RoofLook:
        """Return bright strips on dark, dark on bright, or one kind each way."""
        # sheet, strips along, strips across, unlike
        looks = (
            (84, 205, 198, 0.12),
            (186, 62, 70, 0.08),
            (128, 215, 48, 0.10),
            (150, 58, 222, 0.05),
            (108, 182, 190, 0.14),
        )
        sheet, along, across, unlike = looks[rng.integers(0, len(looks))]
        turn_out = rng.uniform(0.94, 1.06, 3)
        return cls(sheet * turn_out[0], along * turn_out[1], across * turn_out[2], unlike)


def paint_roof(
    rng: Rng, size_m: tuple[float, float], lines: RoofLines, *, texel_m: float, blur_m: float, contrast: float = 1.0
) -> Texture:
    """Return a roof of boards with strips over the joints: the measured ones, and others just like them beside them."""
    look = RoofLook.random(rng)
    half_x, half_y = size_m[0] / 2, size_m[1] / 2
    canvas = Canvas((-half_x, -half_y, half_x, half_y), texel_m, look.sheet, (-2.0, 3.0))
    _boards(canvas, rng, look, lines, half_x=half_x, half_y=half_y, contrast=contrast)
    strip = rng.uniform(0.055, 0.095)
    pitch = abs(lines.l1_y_m - lines.l2_y_m)
    along = look.sheet + contrast * (look.along - look.sheet)
    across = look.sheet + contrast * (look.across - look.sheet)
    for k in range(-6, 7):
        _strip_along(canvas, lines.l2_y_m + k * pitch, strip, (-half_x, half_x), along * rng.uniform(0.96, 1.04))
    _strip_along(canvas, lines.l1_y_m + 0.35, strip, (-half_x, 0.35 * half_x), along)
    _strip_along(canvas, lines.l2_y_m - 0.36, 0.8 * strip, (-0.5 * half_x, half_x), along)
    for k in range(-4, 5):
        _strip_across(canvas, lines.t1_x_m + 2 * k * pitch, strip, (-half_y, half_y), across * rng.uniform(0.96, 1.04))
    _strip_across(canvas, lines.t1_x_m + 0.37, strip, (-half_y, 0.4 * half_y), across)
    _furniture(canvas, rng, look, lines, half_x=half_x, half_y=half_y)
    canvas.box((-half_x, half_y - 0.18, half_x, half_y), look.sheet * 0.7)
    canvas.box((-half_x, -half_y, half_x, -half_y + 0.18), look.sheet * 1.2)
    for size, share in ((0.006, 0.02), (0.03, 0.015), (0.15, 0.012), (0.9, 0.02)):
        canvas.grain(rng, size_m=max(size, texel_m), contrast=share, colour=1.0 if size > 0.5 else 0.0)
    return canvas.finish(blur_m, has_edge=True)


def _boards(
    canvas: Canvas, rng: Rng, look: RoofLook, lines: RoofLines, *, half_x: float, half_y: float, contrast: float
) -> None:
    """Paint boards of different brightness that meet under the strips, so that a strip's two sides differ."""
    pitch = abs(lines.l1_y_m - lines.l2_y_m)
    for k in range(-7, 8):
        for m in range(-5, 6):
            south, west = lines.l2_y_m + k * pitch, lines.t1_x_m + 2 * m * pitch
            box = (max(west, -half_x), max(south, -half_y), min(west + 2 * pitch, half_x), min(south + pitch, half_y))
            if box[0] < box[2] and box[1] < box[3]:
                canvas.box(box, look.sheet * (1 + contrast * rng.normal(0, look.unlike)), (-2.0, 3.0))
                middle = (box[0] + box[2]) / 2
                canvas.box((middle - 0.004, box[1], middle + 0.004, box[3]), look.sheet * 0.75)


def _strip_along(canvas: Canvas, y_m: float, width_m: float, x_m: tuple[float, float], grey: float) -> None:
    canvas.box((x_m[0], y_m - width_m / 2, x_m[1], y_m + width_m / 2), grey)


def _strip_across(canvas: Canvas, x_m: float, width_m: float, y_m: tuple[float, float], grey: float) -> None:
    canvas.box((x_m - width_m / 2, y_m[0], x_m + width_m / 2, y_m[1]), grey)


def _furniture(canvas: Canvas, rng: Rng, look: RoofLook, lines: RoofLines, *, half_x: float, half_y: float) -> None:
    """Put hatches, vents and cables on the roof; cables cross the lines, hatches leave most of them free."""
    for x, y, wide, deep in (
        (-0.72, 0.7, 0.9, 0.9),
        (0.7, -0.72, 1.2, 0.8),
        (0.78, 0.76, 0.5, 0.5),
        (-0.8, -0.66, 0.4, 0.6),
    ):
        at = np.array([x * half_x, y * half_y]) + rng.uniform(-0.2, 0.2, 2)
        grey = rng.uniform(50, 225)
        canvas.box((at[0] + 0.05, at[1] - deep * 0.55, at[0] + wide * 0.62, at[1] + deep * 0.4), look.sheet * 0.45)
        canvas.box(
            (at[0] - wide / 2, at[1] - deep / 2, at[0] + wide / 2, at[1] + deep / 2),
            grey,
            BLUE if grey < 90 else CONCRETE,
        )
    for _ in range(7):
        canvas.polygon(blob(rng, rng.uniform([-half_x, -half_y], [half_x, half_y]), 0.09, 12), rng.uniform(40, 230))
    for start in ((-0.95, -0.3), (0.95, 0.45), (0.2, -0.98)):
        cable = _wander(rng, np.array(start) * [half_x, half_y], steps=40, step_m=0.22)
        canvas.line(cable, rng.uniform(0.012, 0.03), rng.choice([35.0, 60.0, 225.0]))
    target = np.array([lines.t1_x_m + 0.4, (lines.l1_y_m + lines.l2_y_m) / 2])
    canvas.polygon(blob(rng, target, 0.16, 20), 235)
    canvas.polygon(blob(rng, target, 0.05, 12), 60)


def paint_gravel_roof(rng: Rng, size_m: tuple[float, float], *, texel_m: float, blur_m: float) -> Texture:
    """Return a ballasted roof without any line: stones, patches, puddles."""
    half_x, half_y = size_m[0] / 2, size_m[1] / 2
    base = rng.uniform(110, 150)
    canvas = Canvas((-half_x, -half_y, half_x, half_y), texel_m, base, (-4.0, 4.0))
    for _ in range(60):
        at = rng.uniform([-half_x, -half_y], [half_x, half_y])
        canvas.polygon(
            blob(rng, at, rng.uniform(0.1, 0.7)), base * rng.uniform(0.7, 1.25), opacity=rng.uniform(0.3, 0.8)
        )
    for _ in range(2500):
        at = rng.uniform([-half_x, -half_y], [half_x, half_y])
        canvas.polygon(blob(rng, at, rng.uniform(0.015, 0.06), 7), base * rng.uniform(0.5, 1.5))
    for size, share in ((0.012, 0.05), (0.05, 0.06), (0.3, 0.04)):
        canvas.grain(rng, size_m=max(size, texel_m), contrast=share)
    return canvas.finish(blur_m, has_edge=True)


# --- other things -----------------------------------------------------------------------------------------------


def paint_car(rng: Rng, *, texel_m: float, blur_m: float) -> Texture:
    """Return a car from above, 4.5 m by 1.8 m."""
    grey, colour = ((210, CONCRETE), (45, ASPHALT), (95, BLUE), (100, RED), (165, CONCRETE))[rng.integers(0, 5)]
    canvas = Canvas((-2.25, -0.9, 2.25, 0.9), texel_m, grey, colour)
    canvas.box((0.35, -0.72, 1.0, 0.72), 38, BLUE)
    canvas.box((-1.9, -0.7, -1.45, 0.7), 42, BLUE)
    canvas.box((-1.4, -0.6, 0.3, 0.6), min(grey * 1.15, 240), colour)
    canvas.grain(rng, size_m=0.5, contrast=0.04)
    return canvas.finish(blur_m, has_edge=True)


def paint_box(
    rng: Rng, size_m: tuple[float, float], grey: float, colour: Colour, *, texel_m: float, blur_m: float
) -> Texture:
    """Return a plain box's top with ribs: a container, a crate, a cloth."""
    half_x, half_y = size_m[0] / 2, size_m[1] / 2
    canvas = Canvas((-half_x, -half_y, half_x, half_y), texel_m, grey, colour)
    for x in np.arange(-half_x, half_x, 0.3):
        canvas.box((x, -half_y, x + 0.05, half_y), grey * 0.85, colour)
    canvas.grain(rng, size_m=0.2, contrast=0.05)
    return canvas.finish(blur_m, has_edge=True)


def paint_blob(rng: Rng, radius_m: float, grey: float, *, texel_m: float, blur_m: float) -> Texture:
    """Return something small without corners, seen from above: a person, a bird; soft and wide: a puff of dust."""
    canvas = Canvas((-1.5 * radius_m, -1.5 * radius_m, 1.5 * radius_m, 1.5 * radius_m), texel_m, 0.0)
    canvas.polygon(blob(rng, np.zeros(2), radius_m), 1.0)
    cover = canvas.finish(blur_m, has_edge=False)
    return Texture(cover.luma * np.float32(grey), cover.luma, cover.chroma, cover.west_m, cover.north_m, texel_m)


def paint_table(rng: Rng, size_m: tuple[float, float], lines: RoofLines, *, texel_m: float, blur_m: float) -> Texture:
    """Return the steel platen of a shake table with painted lines and rows of anchor holes."""
    half_x, half_y = size_m[0] / 2, size_m[1] / 2
    grey = rng.uniform(88, 112)
    canvas = Canvas((-half_x, -half_y, half_x, half_y), texel_m, grey, (4.0, -2.0))
    for x in np.arange(-half_x + 0.3, half_x, 0.61):
        for y in np.arange(-half_y + 0.3, half_y, 0.61):
            canvas.box((x - 0.03, y - 0.03, x + 0.03, y + 0.03), grey * 0.5)
    pitch = abs(lines.l1_y_m - lines.l2_y_m)
    for y in (lines.l1_y_m, lines.l2_y_m, lines.l2_y_m - 0.36, lines.l1_y_m + pitch):
        _strip_along(canvas, y, 0.09, (-half_x, half_x), 214)
    for x in (lines.t1_x_m, lines.t1_x_m - pitch):
        _strip_across(canvas, x, 0.09, (-half_y, half_y), 208)
    for size, share in ((0.03, 0.02), (0.4, 0.04)):
        canvas.grain(rng, size_m=max(size, texel_m), contrast=share)
    return canvas.finish(blur_m, has_edge=True)


def paint_wall(rng: Rng, length_m: float, height_m: float) -> Texture:
    """Return an outer wall with windows, foot at y = 0."""
    base = rng.uniform(90, 190)
    canvas = Canvas((0.0, 0.0, length_m, height_m), 0.03, base, (-3.0, 4.0))
    storey = height_m / 6
    for floor in range(6):
        for x in np.arange(1.0, length_m - 1.2, 2.4):
            foot = floor * storey + 0.9
            canvas.box((x, foot, x + 1.1, foot + 1.3), base * 0.35, BLUE)
        canvas.box((0, floor * storey, length_m, floor * storey + 0.12), base * 0.8)
    canvas.grain(rng, size_m=0.6, contrast=0.04)
    return canvas.finish(0.04, has_edge=False)
