"""What a person decided is read as it stands, refused as a whole where it contradicts itself, and written readably."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from core.errors import InputError
from core.project import (
    Project,
    naming_file,
    parse_project,
    project_doubts,
    project_json,
    project_problems,
    read_project,
    write_project,
)

BANDS = {name: {"from_m": [0.0, 0.0], "to_m": [1.0, 0.0]} for name in ("L1", "L2", "T1")}
PAIR = {"id": 1, "ground_m": [481250.25, 5812340.5], "frame_px": [1.0, 2.0]}
ROOF = {"name": "roof", "lines": BANDS}
FULL: dict[str, Any] = {
    "rooftrack": 1,
    "name": 'Bâtiment "A", [west]',
    "inputs": {"video": "video.mp4", "gps": {"file": "gps.csv", "at_m": [1.0, 2.0]}},
    "correspondences": [{"id": 1, "ground_m": [481250.25, 5812340.5], "frame_px": [1.0, 2.0], "enabled": False}],
    "moving_regions_px": [[[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]],
    "targets": [ROOF, {"name": "table", "kind": "points", "region_m": [[0, 0], [1, 0], [1, 1]]}],
    "excluded_frames": [[3, 3], [10, 12]],
    "intervals_s": {"pre_event": [0.0, 1.5]},
}


def changed(**changes: Any) -> dict[str, Any]:
    return {**copy.deepcopy(FULL), **changes}


def relative(name: str, to: str) -> dict[str, Any]:
    return {**ROOF, "name": name, "relative_to": to}


def test_what_is_written_is_read_again_as_it_was(tmp_path: Path) -> None:
    project = Project.model_validate(FULL)
    write_project(tmp_path, project)
    assert read_project(tmp_path) == project


def test_the_file_is_for_people_too() -> None:
    """A pair of coordinates stands on one line, and so does a list of numbers; names keep their letters."""
    text = project_json(Project.model_validate(FULL))
    assert '"ground_m": [481250.25, 5812340.5]' in text
    assert '"pre_event": [0.0, 1.5]' in text
    assert 'Bâtiment \\"A\\", [west]' in text
    assert json.loads(text)["name"] == FULL["name"]


def test_what_is_not_said_has_its_default() -> None:
    project = parse_project('{"rooftrack": 1, "name": "EQ7", "inputs": {"video": "v.mp4"}}')
    assert (project.method, project.reference_frame, project.drift.filter) == ("geometric", 0, "none")
    assert project.orthoimage.pixel_size_m == 0.01
    assert project.targets == ()


def test_an_edit_makes_a_new_project() -> None:
    project = Project.model_validate(FULL)
    with pytest.raises(ValueError, match="frozen"):
        project.reference_frame = 3  # type: ignore[misc]


@pytest.mark.parametrize("text", ["EQ7 [ test ]", 'a "[ 1 ]" b', "[\n  1\n]", "back\\", "[ ]"])
def test_what_people_write_is_kept_to_the_letter(text: str) -> None:
    inputs = {"video": text, "gps": {"file": text, "x": text}}
    project = Project.model_validate(changed(name=text.replace("\n", " "), inputs=inputs))
    assert parse_project(project_json(project)) == project


def test_excluded_ranges_hold_both_their_ends() -> None:
    project = Project.model_validate(FULL)
    assert [frame for frame in range(15) if project.is_excluded(frame)] == [3, 10, 11, 12]


@pytest.mark.parametrize(
    ("document", "told"),
    [
        ([], "holds no project"),
        (changed(inputs={}), "inputs.video: missing, add it"),
        (changed(name=""), "name: "),
        (changed(wind=3), 'wind: unknown key "wind", remove it or correct its spelling'),
        (changed(rooftrack=2), "rooftrack: "),
        (changed(rooftrack=True), "rooftrack: must be the whole number 1"),
        (changed(rooftrack=1.0), "rooftrack: must be the whole number 1"),
        (changed(reference_frame=-1), "reference_frame: "),
        (
            changed(correspondences=[{**PAIR, "enabled": "yes"}]),
            "correspondences[0].enabled: input should be a valid b",
        ),
        (changed(correspondences=[{**PAIR, "enabled": 0}]), "correspondences[0].enabled: input should be a valid bool"),
        (
            changed(correspondences=[{**PAIR, "ground_m": [1e308, 0]}]),
            "correspondences[0].ground_m[0]: input should be",
        ),
        (changed(correspondences=[{**PAIR, "frame_px": [0, -1e9]}]), "correspondences[0].frame_px[1]: input should be"),
        (changed(moving_regions_px=[[[0, 0], [1e10, 0], [0, 9]]]), "moving_regions_px[0][1][0]: input should be less"),
        (changed(targets=[{**ROOF, "height_m": 1e308}]), "targets[0].height_m: input should be less than or equal to"),
        (changed(reference_frame=1.0), "reference_frame: "),
        (changed(correspondences=FULL["correspondences"] * 2), "correspondences: id 1 is used twice"),
        (changed(moving_regions_px=[[[0, 0], [1, 1]]]), "moving_regions_px: region 0 has 2 corners; a polygon needs"),
        (changed(excluded_frames=[[5, 4]]), "excluded_frames: [5, 4] must be [first, last]"),
        (changed(excluded_frames=[[-1, 4]]), "excluded_frames: [-1, 4] must be [first, last]"),
        (changed(intervals_s={"event": [2.0, 2.0]}), "intervals_s.event: must be [start, end] with start < end"),
        (changed(orthoimage={"extent_m": [0, 0, 0, 1]}), "orthoimage.extent_m: must be [west, south, east, north]"),
        (changed(orthoimage={"pixel_size_m": 0}), "orthoimage.pixel_size_m: "),
        (changed(orthoimage={"ground_z_m": float("inf")}), "orthoimage.ground_z_m: "),
        (changed(drift={"corner_hz": "0.25"}), 'drift.corner_hz: input should be a valid number, not "0.25"'),
        (changed(drift={"order": 21}), "drift.order: "),
        (changed(method="both"), "method: "),
        (changed(targets=[ROOF, ROOF]), "targets: name 'roof' is used twice"),
        (changed(targets=[{"name": "roof"}]), 'targets[0]: a target of kind "lines" needs "lines"'),
        (
            changed(targets=[{"name": "t", "kind": "points", "region_m": [[0, 0], [1, 1]]}]),
            'needs "region_m" with three',
        ),
        (changed(targets=[{**ROOF, "name": "../roof"}]), "targets[0].name: "),
        (
            changed(targets=[{**ROOF, "lines": {**BANDS, "T1": {"from_m": [1, 1], "to_m": [1, 1]}}}]),
            "targets[0].lines.T1: from_m and to_m are the same place",
        ),
        (changed(targets=[relative("roof", "table")]), '"roof" is relative to "table", which is no other target'),
        (changed(targets=[relative("roof", "roof")]), '"roof" is relative to "roof", which is no other target'),
        (
            changed(targets=[ROOF, relative("a", "roof"), relative("b", "a")]),
            'targets: "b" is relative to "a", which is itself relative',
        ),
    ],
)
def test_what_contradicts_itself_is_told_with_its_place(document: Any, told: str) -> None:
    (problem,) = project_problems(document)
    assert told in problem


def test_every_problem_is_told_at_once() -> None:
    with pytest.raises(InputError) as refused:
        parse_project(json.dumps(changed(wind=3, method="both", reference_frame=-1)), "eq7/project.json")
    assert str(refused.value).startswith("eq7/project.json: ")
    assert str(refused.value).count(";") == 2


def doubts_of(**changes: Any) -> list[str]:
    return list(project_doubts(Project.model_validate(changed(**changes))))


@pytest.mark.parametrize(
    ("intervals_s", "told"),
    [
        ({"pre_event": [0, 10], "event": [10, 20], "residual": [19.95, 30]}, []),
        ({"pre_event": [0, 12], "event": [10, 20]}, ["pre_event and event share 2.0 s"]),
        ({"pre_event": [25, 30], "event": [10, 20]}, ["pre_event lies after event"]),
        ({"event": [10, 20], "residual": [15, 30]}, ["event and residual share 5.0 s"]),
    ],
)
def test_intervals_that_cannot_be_meant_are_doubted(intervals_s: dict[str, Any], told: list[str]) -> None:
    found = doubts_of(intervals_s=intervals_s)
    assert len(found) == len(told)
    assert all(part in doubt for part, doubt in zip(told, found, strict=True))


def test_an_antenna_far_from_every_target_is_doubted() -> None:
    for at_m, height_m, far in ((40, None, False), (90, None, True), (90, 20.0, False), (478_000, 20.0, True)):
        found = doubts_of(
            inputs={"video": "v.mp4", "gps": {"file": "gps.csv", "at_m": [at_m, 0]}},
            targets=[{**ROOF, "height_m": height_m}],
        )
        assert [doubt.partition(":")[0] for doubt in found] == (["inputs.gps.at_m"] if far else [])


def test_a_file_says_what_it_is() -> None:
    document = changed()
    del document["rooftrack"]
    with pytest.raises(InputError, match=r'^eq7/project\.json: rooftrack: missing, add it: "rooftrack": 1\.$'):
        parse_project(json.dumps(document), "eq7/project.json")
    assert Project.model_validate(document).rooftrack == 1


def test_a_long_value_is_told_in_short() -> None:
    (problem,) = project_problems(changed(reference_frame="x" * 1000))
    assert len(problem) < 150


def test_mistakes_in_the_file_are_told_with_its_folder() -> None:
    with pytest.raises(InputError, match=r"eq7.project\.json: targets: none"), naming_file(Path("eq7")):
        raise InputError("project.json: targets: none")
    with pytest.raises(InputError, match=r"^video\.mp4: not found"), naming_file(Path("eq7")):
        raise InputError("video.mp4: not found")


def test_a_file_that_is_not_text(tmp_path: Path) -> None:
    (tmp_path / "project.json").write_bytes(b"\xff\xfe\x00")  # UTF-16 that breaks off in a character
    with pytest.raises(InputError, match=r"project\.json: cannot be read .*; restore it from a copy"):
        read_project(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_a_file_saved_by_another_editor(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "project.json").write_bytes(project_json(Project.model_validate(changed(name="Höhe"))).encode(encoding))
    assert read_project(tmp_path).name == "Höhe"
