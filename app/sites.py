"""Point clouds of the projects: read once in a process of their own, kept as plain arrays, and in memory while used."""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from app.errors import ApiError, Busy, NotYet
from app.frames import Fingerprint, fingerprint
from app.jobs import Jobs
from app.store import CACHE_FOLDER, ProjectFolder, read_json
from core.cloud import Cloud, read_cloud
from core.errors import InputError
from core.ground_plane import GroundPlane, fit_ground_plane
from core.locks import take_lock
from core.progress import CancelToken, Progress
from core.project import RESULTS_FOLDER, Project, read_project
from core.relief import Relief
from core.run import relief_plan
from core.storage import write_atomically

_FACTS = "cloud.json"
_ARRAYS = ("points_m", "colour", "intensity")
_KEPT = 2
_LOOKS_AGAIN_S = 0.1
_BEING_READ = "The cloud is being read; it takes a moment the first time."


@dataclass(frozen=True, eq=False)
class Site:
    """A cloud, its ground, and the key that changes with either."""

    key: str
    cloud: Cloud
    plane: GroundPlane


class Sites:
    """The clouds of the projects a person is looking at."""

    def __init__(self, jobs: Jobs) -> None:
        self._jobs = jobs
        self._sites: OrderedDict[str, Site] = OrderedDict()
        self._reliefs: dict[str, Relief | None] = {}
        self._forgotten: set[str] = set()
        self._lock = threading.Lock()

    def facts(self, folder: ProjectFolder, project: Project, path: Path) -> dict[str, Any] | None:
        """Return what is known of a project's cloud; None while a job reads it, which this starts.

        Raises:
            InputError: the cloud was read and cannot be used, or reading it broke off.
        """
        key = site_key(path, project)
        facts = _known(folder, key)
        if facts is None:
            self._read(folder, project, path, key)
        return facts

    def site(self, folder: ProjectFolder, project: Project) -> Site:
        """Return the cloud and the ground of a project.

        Raises:
            NotYet: it is still being read, which this starts.
            InputError: it cannot be used.
        """
        path = folder.require_input("cloud", project)
        if self.facts(folder, project, path) is None:
            raise NotYet(_BEING_READ, path="inputs.cloud")
        return self._site(folder, site_key(path, project))

    def _site(self, folder: ProjectFolder, key: str) -> Site:
        with self._lock:
            site = self._sites.pop(key, None) or _load(folder.results / CACHE_FOLDER, key)
            self._sites[key] = site
            while len(self._sites) > _KEPT:
                self._sites.popitem(last=False)
        return site

    def site_if_read(self, folder: ProjectFolder, project: Project) -> Site | None:
        """Return the cloud and the ground where they have been read before; None where not. Starts nothing."""
        try:
            path = folder.input_path("cloud", project)
            if path is None or _known(folder, site_key(path, project)) is None:
                return None
            return self._site(folder, site_key(path, project))
        except (InputError, ApiError):
            return None

    def require_usable(self, folder: ProjectFolder, project: Project) -> None:
        """Start nothing, and pass over a cloud that has not been read.

        Raises:
            InputError: the cloud has been read and cannot be used.
        """
        path = folder.input_path("cloud", project)
        if path is not None:
            _known(folder, site_key(path, project))

    def relief(self, folder: ProjectFolder, project: Project) -> Relief | None:
        """Return the ground's relief as the engine uses it; until a job has made it, the one of a moment ago."""
        try:
            plan = relief_plan(folder.folder, project)
        except InputError:
            return None
        if plan is None:
            return None
        if plan.file.is_file():
            self._reliefs[folder.id] = _relief(fingerprint(plan.file))
        return self._reliefs.get(folder.id)

    def begin(self, folder: ProjectFolder, project: Project) -> None:
        """Have the cloud read if there is one and it has not been."""
        with contextlib.suppress(InputError, ApiError):
            path = folder.input_path("cloud", project)
            plan = relief_plan(folder.folder, project)
            known = path is not None and self.facts(folder, project, path) is not None
            if path is not None and known and plan is not None and not plan.file.is_file():
                self._read(folder, project, path, site_key(path, project))

    def forget_failure(self, folder: ProjectFolder) -> None:
        """Let a reading of the cloud that broke off begin anew."""
        latest = self._jobs.latest(folder.id, "cloud")
        if latest is not None:
            self._forgotten.add(latest.id)

    def _read(self, folder: ProjectFolder, project: Project, path: Path, key: str) -> None:
        if self._jobs.running(folder.id, "cloud") is not None:
            return
        plan = relief_plan(folder.folder, project)
        order = {
            "cloud": str(path),
            "key": key,
            "ground_z_m": project.orthoimage.ground_z_m,
            "relief": plan.file.name if plan else None,
        }
        latest = self._jobs.latest(folder.id, "cloud")
        failed = latest is not None and latest.state == "failed" and latest.parameters == order
        if latest is not None and failed and latest.id not in self._forgotten:
            raise InputError(
                f"{path.name}: {latest.message} It is read anew when the page of the inputs is loaded again."
            )
        with contextlib.suppress(Busy):  # another question began it this very moment
            self._jobs.start(folder, "cloud", order)


def site_key(path: Path, project: Project) -> str:
    """Return what changes whenever the cloud's file or the height of the ground does."""
    return json.dumps([*fingerprint(path), project.orthoimage.ground_z_m])


def _known(folder: ProjectFolder, key: str) -> dict[str, Any] | None:
    cache = folder.results / CACHE_FOLDER
    facts = read_json(cache / _FACTS)
    if not isinstance(facts, dict) or facts.get("key") != key:
        return None
    if "error" in facts:
        raise InputError(facts["error"])
    if not _has_arrays(cache, facts):
        return None
    return {name: value for name, value in facts.items() if name not in ("key", "source", "arrays", "plane")}


def read_site(folder: Path, order: dict[str, Any], progress: Progress, cancel: CancelToken) -> Site:
    """Read a cloud and find its ground, keeping both as plain files that open in no time (the job `cloud`).

    Raises:
        InputError: the cloud cannot be used; that is kept too.
    """
    cache, path, key = folder / RESULTS_FOLDER / CACHE_FOLDER, Path(order["cloud"]), str(order["key"])
    cache.mkdir(parents=True, exist_ok=True)
    with _alone(cache, cancel):
        try:
            cloud = _cached_cloud(cache, path, progress)
            cancel.raise_if_cancelled()
            plane = fit_ground_plane(cloud, order["ground_z_m"])
        except InputError as error:
            _write_facts(cache, {"key": key, "error": str(error)})
            raise
        _write_facts(cache, {"key": key, **_kept(cloud, path), **_described(cloud, plane)})
        cancel.raise_if_cancelled()
        wanted = relief_plan(folder, read_project(folder))
        if wanted is not None and not wanted.file.is_file():
            wanted.make(cloud, plane)
    return Site(key, cloud, plane)


@contextlib.contextmanager
def _alone(cache: Path, cancel: CancelToken) -> Iterator[None]:
    """Wait while another job reads the project's cloud: what it has read need not be read again."""
    while (lock := take_lock(cache)) is None:
        cancel.raise_if_cancelled()
        time.sleep(_LOOKS_AGAIN_S)
    with lock:
        yield


@lru_cache(maxsize=8)
def _relief(file: Fingerprint) -> Relief | None:
    return Relief.load(Path(file[0]))


def _cached_cloud(cache: Path, path: Path, progress: Progress) -> Cloud:
    facts = read_json(cache / _FACTS)
    if isinstance(facts, dict) and facts.get("source") == list(fingerprint(path)) and _has_arrays(cache, facts):
        return _arrays(cache, facts)
    cloud = read_cloud(path, progress)
    _write_facts(cache, {})
    for old in cache.glob("cloud_*.npy"):
        old.unlink()
    kept = _kept(cloud, path)
    for name in kept["arrays"]:
        np.save(_array_file(cache, kept, name), getattr(cloud, name))
    return cloud


def _kept(cloud: Cloud, path: Path) -> dict[str, Any]:
    """Return the facts by which a cloud's arrays are found again."""
    arrays = [name for name in _ARRAYS if getattr(cloud, name) is not None]
    return {"source": list(fingerprint(path)), "arrays": arrays}


def _has_arrays(cache: Path, facts: dict[str, Any]) -> bool:
    """Whether all arrays of a cloud are there; an earlier Rooftrack kept them under other names."""
    return "arrays" in facts and all(_array_file(cache, facts, name).is_file() for name in facts["arrays"])


def _array_file(cache: Path, facts: dict[str, Any], name: str) -> Path:
    """Return where an array is kept: each file of a cloud has names of its own, so that no two are ever mixed."""
    source = hashlib.sha256(json.dumps(facts["source"]).encode()).hexdigest()[:16]
    return cache / f"cloud_{name}_{source}.npy"


def _load(cache: Path, key: str) -> Site:
    """Return what a job has kept.

    Raises:
        NotYet: another job has begun to replace it.
    """
    facts = read_json(cache / _FACTS)
    if not isinstance(facts, dict) or facts.get("key") != key:
        raise NotYet(_BEING_READ, path="inputs.cloud")
    plane: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in facts["plane"].items()
    }
    try:
        return Site(key, _arrays(cache, facts), GroundPlane(**plane))
    except FileNotFoundError:
        raise NotYet(_BEING_READ, path="inputs.cloud") from None


def _arrays(cache: Path, facts: dict[str, Any]) -> Cloud:
    found = {name: np.load(_array_file(cache, facts, name), mmap_mode="r") for name in facts["arrays"]}
    return Cloud(origin_m=np.array(facts["origin_m"]), notes=tuple(facts["notes"]), **found)


def _described(cloud: Cloud, plane: GroundPlane) -> dict[str, Any]:
    lowest, highest = cloud.extent_m
    return {
        "points": len(cloud),
        "extent_m": [lowest.tolist(), highest.tolist()],
        "origin_m": cloud.origin_m.tolist(),
        "density_per_m2": plane.ground_points / plane.area_m2 if plane.area_m2 else None,
        "has_color": cloud.colour is not None,
        "has_intensity": cloud.intensity is not None,
        "notes": list(cloud.notes),
        "ground": {
            "z_m": plane.at_m[2],
            "spread_m": plane.elevation_std_m,
            "p5_m": plane.elevation_p5_m,
            "p95_m": plane.elevation_p95_m,
            "tilt_deg": float(np.degrees(plane.tilt_rad)),
            "points": plane.ground_points,
            "area_m2": plane.area_m2,
        },
        "plane": vars(plane),
    }


def _write_facts(cache: Path, facts: dict[str, Any]) -> None:
    write_atomically(cache / _FACTS, json.dumps(facts).encode())
