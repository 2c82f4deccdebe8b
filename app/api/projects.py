"""Projects: listed, made, edited, undone, copied, thrown away, packed and unpacked."""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

from fastapi import APIRouter, Request
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict
from starlette.concurrency import run_in_threadpool

from app.archives import archive_stream, restore
from app.context import Context, Folder, Here, tell_saved
from app.errors import ApiError, Busy
from app.steps import steps_of, steps_of_broken
from app.store import INPUT_KINDS, ProjectFolder, Saved, problem_of
from app.uploads import receive_file
from core.errors import InputError

router = APIRouter(prefix="/api/projects")


class Body(BaseModel):
    """A request body; refuses keys it does not know."""

    model_config = ConfigDict(extra="forbid")


class NewProject(Body):
    """A project to be made; inputs are absolute paths on this computer, or come later."""

    name: str
    video: str | None = None
    cloud: str | None = None
    lens: str | None = None
    gps: str | None = None


class Name(Body):
    """A name."""

    name: str


class Token(Body):
    """What fetches a project back from the trash."""

    undo_token: str


class Edit(Body):
    """A whole project in place of the state `revision`."""

    project: dict[str, Any]
    revision: int
    label: str = "edit"
    merge: bool = False


class Revision(Body):
    """The state a person was looking at."""

    revision: int


@router.get("")
def list_projects(here: Here) -> list[dict[str, Any]]:
    """Return all projects with the state of their steps, the last edited first."""
    return [_listed(here, project_id) for project_id in here.workspace.ids()]


def _listed(here: Context, project_id: str) -> dict[str, Any]:
    try:
        folder = here.workspace.open(project_id)
        project = folder.load().project
        steps, name = steps_of(here, folder, project, look=False).steps, project.name
    except (InputError, ApiError) as error:
        steps, name = steps_of_broken(problem_of(error)), project_id
    return {"id": project_id, "name": name, "updated_s": here.workspace.updated_s(project_id), "steps": steps}


@router.post("")
def create(new: NewProject, here: Here) -> dict[str, str]:
    """Make a project."""
    files = {kind: getattr(new, kind) for kind in INPUT_KINDS}
    return {"id": here.workspace.create(new.name, files).id}


@router.post("/untrash")
def untrash(token: Token, here: Here) -> dict[str, str]:
    """Fetch a project back from the trash."""
    return {"id": here.workspace.fetch_back(token.undo_token).id}


@router.post("/restore")
async def restore_archive(request: Request, here: Here, name: str | None = None) -> dict[str, str]:
    """Unpack an archive, sent as the raw body, as a new project."""
    file = here.workspace.folder / f".incoming-{secrets.token_hex(8)}"
    await receive_file(request, file)
    try:
        folder = await run_in_threadpool(restore, here.workspace, file, name)
    finally:
        file.unlink(missing_ok=True)
    return {"id": folder.id}


@router.get("/{project_id}")
def get(folder: Folder, here: Here) -> dict[str, Any]:
    """Return a project, its revision, the state of its steps, and its problems."""
    return state_of(here, folder, folder.load(), look=True)


@router.put("/{project_id}")
def save(edit: Edit, folder: Folder, here: Here) -> dict[str, Any]:
    """Replace a project; refused when somebody else has changed it since."""
    saved = folder.save(edit.project, revision=edit.revision, label=edit.label, merge=edit.merge)
    tell_saved(here, folder, saved, edit.label)
    return state_of(here, folder, saved)


@router.post("/{project_id}/undo")
def undo(wanted: Revision, folder: Folder, here: Here) -> dict[str, Any]:
    """Go one state back."""
    return _stepped(here, folder, -1, wanted.revision)


@router.post("/{project_id}/redo")
def redo(wanted: Revision, folder: Folder, here: Here) -> dict[str, Any]:
    """Go one state forward again."""
    return _stepped(here, folder, +1, wanted.revision)


def _stepped(here: Context, folder: ProjectFolder, step: int, revision: int) -> dict[str, Any]:
    saved = folder.step_history(step, revision=revision)
    tell_saved(here, folder, saved, "undo" if step < 0 else "redo")
    return state_of(here, folder, saved)


@router.get("/{project_id}/history")
def history(folder: Folder) -> dict[str, Any]:
    """Return every saved state's label and time."""
    entries, position = folder.entries()
    return {"entries": [vars(entry) for entry in entries], "position": position}


@router.post("/{project_id}/duplicate")
def duplicate(copy: Name, folder: Folder, here: Here) -> dict[str, str]:
    """Copy a project with its results."""
    if here.jobs.running(folder.id, "track") is not None:
        raise Busy("A job of this project is running; wait for it or cancel it, then copy the project.")
    return {"id": here.workspace.duplicate(folder, copy.name).id}


@router.delete("/{project_id}")
def delete(folder: Folder, here: Here) -> dict[str, str]:
    """Move a project to the trash; its jobs are stopped first."""
    here.jobs.cancel_all(folder.id)
    return {"undo_token": here.workspace.throw_away(folder)}


@router.get("/{project_id}/archive")
def archive(folder: Folder, inputs: bool = True) -> StreamingResponse:
    """Return the whole project as a zip, streamed."""
    name = folder.load().project.name
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", name) or folder.id
    disposition = f"attachment; filename=\"{plain}.zip\"; filename*=UTF-8''{quote(name)}.zip"
    return StreamingResponse(
        _from_first(archive_stream(folder, inputs=inputs)),
        media_type="application/zip",
        headers={"Content-Disposition": disposition, "Cache-Control": "no-store"},
    )


def _from_first(stream: Iterator[bytes]) -> Iterator[bytes]:
    """Start a stream before its answer, so that what fails at once is told as an error and not as half a file."""
    first = next(stream)

    def whole() -> Iterator[bytes]:
        yield first
        yield from stream

    return whole()


def state_of(here: Context, folder: ProjectFolder, saved: Saved, *, look: bool = False) -> dict[str, Any]:
    """Return what the browser knows of a project: the answer of GET, PUT, undo and redo.

    Args:
        look: whether to look for problems now; otherwise null where they have not been looked for.
    """
    head, facts = saved.head, steps_of(here, folder, saved.project, look=look)
    return {
        "id": folder.id,
        "project": saved.project.model_dump(mode="json"),
        "revision": head.revision,
        "can_undo": head.undo_label is not None,
        "can_redo": head.redo_label is not None,
        "undo_label": head.undo_label,
        "redo_label": head.redo_label,
        "steps": facts.steps,
        "problems": facts.problems,
    }
