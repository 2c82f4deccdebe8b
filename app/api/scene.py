"""The 3D scene of a project (see `app.scenes`)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter
from pydantic import Field

from app.api.projects import Body
from app.context import Folder, Here
from app.scene3d import MAX_POINTS
from app.scenes import DEFAULT_POINTS, View, show

router = APIRouter(prefix="/api/projects/{project_id}")

Part = Literal["cloud", "ground", "orthoimage", "camera", "lines"]


class Wanted(Body):
    """What a person wants to see."""

    frame: int | None = None
    exaggeration: Annotated[float, Field(ge=0.0, le=1000.0)] = 1.0
    points: Annotated[int, Field(ge=1000, le=MAX_POINTS)] = DEFAULT_POINTS
    colour: Literal["rgb", "intensity", "height"] = "rgb"
    show: dict[Part, bool] = Field(default_factory=dict)
    take: bool = False


@router.post("/scene")
def scene(folder: Folder, here: Here, wanted: Wanted | None = None) -> dict[str, Any]:
    """Show a project in the scene, at a frame of the video; `take` it where another project has it."""
    view = wanted or Wanted()
    before = here.scene.project
    shown = show(
        here,
        folder,
        View(
            frame=view.frame,
            exaggeration=view.exaggeration,
            points=view.points,
            colour=view.colour,
            show={str(part): visible for part, visible in view.show.items()},
        ),
        take=view.take,
    )
    owner = shown["owner"]
    if before is not None and before != owner:
        here.hub.publish(before, "scene", {"owner": owner})
    if owner == folder.id:
        here.hub.publish(folder.id, "scene", {"owner": owner, "frame": view.frame})
    return shown
