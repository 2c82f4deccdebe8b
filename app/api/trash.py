"""Deleted projects, as long as they are kept. Not below the address of projects: one may be called "trash"."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from app.context import Here

router = APIRouter(prefix="/api/trash")


@router.get("")
def list_deleted(here: Here) -> list[dict[str, Any]]:
    """Return the projects that can be fetched back, the last deleted first."""
    return [vars(project) for project in here.workspace.deleted()]
