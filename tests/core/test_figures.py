from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from functools import lru_cache

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from core import figures
from core.coordinates import Floats
from core.drift import amplitude_spectrum, corner_sweep, high_pass
from core.gps_record import GpsRecord
from core.intervals import within
from core.project import Drift, Intervals
from core.results import TargetHistory
from core.validation import GpsComparison, compare_with_gps

INTERVALS = Intervals(pre_event=(0.0, 5.0), event=(6.0, 14.0), residual=(15.0, 20.0))
TIME_S = np.arange(600) / 30


def displacement() -> Floats:
    envelope = np.clip(np.minimum(TIME_S - 6, 14 - TIME_S), 0, 1)
    residual = 0.1 * np.clip(TIME_S - 9, 0, 1)
    return np.column_stack([0.3 * envelope * np.sin(9 * TIME_S) + residual, 0.004 * envelope * np.cos(7 * TIME_S)])


def history(status: str = "ok") -> TargetHistory:
    statuses = np.full(600, status, dtype="<U8")
    statuses[290:300] = "lost"
    moved = displacement()
    drift = 0.05 * np.sin(0.9 * TIME_S)[:, None]
    return TargetHistory(
        name="roof",
        frame=np.arange(600),
        time_s=TIME_S,
        status=statuses,
        p1_m=moved,
        p2_m=moved,
        rotation_rad=1e-3 * moved[:, 0],
        p1_sigma_m=np.full((600, 2), 4e-4),
        p2_sigma_m=np.full((600, 2), 4e-4),
        rotation_sigma_rad=np.full(600, 1e-4),
        p1_raw_m=moved + drift,
        p2_raw_m=moved + drift,
        rotation_raw_rad=1e-3 * moved[:, 0],
    )


@lru_cache
def comparison() -> GpsComparison:
    record = GpsRecord("gps.csv", TIME_S[::3] - 4.0, displacement()[::3])
    return compare_with_gps(TIME_S, history().p1_m, record, INTERVALS)


def pre_event_figure() -> Figure:
    raw_m, rest = history().p1_raw_m, within(TIME_S, INTERVALS.pre_event)
    return figures.pre_event_figure(TIME_S[rest], raw_m[rest], amplitude_spectrum(raw_m, TIME_S, INTERVALS.pre_event))


def effect_figure() -> Figure:
    raw_m = history().p1_raw_m[:, 0]
    filtered = {corner: high_pass(raw_m, TIME_S, corner) for corner in (0.1, 0.25, 0.5)}
    return figures.corner_effect_figure(TIME_S, raw_m, filtered, intervals=INTERVALS, comparison=comparison())


def frame_figure() -> Figure:
    image = np.random.default_rng(0).integers(60, 200, (135, 240)).astype(np.uint8)
    return figures.frame_figure(
        image,
        lines_px={"L1": [[100, 50], [140, 52]], "L2": [[100, 70], [140, 72]], "T1": [[120, 40], [119, 80]]},
        edges_px={"L1": np.column_stack([np.linspace(100, 140, 20), np.full(20, 49)])},
        points_px={"P1": [120, 51], "P2": [119.5, 71]},
        ground_px=[[10, 10], [200, 120]],
        regions_px=[[[90, 30], [150, 30], [150, 90]]],
        title="Frame 0",
    )


FIGURES: dict[str, Callable[[], Figure]] = {
    "history": lambda: figures.history_figure(history(), INTERVALS, {"raw": history().p1_raw_m}),
    "pre-event": pre_event_figure,
    "sweep": lambda: figures.corner_sweep_figure(corner_sweep(history().p1_raw_m, TIME_S, (0.0, 5.0)), chosen_hz=0.25),
    "effect": effect_figure,
    "gps": lambda: figures.gps_figure(TIME_S, history().p1_m, comparison(), INTERVALS),
    "orbit": lambda: figures.orbit_figure(history()),
    "camera": lambda: figures.camera_figure(TIME_S, np.column_stack([TIME_S, -TIME_S, 42 + TIME_S]) * 0.01),
    "frame": frame_figure,
}


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_draws(name: str) -> None:
    picture = figures.encoded(FIGURES[name](), dpi=40)
    assert picture.startswith(b"\x89PNG")
    assert b"Software" not in picture


@pytest.mark.parametrize("name", ["sweep", "frame"])
def test_the_same_data_give_the_same_picture(name: str) -> None:
    first, second = (figures.encoded(FIGURES[name](), dpi=40) for _ in range(2))
    assert first == second


def test_a_target_gets_the_figures_its_project_can_tell() -> None:
    every = figures.target_figures(history(), INTERVALS, Drift(), comparison=comparison())
    assert set(every) == {"displacement", "orbit", "pre_event", "corner_sweep", "corner_effect", "gps"}
    assert set(figures.target_figures(history(), Intervals(), Drift())) == {"displacement", "orbit"}
    assert set(figures.target_figures(history("lost"), INTERVALS, Drift())) == {"displacement", "orbit"}


def test_svg_has_no_date_and_is_the_same_twice() -> None:
    content, again = (figures.encoded(FIGURES["sweep"](), "svg") for _ in range(2))
    assert content == again
    assert ElementTree.fromstring(content).tag.endswith("svg")
    assert b"dc:date" not in content


def test_other_formats_are_refused() -> None:
    with pytest.raises(ValueError, match="png or svg, not 'tiff'"):
        figures.encoded(FIGURES["orbit"](), "tiff")


def test_curves_carry_the_numbers_in_the_unit_of_the_label() -> None:
    made = history()
    panels = figures.history_figure(made, INTERVALS).axes
    assert panels[0].get_ylabel() == "x (east), cm"
    assert panels[1].get_ylabel() == "y (north), mm"
    curve = next(line for line in panels[1].get_lines() if line.get_label() == "measured")
    np.testing.assert_allclose(np.asarray(curve.get_ydata(), dtype=float), 1000 * made.p1_m[:, 1])
    assert np.isnan(np.asarray(curve.get_ydata(), dtype=float)[290:300]).all()


def test_gps_error_panel_names_its_rms() -> None:
    figure = FIGURES["gps"]()
    for error in figure.axes[2:]:
        legend = error.get_legend()
        assert legend is not None
        assert legend.get_texts()[0].get_text().startswith("RMS ")
    assert "clock lag 4.000 s" in figure.axes[0].get_title(loc="left")


@pytest.mark.parametrize(
    "draw",
    [
        lambda: figures.history_figure(history("lost"), Intervals()),
        lambda: figures.orbit_figure(history("lost")),
        lambda: figures.camera_figure(TIME_S, np.full((600, 3), np.nan)),
        lambda: figures.frame_figure(np.zeros((90, 160), dtype=np.uint8), lines_px={}),
    ],
)
def test_nothing_measured_still_draws(draw: Callable[[], Figure]) -> None:
    assert figures.encoded(draw(), dpi=40).startswith(b"\x89PNG")


def test_style_is_the_houses_and_leaves_the_process_alone() -> None:
    before = dict(mpl.rcParams)
    with mpl.rc_context({"font.size": 30.0, "lines.linewidth": 9.0}):
        loud = figures.encoded(FIGURES["orbit"](), dpi=40)
    assert figures.encoded(FIGURES["orbit"](), dpi=40) == loud
    assert dict(mpl.rcParams) == before


@pytest.mark.parametrize(
    ("values_m", "unit"),
    [([0.0], (1000.0, "mm")), ([np.nan], (1000.0, "mm")), ([0.0199], (1000.0, "mm")), ([-0.4], (100.0, "cm"))],
)
def test_people_read_millimetres_or_centimetres(values_m: list[float], unit: tuple[float, str]) -> None:
    assert figures.length_unit(values_m) == unit


@pytest.mark.parametrize("name", FIGURES)
def test_two_figures_fit_on_a_page(name: str) -> None:
    """Else what does not fit below another leaves half a page empty: Letter is the shorter paper."""
    page_in, caption_in = 11.0 - 2 * 15 / 25.4, 0.25
    shown = 178 / 25.4 / figures.PAGE_WIDTH_IN  # of the width drawn for, as the report prints it
    assert 2 * (shown * FIGURES[name]().get_figheight() + caption_in) < page_in + 0.05
