"""The rooms and the direction in which they may know each other, and a walk that finds who breaks it.

`static` → (HTTP) → `app` → `core`; inside `core` a later step may know the types of earlier ones, and only the
conductors put steps together.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# The order in which data flows: a module imports only from those named before it.
ORDER = (
    "version",
    "errors",
    "words",
    "progress",
    "parallel",
    "coordinates",
    "normal_equations",
    "robust",
    "storage",
    "text_files",
    "locks",
    "intervals",
    "project",
    "video",
    "lens",
    "lens_calibration",
    "camera",
    "roof_level",
    "point_files",
    "cloud",
    "ground_plane",
    "relief",
    "orthoimage",
    "georeference",
    "patches",
    "ground",
    "roof_lines",
    "motion",
    "flight",
    "self_calibration",
    "apparent",
    "texture",
    "following",
    "drift",
    "clock_times",
    "gps_record",
    "validation",
    "results",
    "measurements",
    "row_times",
    "bodies",
    "prediction",
    "paper",
    "chunks",
    "workers",
    "cluster",
    "measure",
    "preview",
    "repeats",
    "uncertainty",
    "solution",
    "ground_poses",
    "calibration",
    "texture_motion",
    "solve_geometric",
    "solve_paper",
    "solve",
    "figures",
    "report",
    "export",
    "review",
    "create",
    "check",
    "run",
)
# Steps of the measurement: others may know what they return, only conductors call them.
STEPS = {"georeference", "ground", "roof_lines", "motion", "flight", "drift", "validation"}
CONDUCTORS = {
    "bodies",
    "following",
    "paper",
    "measure",
    "preview",
    "ground_poses",
    "calibration",
    "texture_motion",
    "solve_geometric",
    "solve_paper",
    "solve",
    "figures",
    "report",
    "review",
    "export",
    "check",
    "run",
}

# Libraries that enter the program through one door only; the sample is rendered outside of it.
DOORS = {
    "open3d": {"core.cloud"},
    "laspy": {"core.cloud"},
    "lazrs": {"core.cloud"},
    "pye57": {"core.cloud"},
    "viser": {"app.scene3d"},
}
WEB = {"fastapi", "starlette", "uvicorn", "websockets", "viser", "httpx", "requests", "aiohttp", "http"}
MAY_KNOW = {"core": {"core"}, "app": {"app", "core"}, "sample_data": {"sample_data", "core"}}
ROOMS = {"app", "core", "sample_data", "static", "tests"}

JS_LAYERS = ("lib", "components", "pages")
_JS_IMPORT = re.compile(
    r"""^\s*(?:import|export)\b[^'"`;]*?\bfrom\s*["']([^"']+)["']|\bimport\s*\(?\s*["']([^"']+)["']""", re.M
)


@dataclass(frozen=True)
class Import:
    """One imported module, or one name out of it."""

    line: int
    module: str
    name: str | None = None

    @property
    def top(self) -> str:
        return self.module.split(".")[0]


def violations(root: Path) -> list[str]:
    """Return each import under `root` that goes the wrong way, `file:line: what`."""
    found: list[str] = []
    for room in MAY_KNOW:
        for file in sorted((root / room).rglob("*.py")):
            module = ".".join(file.relative_to(root).with_suffix("").parts)
            place = file.relative_to(root).as_posix()
            if file.name == "__init__.py":
                if file.read_text(encoding="utf-8").strip():
                    found.append(f"{place}: is not empty")
                continue
            if room == "core" and module.removeprefix("core.") not in ORDER:
                found.append(f"{place}: has no place in the order in which data flows")
            found += [
                f"{place}:{imported.line}: {problem}"
                for imported in imports_of(file.read_text(encoding="utf-8"))
                for problem in _python_problems(module, imported)
            ]
    return found + list(_javascript_problems(root))


def imports_of(source: str) -> Iterator[Import]:
    """Yield every import of a Python source, those inside functions too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(node.lineno, alias.name)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            for alias in node.names:
                yield Import(node.lineno, module, alias.name)


def _python_problems(module: str, imported: Import) -> Iterator[str]:
    room = module.split(".")[0]
    if imported.module.startswith("."):
        yield "imports relatively; say from where"
        return
    if imported.top in ROOMS and imported.top not in MAY_KNOW[room]:
        yield f"{room} may not know {imported.top}"
    if room == "core" and imported.top in WEB:
        yield f"core knows no web, but imports {imported.top}"
    if room != "sample_data" and imported.top in DOORS and module not in DOORS[imported.top]:
        yield f"{imported.top} enters only through {' and '.join(sorted(DOORS[imported.top]))}"
    if room == "core" and imported.top == "core":
        yield from _order_problems(module.removeprefix("core."), imported)


def _order_problems(importer: str, imported: Import) -> Iterator[str]:
    step, name = imported.module.removeprefix("core").removeprefix("."), imported.name
    if not step and name:  # `from core import ground`
        step, name = name, None
    if importer not in ORDER or step not in ORDER:
        return
    if ORDER.index(step) >= ORDER.index(importer):
        yield f"{importer} comes before {step} and may not know it"
    is_type = name is not None and name[0].isupper()
    if step in STEPS and importer not in CONDUCTORS and not is_type:
        yield f"only {', '.join(sorted(CONDUCTORS))} put steps together; {importer} takes {name or 'all'} from {step}"


def javascript_imports(source: str) -> list[str]:
    """Return what a JavaScript module imports, as it names it."""
    return [first or second for first, second in _JS_IMPORT.findall(source)]


def _javascript_problems(root: Path) -> Iterator[str]:
    scripts = root / "static" / "js"
    for file in sorted(scripts.rglob("*.js")):
        place = file.relative_to(root).as_posix()
        layer = file.relative_to(scripts).parts[0]
        for target in javascript_imports(file.read_text(encoding="utf-8")):
            if not target.startswith((".", "/")) or not target.endswith((".js", ".mjs")):
                yield f"{place}: imports {target}; name a file of this site, with its ending"
                continue
            parts = (file.parent / target).resolve().parts
            known = next((part for part in parts[len(scripts.resolve().parts) :] if part in JS_LAYERS), None)
            if layer in JS_LAYERS and known and JS_LAYERS.index(known) > JS_LAYERS.index(layer):
                yield f"{place}: {layer} may not know {known} ({target})"
