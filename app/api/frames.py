"""Pictures of single frames."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from app.context import Folder, Here
from app.reference import lens_of

router = APIRouter(prefix="/api/projects/{project_id}")


@router.get("/frames/{number}.jpg")
def frame(
    number: int,
    folder: Folder,
    here: Here,
    w: Annotated[int | None, Query(ge=16, le=20_000)] = None,
    und: bool = False,
) -> Response:
    """Return a frame as JPEG: raw, or undistorted; `w` scales it down."""
    project = folder.load().project
    video = folder.require_video(project)
    lens = lens_of(folder, project)[0] if und else None
    picture = here.frames.jpeg(video, number, width=w, lens=lens)
    return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=60"})
