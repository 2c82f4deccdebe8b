"""The report of a measurement: one HTML file a review board can read, print and keep.

Everything is inside the file: styles, figures, numbers. It asks the network for nothing, and forbids itself to.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from html import escape
from pathlib import Path
from typing import Any

from core.georeference import PairResidual, ReferenceFit
from core.project import Project, Target
from core.self_calibration import SUSPICIOUS
from core.storage import write_atomically
from core.validation import GpsComparison
from core.words import with_minus_sign

REPORT_FILE = "report.html"
_LENS_WORDS = {
    "fx": "fx and fy are the focal length",
    "cx": "cx and cy the principal point",
    "k1": "k1 … the distortion",
}


@dataclass(frozen=True)
class InputFile:
    """One input: its part, its path, its SHA-256, and what was understood of it in a few words."""

    part: str
    path: str
    sha256: str
    understood: str = ""


@dataclass(frozen=True)
class Fact:
    """A named result in words and numbers, such as `median ground points`, `287 of 300`."""

    name: str
    value: str


@dataclass(frozen=True)
class Correction:
    """What self-calibration changed.

    Attributes:
        name: of the parameter.
        before, after: with unit, as a person reads them.
        in_priors: the change in units of its prior standard deviation.
    """

    name: str
    before: str
    after: str
    in_priors: float


@dataclass(frozen=True)
class ReportFigure:
    """A figure as the bytes of its PNG file, its caption, and the share of the page's width it was drawn for."""

    caption: str
    png: bytes
    width: float = 1.0


@dataclass(frozen=True)
class TargetReport:
    """Results of one target.

    Attributes:
        name: of the target.
        summary: its rows as `core.results.summarise` gives them.
        gps: comparison with GPS, where there is one.
        figures: in the order to be shown.
    """

    name: str
    summary: Mapping[str, Any]
    gps: GpsComparison | None = None
    figures: Sequence[ReportFigure] = ()


@dataclass(frozen=True)
class ReportContent:
    """Everything the report shows.

    Attributes:
        project: what the person decided.
        version: of the program.
        inputs: the files measured from.
        frames, seconds: how much was measured, and how long the measurement took.
        reference_fit: of the clicked pairs.
        ground: quality of the ground registration.
        corrections: of the self-calibration; none where it did not run.
        calibration_note: why it did not run, or what it rests on.
        targets: in the project's order.
        figures: of the whole run, such as the camera path.
        warnings: whatever an engineer must know before using the numbers.
    """

    project: Project
    version: str
    inputs: Sequence[InputFile]
    frames: int
    seconds: float | None = None
    reference_fit: ReferenceFit | None = None
    ground: Sequence[Fact] = ()
    corrections: Sequence[Correction] = ()
    calibration_note: str = ""
    targets: Sequence[TargetReport] = ()
    figures: Sequence[ReportFigure] = ()
    warnings: Sequence[str] = field(default=())


def write_report(folder: Path, content: ReportContent) -> Path:
    """Write `report.html` into a folder, atomically; return its path."""
    path = folder / REPORT_FILE
    write_atomically(path, report_html(content, date.today()).encode())
    return path


def report_html(content: ReportContent, made_on: date | None = None) -> str:
    """Return the report as one self-contained HTML document, with the day it was made on where that is given."""
    sections = [
        _section("Warnings", _list(content.warnings)) if content.warnings else "",
        _section(
            "Results", _how_to_read(content.project), *(_target(content.project, target) for target in content.targets)
        ),
        _section("Inputs", _inputs(content)),
        _section("Method", _method(content.project), _settings(content.project)),
        _section("Limitations", _list(_limitations(content.project))),
        _section("Reference frame", _reference_fit(content.reference_fit)),
        _section("Ground registration", _facts(content.ground)) if content.ground else "",
        _section("Self-calibration", _calibration(content)),
        _section("Camera", *map(_figure, content.figures)) if content.figures else "",
    ]
    return _PAGE.format(
        title=escape(content.project.name), style=_STYLE, head=_head(content, made_on), body="".join(sections)
    )


def _head(content: ReportContent, made_on: date | None) -> str:
    pace = (
        ""
        if not content.seconds
        else f" in {content.seconds:.1f} s ({content.frames / content.seconds:.1f} per second)"
    )
    method = "geometric method" if content.project.method == "geometric" else "published method"
    day = "" if made_on is None else f" Made on {made_on.isoformat()}."
    return f"<p>{escape(f'{content.frames} frames{pace}, {method}. Rooftrack {content.version}.{day}')}</p>"


def _how_to_read(project: Project) -> str:
    """Return what the numbers are: of which points, along which axes, from where they are counted."""
    at_rest = project.intervals_s.pre_event
    rest = "the reference frame"
    if project.method == "geometric" and at_rest is not None:
        rest = f"the mean position from {at_rest[0]:g} to {at_rest[1]:g} s, before the event"
    kinds = {target.kind for target in project.targets}
    points = "P1, where the lines L1 and T1 cross, and P2, where L2 and T1 cross"
    if kinds == {"points"}:
        points = "P1 and P2, two points of the target's region"
    elif "points" in kinds:
        points += " (of a target without lines, two points of its region)"
    text = (
        f"Displacement of {points}, at the height of the target, along x (east) and y (north) of the point cloud. It "
        f"is counted from {rest}. Drift ratio is the residual over the height of the target."
    )
    return f"<p>{escape(text)}</p>"


def _target(project: Project, target: TargetReport) -> str:
    settings = next((candidate for candidate in project.targets if candidate.name == target.name), None)
    relative = f" relative to {settings.relative_to}" if settings is not None and settings.relative_to else ""
    parts = [
        f"<h3>{escape(f'Displacement of {target.name}{relative}')}</h3>",
        _results_table(target.summary, settings),
        _counts(target.summary),
    ]
    if target.gps is not None:
        parts.append(_gps_table(target.gps))
    return "".join([*parts, *map(_figure, target.figures)])


def _results_table(summary: Mapping[str, Any], settings: Target | None) -> str:
    rows: list[list[str]] = []
    for point, values in (("P1", summary), ("P2", summary.get("p2", {}))):
        for axis, name in (("x", "x (east)"), ("y", "y (north)")):
            row = [f"{point} {name}"]
            for key in ("peak_positive_m", "peak_negative_m"):
                peak = (values.get(key) or {}).get(axis)
                row += ["–", "–"] if peak is None else [_cm(peak["value"]), f"{peak['time_s']:.2f}"]
            residual = (values.get("residual_m") or {}).get(axis)
            rest = (values.get("pre_event_rms_m") or {}).get(axis)
            row += [_cm(residual), _drift_ratio(residual, settings), "–" if rest is None else f"{1000 * rest:.2f}"]
            rows.append(row)
    header = [
        "",
        "peak +, cm",
        "at, s",
        "peak −, cm",
        "at, s",
        "residual, cm",
        "drift ratio, %",
        "RMS before event, mm",
    ]
    return _table(header, rows)


def _drift_ratio(residual_m: float | None, settings: Target | None) -> str:
    """Residual over the target's height, the paper's roof drift ratio; a relative target has no such height."""
    if (
        residual_m is None
        or settings is None
        or settings.relative_to
        or not settings.height_m
        or settings.height_m <= 0
    ):
        return "–"
    return f"{100 * abs(residual_m) / settings.height_m:.2f}"


def _counts(summary: Mapping[str, Any]) -> str:
    counts = ", ".join(f"{number} {word}" for word, number in summary.get("counts", {}).items())
    sigma = summary.get("sigma_median_m")
    noise = (
        ""
        if sigma is None
        else f" Median standard deviation of a frame: {1000 * sigma['x']:.2f} mm in x, {1000 * sigma['y']:.2f} mm in y."
    )
    return f"<p>{escape(f'Frames: {counts}.{noise}')}</p>"


def _gps_table(gps: GpsComparison) -> str:
    names = {"peak_positive": "peak +", "peak_negative": "peak −", "residual": "residual"}
    rows = [
        [
            f"{names[row['quantity']]}, {row['axis']}",
            _cm(row["video_m"]),
            _cm(row["gps_m"]),
            _cm(row["error_m"]),
            "–" if row["error_percent"] is None else with_minus_sign(f"{row['error_percent']:z.1f}"),
            *([_cm(row["video_at_gps_m"]), _cm(row["error_at_gps_m"])] if gps.is_coarse else []),
        ]
        for row in gps.table()
    ]
    rms_x, rms_y = gps.rms_m
    text = (
        f"RMS difference {1000 * rms_x:.2f} mm in x and {1000 * rms_y:.2f} mm in y over {len(gps.time_s)} samples; "
        f"{_lag_words(gps)} {gps.spacing} {gps.message}"
    )
    header = ["", "video, cm", "GPS, cm", "error, cm", "error, %"]
    if gps.is_coarse:
        header += ["video at the GPS instant, cm", "error there, cm"]
    return f"<h4>Comparison with GPS</h4><p>{escape(text.strip())}</p>{_table(header, rows)}"


def _lag_words(gps: GpsComparison) -> str:
    if gps.lag_sigma_s is None:
        return "the lag of its clock could not be told, and none is applied."
    direction = "behind" if gps.lag_s > 0 else "ahead of"
    lag = f"{abs(gps.lag_s):.4f} s (± {1000 * gps.lag_sigma_s:.1f} ms)"
    return f"its clock runs {direction} the video's by {lag}, found from the motion itself."


def _inputs(content: ReportContent) -> str:
    return _facts(
        Fact(file.part, ". ".join(filter(None, (file.path, file.understood, f"SHA-256 {file.sha256}"))))
        for file in content.inputs
    )


def _method(project: Project) -> str:
    if project.method == "paper":
        text = (
            "The published method: each frame is undistorted, registered to the reference frame by matched ground "
            "features and a homography, and orthorectified onto the LiDAR ground. Edge point pairs of the lines L1, L2 "
            "and T1 give the intersections P1 and P2; their known distance, or else the target's height, sets the "
            "scale, and their rigid motion is the "
            "displacement. The homography holds the ground still, not the roof: camera drift remains in the result as "
            "apparent motion."
        )
    else:
        text = (
            "The geometric method: the clicked pairs tie the reference frame to the LiDAR ground, so that every "
            "tracked ground feature is a surveyed point. They give the camera pose of each frame; the target's lines "
            "or patches, measured to a fraction of a pixel in the source frame, are carried to the plane at the "
            "target's height. Camera drift is thereby computed, not filtered."
        )
    return f"<p>{escape(text)} {escape(_filter_words(project))}</p>"


def _filter_words(project: Project) -> str:
    if project.drift.filter == "none":
        return "No filter was applied."
    return (
        f"A zero-phase Butterworth high-pass of order {project.drift.order}, 3 dB down at "
        f"{project.drift.corner_hz:g} Hz, was applied to the displacement; it removes any residual displacement too."
    )


def _settings(project: Project) -> str:
    intervals = project.intervals_s
    facts = [
        Fact("reference frame", str(project.reference_frame)),
        *(
            Fact(f"{name} interval", "not given" if interval is None else f"{interval[0]:g} to {interval[1]:g} s")
            for name, interval in (
                ("pre-event", intervals.pre_event),
                ("event", intervals.event),
                ("residual", intervals.residual),
            )
        ),
        Fact("excluded frames", ", ".join(f"{first}–{last}" for first, last in project.excluded_frames) or "none"),
        *(Fact(f"target {target.name}", _target_words(target)) for target in project.targets),
    ]
    return _facts(facts)


def _target_words(target: Target) -> str:
    words = ["lines L1, L2, T1" if target.kind == "lines" else "points of a textured region"]
    if target.height_m is not None:
        words.append(f"{target.height_m:g} m above the ground plane")
    if target.p1_p2_m is not None:
        words.append(f"P1–P2 {target.p1_p2_m:g} m")
    if target.relative_to is not None:
        words.append(f"relative to {target.relative_to}")
    return ", ".join(words)


def _reference_fit(fit: ReferenceFit | None) -> str:
    if fit is None:
        return "<p>Not available.</p>"
    left_out = "" if fit.left_out_rms_px is None else f", {fit.left_out_rms_px:.2f} px when left out one by one"
    text = (
        f"{sum(pair.enabled for pair in fit.pairs)} pairs: RMS {fit.rms_px:.2f} px, {100 * fit.rms_m:.2f} cm on the "
        f"ground{left_out}. The pairs touch {100 * fit.coverage:.0f} % of the frame."
    )
    header = ["pair", "du, px", "dv, px", "dx, cm", "dy, cm", "left out, px", "left out, cm"]
    return f"<p>{escape(text)}</p>{_table(header, [_pair_row(pair) for pair in fit.pairs])}"


def _pair_row(pair: PairResidual) -> list[str]:
    return [
        f"{pair.id}" if pair.enabled else f"{pair.id} (off)",
        *(with_minus_sign(f"{value:+z.2f}") for value in pair.residual_px),
        *(with_minus_sign(f"{100 * value:+z.2f}") for value in pair.residual_m),
        "–" if pair.left_out_px is None else f"{pair.left_out_px:.2f}",
        _cm(pair.left_out_m),
    ]


def _calibration(content: ReportContent) -> str:
    note = f"<p>{escape(content.calibration_note)}</p>" if content.calibration_note else ""
    if not content.corrections:
        return note or "<p>Did not run.</p>"
    rows = [
        [
            correction.name,
            with_minus_sign(correction.before),
            with_minus_sign(correction.after),
            with_minus_sign(f"{correction.in_priors:+z.2f}") + (" !" if abs(correction.in_priors) > SUSPICIOUS else ""),
        ]
        for correction in content.corrections
    ]
    names = {correction.name for correction in content.corrections}
    legend = ", ".join(words for name, words in _LENS_WORDS.items() if name in names)
    words = f"<p>{escape(legend)}.</p>" if legend else ""
    return note + _table(["parameter", "before", "after ± 1 σ", "change, in σ of what was given"], rows) + words


def _limitations(project: Project) -> list[str]:
    sentences = [
        "The roof is taken as rigid in its plane and as moving without vertical displacement or overturning.",
        "Displacement is relative to the ground features in view; where the ground itself moves in an earthquake, "
        "it is not absolute.",
        "Motion faster than half the frame rate cannot be seen.",
        "The standard deviations are those of each frame's random error; errors of height, scale and lens shared by "
        "all frames come on top.",
    ]
    if project.method == "paper":
        sentences.append(
            "Without a filter the displacement holds the apparent motion that camera drift causes at roof height."
        )
    if project.drift.filter == "high-pass":
        sentences.append(
            "Residual displacement, and motion slower than the corner frequency, are not in the filtered result."
        )
    if project.intervals_s.pre_event is None:
        sentences.append(
            "No pre-event interval was given, so rest is the reference frame, and nothing was calibrated at rest."
        )
    return sentences


def _cm(value_m: float | None) -> str:
    return "–" if value_m is None else with_minus_sign(f"{100 * value_m:z.2f}")


def _section(title: str, *parts: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{''.join(parts)}</section>"


def _list(sentences: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences) + "</ul>"


def _facts(facts: Iterable[Fact]) -> str:
    return "<dl>" + "".join(f"<dt>{escape(fact.name)}</dt><dd>{escape(fact.value)}</dd>" for fact in facts) + "</dl>"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table whose first column names the row and whose others hold numbers."""

    def cells(tag: str, texts: Sequence[str]) -> str:
        name, *numbers = (escape(text) for text in texts)
        return f"<{tag}>{name}</{tag}>" + "".join(f'<{tag} class="number">{number}</{tag}>' for number in numbers)

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f"<table><thead><tr>{cells('th', header)}</tr></thead><tbody>{body}</tbody></table>"


def _figure(figure: ReportFigure) -> str:
    data = base64.b64encode(figure.png).decode("ascii")
    caption = escape(figure.caption)
    return (
        f'<figure style="width: {100 * figure.width:.0f}%"><img src="data:image/png;base64,{data}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


_STYLE = """
@page { margin: 15mm 16mm;
  @bottom-left { content: "Rooftrack, displacement report"; font: 8pt sans-serif; color: #555; }
  @bottom-right { content: "page " counter(page) " of " counter(pages); font: 8pt sans-serif; color: #555; } }
body { font: 9.5pt/1.4 "Segoe UI", "Helvetica Neue", Arial, "DejaVu Sans", sans-serif; color: #1a1a1a; background: #fff;
  max-width: 178mm; margin: 12mm auto; padding: 0 6mm; counter-reset: figure;
  orphans: 1; widows: 1; }
.kind { font-size: 10pt; color: #555; margin: 0; }
h1 { font-size: 20pt; margin: 0 0 1mm; }
h2 { font-size: 13pt; margin: 6mm 0 2mm; border-bottom: 0.3mm solid #bbb; padding-bottom: 1mm; break-after: avoid; }
h3 { font-size: 11pt; margin: 4mm 0 1mm; break-after: avoid; }
h4 { font-size: 10pt; margin: 3mm 0 1mm; break-after: avoid; }
table { border-collapse: collapse; width: 100%; font-size: 8.5pt; margin: 2mm 0; }
thead { display: table-header-group; }
tr, figure, dd, li { break-inside: avoid; }
p { margin: 2mm 0; }
p, li { orphans: 2; widows: 2; }
th { text-align: left; font-weight: 600; border-bottom: 0.3mm solid #666; vertical-align: bottom; }
th, td { padding: 0.6mm 1.5mm; }
td { border-bottom: 0.15mm solid #ddd; overflow-wrap: anywhere; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
th.number { white-space: normal; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.6mm 5mm; margin: 2mm 0; font-size: 9pt; }
dt { color: #555; }
dd { margin: 0; overflow-wrap: anywhere; }
figure { display: inline-block; margin: 3mm 0 0; vertical-align: top; counter-increment: figure; }
img { width: 100%; }
figcaption { font-size: 8.5pt; color: #444; padding-right: 3mm; }
figcaption::before { content: "Figure " counter(figure) ". "; font-weight: 600; }
@media print { body { margin: 0 auto; padding: 0; } }
"""
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}: displacement report</title>
<style>{style}</style>
</head>
<body>
<header><p class="kind">Displacement report</p><h1>{title}</h1>{head}</header>
{body}
</body>
</html>
"""
