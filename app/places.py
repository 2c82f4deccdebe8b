"""Which places on this computer the browser may see: the allowed roots, and nothing a link leads to outside them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from app.errors import Missing, Refused
from core.cloud import CLOUD_SUFFIXES
from core.lens_calibration import IMAGE_SUFFIXES

# What comes later wins: a table of numbers is taken for a GPS record.
KINDS_BY_SUFFIX = {
    **dict.fromkeys((".mp4", ".mov", ".m4v", ".mkv", ".avi", ".mts", ".m2ts", ".ts", ".webm"), "video"),
    **dict.fromkeys(CLOUD_SUFFIXES, "cloud"),
    **dict.fromkeys((".yaml", ".yml", ".xml", ".json"), "lens"),
    **dict.fromkeys((".csv", ".txt"), "gps"),
    **dict.fromkeys(IMAGE_SUFFIXES, "image"),
}
# It may be a point cloud too, so these suffixes are offered for both.
SUFFIXES_OF_CLOUD_TABLES = (".csv", ".txt")


def kind_of(path: Path) -> str | None:
    """Return what a file seems to be, by its suffix: video, cloud, lens, gps, image; None where it is unknown."""
    return KINDS_BY_SUFFIX.get(path.suffix.lower())


class Places:
    """The folders the browser may look into."""

    def __init__(self, roots: Iterable[Path]) -> None:
        """Take the roots as they really lie; those that do not exist, or lie in another, are dropped."""
        real = sorted({Path(root).expanduser().resolve() for root in roots if Path(root).expanduser().is_dir()})
        self.roots = tuple(root for root in real if not any(root != other and _within(root, other) for other in real))

    def allowed(self, path: Path | str) -> Path:
        """Return the real place of an absolute path.

        Raises:
            Refused: the place, or what a link at it leads to, lies outside the roots, or in nobody's home.
        """
        if "\0" in str(path):
            raise Refused("A path cannot hold a null character; correct it.", path=None)
        try:
            place = Path(path).expanduser()
        except RuntimeError:
            raise Refused(f"{path}: there is no such home folder; give the whole path.", path=str(path)) from None
        if not place.is_absolute():
            raise Refused(f"{path}: is not an absolute path; give the whole path.", path=str(path))
        real = Path(os.path.realpath(place))
        if not any(_within(real, root) for root in self.roots):
            raise Refused(f"{path}: lies outside the folders Rooftrack may read ({self._named()}).", path=str(path))
        return real

    def file(self, path: Path | str) -> Path:
        """Return the real place of an existing file.

        Raises:
            Refused: outside the roots.
            Missing: there is no such file.
        """
        real = self.allowed(path)
        if not real.is_file():
            raise Missing(f"{path}: no such file; choose another one.", path=str(path))
        return real

    def _named(self) -> str:
        return ", ".join(str(root) for root in self.roots)


def _within(path: Path, root: Path) -> bool:
    return path == root or root in path.parents
