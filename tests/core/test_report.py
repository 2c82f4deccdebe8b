from __future__ import annotations

import base64
import re
from dataclasses import replace
from datetime import date
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.georeference import ReferenceFit, fit_reference
from core.gps_record import GpsRecord
from core.lens import Lens
from core.project import Correspondence, Project, parse_project
from core.report import (
    Correction,
    Fact,
    InputFile,
    ReportContent,
    ReportFigure,
    TargetReport,
    report_html,
    write_report,
)
from core.validation import compare_with_gps

NASTY = "<script>alert(\"1\")</script> & 'roof'"
PNG = b"\x89PNG\r\n\x1a\nnot really"
VOID = {"meta", "img", "br"}


class Balanced(HTMLParser):
    """Collects tags, texts and addresses, and fails where tags do not nest."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "action", "poster")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.texts.append(data.strip())


def parsed(html: str) -> Balanced:
    parser = Balanced()
    parser.feed(html)
    assert parser.open == []
    return parser


def project(**changes: Any) -> Project:
    band = '{"from_m": [0, 0], "to_m": [5, 0]}'
    made = parse_project(
        f"""{{"rooftrack": 1, "name": "EQ9", "inputs": {{"video": "video.mp4"}}, "excluded_frames": [[812, 840]],
        "targets": [{{"name": "roof", "height_m": 18.3, "p1_p2_m": 1.22,
                      "lines": {{"L1": {band}, "L2": {band}, "T1": {band}}}}}],
        "intervals_s": {{"pre_event": [0.0, 9.0], "event": [10.0, 24.0], "residual": [27.0, 30.0]}}}}"""
    )
    return made.model_copy(update=changes)


def summary() -> dict[str, Any]:
    peak = {"x": {"value": 0.795, "time_s": 14.2}, "y": {"value": 0.0123, "time_s": 15.0}}
    trough = {"x": {"value": -0.213, "time_s": 12.2}, "y": None}
    rows = {
        "peak_positive_m": peak,
        "peak_negative_m": trough,
        "residual_m": {"x": 0.22, "y": 0.001},
        "pre_event_rms_m": {"x": 0.0004, "y": 0.0003},
    }
    return {
        **rows,
        "p2": rows,
        "sigma_median_m": {"x": 0.0003, "y": 0.0004},
        "counts": {"ok": 930, "weak": 4, "lost": 2, "excluded": 29},
    }


@lru_cache
def fit() -> ReferenceFit:
    """Eight clicks from 42 m straight above, with human error; the last one is switched off."""
    ground = [(-15, -9), (14, -8), (13, 9), (-14, 8), (1, -9), (0, 8), (9, 1), (-9, 0)]
    noise = np.random.default_rng(0).normal(scale=0.7, size=(8, 2))
    pairs = [
        Correspondence(
            id=number + 1,
            ground_m=(float(x), float(y)),
            frame_px=(960 + 1500 * x / 42 + noise[number, 0], 540 - 1500 * y / 42 + noise[number, 1]),
            enabled=number < 7,
        )
        for number, (x, y) in enumerate(ground)
    ]
    return fit_reference(pairs, Lens.ideal((1920, 1080), 1500.0))


def gps_target() -> TargetReport:
    time_s = np.arange(930) / 30
    moved = np.column_stack([np.sin(2 * time_s) * np.exp(-(((time_s - 16) / 4) ** 2)), 0 * time_s])
    comparison = compare_with_gps(
        time_s, moved, GpsRecord("gps.csv", time_s[::3] - 2.5, moved[::3] * 1.1), project().intervals_s
    )
    return TargetReport("roof", summary(), comparison, (ReportFigure("Displacement of roof at P1", PNG),))


def content(**changes: Any) -> ReportContent:
    made = ReportContent(
        project=project(),
        version="0.1.0",
        inputs=[InputFile("video", "video.mp4", "ab" * 32, "1920 × 1080, 30 frames per second, 31.0 s")],
        frames=965,
        seconds=48.25,
        reference_fit=fit(),
        ground=[Fact("median ground points", "287 of 300"), Fact("RMS", "0.12 px")],
        corrections=[
            Correction("focal length", "2300.0 px", "2301.2 px", 0.87),
            Correction("k1", "-0.01", "0.02", -3.4),
        ],
        calibration_note="From 40 stationary frames.",
        targets=[gps_target()],
        figures=[ReportFigure("Camera drift", PNG)],
        warnings=["The correction of k1 is 3.4 times its prior."],
    )
    return replace(made, **changes)


def test_report_is_whole_and_asks_the_network_for_nothing(tmp_path: Path) -> None:
    path = write_report(tmp_path / "results", content())
    assert path == tmp_path / "results" / "report.html"
    html = path.read_text(encoding="utf-8")
    page = parsed(html)
    assert html.startswith("<!doctype html>")
    assert len(page.addresses) == 2
    assert all(address == "data:image/png;base64," + base64.b64encode(PNG).decode() for address in page.addresses)
    assert "default-src 'none'" in html
    assert not re.search(r"https?://|//[a-z]|@import|url\(|<script|<link|<iframe", html)


def test_report_holds_what_a_review_board_needs() -> None:
    page = parsed(report_html(content()))
    for title in ("Warnings", "Results", "Inputs", "Method", "Reference frame", "Ground registration",
                  "Self-calibration", "Camera", "Limitations"):  # fmt: skip
        assert title in page.texts
    for text in ("79.50", "−21.30", "22.00", "1.20", "0.40", "8 (off)", "+0.87", "−3.40 !",
                 "287 of 300", "812–840", "0 to 9 s"):  # fmt: skip
        assert text in page.texts, text
    worst = max(
        (pair for pair in fit().pairs if pair.left_out_px is not None), key=lambda pair: pair.left_out_px or 0.0
    )
    gps = content().targets[0].gps
    assert gps is not None
    assert f"{worst.left_out_px:.2f}" in page.texts
    assert f"{gps.table()[0]['error_percent']:.1f}" in page.texts
    whole = " ".join(page.texts)
    assert "965 frames in 48.2 s (20.0 per second), geometric method. Rooftrack 0.1.0." in whole
    assert re.search(r"its clock runs behind the video's by 2\.5000 s \(± \d+\.\d ms\)", whole)
    assert "It is counted from the mean position from 0 to 9 s, before the event." in whole
    assert f"SHA-256 {'ab' * 32}" in whole
    assert "930 ok, 4 weak, 2 lost, 29 excluded" in whole
    assert "18.3 m above the ground plane" in whole
    assert "No filter was applied" in whole


def test_everything_from_outside_is_escaped() -> None:
    nasty = content(
        project=project(name=NASTY),
        version=NASTY,
        inputs=[InputFile(NASTY, NASTY, NASTY, NASTY)],
        ground=[Fact(NASTY, NASTY)],
        corrections=[Correction(NASTY, NASTY, NASTY, 0.0)],
        calibration_note=NASTY,
        targets=[TargetReport(NASTY, summary(), None, (ReportFigure(NASTY + '" onload="x', PNG),))],
        warnings=[NASTY],
    )
    html = report_html(nasty)
    assert "script" not in parsed(html).tags
    assert "<script" not in html
    assert 'onload="' not in html


def test_report_is_the_same_twice_on_one_day() -> None:
    assert report_html(content()) == report_html(content())
    day = date(2026, 11, 23)
    assert "Made on 2026-11-23." in report_html(content(), day)
    assert report_html(content(), day) == report_html(content(), day)


def test_numbers_have_one_minus_sign_and_names_of_the_lens_are_explained() -> None:
    page = parsed(report_html(content()))
    assert "−0.01" in page.texts
    assert not any(re.fullmatch(r"-\d.*", text) for text in page.texts)
    assert any("the distortion" in text for text in page.texts)


def test_paper_method_with_filter_says_what_it_cannot() -> None:
    html = report_html(
        content(
            project=parse_project(
                '{"rooftrack": 1, "name": "EQ7", "inputs": {"video": "v.mp4"}, "method": "paper", '
                '"drift": {"filter": "high-pass"}}'
            ),
            targets=[],
        )
    )
    assert "The published method" in html
    assert "order 10, 3 dB down at 0.25 Hz" in html
    assert "camera drift causes at roof height" in html
    assert "Residual displacement, and motion slower than the corner frequency" in html
    assert "No pre-event interval was given" in html


def test_what_p1_and_p2_are_is_said_of_each_kind_of_target() -> None:
    points = parse_project(
        """{"rooftrack": 1, "name": "EQ7", "inputs": {"video": "v.mp4"}, "targets": [{"name": "roof", "kind": "points",
        "height_m": 9.0, "region_m": [[0, 0], [5, 0], [5, 5]]}]}"""
    )
    assert "two points of the target&#x27;s region" in report_html(content(project=points, targets=[]))
    assert "where the lines L1 and T1 cross" in report_html(content())


def test_relative_targets_have_no_drift_ratio() -> None:
    roof = project().targets[0]
    both = (roof.model_copy(update={"relative_to": "table"}), roof.model_copy(update={"name": "table"}))
    page = parsed(report_html(content(project=project(targets=both))))
    assert "Displacement of roof relative to table" in page.texts
    assert "1.20" not in page.texts


@pytest.mark.parametrize(
    "changes", [{"reference_fit": None, "corrections": [], "calibration_note": "", "seconds": None}]
)
def test_what_is_missing_is_said(changes: dict[str, Any]) -> None:
    page = parsed(report_html(content(**changes)))
    assert "Not available." in page.texts
    assert "Did not run." in page.texts
    assert "965 frames, geometric method. Rooftrack 0.1.0." in page.texts
