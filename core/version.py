"""Which Rooftrack this is."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def program_version() -> str:
    """Return the installed version of Rooftrack."""
    try:
        return version("rooftrack")
    except PackageNotFoundError:
        return "not installed"
