"""Imports run one way: proved for this code base, and proved to be noticed where they do not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.architecture.imports import ORDER, imports_of, violations

ROOT = Path(__file__).resolve().parents[2]


def test_every_import_of_this_code_base_goes_the_right_way() -> None:
    assert violations(ROOT) == []


def test_every_place_in_the_order_is_taken() -> None:
    assert [name for name in ORDER if not (ROOT / "core" / f"{name}.py").exists()] == []


def test_the_walk_saw_the_code_base() -> None:
    source = (ROOT / "core" / "project.py").read_text(encoding="utf-8")
    assert "core.errors" in {imported.module for imported in imports_of(source)}


@pytest.mark.parametrize(
    ("file", "source", "told"),
    [
        ("core/lens.py", "import app.cli", "core may not know app"),
        ("core/lens.py", "from sample_data import scene", "core may not know sample_data"),
        ("core/lens.py", "from fastapi import FastAPI", "core knows no web, but imports fastapi"),
        ("core/lens.py", "from .errors import InputError", "imports relatively"),
        ("core/lens.py", "from core.solve import Solution", "lens comes before solve and may not know it"),
        ("core/lens.py", "from core import solve", "lens comes before solve and may not know it"),
        ("core/lens.py", "import core.lens", "lens comes before lens and may not know it"),
        ("core/lens.py", "def f():\n    import core.solve", "lens.py:2: lens comes before solve"),
        ("core/ground.py", "from core.georeference import fit", "put steps together; ground takes fit"),
        ("core/ground.py", "import core.georeference", "put steps together; ground takes all"),
        ("core/lens.py", "import open3d.geometry", "open3d enters only through core.cloud"),
        ("core/lens.py", "def f():\n    from laspy import open", "laspy enters only through core.cloud"),
        ("app/server.py", "import viser", "viser enters only through app.scene3d"),
        ("app/server.py", "from tests.core import scenes", "app may not know tests"),
        ("sample_data/scene.py", "from app.cli import main", "sample_data may not know app"),
        ("core/helpers.py", "", "core/helpers.py: has no place in the order"),
        ("core/__init__.py", "VERSION = 1", "core/__init__.py: is not empty"),
        ("static/js/lib/pan.js", 'import { page } from "../pages/review.js";', "lib may not know pages"),
        ("static/js/lib/pan.js", 'import uPlot from "uplot";', "imports uplot; name a file of this site"),
        ("static/js/lib/pan.js", 'const a = await import("https://cdn/x.js");', "imports https://cdn/x.js"),
    ],
)
def test_a_wrong_import_is_told(tmp_path: Path, file: str, source: str, told: str) -> None:
    place = tmp_path / file
    place.parent.mkdir(parents=True)
    place.write_text(source, encoding="utf-8")
    found = violations(tmp_path)
    assert len(found) == 1
    assert told in found[0]
    assert found[0].startswith(file)


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("core/solve.py", "from core.georeference import fit\nfrom core.lens import Lens"),
        ("core/ground.py", "from core.georeference import Reference"),
        ("core/cloud.py", "def f():\n    import open3d, laspy"),
        ("app/server.py", "from core.run import run_project\nimport fastapi"),
        ("sample_data/scene.py", "from core.lens import write_lens\nfrom sample_data.optics import Optics"),
        ("core/__init__.py", "\n"),
        ("static/js/pages/review.js", 'import { pan } from "../lib/pan.js";\nimport "../components/plot.js";'),
    ],
)
def test_a_right_import_is_not(tmp_path: Path, file: str, source: str) -> None:
    place = tmp_path / file
    place.parent.mkdir(parents=True)
    place.write_text(source, encoding="utf-8")
    assert violations(tmp_path) == []


def test_a_process_that_only_measures_loads_no_library_for_it_in_vain() -> None:
    """Helpers and workers of a cluster start while the reference frame is looked at, and scipy takes half a second."""
    code = "import sys, core.measure; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=True, text=True).stdout
    assert {"cv2", "av", "numpy"} <= set(loaded.split())
    assert not {"scipy", "open3d", "distributed", "fastapi", "matplotlib"} & set(loaded.split())
