"""An installed Rooftrack has its pages and its sample, as a checkout has."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile

import pytest

from tests.architecture.test_repository import ROOT, committed_files


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """The names of the files in a wheel made from what is committed."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for file in committed_files():
        copy = source / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--wheel-dir", str(folder), str(source)], check=True, capture_output=True)
    (built,) = folder.glob("rooftrack-*.whl")
    return set(zipfile.ZipFile(built).namelist())


@pytest.mark.parametrize("room", ["app", "core", "static", "sample_data"])
def test_a_wheel_holds_every_file_of_a_room(wheel: set[str], room: str) -> None:
    wanted = {name for file in committed_files() if (name := file.relative_to(ROOT).as_posix()).startswith(f"{room}/")}
    assert wanted
    assert wanted - wheel == set()


def test_a_wheel_holds_nothing_else(wheel: set[str]) -> None:
    rooms = {name.split("/")[0] for name in wheel if ".dist-info/" not in name}
    assert rooms == {"app", "core", "static", "sample_data"}
