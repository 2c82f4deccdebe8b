"""What has been measured of a project, told from the results on the disk."""

from __future__ import annotations

from dataclasses import dataclass, field

from app.store import ProjectFolder, read_json
from core.project import Project


@dataclass(frozen=True)
class Outcome:
    """State of the results."""

    ready: bool = False
    stale: bool = False
    frames_done: int = 0
    frames_total: int = 0
    failure: str = ""
    counts: dict[str, int] = field(default_factory=dict)


def state_of(folder: ProjectFolder, project: Project) -> Outcome:
    """Return the state of a project's results."""
    summary = read_json(folder.results / "summary.json")
    return Outcome(ready=isinstance(summary, dict))
