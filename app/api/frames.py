"""Pictures of single frames."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Query, Response

from app.context import Folder, Here
from app.frames import jpeg_tag
from app.reference import lens_of

router = APIRouter(prefix="/api/projects/{project_id}")


@router.get("/frames/{number}.jpg")
def frame(
    number: int,
    folder: Folder,
    here: Here,
    w: Annotated[int | None, Query(ge=16, le=20_000)] = None,
    und: bool = False,
    if_none_match: Annotated[str, Header()] = "",
) -> Response:
    """Return a frame as JPEG: raw, or undistorted; `w` scales it down.

    Its address stays the same with another video or lens, so the browser asks each time whether what it keeps is still
    the picture; where it is, nothing is decoded or sent.
    """
    project = folder.load().project
    video = folder.require_video(project)
    lens = lens_of(folder, project)[0] if und else None
    tag = jpeg_tag(video, number, width=w, lens=lens)
    headers = {"Cache-Control": "private, no-cache", "ETag": f'"{tag}"'}
    if tag in if_none_match:
        return Response(status_code=304, headers=headers)
    picture = here.frames.jpeg(video, number, width=w, lens=lens)
    return Response(picture, media_type="image/jpeg", headers=headers)
