"""What is committed: nothing too large, no address of a package index, and words in the README that are true."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from tests.architecture.imports import javascript_imports

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
MAX_FILE_BYTES = 8 * 2**20
INDEX_ADDRESS = re.compile(r"(index-url|registry|resolved|find-links)[\"' ]*[:=]+ *[\"']?https?://")


def committed_files() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
    return [file for name in listed.split("\0") if name and (file := ROOT / name).is_file()]


def test_no_committed_file_is_too_large() -> None:
    large = {file.name: file.stat().st_size for file in committed_files() if file.stat().st_size > MAX_FILE_BYTES}
    assert large == {}


def test_no_committed_file_names_a_package_index() -> None:
    naming = [file.name for file in committed_files() if INDEX_ADDRESS.search(file.read_text("utf-8", "replace"))]
    assert naming == []


def test_committed_pages_import_committed_modules() -> None:
    committed = {file.resolve() for file in committed_files()}
    scripts = [file for file in committed if file.suffix == ".js" and (ROOT / "static" / "js") in file.parents]
    missing = [
        f"{script.name}: {target}"
        for script in scripts
        for target in javascript_imports(script.read_text(encoding="utf-8"))
        if target.startswith(".") and (script.parent / target).resolve() not in committed
    ]
    assert missing == []


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-test.lock", "package-lock.json"])
def test_lock_files_hold_no_addresses(name: str) -> None:
    assert "://" not in (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-test.lock"])
def test_lock_files_pin_each_requirement(name: str) -> None:
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    unpinned = [line for line in lines if line and not re.fullmatch(r"[a-z0-9._-]+==[^\s;]+( ; .+)?", line)]
    assert unpinned == []


def test_lock_file_holds_every_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    locked = {line.split("==")[0] for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()}
    wanted = {re.split(r"[^A-Za-z0-9._-]", requirement)[0].lower() for requirement in project["dependencies"]}
    assert wanted - locked == set()


def test_make_targets_in_the_readme_exist() -> None:
    told = set(re.findall(r"^\s*make ([a-z-]+)|`make ([a-z-]+)", README, re.MULTILINE))
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = {first or second for first, second in told}
    assert {"run", "test"} <= named
    assert named - targets == set()


def test_files_linked_from_the_readme_exist() -> None:
    links = [link for link in re.findall(r"\]\(([^)#]+)[^)]*\)", README) if "://" not in link]
    missing = [link for link in links if not (ROOT / link).exists()]
    assert missing == []


def test_ci_runs_the_tests() -> None:
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
