"""What every request has at hand: the workspace, its jobs, its tabs, and what is kept in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, cast

from fastapi import Depends, Request

from app.events import Hub
from app.frames import FrameStore
from app.growing import Growing
from app.jobs import Jobs
from app.outcome import Outcomes
from app.places import Places
from app.scene3d import Scene3D
from app.sites import Sites
from app.store import ProjectFolder, Saved, Workspace


@dataclass(frozen=True)
class Context:
    """The parts of one server."""

    workspace: Workspace
    places: Places
    hub: Hub
    jobs: Jobs
    frames: FrameStore
    sites: Sites
    outcomes: Outcomes
    growing: Growing
    scene: Scene3D


def _context(request: Request) -> Context:
    return cast(Context, request.app.state.context)


Here = Annotated[Context, Depends(_context)]


def _folder(project_id: str, here: Here) -> ProjectFolder:
    return here.workspace.open(project_id)


Folder = Annotated[ProjectFolder, Depends(_folder)]


def tell_saved(here: Context, folder: ProjectFolder, saved: Saved, label: str) -> None:
    """Tell every tab that there is a newer state."""
    here.hub.publish(folder.id, "project", {"revision": saved.head.revision, "label": label})
