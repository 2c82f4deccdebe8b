"""The reference frame on the ground, as the browser asks for it while a person clicks."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

SMALL = "/api/projects/small"


def fit(client: TestClient, correspondences: Any = None) -> dict[str, Any]:
    body = {} if correspondences is None else {"correspondences": correspondences}
    answer = client.post(f"{SMALL}/fit", json=body)
    assert answer.status_code == 200
    found: dict[str, Any] = answer.json()
    return found


def pairs(client: TestClient) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = client.get(SMALL).json()["project"]["correspondences"]
    return found


def test_exact_pairs_fit_exactly(client: TestClient) -> None:
    found = fit(client)
    assert (found["state"], found["message"]) == ("ok", "")
    assert found["rms_px"] == pytest.approx(0.0, abs=1e-6)
    assert found["camera"]["height_m"] == pytest.approx(15.0, abs=1e-6)
    assert found["camera"]["tilt_deg"] == pytest.approx(0.0, abs=1e-4)
    assert found["camera"]["azimuth_deg"] % 360 == pytest.approx(0.0, abs=1e-4)
    assert np.array(found["coverage"]["grid"]).sum() == len(pairs(client))


def test_a_slip_of_two_pixels_shows_where_it_is(client: TestClient) -> None:
    clicked = [*pairs(client), {"id": 6, "ground_m": [3, -4], "frame_px": [109.5, 99.5]}]
    clicked[4] = clicked[4] | {"frame_px": [clicked[4]["frame_px"][0] + 2.0, clicked[4]["frame_px"][1]]}
    errors = {pair["id"]: pair["loo_px"] for pair in fit(client, clicked)["pairs"]}
    assert errors[5] == pytest.approx(2.0, abs=0.2)
    assert fit(client)["rms_px"] == pytest.approx(0.0, abs=1e-6), "nothing is saved by asking"


def test_starts_that_cannot_be_fitted_are_named(client: TestClient) -> None:
    few = fit(client, pairs(client)[:3])
    assert (few["state"], few["rms_px"], few["pairs"]) == ("too_few", None, [])
    line = [{"id": n, "ground_m": [n, 0], "frame_px": [10 * n, 60]} for n in range(1, 7)]
    assert fit(client, line)["state"] == "collinear"
    assert "collinear" in fit(client, line)["message"]


def test_a_click_beside_the_frame_is_told_with_the_fit_and_in_its_step(client: TestClient) -> None:
    state = client.get(SMALL).json()
    clicked = state["project"]["correspondences"]
    clicked[2]["frame_px"] = [160.0, 20.0]
    assert fit(client, clicked)["message"] == "Pair 3 lies outside the 160 × 120 frame; move it, or switch it off."
    clicked[4]["frame_px"] = [20.0, -0.6]
    edit = {"project": state["project"] | {"correspondences": clicked}, "revision": state["revision"]}
    step = client.put(SMALL, json=edit).json()["steps"]["correspondences"]
    assert step["status"] == "error"
    assert step["message"].startswith("Pairs 3, 5 lie outside")
    for pair in (clicked[2], clicked[4]):
        pair["enabled"] = False
    assert "outside" not in fit(client, clicked)["message"]


@pytest.mark.parametrize("to", ["und", "plan", "ortho", "world"])
def test_points_go_there_and_back(client: TestClient, to: str) -> None:
    given = [[10.0, 20.0], [79.5, 59.5], [150.0, 100.0]]

    def lead(source: str, target: str, points: Any) -> Any:
        body = {"from": source, "to": target, "points": points, "height_m": 3.0}
        return client.post(f"{SMALL}/transform", json=body).json()["points"]

    there = lead("raw", to, given)
    assert np.array(lead(to, "raw", there)) == pytest.approx(np.array(given), abs=1e-6)
    if to == "plan":
        assert np.array(there[0]) == pytest.approx([-6.95, 3.95], abs=1e-6)
    if to == "world":
        assert np.array(there[0]) == pytest.approx([-6.95 * 12 / 15, 3.95 * 12 / 15], abs=1e-6)


def test_a_height_is_needed_for_the_world_and_a_fit_for_the_ground(client: TestClient) -> None:
    body = {"from": "raw", "to": "world", "points": [[1, 1]]}
    assert client.post(f"{SMALL}/transform", json=body).json()["error"]["path"] == "height_m"
    state = client.get(SMALL).json()
    project = state["project"] | {"correspondences": []}
    client.put(SMALL, json={"project": project, "revision": state["revision"]})
    answer = client.post(f"{SMALL}/transform", json=body | {"to": "plan"})
    assert (answer.status_code, answer.json()["error"]["kind"]) == (409, "missing")
    assert not client.get(f"{SMALL}/rectified").json()["ready"]
    assert client.get(f"{SMALL}/rectified.jpg").status_code == 409


def test_the_rectified_frame_lies_on_its_raster(client: TestClient) -> None:
    grid = client.get(f"{SMALL}/rectified", params={"pixels": 40_000}).json()["grid"]
    assert grid["width"] * grid["height"] <= 44_000
    picture = client.get(f"{SMALL}/rectified.jpg", params={"pixels": 40_000}).content
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape[:2] == (grid["height"], grid["width"])


def test_a_band_without_a_line_says_so_and_half_drawn_targets_are_welcome(client: TestClient) -> None:
    target = client.get(SMALL).json()["project"]["targets"][0]
    whole = client.post(f"{SMALL}/lines/preview", json={"target": target}).json()
    assert set(whole["lines"]) == {"L1", "L2", "T1"}
    for line in whole["lines"].values():
        assert len(line["band_plan"]) == 4
        assert line["message"] == "" or line["message"].endswith(".")
    half = target | {"lines": {"L1": target["lines"]["L1"], "T1": None}}
    seen = client.post(f"{SMALL}/lines/preview", json={"target": half}).json()
    assert (set(seen["lines"]), seen["p1"], seen["p2"]) == ({"L1"}, None, None)
    wrong = target | {"lines": target["lines"] | {"L1": {"from_m": [0, 0], "to_m": [0, 0]}}}
    answer = client.post(f"{SMALL}/lines/preview", json={"target": wrong})
    assert answer.status_code == 422
    assert "lines.L1" in answer.json()["error"]["path"]
