"""LiDAR point clouds: reading, local origin, picking, thinning. The only door to open3d, laspy and pye57.

Everything here speaks the cloud's own coordinates (`world`, metres, right-handed, z up), except `Cloud.points_m`, which
is relative to `Cloud.origin_m`: coordinates of millions of metres, as in UTM, leave float32 no room for millimetres.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.coordinates import LARGEST_M, Floats, read_only
from core.errors import InputError
from core.point_files import PointTable, read_pcd, read_ply, read_text
from core.progress import Progress, silent

# Tables of numbers; the others say what they are in their first bytes.
TABLE_SUFFIXES = (".xyz", ".pts", ".txt", ".csv", ".asc")
CLOUD_SUFFIXES = (".las", ".laz", ".ply", ".pcd", ".e57", *TABLE_SUFFIXES)
_LAS_CHUNK_POINTS = 2_000_000
# ASPRS classes of points that are no surface: low noise and high noise.
_NOISE_CLASSES = (7, 18)
OPEN3D_PACKAGES = "libegl1 libgl1 libx11-6 libusb-1.0-0 libudev1 libidn2-0"


@dataclass(frozen=True, eq=False)
class Cloud:
    """A point cloud.

    Attributes:
        points_m: (N, 3) float64, relative to `origin_m`.
        origin_m: (3,) float64, whole metres near the median point.
        colour: (N, 3) uint8 red, green, blue, or None.
        intensity: (N,) float32 in the file's own units, or None.
        notes: sentences on what was left out or looks doubtful.
    """

    points_m: Floats
    origin_m: Floats
    colour: NDArray[np.uint8] | None = None
    intensity: NDArray[np.float32] | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin_m", read_only(self.origin_m))
        for array in (self.points_m, self.colour, self.intensity):
            if array is not None:
                array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def world_m(self) -> Floats:
        """(N, 3) in the file's own coordinates; a new array."""
        return self.points_m + self.origin_m

    @cached_property
    def extent_m(self) -> tuple[Floats, Floats]:
        """Smallest and largest world coordinates, each (3,)."""
        return self.points_m.min(axis=0) + self.origin_m, self.points_m.max(axis=0) + self.origin_m

    def select(self, which: NDArray[Any] | slice) -> Cloud:
        """Return the cloud of some points, given by mask, indices or a slice, with the same origin."""
        return replace(
            self,
            points_m=self.points_m[which],
            colour=None if self.colour is None else self.colour[which],
            intensity=None if self.intensity is None else self.intensity[which],
        )


def read_cloud(path: Path | str, progress: Progress = silent) -> Cloud:
    """Read a point cloud: LAS, LAZ, PLY, PCD, XYZ, PTS, TXT, CSV or E57.

    Raises:
        InputError: the file is missing, empty, cut off or damaged, has no points, or needs a library that is not there.
    """
    path = Path(path)
    readers: dict[str, Callable[[Path, Progress], Cloud]] = {
        **dict.fromkeys((".las", ".laz"), _read_las),
        **dict.fromkeys(TABLE_SUFFIXES, lambda *a: _from_table(path, read_text(*a))),
        ".ply": lambda *a: _from_table(path, read_ply(*a)),
        ".pcd": _read_pcd,
        ".e57": _read_e57,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"{path}: point clouds end in {', '.join(CLOUD_SUFFIXES)}, not in {path.suffix or 'nothing'}; "
            "export it in one of these formats."
        )
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty; copy or export it again.")
        return reader(path, progress)
    except FileNotFoundError:
        raise InputError(f"{path}: not found; correct the path of the point cloud.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error}); check the file and its permissions.") from None


def make_cloud(
    world_m: Floats,
    *,
    rgb: NDArray[Any] | None = None,
    intensity: NDArray[Any] | None = None,
    notes: tuple[str, ...] = (),
) -> Cloud:
    """Return a cloud of world coordinates (N, 3) with its local origin; colours of 8 or 16 bits or 0 to 1, (N, 3)."""
    origin = np.round(np.median(world_m[:: max(1, len(world_m) // 100_000)], axis=0))
    return Cloud(
        points_m=world_m - origin,
        origin_m=origin,
        colour=None if rgb is None else _eight_bits(rgb),
        intensity=None if intensity is None or not np.ptp(intensity) else intensity.astype(np.float32),
        notes=notes,
    )


def _eight_bits(rgb: NDArray[Any]) -> NDArray[np.uint8] | None:
    """Bring colours to 0..255; None where all points have the same one, which says nothing."""
    low, high = float(rgb.min()), float(rgb.max())
    if not np.any(rgb != rgb[0]):
        return None
    if rgb.dtype.kind == "f" and low >= 0 and high <= 1:
        return np.round(rgb * 255).astype(np.uint8)
    if high > 255:
        rgb = rgb // 256
    return np.asarray(np.clip(rgb, 0, 255), dtype=np.uint8)


def _from_table(path: Path, table: PointTable) -> Cloud:
    if not len(table.xyz):
        raise InputError(f"{path}: holds no points; export it again.")
    _require_on_earth(path, table.xyz)
    return _with_precision_note(path, table)


def _require_on_earth(path: Path, world_m: Floats) -> None:
    on_earth = (np.abs(world_m) < LARGEST_M).all(axis=1)
    if not on_earth.all():
        raise InputError(
            f"{path}: {np.count_nonzero(~on_earth)} points have coordinates that are not finite or no place on Earth, "
            f"the first is point {int(np.argmin(on_earth))} (counted from 0); remove them and export again."
        )


def _with_precision_note(path: Path, table: PointTable) -> Cloud:
    notes: tuple[str, ...] = ()
    if table.stored_in_float32:
        step = float(np.spacing(np.float32(np.abs(table.xyz).max())))
        if step > 0.002:
            notes = (
                f"{path}: coordinates are stored in single precision, in steps of {1000 * step:.0f} mm; "
                "export in double precision or with a local origin.",
            )
    return make_cloud(table.xyz, rgb=table.rgb, intensity=table.intensity, notes=notes)


def _read_pcd(path: Path, progress: Progress) -> Cloud:
    table = read_pcd(path, progress)
    if table is None:
        table = _read_compressed_pcd(path)
    # PCD marks rays without an echo by nan: they are no points.
    finite = np.asarray(np.isfinite(table.xyz).all(axis=1))
    if not finite.any():
        raise InputError(f"{path}: holds no points; export it again.")
    _require_on_earth(path, np.where(finite[:, None], table.xyz, 0))
    rgb = None if table.rgb is None else table.rgb[finite]
    intensity = None if table.intensity is None else table.intensity[finite]
    return _with_precision_note(path, PointTable(table.xyz[finite], rgb, intensity, table.stored_in_float32))


def _read_compressed_pcd(path: Path) -> PointTable:
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"{path}: compressed PCD is read with open3d, which cannot be loaded ({error}); on Debian or Ubuntu run "
            f"`apt-get install {OPEN3D_PACKAGES}`, or export the cloud as LAS, PLY or plain PCD."
        ) from None
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        read = open3d.io.read_point_cloud(path, remove_nan_points=True)
    xyz = np.array(read.points, dtype=np.float64).reshape(-1, 3)
    if not len(xyz):
        raise InputError(f"{path}: holds no points or is cut off; export it again.")
    return PointTable(xyz, np.array(read.colors) if read.has_colors() else None)


def _read_las(path: Path, progress: Progress) -> Cloud:
    import laspy

    _require_room_for_records(path)
    try:
        with laspy.open(path) as reader:
            header = reader.header
            if not header.point_count:
                raise InputError(f"{path}: its header says 0 points; export it again.")
            _require_sound(path, header)
            parts = []
            for chunk in reader.chunk_iterator(_LAS_CHUNK_POINTS):
                parts.append(_las_columns(chunk))
                progress("cloud", sum(part["read"] for part in parts), header.point_count)
    except (InputError, OSError):
        raise
    except Exception as error:  # laspy and lazrs raise whatever they stumble over in a damaged file
        raise InputError(f"{path}: is damaged or no LAS file ({_first_line(error)}); copy it again.") from None
    found = sum(part["read"] for part in parts)
    if found < header.point_count:
        raise InputError(f"{path}: ends after {found} of {header.point_count} points; copy it again, it is cut off.")
    whole: dict[str, Any] = {
        name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "read"
    }
    if not len(whole["xyz"]):
        raise InputError(f"{path}: all its points are classified as noise; export it again.")
    dropped = found - len(whole["xyz"])
    notes = (f"{path}: {dropped} points classified as noise were left out.",) if dropped else ()
    world_m = whole["xyz"] * header.scales + header.offsets
    _require_on_earth(path, world_m)
    return make_cloud(world_m, rgb=whole.get("rgb"), intensity=whole["intensity"], notes=notes)


def _require_room_for_records(path: Path) -> None:
    """Refuse a header that promises more records than there is room for: laspy would go on reading for ever.

    Source: LAS 1.4 R15, public header block; its records begin with 54 bytes each, those after the points with 60.
    """
    with path.open("rb") as stream:
        header = stream.read(247).ljust(247, b"\0")
    size = path.stat().st_size
    header_bytes, points_at, records = struct.unpack_from("<HII", header, 94)
    last_at, last_records = struct.unpack_from("<QI", header, 235) if header[25] >= 4 else (0, 0)
    too_many = header_bytes + 54 * records > min(points_at, size)
    if header[:4] == b"LASF" and (too_many or (last_records and last_at + 60 * last_records > size)):
        raise InputError(
            f"{path}: its header promises {max(records, last_records)} records for which it has no room; copy or "
            "export it again, it is damaged."
        )


def _require_sound(path: Path, header: Any) -> None:
    """Refuse a file whose header gives no place to its points, or that ends before them."""
    if not (np.isfinite([header.scales, header.offsets]).all() and (header.scales > 0).all()):
        raise InputError(f"{path}: the scales or offsets in its header are no numbers of metres; export it again.")
    if header.are_points_compressed:
        _require_sound_chunks(path, header)
        return
    held = (path.stat().st_size - header.offset_to_point_data) // header.point_format.size
    if held < header.point_count:
        raise InputError(
            f"{path}: ends after {max(held, 0)} of {header.point_count} points; copy it again, it is cut off."
        )


def _require_sound_chunks(path: Path, header: Any) -> None:
    """Refuse a LAZ file whose table of chunks is cut off or damaged: lazrs would give it all the memory it asks for.

    The eight bytes before the points say where the table lies, or, with -1, that the last eight of the file say it.
    The table begins with its version and how many chunks it knows; each holds a point at least.

    Source: LASzip 3 file format, chunk table.
    """
    size = path.stat().st_size

    def numbers_at(place: int, kind: str) -> NDArray[Any]:
        if not 0 < place <= size - 8:
            raise InputError(f"{path}: ends before the table of its compressed chunks; copy it again, it is cut off.")
        return np.fromfile(path, dtype=kind, count=8 // np.dtype(kind).itemsize, offset=place)

    (place,) = numbers_at(header.offset_to_point_data, "<i8")
    if place == -1:
        (place,) = numbers_at(size - 8, "<i8")
    _, chunks = numbers_at(int(place), "<u4")
    if chunks > header.point_count:
        raise InputError(f"{path}: the table of its compressed chunks is damaged; copy it again.")


def _las_columns(chunk: Any) -> dict[str, Any]:
    """Whole-number coordinates, intensity and colour of a chunk without its noise."""
    keep = ~np.isin(np.asarray(chunk.classification), _NOISE_CLASSES)
    columns: dict[str, Any] = {
        "read": len(chunk),
        "xyz": np.stack([chunk.X, chunk.Y, chunk.Z], axis=1)[keep],
        "intensity": np.asarray(chunk.intensity)[keep],
    }
    if "red" in chunk.point_format.dimension_names:
        columns["rgb"] = np.stack([chunk.red, chunk.green, chunk.blue], axis=1)[keep]
    return columns


def _read_e57(path: Path, progress: Progress) -> Cloud:
    try:
        import pye57
    except (ImportError, OSError) as error:
        raise InputError(
            f"{path}: E57 is read with pye57, which cannot be loaded ({error}); "
            "run `pip install rooftrack[e57]` or export the cloud as LAS."
        ) from None
    try:
        file = pye57.E57(str(path))
        scans = []
        for number in range(file.scan_count):
            # pye57 cannot read a scan without points, and leaves out those that a scan itself says are invalid.
            if file.get_header(number).point_count:
                scans.append(file.read_scan(number, intensity=True, colors=True, ignore_missing_fields=True))
            progress("cloud", number + 1, file.scan_count)
        file.close()
    except Exception as error:  # libE57 raises its own unnamed errors
        raise InputError(f"{path}: is damaged or no E57 file ({_first_line(error)}); export it again.") from None
    if not any(len(scan["cartesianX"]) for scan in scans):
        raise InputError(f"{path}: holds no points; export it again.")
    world_m = _gathered(scans, ("cartesianX", "cartesianY", "cartesianZ"))
    assert world_m is not None
    finite = np.asarray(np.isfinite(world_m).all(axis=1))
    if not finite.any():
        raise InputError(f"{path}: holds no points with finite coordinates; export it again.")
    _require_on_earth(path, np.where(finite[:, None], world_m, 0))
    rgb, intensity = _gathered(scans, ("colorRed", "colorGreen", "colorBlue")), _gathered(scans, ("intensity",))
    return make_cloud(
        world_m[finite].astype(np.float64),
        rgb=None if rgb is None else rgb[finite],
        intensity=None if intensity is None else intensity[finite, 0],
    )


def _gathered(scans: list[dict[str, Any]], names: tuple[str, ...]) -> NDArray[Any] | None:
    if not all(name in scan for scan in scans for name in names):
        return None
    return np.concatenate([np.stack([scan[name] for name in names], axis=1) for scan in scans])


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def pick(cloud: Cloud, ray_origin_m: ArrayLike, ray_direction: ArrayLike, radius_m: float = 0.1) -> Floats | None:
    """Return the world place (3,) where a ray first meets the cloud, or None.

    Args:
        cloud: the site.
        ray_origin_m: (3,) world.
        ray_direction: (3,), any length.
        radius_m: how near a point must come to the ray.
    """
    direction = np.asarray(ray_direction, dtype=np.float64)
    direction = direction / np.linalg.norm(direction)
    offset = cloud.points_m - (np.asarray(ray_origin_m, dtype=np.float64) - cloud.origin_m)
    along = offset @ direction
    aside = np.einsum("ij,ij->i", offset, offset) - along**2
    hit = np.flatnonzero((along > 0) & (aside <= radius_m**2))
    if not len(hit):
        return None
    first = hit[along[hit] <= along[hit].min() + 2 * radius_m]
    return np.asarray(cloud.points_m[first[np.argmin(aside[first])]] + cloud.origin_m)


def thin(cloud: Cloud, count: int) -> Cloud:
    """Return at most `count` points spread evenly over the surfaces, for display; the same ones each time."""
    if len(cloud) <= count:
        return cloud
    random = np.random.default_rng(0)
    candidates = np.sort(random.choice(len(cloud), min(len(cloud), 6 * count), replace=False))
    points = cloud.points_m[candidates]
    # Of all but the outermost points: a stray echo far away would leave room for nothing else.
    span = np.ptp(np.percentile(points, (1, 99), axis=0), axis=0)
    size = max(float(np.sqrt(max(span[0] * span[1], 1e-6) / count)) / 2, 1e-3)
    while True:
        voxels = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
        wide = voxels.max(axis=0) + 1
        _, first = np.unique((voxels[:, 0] * wide[1] + voxels[:, 1]) * wide[2] + voxels[:, 2], return_index=True)
        if len(first) <= count:
            return cloud.select(candidates[np.sort(first)])
        size *= max(1.05, float(np.sqrt(len(first) / count)))
