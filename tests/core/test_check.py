"""Whatever contradicts itself is told before hours are spent, one line each with what to do."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.check import check_project
from core.drift import corner_obstacle, high_pass
from core.errors import InputError, disk_problem
from core.lens import Lens, write_lens
from core.run import run_project
from tests import small_project

IN_A_LINE = [{"id": i, "ground_m": [i, 0], "frame_px": [i, i * i]} for i in range(5)]

Change = Callable[[dict[str, Any]], object]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("project")
    small_project.write_inputs(folder)
    return folder


def problems(folder: Path, change: Change) -> list[str]:
    document = small_project.document()
    change(document)
    small_project.write_document(folder, document)
    return check_project(folder)


def put(value: Any, *path: str | int) -> Change:
    """Return a change that puts a value at a place of the document."""

    def change(document: Any) -> None:
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = value

    return change


def test_a_sound_project_has_no_problems(inputs: Path) -> None:
    assert problems(inputs, lambda document: None) == []


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (put("gone.mp4", "inputs", "video"), "gone.mp4: not found"),
        (put("go\nne.mp4", "inputs", "video"), "go ne.mp4: not found"),
        (put("gps.csv", "inputs", "video"), "gps.csv: cannot be opened as a video"),
        (put("gone.yaml", "inputs", "lens"), "gone.yaml: not found"),
        (put("gps.csv", "inputs", "lens"), "gps.csv: is not an OpenCV FileStorage file"),
        (put(None, "inputs", "lens"), 'inputs.lens: missing, but method "geometric" needs it'),
        (put("gone.laz", "inputs", "cloud"), "gone.laz: not found"),
        (put(90, "reference_frame"), "reference_frame: is 90, but the video ends with frame 39"),
        (put("", "inputs", "cloud"), "inputs.cloud: names no file; give its path, or null"),
        (put("", "inputs", "video"), "inputs.video: names no file; give its path."),
        (
            put("the roof", "targets", 0, "name"),
            'targets[0].name: "the roof" cannot be the name of a file; take up to 64 letters',
        ),
        (put("a\0b.csv", "inputs", "gps", "file"), "inputs.gps.file: names no file"),
        (put([[0, 20], [15, 39]], "excluded_frames"), "excluded_frames: leave no frame of the video"),
        (put([[30, 45]], "excluded_frames"), "excluded_frames[0]: [30, 45] ends after the last frame, 39"),
        (put([], "correspondences"), "no correspondence is enabled, at least four are needed"),
        (
            put([{"id": i, "ground_m": [i, 0], "frame_px": [i, i * i]} for i in range(5)], "correspondences"),
            "collinear",
        ),
        (put("gone.csv", "inputs", "gps", "file"), "gone.csv"),
        (put("up_m", "inputs", "gps", "x"), "up_m"),
        (put([200, 10], "correspondences", 0, "frame_px"), "id 1: frame_px [200, 10] is outside the 160 x 120 frame"),
        (put([50, 0], "correspondences", 4, "ground_m"), "id 5: ground_m [50, 0] lies outside the point cloud"),
        (put([], "moving_regions_px"), "moving_regions_px: none"),
        (put([[[200, 0], [210, 0], [210, 9]]], "moving_regions_px"), "moving_regions_px[0]: lies wholly outside"),
        (
            put([[[60, 40], [80, 60], [100, 80]]], "moving_regions_px"),
            "moving_regions_px[0]: its corners lie in a line",
        ),
        (put([], "targets"), "targets: none"),
        (put(1e-4, "orthoimage", "pixel_size_m"), "orthoimage.pixel_size_m: 0.0001 is no size of a pixel in metres"),
        (put([0, 0, 0.1, 0.1], "orthoimage", "extent_m"), "orthoimage: 10 x 10 pixels are too few"),
        (
            put(1200, "targets", 0, "p1_p2_m"),
            "p1_p2_m: 1200, but its bands put P1 and P2 0.56 to 1.36 m apart; write it",
        ),
        (put(0.0012, "targets", 0, "p1_p2_m"), "targets[0].p1_p2_m: 0.0012, but its bands"),
        (put(0.01, "targets", 0, "lines", "L2", "width_m"), "lines.L2.width_m: 0.01 m are 0.1 pixels of the reference"),
        (put(None, "targets", 0, "height_m"), 'targets[0].height_m: missing, but method "geometric" needs'),
        (put([-8, -8, 8, 1], "orthoimage", "extent_m"), "targets[0].lines.T1.to_m: [0, 2] lies outside orthoimage"),
        (put([0, 9.5], "targets", 0, "lines", "T1", "to_m"), "T1.to_m: [0, 9.5] appears outside the reference frame"),
        (put([0.2, -2], "targets", 0, "lines", "T1", "from_m"), None),
        (put([-2, 1.9], "targets", 0, "lines", "T1", "from_m"), "L1 and T1 run nearly the same way"),
        (put([1.0, 5.0], "intervals_s", "residual"), "intervals_s.residual: [1, 5] reaches outside the video"),
        (put([0.51, 0.54], "intervals_s", "pre_event"), "intervals_s.pre_event: [0.51, 0.54] holds no frame"),
        (
            put({"filter": "high-pass", "corner_hz": 10}, "drift"),
            "drift.corner_hz: 10 Hz is not between 0 and half the frame rate (10 Hz)",
        ),
        (
            put({"filter": "high-pass", "corner_hz": 0.1}, "drift"),
            "less than half a period of 0.1 Hz; choose a corner above 0.25 Hz",
        ),
        (
            put(20, "targets", 0, "height_m"),
            "height_m: 20, but by the clicks the camera hovers 15.0 m above",
        ),
        (put("3.0", "targets", 0, "height_m"), 'targets[0].height_m: input should be a valid number, not "3.0"'),
        (put(True, "reference_frame"), "reference_frame: input should be a valid integer, not true"),
        (put(3, "wind"), 'wind: unknown key "wind"'),
        (
            put({"from_m": [-2, 4], "to_m": [2, 4]}, "targets", 0, "lines", "L1"),
            "targets.roof.lines.L1 ",
        ),
        (put([[[-9, -9], [170, -9], [170, 130], [-9, 130]]], "moving_regions_px"), "leave only 0 ground features"),
    ],
)
def test_each_contradiction_is_told_in_one_line(inputs: Path, change: Change, told: str | None) -> None:
    found = problems(inputs, lambda document: (document.setdefault("orthoimage", {}), change(document)))
    if told is None:
        assert found == []
        return
    assert any(told in line for line in found), found
    assert all("\n" not in line and line.endswith(".") for line in found)
    assert all(line.startswith(str(inputs)) for line in found)


def test_a_corner_is_told_in_the_words_of_the_filter_before_anything_is_measured(inputs: Path) -> None:
    """Whoever waits for the filter itself to refuse has measured the whole video first."""
    (line,) = problems(inputs, put({"filter": "high-pass", "corner_hz": 0.1}, "drift"))
    obstacle = corner_obstacle(0.1, np.arange(small_project.FRAMES) / small_project.RATE_HZ)
    assert line == f"{inputs / 'project.json'}: {obstacle}."
    with pytest.raises(InputError, match=re.escape(obstacle or "")):
        high_pass(np.zeros(small_project.FRAMES), np.arange(small_project.FRAMES) / small_project.RATE_HZ, 0.1)


@pytest.mark.parametrize("p1_p2_m", [0.02, 4.0])
def test_without_height_a_distance_is_another_unit_only_where_no_roof_rises_so_far(
    inputs: Path, p1_p2_m: float
) -> None:
    def change(document: dict[str, Any]) -> None:
        document["method"] = "paper"
        document["targets"][0].update(height_m=None, p1_p2_m=p1_p2_m)

    (line,) = problems(inputs, change)
    assert f"p1_p2_m: {p1_p2_m:g}, but its bands put P1 and P2 0.07 to 1.70 m apart" in line


def test_all_problems_are_told_at_once(inputs: Path) -> None:
    def change(document: dict[str, Any]) -> None:
        document["reference_frame"] = 90
        document["targets"] = []
        document["inputs"]["lens"] = "gone.yaml"

    assert len(problems(inputs, change)) == 3


def test_a_byte_order_mark_is_no_mistake(inputs: Path) -> None:
    small_project.write_document(inputs, small_project.document())
    file = inputs / "project.json"
    file.write_text(file.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert check_project(inputs) == []


@pytest.mark.parametrize("text", ["[" * 100_000, '{"rooftrack": ' + "9" * 5000 + "}"])
def test_what_overwhelms_the_parser_is_no_project(tmp_path: Path, text: str) -> None:
    (tmp_path / "project.json").write_text(text, encoding="utf-8")
    (line,) = check_project(tmp_path)
    assert "no project looks like this" in line


def test_a_cloud_without_ground_is_named(inputs: Path) -> None:
    (inputs / "few.csv").write_text("x,y,z\n-9,-9,0\n9,9,0\n0,0,3\n", encoding="utf-8")
    assert any(
        line.startswith(f"{inputs / 'few.csv'}: ") and "without ground" in line
        for line in problems(inputs, put("few.csv", "inputs", "cloud"))
    )


def test_lens_of_another_image_size(inputs: Path) -> None:
    write_lens(inputs / "other.yaml", Lens.ideal((320, 240), 300.0))
    (line,) = problems(inputs, put("other.yaml", "inputs", "lens"))
    assert "320 x 240" in line
    assert "160 x 120" in line


def test_l1_and_l2_in_the_same_place(inputs: Path) -> None:
    band = small_project.document()["targets"][0]["lines"]["L1"]
    (line,) = problems(inputs, put(band, "targets", 0, "lines", "L2"))
    assert "L1 and L2 cross T1 in the same place" in line


def test_names_that_differ_by_case_only(inputs: Path) -> None:
    roof = small_project.document()["targets"][0]
    (line,) = problems(inputs, put([roof, {**roof, "name": "ROOF"}], "targets"))
    assert 'targets: "roof" and "ROOF" differ by case only, as their files may not; rename one of them' in line


def test_lines_that_cross_nowhere_are_not_measured_either(inputs: Path) -> None:
    """Whoever does not check first would get P1 and P2 kilometres apart."""
    lines = small_project.document()["targets"][0]["lines"]
    change = put({"L1": lines["L1"], "L2": lines["T1"], "T1": lines["L2"]}, "targets", 0, "lines")
    (line,) = problems(inputs, change)
    with pytest.raises(InputError, match="L1 and T1 run nearly the same way") as refusal:
        run_project(inputs)
    assert str(refusal.value) == line


def test_paper_needs_neither_lens_nor_height(inputs: Path) -> None:
    def change(document: dict[str, Any]) -> None:
        document["method"] = "paper"
        document["inputs"]["lens"] = None
        document["targets"][0]["height_m"] = None

    assert problems(inputs, change) == []


def test_paper_needs_lines_and_their_scale(inputs: Path) -> None:
    def scaleless(document: dict[str, Any]) -> None:
        document["method"] = "paper"
        document["inputs"]["lens"] = None
        document["targets"][0]["p1_p2_m"] = None

    (line,) = problems(inputs, scaleless)
    assert "targets[0].p1_p2_m: missing" in line

    def patches(document: dict[str, Any]) -> None:
        document["method"] = "paper"
        document["targets"][0].update(kind="points", lines=None, region_m=[[-2, -2], [2, -2], [2, 2]])

    (line,) = problems(inputs, patches)
    assert 'targets[0].kind: "points", which method "paper" does not know' in line


@pytest.mark.parametrize(
    ("text", "told"), [("{", "line 1, column 2 is not valid JSON"), ("[]", "project.json: holds no project")]
)
def test_a_file_that_is_no_project(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "project.json").write_text(text, encoding="utf-8")
    (line,) = check_project(tmp_path)
    assert told in line


def test_a_key_that_stands_twice(inputs: Path) -> None:
    file = inputs / "project.json"
    text = json.dumps(small_project.document())
    file.write_text(text.replace('"height_m": 3.0', '"height_m": 3.0, "height_m": 4.0'))
    (line,) = check_project(inputs)
    assert 'the key "height_m" stands twice in one place; remove one of them' in line


def test_a_folder_without_project(tmp_path: Path) -> None:
    (line,) = check_project(tmp_path)
    assert "project.json: not found; make a project with `rooftrack new" in line


def test_a_large_cloud_may_be_left_out(inputs: Path) -> None:
    document = small_project.document()
    document["inputs"]["cloud"] = "gone.laz"
    small_project.write_document(inputs, document)
    assert check_project(inputs, thorough=False) == []


def test_what_lies_in_the_place_of_results_is_told_as_a_run_tells_it(tmp_path: Path) -> None:
    small_project.write_inputs(tmp_path)
    small_project.write_document(tmp_path, small_project.document())
    (tmp_path / "results").write_text("somebody's notes")
    expected = f"{tmp_path / 'results'}: File exists; move away what lies in its place, then do it again."
    assert check_project(tmp_path) == [expected]
    with pytest.raises(OSError, match="File exists") as refusal:
        run_project(tmp_path)
    assert disk_problem(refusal.value) == expected


def test_results_that_lead_nowhere(tmp_path: Path) -> None:
    small_project.write_inputs(tmp_path)
    small_project.write_document(tmp_path, small_project.document())
    (tmp_path / "results").symlink_to("away/results")
    expected = (
        f"{tmp_path / 'results'}: is a link to away/results, which is not there; bring that back or remove the link."
    )
    assert check_project(tmp_path) == [expected]
    with pytest.raises(OSError, match="File exists") as refusal:
        run_project(tmp_path)
    assert disk_problem(refusal.value) == expected


def test_of_a_path_that_a_file_cuts_off_the_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("somebody's notes")
    with pytest.raises(NotADirectoryError) as refusal:
        (tmp_path / "results" / "cache" / "cloud").mkdir(parents=True)
    expected = f"{tmp_path / 'results'}: Not a directory; move away what lies in its place, then do it again."
    assert disk_problem(refusal.value) == expected


@pytest.mark.parametrize("made", [True, False], ids=["results", "folder"])
def test_results_that_may_not_be_written_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: bool) -> None:
    """The system's answer is put in its mouth: nothing is forbidden to those who test as root."""
    small_project.write_inputs(tmp_path)
    small_project.write_document(tmp_path, small_project.document())
    if made:
        (tmp_path / "results").mkdir()
    forbidden = tmp_path / "results" if made else tmp_path
    monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != forbidden)
    (line,) = check_project(tmp_path)
    assert line == f"{tmp_path / 'results'}: Permission denied; make it accessible, then do it again."


def test_nothing_is_written(inputs: Path) -> None:
    problems(inputs, lambda document: None)
    before = sorted((file.name, file.stat().st_mtime_ns) for file in inputs.iterdir())
    check_project(inputs)
    assert sorted((file.name, file.stat().st_mtime_ns) for file in inputs.iterdir()) == before
