"""Interior orientation: the lens model and its file.

The model is Bouguet's, as OpenCV has it: focal lengths, principal point and the distortion k1 k2 p1 p2 k3.
The camera looks along +z, x right, y down. `rays` are normalised image coordinates (x/z, y/z) without distortion,
`raw` and `und` are pixels as in `core.coordinates`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from core.coordinates import Floats, batches, read_only
from core.errors import InputError
from core.storage import File, write_atomically
from core.text_files import decoded

# A shorter focal length, as part of the longer side of the frame, sees more than 157 degrees: it is in millimetres.
_SHORTEST_FOCAL = 0.1
# What ROS calls k1 k2 p1 p2 k3, and the same with more that may be zero.
_MODELS = ("plumb_bob", "rational_polynomial")
# Rolling shutters take a few hundredths; a larger number is in milliseconds.
_LONGEST_READOUT_S = 1.0
# Newton's method doubles the number of right digits: after a step this small the ray is exact to 1e-13 or so.
_LAST_STEP = 1e-7
_MAX_STEPS = 40
# Points undistorted at a time: what they need besides themselves stays small, and near the processor.
_BLOCK = 1 << 15


@dataclass(frozen=True)
class LensSigma:
    """One standard deviation of each calibrated parameter: the priors of self-calibration.

    Attributes:
        focal_relative: of the focal length, as a part of it.
        centre_px: of each coordinate of the principal point.
        k1, k2: of the first two radial coefficients.
    """

    focal_relative: float = 6e-4
    centre_px: float = 1.5
    k1: float = 1.5e-3
    k2: float = 3e-3


@dataclass(frozen=True, eq=False)
class Lens:
    """Interior orientation of a camera; all methods work on (..., 2) arrays in float64.

    Attributes:
        image_size_px: (width, height) of the frames it was calibrated for.
        camera_matrix: (3, 3) with fx, fy, cx, cy in pixels; no skew.
        distortion: (5,) k1 k2 p1 p2 k3.
        readout_s: time between the exposures of the first and the last row (rolling shutter); 0 for a global shutter.
        rms_px: reprojection error of the calibration, if known.
        sigma: how well the parameters are known.
    """

    image_size_px: tuple[int, int]
    camera_matrix: Floats
    distortion: Floats
    readout_s: float = 0.0
    rms_px: float | None = None
    sigma: LensSigma = field(default_factory=LensSigma)

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera_matrix", read_only(self.camera_matrix))
        object.__setattr__(self, "distortion", read_only(self.distortion))
        if self.camera_matrix.shape != (3, 3) or self.distortion.shape != (5,):
            raise ValueError("a Lens needs a (3, 3) camera matrix and (5,) distortion coefficients")

    @classmethod
    def ideal(cls, image_size_px: tuple[int, int], focal_px: float) -> Lens:
        """Return a pinhole camera without distortion, principal point in the middle of the image."""
        width, height = image_size_px
        K = np.array([[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])
        return cls(image_size_px, K, np.zeros(5))

    @classmethod
    def stand_in(cls, image_size_px: tuple[int, int]) -> Lens:
        """Return the ideal lens that serves where none is known, its focal length the longer side of the image."""
        return cls.ideal(image_size_px, float(max(image_size_px)))

    @property
    def focal_px(self) -> Floats:
        """(2,) fx, fy."""
        return self.camera_matrix[[0, 1], [0, 1]]

    @property
    def centre_px(self) -> Floats:
        """(2,) cx, cy, the principal point."""
        return self.camera_matrix[:2, 2]

    @cached_property
    def valid_radius(self) -> float:
        """Largest ray radius up to which a larger angle still means a larger image radius; inf if there is no end."""
        k1, k2, _, _, k3 = self.distortion
        slope = np.array([7 * k3, 5 * k2, 3 * k1, 1.0])
        # A coefficient this small bends nothing that a camera sees, but overflows the roots.
        roots = np.roots(np.where(np.abs(slope) < 1e-12, 0.0, slope))
        turning = [root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0]
        return float(np.sqrt(min(turning))) if turning else float("inf")

    def raw_from_rays(self, rays: ArrayLike) -> Floats:
        """Project rays onto the sensor, distortion in.

        Args:
            rays: (..., 2) x/z, y/z.

        Returns:
            (..., 2) raw pixels; nan beyond `valid_radius`, where the model folds the image over itself.
        """
        rays = np.asarray(rays, dtype=np.float64)
        x, y = self._distorted(rays[..., 0], rays[..., 1])
        raw = np.stack((x, y), axis=-1) * self.focal_px + self.centre_px
        if np.isfinite(self.valid_radius):
            raw[(rays * rays).sum(axis=-1) > self.valid_radius**2] = np.nan
        return raw

    def jacobian_raw_rays(self, rays: ArrayLike) -> Floats:
        """Return d(raw)/d(rays): (..., 2, 2) pixels per unit of ray, for rays (..., 2)."""
        rays = np.asarray(rays, dtype=np.float64)
        a, b, d = self._ray_jacobian(rays[..., 0], rays[..., 1])
        fx, fy = self.focal_px
        jacobian = np.empty((*rays.shape, 2))
        jacobian[..., 0, 0] = fx * a
        jacobian[..., 0, 1] = fx * b
        jacobian[..., 1, 0] = fy * b
        jacobian[..., 1, 1] = fy * d
        return jacobian

    def rays_from_raw(self, raw: ArrayLike) -> Floats:
        """Return the rays seen at raw pixels: the exact inverse of `raw_from_rays`, by Newton's method.

        Args:
            raw: (..., 2).

        Returns:
            (..., 2) x/z, y/z; nan where no ray within `valid_radius` is imaged.
        """
        raw = np.asarray(raw, dtype=np.float64)
        distorted = (raw - self.centre_px) / self.focal_px
        if not np.any(self.distortion):
            return distorted
        flat = distorted.reshape(-1, 2)
        rays = np.empty_like(flat)
        for some in batches(len(flat), _BLOCK):
            rays[some] = self._undistorted(flat[some])
        return rays.reshape(raw.shape)

    def _undistorted(self, distorted: Floats) -> Floats:
        target_x, target_y = distorted[:, 0].copy(), distorted[:, 1].copy()
        x, y = target_x.copy(), target_y.copy()
        rays = np.full(distorted.shape, np.nan)
        open_points = np.arange(len(distorted))
        limit = 2.0 * min(self.valid_radius, 1e6)
        for _ in range(_MAX_STEPS):
            with np.errstate(all="ignore"):
                step_x, step_y = self._newton_step(x, y, target_x, target_y)
                x, y = x + step_x, y + step_y
                size = np.maximum(np.abs(step_x), np.abs(step_y))
                found = (size <= _LAST_STEP) & (x * x + y * y <= self.valid_radius**2)
                going = (size > _LAST_STEP) & (np.abs(x) < limit) & (np.abs(y) < limit)
            rays[open_points[found], 0] = x[found]
            rays[open_points[found], 1] = y[found]
            if not going.any():
                break
            if not going.all():
                open_points = open_points[going]
                x, y, target_x, target_y = x[going], y[going], target_x[going], target_y[going]
        return rays

    def und_from_rays(self, rays: ArrayLike) -> Floats:
        """Return undistorted pixels (..., 2) of rays (..., 2)."""
        return np.asarray(rays, dtype=np.float64) * self.focal_px + self.centre_px

    def rays_from_und(self, und: ArrayLike) -> Floats:
        """Return rays (..., 2) of undistorted pixels (..., 2)."""
        return (np.asarray(und, dtype=np.float64) - self.centre_px) / self.focal_px

    def undistort(self, raw: ArrayLike) -> Floats:
        """Return undistorted pixels (..., 2) of raw pixels (..., 2), same camera matrix; nan as `rays_from_raw`."""
        return self.und_from_rays(self.rays_from_raw(raw))

    def distort(self, und: ArrayLike) -> Floats:
        """Return raw pixels (..., 2) of undistorted pixels (..., 2); nan as `raw_from_rays`."""
        return self.raw_from_rays(self.rays_from_und(und))

    def _distorted(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """The distorted ray. Source: Heikkila and Silven 1997; Bouguet's toolbox; OpenCV calib3d."""
        k1, k2, p1, p2, k3 = self.distortion
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx), y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy

    def _ray_jacobian(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Derivatives of the distorted by the ideal ray; symmetric: dx/dx, dx/dy = dy/dx, dy/dy."""
        k1, k2, p1, p2, k3 = self.distortion
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))
        a = radial + xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
        b = xy * slope + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + yy * slope + 6.0 * p1 * y + 2.0 * p2 * x
        return a, b, d

    def _newton_step(self, x: Floats, y: Floats, target_x: Floats, target_y: Floats) -> tuple[Floats, Floats]:
        distorted_x, distorted_y = self._distorted(x, y)
        off_x, off_y = target_x - distorted_x, target_y - distorted_y
        a, b, d = self._ray_jacobian(x, y)
        determinant = a * d - b * b
        return (d * off_x - b * off_y) / determinant, (a * off_y - b * off_x) / determinant


def require_image_size(lens: Lens, *, width: int, height: int, lens_file: Path | str, video_file: File | str) -> None:
    """Refuse a lens calibrated for frames of another size than the video's.

    Raises:
        InputError: naming both sizes.
    """
    if lens.image_size_px == (width, height):
        return
    lens_width, lens_height = lens.image_size_px
    if lens.image_size_px == (height, width):
        remedy = "the video is upright now, so calibrate with frames held the same way"
    else:
        remedy = "calibrate with the same video mode or give the lens file that belongs to this video"
    raise InputError(
        f"{lens_file}: image_width x image_height is {lens_width} x {lens_height}, "
        f"but {video_file} has frames of {width} x {height}; {remedy}."
    )


def read_lens(path: Path | str) -> Lens:
    """Read a lens from OpenCV FileStorage (YAML, XML or JSON), or from YAML as ROS writes it.

    Raises:
        InputError: the file is missing, is no FileStorage, or a node is missing, malformed or out of range.
    """
    path = Path(path)
    try:
        text = decoded(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path}: not found; calibrate with `rooftrack lens` or correct the path.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give an OpenCV FileStorage file.") from None
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as text ({error}); give an OpenCV FileStorage file.") from None
    nodes = _LensNodes(path, text)
    width, height = nodes.whole_number("image_width"), nodes.whole_number("image_height")
    defaults = LensSigma()
    return Lens(
        image_size_px=(width, height),
        camera_matrix=nodes.camera_matrix(width, height),
        distortion=nodes.distortion(),
        readout_s=nodes.readout_s(),
        rms_px=nodes.optional_number("rms_px"),
        sigma=LensSigma(
            focal_relative=nodes.number("sigma_focal_relative", default=defaults.focal_relative),
            centre_px=nodes.number("sigma_centre_px", default=defaults.centre_px),
            k1=nodes.number("sigma_k1", default=defaults.k1),
            k2=nodes.number("sigma_k2", default=defaults.k2),
        ),
    )


def write_lens(path: Path | str, lens: Lens) -> None:
    """Write a lens as OpenCV FileStorage YAML, atomically."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", lens.image_size_px[0])
    storage.write("image_height", lens.image_size_px[1])
    storage.write("camera_matrix", np.array(lens.camera_matrix))
    storage.write("distortion_coefficients", np.array(lens.distortion)[None])
    storage.write("readout_s", float(lens.readout_s))
    if lens.rms_px is not None:
        storage.write("rms_px", float(lens.rms_px))
    storage.write("sigma_focal_relative", float(lens.sigma.focal_relative))
    storage.write("sigma_centre_px", float(lens.sigma.centre_px))
    storage.write("sigma_k1", float(lens.sigma.k1))
    storage.write("sigma_k2", float(lens.sigma.k2))
    write_atomically(Path(path), storage.releaseAndGetString().encode())


class _LensNodes:
    """The nodes of a lens file, each refused by name where it is not what it should be."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        try:
            self._storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            is_usable = self._storage.isOpened() and self._storage.root().isMap()
        except (cv2.error, SystemError):
            is_usable = False
        if not is_usable:
            raise InputError(
                f"{path}: is not an OpenCV FileStorage file; write one with `rooftrack lens` or cv2.FileStorage."
            )

    def _refuse(self, name: str, problem: str) -> InputError:
        return InputError(f"{self._path}: {name} {problem}.")

    def _node(self, name: str) -> Any:
        node = self._storage.getNode(name)
        return None if node is None or node.empty() or node.isNone() else node

    def _array(self, name: str) -> Floats:
        node = self._node(name)
        if node is None:
            raise self._refuse(name, "is missing; add it, or calibrate anew with `rooftrack lens`")
        if _would_be_cut_off(node):
            raise self._refuse(name, f"has dt: {node.getNode('dt').string()}, which cuts off its decimals; write dt: d")
        try:
            values = _numbers(node)
        except (cv2.error, SystemError, TypeError, ValueError):
            raise self._refuse(name, "is not a matrix of numbers; write it as !!opencv-matrix") from None
        if not np.isfinite(values).all():
            raise self._refuse(name, "holds a value that is not finite; calibrate anew")
        return values

    def camera_matrix(self, width: int, height: int) -> Floats:
        K = self._array("camera_matrix")
        if K.size != 9:
            raise self._refuse("camera_matrix", f"has shape {_shape(K)}; it must be 3 x 3")
        K = K.reshape(3, 3)
        if not (K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[2], [0, 0, 1]) and K[1, 0] == 0):
            raise self._refuse("camera_matrix", "must be [fx 0 cx; 0 fy cy; 0 0 1] with positive fx and fy")
        if min(K[0, 0], K[1, 1]) < _SHORTEST_FOCAL * max(width, height):
            raise self._refuse(
                "camera_matrix",
                f"has focal lengths of {K[0, 0]:g} and {K[1, 1]:g}; write them in pixels, not in millimetres",
            )
        if K[0, 1] != 0:
            raise self._refuse("camera_matrix", "has a skew, which the model does not know; calibrate without it")
        if not (-width < K[0, 2] < 2 * width and -height < K[1, 2] < 2 * height):
            raise self._refuse(
                "camera_matrix", f"has its centre far outside the {width} x {height} image; calibrate anew"
            )
        return K

    def distortion(self) -> Floats:
        model = self._node("distortion_model")
        if model is not None and model.string() not in _MODELS:
            raise self._refuse("distortion_model", f"is {model.string()}; calibrate with k1 k2 p1 p2 k3 only")
        values = self._array("distortion_coefficients").ravel()
        if not values[5:].any():
            values = values[:5]
        if len(values) >= 8:
            raise self._refuse(
                "distortion_coefficients",
                f"holds {len(values)} numbers, a rational or thin-prism model; calibrate with k1 k2 p1 p2 k3 only",
            )
        if len(values) not in (4, 5):
            raise self._refuse(
                "distortion_coefficients", f"holds {len(values)} numbers; it must hold k1 k2 p1 p2 and perhaps k3"
            )
        return np.append(values, 0.0)[:5]

    def whole_number(self, name: str) -> int:
        value = self.optional_number(name)
        if value is None:
            raise self._refuse(name, "is missing; add the size of the calibrated frames in pixels")
        if value != int(value) or not 0 < value <= 100_000:
            raise self._refuse(name, f"is {value:g}; it must be a whole number of pixels")
        return int(value)

    def optional_number(self, name: str) -> float | None:
        node = self._node(name)
        if node is None:
            return None
        if not (node.isInt() or node.isReal()):
            raise self._refuse(name, "is not a number; write one")
        value = float(node.real())
        if not np.isfinite(value):
            raise self._refuse(name, "is not finite; write a number")
        return value

    def number(self, name: str, *, default: float) -> float:
        value = self.optional_number(name)
        if value is None:
            return default
        if not value > 0:
            raise self._refuse(name, f"is {value:g}; it must be more than 0")
        return value

    def readout_s(self) -> float:
        value = self.optional_number("readout_s") or 0.0
        if abs(value) >= _LONGEST_READOUT_S:
            raise self._refuse(
                "readout_s",
                f"is {value:g}, but no camera takes {_LONGEST_READOUT_S:g} s from its first row to its last; write "
                "seconds, such as 0.02, or 0",
            )
        return value


def _numbers(node: Any) -> Floats:
    """Return the numbers of a matrix, a list, lists in a list or, as ROS writes them, `data` beside rows and columns.

    Raises:
        TypeError, ValueError, cv2.error, SystemError: it is none of these.
    """
    if node.isSeq():
        return np.array([value for place in range(node.size()) for value in _numbers(node.at(place)).ravel()])
    if node.isInt() or node.isReal():
        return np.array([node.real()])
    if node.isMap() and node.getNode("dt").empty() and node.getNode("data").isSeq():
        return _numbers(node.getNode("data"))
    matrix = node.mat()
    return np.empty(0) if matrix is None else np.asarray(matrix, dtype=np.float64)


def _would_be_cut_off(node: Any) -> bool:
    """Whether a matrix says that its numbers are whole, by `dt` other than `f` or `d`, but they are not."""
    if not node.isMap() or node.getNode("dt").string()[-1:] in ("", "f", "d"):
        return False
    data = node.getNode("data")
    return data.isSeq() and any(not data.at(place).real().is_integer() for place in range(data.size()))


def _shape(array: Floats) -> str:
    return " x ".join(str(length) for length in array.shape)
