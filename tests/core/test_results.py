from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.coordinates import Floats, rotation_2d
from core.errors import InputError
from core.intervals import within
from core.project import Intervals
from core.results import (
    CSV_HEADER,
    Status,
    TargetHistory,
    displacement_at,
    plain,
    read_history_csv,
    relative_history,
    summarise,
    write_history_csv,
    write_summary,
)

COUNT = 6
STATUS = ["ok", "weak", "lost", "excluded", "ok", "ok"]
# The contract's header, copied from there.
HEADER = (
    "frame,time_s,status,p1_dx_m,p1_dy_m,p2_dx_m,p2_dy_m,rotation_rad,p1_dx_sigma_m,p1_dy_sigma_m,p2_dx_sigma_m,"
    "p2_dy_sigma_m,rotation_sigma_rad,p1_dx_raw_m,p1_dy_raw_m,p2_dx_raw_m,p2_dy_raw_m,rotation_raw_rad"
)


def history(seed: int = 0, **changes: Any) -> TargetHistory:
    rng = np.random.default_rng(seed)
    fields: dict[str, Any] = {
        "name": "roof",
        "frame": np.arange(COUNT),
        "time_s": np.arange(COUNT) / 30,
        "status": np.array(STATUS),
        "rotation_rad": rng.normal(scale=1e-3, size=COUNT),
        "rotation_sigma_rad": np.full(COUNT, 1e-4),
        "rotation_raw_rad": rng.normal(scale=1e-3, size=COUNT),
    }
    for name in ("p1_m", "p2_m", "p1_raw_m", "p2_raw_m"):
        fields[name] = rng.normal(scale=0.1, size=(COUNT, 2))
    for name in ("p1_sigma_m", "p2_sigma_m"):
        fields[name] = np.full((COUNT, 2), 3e-4)
    return TargetHistory(**{**fields, **changes})


def rigid(name: str, rest_m: Floats, shift_m: Floats, turn_rad: Floats, sigma_m: float = 0.0) -> TargetHistory:
    """A body that turns about the world's origin and shifts."""
    moved = [
        np.stack([rotation_2d(angle) @ point + shift - point for angle, shift in zip(turn_rad, shift_m, strict=True)])
        for point in rest_m
    ]
    return history(
        name=name,
        status=np.full(COUNT, "ok"),
        p1_m=moved[0],
        p2_m=moved[1],
        rotation_rad=turn_rad,
        p1_raw_m=moved[0],
        p2_raw_m=moved[1],
        rotation_raw_rad=turn_rad,
        p1_sigma_m=np.full((COUNT, 2), sigma_m),
        p2_sigma_m=np.full((COUNT, 2), sigma_m),
        rotation_sigma_rad=np.full(COUNT, sigma_m),
    )


def test_what_was_not_measured_is_blank_and_nothing_can_be_written_into() -> None:
    made = history()
    assert made.measured.tolist() == [True, True, False, False, True, True]
    assert np.isnan(made.p1_m[2:4]).all()
    assert np.isnan(made.rotation_raw_rad[2:4]).all()
    assert np.isfinite(made.time_s).all()
    assert made.counts() == {"ok": 3, "weak": 1, "lost": 1, "excluded": 1}
    with pytest.raises(ValueError, match="read-only"):
        made.p1_m[0, 0] = 1.0


def test_histories_that_contradict_themselves_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown status"):
        history(status=np.array([*STATUS[:-1], "fine"]))
    with pytest.raises(ValueError, match=r"p2_m of 'roof' has shape \(6,\)"):
        history(p2_m=np.zeros(COUNT))
    with pytest.raises(ValueError, match="frame 0 of 'roof' counts as measured but has no P1"):
        history(p1_m=np.full((COUNT, 2), np.nan))


def test_csv_keeps_to_the_contract(tmp_path: Path) -> None:
    file = tmp_path / "results" / "roof.csv"
    p1_m = np.array([[0.1, -0.00000001], *[[1.0, 2.0]] * 5])
    write_history_csv(file, history(p1_m=p1_m, p1_sigma_m=np.full((COUNT, 2), np.nan)))
    assert CSV_HEADER == HEADER
    content = file.read_bytes()
    assert b"\r" not in content
    lines = content.decode().splitlines()
    assert lines[0] == HEADER
    assert len(lines) == COUNT + 1
    assert lines[1].startswith("0,0.000000,ok,0.1000000,0.0000000,")
    assert lines[1].split(",")[8:10] == ["", ""]
    assert lines[3] == "2,0.066667,lost" + "," * 15
    assert lines[4] == "3,0.100000,excluded" + "," * 15


def test_csv_is_the_same_byte_for_byte_and_survives_a_round_trip(tmp_path: Path) -> None:
    made = history()
    for name in ("roof.csv", "again.csv"):
        write_history_csv(tmp_path / name, made)
    assert (tmp_path / "roof.csv").read_bytes() == (tmp_path / "again.csv").read_bytes()
    back = read_history_csv(tmp_path / "roof.csv")
    assert back.name == "roof"
    assert back.status.tolist() == STATUS
    assert back.frame.tolist() == list(range(COUNT))
    for field in ("p1_m", "p2_m", "p1_sigma_m", "p2_sigma_m", "p1_raw_m", "p2_raw_m"):
        np.testing.assert_allclose(getattr(back, field), getattr(made, field), atol=0.5e-7 + 1e-15)
    for field in ("rotation_rad", "rotation_sigma_rad", "rotation_raw_rad"):
        np.testing.assert_allclose(getattr(back, field), getattr(made, field), atol=0.5e-9 + 1e-17)
    write_history_csv(tmp_path / "third.csv", back)
    assert (tmp_path / "third.csv").read_bytes() == (tmp_path / "roof.csv").read_bytes()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,time_s\n", "line 1 is not the header"),
        ("", "line 1 is not the header"),
        (HEADER + "\n0,0,ok\n", "line 2 has 3 fields instead of 18"),
        (HEADER + "\n0,0,ok" + ",x" * 15 + "\n", "line 2: could not convert"),
        (HEADER + "\n,0,ok" + ",1" * 15 + "\n", "line 2 has no frame number"),
        (HEADER + "\n0,0,good" + ",1" * 15 + "\n", "unknown status"),
    ],
)
def test_foreign_csv_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "roof.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_history_csv(tmp_path / "roof.csv")


def test_missing_csv_says_how_to_make_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not found; measure the project with `rooftrack run` first"):
        read_history_csv(tmp_path / "roof.csv")


def test_roof_that_rides_on_its_table_has_no_relative_motion() -> None:
    rng = np.random.default_rng(3)
    roof_rest, table_rest = np.array([[1.8, 1.1], [1.8, -1.0]]), np.array([[5.0, 6.0], [5.5, -6.0]])
    shift, turn = rng.normal(scale=0.2, size=(COUNT, 2)), rng.normal(scale=0.01, size=COUNT)
    roof, table = rigid("roof", roof_rest, shift, turn), rigid("table", table_rest, shift, turn)
    relative = relative_history(roof, table, rest_m=roof_rest, base_rest_m=table_rest)
    for field in ("p1_m", "p2_m", "rotation_rad", "p1_raw_m", "p2_raw_m", "rotation_raw_rad"):
        np.testing.assert_allclose(getattr(relative, field), 0.0, atol=1e-14)
    drifted = replace(roof, p1_m=roof.p1_m + [0.05, 0.0], p2_m=roof.p2_m + [0.05, 0.0])
    relative = relative_history(drifted, table, rest_m=roof_rest, base_rest_m=table_rest)
    np.testing.assert_allclose(relative.p1_m, np.tile([0.05, 0.0], (COUNT, 1)), atol=1e-14)
    assert relative.name == "roof"


def test_relative_sigma_is_what_scatter_shows() -> None:
    """Errors of both bodies drawn at random: the spread of the relative motion is the stated sigma."""
    rng = np.random.default_rng(4)
    draws, sigma = 4000, 5e-4
    roof_rest, table_rest = np.array([[1.8, 1.1], [1.8, -1.1]]), np.array([[6.0, 3.0], [6.0, -3.0]])
    half_base = 3.0

    def noisy(name: str) -> TargetHistory:
        p1, p2 = rng.normal(scale=sigma, size=(2, draws, 2))
        turn = (p2[:, 0] - p1[:, 0]) / (2 * half_base)
        vectors = {"p1_m": p1, "p2_m": p2, "p1_raw_m": p1, "p2_raw_m": p2}
        return TargetHistory(
            name=name,
            frame=np.arange(draws),
            time_s=np.arange(draws) / 30,
            status=np.full(draws, "ok"),
            rotation_rad=turn,
            rotation_raw_rad=turn,
            p1_sigma_m=np.full((draws, 2), sigma),
            p2_sigma_m=np.full((draws, 2), sigma),
            rotation_sigma_rad=np.full(draws, sigma * np.sqrt(2) / (2 * half_base)),
            **vectors,
        )

    relative = relative_history(noisy("roof"), noisy("table"), rest_m=roof_rest, base_rest_m=table_rest)
    # A standard deviation from 4,000 draws is good to 1.1 %; four of them.
    np.testing.assert_allclose(relative.p1_m.std(axis=0), relative.p1_sigma_m[0], rtol=0.045)
    np.testing.assert_allclose(relative.p2_m.std(axis=0), relative.p2_sigma_m[0], rtol=0.045)


def test_relative_frame_is_as_good_as_the_worse() -> None:
    rest = np.zeros((2, 2))
    base = history(seed=1, status=np.array(["weak", "ok", "ok", "lost", "lost", "excluded"]))
    relative = relative_history(history(), base, rest_m=rest, base_rest_m=rest)
    assert relative.status.tolist() == ["weak", "weak", "lost", "excluded", "lost", "excluded"]
    with pytest.raises(ValueError, match="not histories of the same frames"):
        relative_history(history(), history(frame=np.arange(COUNT) + 1), rest_m=rest, base_rest_m=rest)


def test_displacement_of_an_antenna_follows_the_rigid_motion() -> None:
    rest, antenna = np.array([[1.8, 1.1], [1.8, -1.0]]), np.array([-4.0, 2.5])
    turn, shift = np.linspace(0, 0.02, COUNT), np.linspace(0, 0.3, 2 * COUNT).reshape(COUNT, 2)
    moved = displacement_at(rigid("roof", rest, shift, turn), rest_m=rest, at_m=antenna)
    expected = [rotation_2d(angle) @ antenna + by - antenna for angle, by in zip(turn, shift, strict=True)]
    np.testing.assert_allclose(moved, expected, atol=1e-14)


def test_interval_holds_its_ends() -> None:
    assert within([0.0, 1.0, 2.0, 3.0], (1.0, 2.0)).tolist() == [False, True, True, False]
    assert within([0.0, 1.0], None).all()


def test_summary_rows_have_value_and_time() -> None:
    p1_m = np.array([[0.9, 0.0], [0.02, -0.03], [9, 9], [9, 9], [-0.4, 0.01], [0.05, 0.02]])
    rows = summarise(history(p1_m=p1_m), Intervals(pre_event=(0.03, 0.05), event=(0.03, 0.15), residual=(0.15, 0.2)))
    assert rows["peak_positive_m"]["x"] == {"value": 0.02, "time_s": pytest.approx(1 / 30)}
    assert rows["peak_negative_m"]["x"] == {"value": -0.4, "time_s": pytest.approx(4 / 30)}
    assert rows["residual_m"] == {"x": 0.05, "y": 0.02}
    assert rows["pre_event_rms_m"] == {"x": pytest.approx(0.02), "y": pytest.approx(0.03)}
    assert rows["counts"] == {"ok": 3, "weak": 1, "lost": 1, "excluded": 1}
    assert set(rows["p2"]) == {"peak_positive_m", "peak_negative_m", "residual_m", "pre_event_rms_m"}


def test_summary_says_null_where_nothing_can_be_told() -> None:
    lost = history(status=np.full(COUNT, Status.LOST))
    rows = summarise(lost, Intervals(pre_event=(0.0, 0.1), residual=(5.0, 6.0)))
    assert rows["peak_positive_m"] == {"x": None, "y": None}
    assert rows["residual_m"] is None
    assert rows["pre_event_rms_m"] is None
    assert rows["rotation_peak_rad"] is None
    assert rows["sigma_median_m"] is None


@dataclass(frozen=True)
class Fit:
    residuals_px: Floats
    counts: tuple[float, ...]


def test_what_a_dataclass_holds_is_told_by_field() -> None:
    told = plain({"fit": Fit(np.array([[1.0, np.nan], [2.0, 3.0]]), (np.int64(3), np.inf))})
    assert told == {"fit": {"residuals_px": [[1.0, None], [2.0, 3.0]], "counts": [3, None]}}
    assert json.loads(json.dumps(told, allow_nan=False)) == told


def test_summary_file_is_plain_json(tmp_path: Path) -> None:
    write_summary(
        tmp_path / "summary.json",
        {
            "rms": np.float64(0.5),
            "no": float("nan"),
            "a": np.array([1.0, np.inf]),
            "n": np.int64(3),
            "p": Path("x/y"),
            "pair": (True, "ß"),
        },
    )
    text = (tmp_path / "summary.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"rms": 0.5, "no": None, "a": [1.0, None], "n": 3, "p": "x/y", "pair": [True, "ß"]}
    assert "ß" in text
    assert text.endswith("}\n")
