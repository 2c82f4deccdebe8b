"""Lens calibration: pictures or a video of a checkerboard → interior orientation, and how well it is known.

Views without a board, blurred ones and outliers are left out by name; what remains is judged by its coverage of the
image and by the variety of its tilts, since a lens is known only where and how it was looked through.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.coordinates import Floats, read_only
from core.errors import InputError
from core.lens import Lens, LensSigma, read_lens
from core.progress import CancelToken, Progress, silent
from core.video import frame_index, probe, read_frames

Luma = NDArray[np.uint8]

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
MIN_VIEWS = 4
# Bytes; a lens takes a thousand.
_LARGEST_LENS_FILE = 1 << 20
# Frames of a video are looked at this many times at most, in equal parts of its duration.
_VIDEO_PARTS = 40
_FRAMES_PER_PART = 5
# Boards whose corners lie no farther apart than this show nothing twice but its noise, which counts as knowledge then.
_REPEATED_PX = 0.5
# A board is looked for in a picture of about this width first: fast, and blind to fine texture.
_SEARCH_WIDTH_PX = 1600
# A view whose edges rise over so many times more pixels than those of the others was out of focus or moved;
_BLURRED_RATIO = 2.0
# edges as sharp as this are never blamed;
_SHARP_PX = 5.0
# where they fill so much of a square, the corners run into each other.
_BLURRED_SHARE = 0.4
# A view whose error is this many times the median of all is an outlier: a bent board, a wrong corner.
_OUTLIER_RATIO = 2.5
_OUTLIER_FLOOR_PX = 0.15
# What no checkerboard session reaches in the field, whatever least squares say: bent boards, focus, temperature.
_LEAST_SIGMA = LensSigma(focal_relative=2e-4, centre_px=0.5, k1=5e-4, k2=1e-3)
_GOOD_COVERAGE = 0.6
_GOOD_TILT_RAD = np.radians(12.0)


@dataclass(frozen=True)
class View:
    """What became of one picture of the board.

    Attributes:
        name: of the file, with the frame number for a video.
        corners_px: (N, 2) raw pixels, row by row of the board, or None where none was found.
        edge_px: pixels over which the edges of the squares rise; small is sharp.
        rms_px: reprojection error, or None where the view was left out before.
        tilt_rad: angle between the board and the image plane, or None.
        left_out: why it was left out; empty where it was used.
    """

    name: str
    corners_px: Floats | None = None
    edge_px: float | None = None
    rms_px: float | None = None
    tilt_rad: float | None = None
    left_out: str = ""


@dataclass(frozen=True)
class Calibration:
    """A lens and the report on how it was found.

    Attributes:
        lens: with `rms_px` and `sigma` set.
        board: inner corners along and across.
        square_m: edge of a square.
        views: all pictures looked at, used or left out.
        coverage_grid: (6, 8) number of corners per part of the image, row by row from the top.
        covered_share: part of the image inside the hull of all corners.
        deviations: standard deviation of fx, fy, cx, cy, k1, k2, p1, p2, k3 from least squares.
        warnings: sentences.
    """

    lens: Lens
    board: tuple[int, int]
    square_m: float
    views: tuple[View, ...]
    coverage_grid: NDArray[np.int64]
    covered_share: float
    deviations: Floats
    warnings: tuple[str, ...]

    @property
    def used(self) -> tuple[View, ...]:
        """The views the lens was fitted to."""
        return tuple(view for view in self.views if not view.left_out)

    def facts(self) -> dict[str, Any]:
        """Return the whole report as JSON values, corners included, for pages and files."""
        K = self.lens.camera_matrix
        values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *self.lens.distortion]
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        return {
            "image_size_px": list(self.lens.image_size_px),
            "board": list(self.board),
            "square_m": self.square_m,
            "rms_px": self.lens.rms_px,
            "parameters": [
                {"name": name, "value": float(value), "deviation": float(deviation)}
                for name, value, deviation in zip(names, values, self.deviations, strict=True)
            ],
            "sigma": dict(vars(self.lens.sigma)),
            "coverage_grid": self.coverage_grid.tolist(),
            "covered_share": self.covered_share,
            "views": [
                {
                    "name": view.name,
                    "used": not view.left_out,
                    "left_out": view.left_out,
                    "edge_px": view.edge_px,
                    "rms_px": view.rms_px,
                    "tilt_rad": view.tilt_rad,
                    "corners_px": None if view.corners_px is None else np.round(view.corners_px, 2).tolist(),
                }
                for view in self.views
            ],
            "warnings": list(self.warnings),
        }

    def report(self) -> str:
        """Return the report in lines for a terminal."""
        facts = self.facts()
        width, height = self.lens.image_size_px
        lines = [f"{len(self.used)} of {len(self.views)} views used, {width} x {height}, RMS {self.lens.rms_px:.3f} px"]
        lines += [f"  {p['name']:<3}{p['value']:>14.6g}  ± {p['deviation']:.2g}" for p in facts["parameters"]]
        lines.append(f"Corners cover {self.covered_share:.0%} of the image; corners per part of it:")
        lines += ["  " + "".join(f"{count:6d}" for count in row) for row in self.coverage_grid]
        for view in self.views:
            error = "" if view.rms_px is None else f"RMS {view.rms_px:.3f} px"
            tilt = "" if view.tilt_rad is None else f"tilt {np.degrees(view.tilt_rad):.0f}°"
            judged = f"left out: {view.left_out}" if view.left_out else f"{error}, {tilt}"
            lines.append(f"  {view.name}: {judged}")
        return "\n".join([*lines, *(f"Warning: {warning}" for warning in self.warnings)])


def calibrate(
    sources: Iterable[Path | str],
    *,
    board: tuple[int, int],
    square_m: float,
    progress: Progress = silent,
    cancel: CancelToken | None = None,
) -> Calibration:
    """Calibrate from picture files and videos of a checkerboard.

    Args:
        sources: files; of a video, its sharpest frames all along are taken.
        board: inner corners along and across.
        square_m: edge of a square.
        progress: told after each picture.
        cancel: asked before each picture.

    Raises:
        InputError: a file cannot be read, sizes differ, or too few views show the board.
        Cancelled: by `cancel`.
    """
    return calibrate_images(images_of([Path(source) for source in sources], progress, cancel), board, square_m)


def calibrate_images(images: Iterable[tuple[str, Luma]], board: tuple[int, int], square_m: float) -> Calibration:
    """Calibrate from named grey images (height, width); see `calibrate`.

    Raises:
        InputError: sizes differ, or too few views show the board.
    """
    if min(board) < 3 or board[0] == board[1] or not 1e-4 <= square_m <= 10:
        raise InputError(
            f"a board of {board[0]} x {board[1]} inner corners and squares of {square_m:g} m cannot tell a lens; "
            "count the inner corners (3 or more, not the same number both ways) and give metres."
        )
    size, views = None, list[View]()
    for name, image in images:
        if size is not None and image.shape != size:
            raise InputError(
                f"{name}: has {image.shape[1]} x {image.shape[0]} pixels, the pictures before it "
                f"{size[1]} x {size[0]}; give pictures of one camera in one mode only."
            )
        size = image.shape
        views.append(_view(name, image, board))
    if size is None:
        raise InputError("no pictures of a checkerboard were given; give 10 to 30, tilted, to the edges of the image.")
    views, fit = _fitted(_without_repeated(_without_blurred(views, board)), (size[1], size[0]), board, square_m)
    return _judged(views, fit, (size[1], size[0]), board, square_m)


def images_of(
    sources: Sequence[Path], progress: Progress = silent, cancel: CancelToken | None = None
) -> Iterator[tuple[str, Luma]]:
    """Yield named grey pictures, one in memory at a time, from picture files, folders of them, and videos.

    Raises:
        InputError: a file cannot be read, or a folder holds no pictures.
    """
    files = [file for source in sources for file in (_pictures_in(source) if source.is_dir() else [source])]
    for done, source in enumerate(files):
        if source.suffix.lower() in IMAGE_SUFFIXES:
            if cancel is not None:
                cancel.raise_if_cancelled()
            yield source.name, _read_image(source)
        else:
            for name, luma in _sharpest_frames(source):
                if cancel is not None:
                    cancel.raise_if_cancelled()
                yield name, luma
        progress("calibration", done + 1, len(files))


def _pictures_in(folder: Path) -> list[Path]:
    pictures = sorted(file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
    if not pictures:
        raise InputError(f"{folder}: is a folder without pictures; give checkerboard pictures, or a video.")
    return pictures


def require_place_for_lens(file: Path, sources: Sequence[Path]) -> None:
    """Refuse to write a lens in the place of anything but an earlier lens, pictures of the board above all.

    Raises:
        InputError: something else is there.
    """
    if file.is_dir():
        raise InputError(f"{file}: is a folder; name the lens file to write in it.")
    if not file.exists() or not file.stat().st_size:
        return
    if any(source.exists() and source.samefile(file) for source in sources):
        raise InputError(f"{file}: is one of the pictures to calibrate from; give --out the name of a lens file.")
    try:
        if file.stat().st_size < _LARGEST_LENS_FILE:
            read_lens(file)
            return
    except InputError:
        pass
    raise InputError(f"{file}: exists and is no lens file; give --out another name, or move it away.")


def _read_image(path: Path) -> Luma:
    try:
        content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except FileNotFoundError:
        raise InputError(f"{path}: not found; correct the path of the checkerboard picture.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error}); check the file.") from None
    # The lens belongs to the sensor's own rows and columns: no turning by what the file says of the camera's hold.
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(content, flags) if len(content) else None
    if image is None:
        raise InputError(f"{path}: is no picture that can be decoded; give JPEG, PNG or TIFF, or a video.")
    return np.asarray(image, dtype=np.uint8)


def _sharpest_frames(path: Path) -> Iterator[tuple[str, Luma]]:
    """Yield the sharpest of a few neighbouring frames from each of equal parts of a video."""
    probe(path)  # a mirrored picture would be another lens
    index = frame_index(path)
    total = len(index)
    for part in range(min(_VIDEO_PARTS, max(1, total // _FRAMES_PER_PART))):
        first = part * total // min(_VIDEO_PARTS, max(1, total // _FRAMES_PER_PART))
        best, sharpness = None, -1.0
        for frame in read_frames(path, first, min(first + _FRAMES_PER_PART, total)):
            detail = float(cv2.Laplacian(frame.luma[::2, ::2], cv2.CV_32F).var())
            if detail > sharpness:
                best, sharpness = (f"{path.name} frame {frame.index}", frame.luma.copy()), detail
        if best is not None:
            yield best


def _view(name: str, image: Luma, board: tuple[int, int]) -> View:
    corners = _find_corners(image, board)
    if corners is None:
        return View(name, left_out=f"no board of {board[0]} x {board[1]} inner corners found")
    across, _ = cv2.estimateChessboardSharpness(image, board, corners.astype(np.float32).reshape(-1, 1, 2))
    return View(name, read_only(corners), edge_px=float(np.ravel(across)[0]))


def _without_blurred(views: list[View], board: tuple[int, int]) -> list[View]:
    """Leave out what is much less sharp than the other views, or too blurred for its squares."""
    usual = float(np.median([view.edge_px for view in views if view.edge_px is not None] or [0.0]))
    judged = []
    for view in views:
        if view.edge_px is not None and view.corners_px is not None:
            limit = min(
                max(_BLURRED_RATIO * usual, _SHARP_PX), _BLURRED_SHARE * _shortest_square_px(view.corners_px, board)
            )
            if not view.edge_px <= limit:
                view = replace(view, left_out=f"blurred, edges rise over {view.edge_px:.1f} px, {limit:.1f} at most")
        judged.append(view)
    return judged


def _without_repeated(views: list[View]) -> list[View]:
    """Leave out what shows the board where another view has it already: a copy of a file, or a board at rest."""
    judged = list[View]()
    for view in views:
        first = next((known for known in judged if not known.left_out and _show_the_same(known, view)), None)
        judged.append(view if first is None or view.left_out else replace(view, left_out=f"the same as {first.name}"))
    return judged


def _show_the_same(one: View, other: View) -> bool:
    if one.corners_px is None or other.corners_px is None:
        return False
    return float(np.abs(one.corners_px - other.corners_px).max()) < _REPEATED_PX


def _shortest_square_px(corners: Floats, board: tuple[int, int]) -> float:
    grid = corners.reshape(board[1], board[0], 2)
    return float(min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)))


def _find_corners(image: Luma, board: tuple[int, int]) -> Floats | None:
    """(N, 2) sub-pixel corners: sought in a small picture, then refined in the full one."""
    scale = max(1.0, image.shape[1] / _SEARCH_WIDTH_PX)
    small = image
    if scale > 1:
        small = np.asarray(cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA))
    found, rough = cv2.findChessboardCornersSB(small, board, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, rough = cv2.findChessboardCorners(small, board, flags=flags)
    if not found:
        return None
    # A reduced pixel spans `scale` full ones, so their centres differ by half of what it spans more.
    corners = (np.asarray(rough, dtype=np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
    reach = int(np.clip(0.35 * _shortest_square_px(corners, board), 3, 15 * scale))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    refined = cv2.cornerSubPix(image, corners.astype(np.float32).reshape(-1, 1, 2), (reach, reach), (-1, -1), criteria)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class _Fit:
    """Result of OpenCV's bundle adjustment over some views, and its figures for each of them."""

    rms_px: float
    camera_matrix: Floats
    distortion: Floats
    deviations: Floats
    rms_of_views_px: Floats
    tilts_rad: Floats


def _fitted(
    views: list[View], size: tuple[int, int], board: tuple[int, int], square_m: float
) -> tuple[list[View], _Fit]:
    """Fit, leave out the worst view while it stands off from the others, fit again."""
    while True:
        used = [number for number, view in enumerate(views) if not view.left_out]
        if len(used) < MIN_VIEWS:
            reasons = "; ".join(f"{view.name}: {view.left_out}" for view in views if view.left_out)
            raise InputError(
                f"only {len(used)} of {len(views)} pictures can be used, {MIN_VIEWS} are needed ({reasons}); "
                "take more, tilted by 20 to 40 degrees, sharp, and check the number of inner corners."
            )
        fit = _bundle([_corners(views[number]) for number in used], size, board, square_m)
        worst = int(np.argmax(fit.rms_of_views_px))
        limit = max(_OUTLIER_RATIO * float(np.median(fit.rms_of_views_px)), _OUTLIER_FLOOR_PX)
        if fit.rms_of_views_px[worst] <= limit:
            break
        error = float(fit.rms_of_views_px[worst])
        view = views[used[worst]]
        reason = f"outlier, RMS {error:.2f} px where the others have {np.median(fit.rms_of_views_px):.2f}"
        views[used[worst]] = replace(view, rms_px=error, tilt_rad=float(fit.tilts_rad[worst]), left_out=reason)
    for number, rms_px, tilt_rad in zip(used, fit.rms_of_views_px, fit.tilts_rad, strict=True):
        views[number] = replace(views[number], rms_px=float(rms_px), tilt_rad=float(tilt_rad))
    return views, fit


def _corners(view: View) -> Floats:
    assert view.corners_px is not None
    return view.corners_px


def _bundle(corners: list[Floats], size: tuple[int, int], board: tuple[int, int], square_m: float) -> _Fit:
    places = np.zeros((board[0] * board[1], 3), dtype=np.float32)
    places[:, :2] = square_m * np.stack(np.meshgrid(np.arange(board[0]), np.arange(board[1])), axis=-1).reshape(-1, 2)
    objects = [places] * len(corners)
    images = [view.astype(np.float32).reshape(-1, 1, 2) for view in corners]
    try:
        rms, K, distortion, rotations, _, deviations, _, of_views = cv2.calibrateCameraExtended(
            objects, images, size, _first_guess(places, corners, size), np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS
        )
    except cv2.error as error:
        raise InputError(
            f"the views of the board tell no lens ({error.err}); take more, tilted by 20 to 40 degrees all ways."
        ) from None
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(distortion).all()):
        raise InputError("the views of the board tell no lens; tilt the board by 20 to 40 degrees in all directions.")
    facing = [cv2.Rodrigues(rotation)[0][2, 2] for rotation in rotations]
    return _Fit(
        rms_px=float(rms),
        camera_matrix=np.asarray(K, dtype=np.float64),
        distortion=np.asarray(distortion, dtype=np.float64).ravel()[:5],
        deviations=np.asarray(deviations, dtype=np.float64).ravel()[:9],
        rms_of_views_px=np.asarray(of_views, dtype=np.float64).ravel(),
        tilts_rad=np.arccos(np.clip(np.abs(facing), 0, 1)),
    )


def _first_guess(places: NDArray[np.float32], corners: list[Floats], size: tuple[int, int]) -> Floats:
    """Centre of the image, and the focal length the boards' perspective asks for.

    Each homography H = K [r1 r2 t] gives two equations in 1/f², from r1·r2 = 0 and |r1| = |r2|; the median holds
    against boards that face the camera and tell nothing.

    Source: Zhang 2000, section 3.1.
    """
    centre = (np.array(size) - 1) / 2
    squared = []
    for view in corners:
        H = np.asarray(cv2.findHomography(places[:, :2], view - centre)[0], dtype=np.float64)
        if H.shape != (3, 3):
            continue
        (a1, b1, c1), (a2, b2, c2) = H[:, 0], H[:, 1]
        for metric, perspective in (
            (a1 * a2 + b1 * b2, c1 * c2),
            (a1**2 + b1**2 - a2**2 - b2**2, c1**2 - c2**2),
        ):
            if abs(perspective) > 1e-12 and -metric / perspective > 0:
                squared.append(-metric / perspective)
    usual = 0.8 * max(size)
    focal = float(np.sqrt(np.median(squared))) if squared else usual
    if not 0.3 * max(size) < focal < 10 * max(size):
        focal = usual
    return np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])


def _judged(
    views: list[View], fit: _Fit, size: tuple[int, int], board: tuple[int, int], square_m: float
) -> Calibration:
    """Put together the lens, its uncertainty and what a person should know."""
    corners = np.concatenate([_corners(view) for view in views if not view.left_out])
    hull = cv2.contourArea(cv2.convexHull(corners.astype(np.float32)))
    grid = np.histogram2d(corners[:, 1], corners[:, 0], bins=(6, 8), range=((0, size[1]), (0, size[0])))[0]
    covered = float(hull / (size[0] * size[1]))
    deviation = fit.deviations
    sigma = LensSigma(
        focal_relative=max(float(deviation[0] / fit.camera_matrix[0, 0]), _LEAST_SIGMA.focal_relative),
        centre_px=max(float(deviation[2:4].max()), _LEAST_SIGMA.centre_px),
        k1=max(float(deviation[4]), _LEAST_SIGMA.k1),
        k2=max(float(deviation[5]), _LEAST_SIGMA.k2),
    )
    return Calibration(
        lens=Lens(size, fit.camera_matrix, fit.distortion, rms_px=fit.rms_px, sigma=sigma),
        board=board,
        square_m=square_m,
        views=tuple(views),
        coverage_grid=grid.astype(np.int64),
        covered_share=covered,
        deviations=read_only(deviation),
        warnings=tuple(_warnings(fit, covered, grid)),
    )


def _warnings(fit: _Fit, covered: float, grid: Floats) -> Iterator[str]:
    if len(fit.rms_of_views_px) < 8:
        yield f"only {len(fit.rms_of_views_px)} views are used; 10 to 30 make a lens well known."
    if covered < _GOOD_COVERAGE:
        yield f"the corners cover {covered:.0%} of the image; hold the board near its edges and corners, too."
    empty = int(np.count_nonzero(grid == 0))
    if empty > grid.size // 4:
        yield f"{empty} of {grid.size} parts of the image saw no corner; the distortion there is extrapolated."
    tilted = int(np.count_nonzero(fit.tilts_rad > _GOOD_TILT_RAD))
    if tilted < max(3, len(fit.tilts_rad) // 3):
        yield f"only {tilted} views are tilted by more than 12 degrees; the focal length needs tilts in all directions."
    if fit.rms_px > 1.0:
        yield f"the RMS of {fit.rms_px:.2f} px is high; check that the board is flat and the pictures are sharp."
    if fit.deviations[0] / fit.camera_matrix[0, 0] > 2e-3:
        yield "the focal length is known to worse than 0.2 %; take more tilted views."
    grown = 1 + fit.distortion[0] * 0.25 + fit.distortion[1] * 0.0625 + fit.distortion[4] * 0.0156
    if not 0.3 < grown < 3:
        yield "the distortion is implausibly strong; check the board's number of corners and the pictures."
