"""Render scenes with known truth, measure them as an engineer would, print how far the engine was off.

`python -m sample_data.accuracy [--scenes eq5,eq7] [--seeds 1,2,3] [--paper] [--write]`. A scene is rendered once and
kept; it is measured anew each time, because the engine is what is on trial.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from core.coordinates import Floats
from core.intervals import during
from core.measure import measure
from core.measurements import MeasurementStore, Recording
from core.project import Drift, Intervals, Project
from core.results import Status, TargetHistory
from core.run import FRAMES_FILE, LoadedInputs, load_inputs
from core.solution import Solution
from core.solve import filtered, solve
from sample_data.bound import camera_bound, displacement_bound
from sample_data.catalogue import SCENES, build
from sample_data.make import make
from sample_data.tables import README, markdown_table, write_between_markers

CACHE = Path("workspace/accuracy")
Size = tuple[int, int]
SIZE, SECONDS = re.compile(r"\d+x\d+"), re.compile(r"[\d.]+s")
TRUTH_FILE = "truth.npz"
# The paper's corner frequencies.
PAPER_CORNER_HZ = {"eq5": 0.3, "eq5_slow_drift": 0.3}
PAPER_USUAL_CORNER_HZ = 0.25


@dataclass(frozen=True)
class Limit:
    """What a scene must keep to: RMS on each axis over the whole clip, residual, frames lost; None where unstated."""

    rms_mm: float | None
    residual_mm: float | None = None
    lost_share: float | None = None


DISTURBED = Limit(1.0, lost_share=0.02)
LIMITS: Mapping[str, Limit] = {
    "eq5": Limit(0.5, 0.5, 0.0),
    "eq7": Limit(0.5, 0.5, 0.0),
    "eq9": Limit(0.6, 0.5, 0.0),
    "tall_flexible": Limit(0.7, 0.7, 0.0),
    "windy": Limit(0.6, 0.6, 0.0),
    # Frames in which its encoder, short of bits, shows the ground of an earlier one are as good as hidden.
    "poor_texture": Limit(2.5, 2.5, 0.02),
    "fullhd": Limit(1.3, 1.3, 0.0),
    "oblique": Limit(1.0, 1.0, 0.0),
    "crossings": DISTURBED,
    "dust": DISTURBED,
    "cloud_shadow": DISTURBED,
    "flicker": DISTURBED,
    "hidden_line": DISTURBED,
    "gust": DISTURBED,
}
NO_LIMIT = Limit(None)
USUAL_SCENES = (
    *LIMITS,
    "mid_shaking",
    "fps60",
    "fps120",
    "portrait",
    "points_roof",
    "two_targets",
    "rolling_shutter",
    "dusk",
    "night",
    "variable_rate",
)
PAPER_SCENES = ("eq5_slow_drift", "eq7_slow_drift")


@dataclass(frozen=True)
class Clip:
    """A rendered scene.

    Attributes:
        scene: name in the catalogue.
        size, seconds, preset: of the encoder, where they are not the scene's own.
    """

    scene: str
    seed: int
    size: Size | None = None
    seconds: float | None = None
    preset: str | None = None

    @property
    def folder(self) -> str:
        """Name of the folder it is kept in; see `in_folder`."""
        size = f"{self.size[0]}x{self.size[1]}" if self.size else ""
        seconds = f"{self.seconds:g}s" if self.seconds else ""
        return "-".join(part for part in (self.scene, str(self.seed), size, seconds, self.preset) if part)

    @property
    def row(self) -> str:
        """Name of the row of the table in which clips of several seeds come together."""
        size = f"{self.size[0]}×{self.size[1]}" if self.size else ""
        return ", ".join(part for part in (self.scene, size, self.preset) if part)

    @staticmethod
    def in_folder(name: str) -> Clip | None:
        """Return the clip that a folder of this name holds, or None if it holds none."""
        scene, _, rest = name.partition("-")
        seed, *parts = rest.split("-")
        if not seed.isdigit():
            return None
        size = next((_size(part) for part in parts if SIZE.fullmatch(part)), None)
        seconds = next((float(part[:-1]) for part in parts if SECONDS.fullmatch(part)), None)
        preset = next((part for part in parts if part.isalpha()), None)
        return Clip(scene, int(seed), size, seconds, preset)


@dataclass(frozen=True)
class Score:
    """How far one target of one clip was off.

    Attributes:
        name: of scene and target.
        rms_mm: (2, 2) of P1 and P2 along x and y over all measured frames.
        residual_mm: largest error of the mean over the residual interval; nan without one.
        lost_share, weak_share: of frames in which the target could be seen.
        sigma_by_scatter: (2, 2) stated sigma by scatter in the stationary part.
        within_two_sigma: share of values.
        rms_by_bound: RMS by what one frame can tell at best.
        camera_by_bound: noise of single poses' positions by what one frame can tell at best.
        frame_ms: time for a frame.
    """

    name: str
    rms_mm: Floats
    residual_mm: float
    lost_share: float
    weak_share: float
    sigma_by_scatter: Floats
    within_two_sigma: float
    rms_by_bound: float
    camera_by_bound: float
    frame_ms: float
    limit: Limit

    @property
    def keeps(self) -> bool:
        """Whether everything that is asked of the scene holds."""
        limit = self.limit
        return not (
            (limit.rms_mm is not None and self.rms_mm.max() > limit.rms_mm)
            or (limit.residual_mm is not None and self.residual_mm > limit.residual_mm)
            or (limit.lost_share is not None and self.lost_share > limit.lost_share)
        )


@dataclass(frozen=True)
class PaperScore:
    """How far the published method was off, RMS (2, 2) of P1 and P2 along x and y.

    Attributes:
        raw_mm: unfiltered, against the exact apparent motion: truth plus parallax.
        filtered_mm: filtered, against the truth.
        geometric_raw_mm: the geometric method's raw columns against the same apparent motion.
        corner_hz: of the filter.
    """

    name: str
    raw_mm: Floats
    filtered_mm: Floats
    geometric_raw_mm: Floats
    corner_hz: float


# --- one clip --------------------------------------------------------------------------------------------------------


def rendered(clip: Clip, cache: Path) -> Path:
    """Return the folder of a clip, rendered if it is not there yet."""
    folder = cache / clip.folder
    if (folder / "video.mp4").exists() and (folder / TRUTH_FILE).exists():
        return folder
    unfinished = cache / f".{clip.folder}"
    scene = build(clip.scene, seed=clip.seed, size_px=clip.size, duration_s=clip.seconds, preset=clip.preset)
    make(scene, unfinished, lambda done, total: _say(f"{clip.folder}: rendering frame {done} of {total}"))
    unfinished.rename(folder)
    return folder


def measured(inputs: LoadedInputs, *, keep: bool = False) -> tuple[Recording, Solution, float]:
    """Return measurements, solution and the time per frame of a project.

    Args:
        keep: take earlier measurements where they still fit.
    """
    started = time.perf_counter()
    with MeasurementStore(inputs.folder / "results" / FRAMES_FILE) as store:
        number = measure(
            inputs.setup(), store, fresh=not keep, progress=lambda stage, done, total: _tell(inputs, stage, done, total)
        )
        recording = store.load(number)
    frame_ms = (time.perf_counter() - started) / len(recording.frame) * 1e3
    solution = solve(recording, inputs.project, inputs.lens, inputs.relief, has_lens=inputs.has_lens)
    return recording, solution, frame_ms


def true_displacement(truth: Mapping[str, NDArray[np.float64]], name: str, rest_m: Floats, kind: str) -> Floats:
    """Return the true displacement (F, 2, 2) of P1 and P2 from where the building stands without an earthquake."""
    if kind == "lines":
        return np.stack([truth[f"{name}_p1_m"], truth[f"{name}_p2_m"]], axis=1)
    motion, centre = truth[f"{name}_motion"], truth[f"{name}_centre_m"] + truth["cloud_origin_m"][:2]
    c, s = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    turned = np.einsum(
        "fij,pj->fpi", np.stack([np.stack([c - 1, -s], -1), np.stack([s, c - 1], -1)], 1), rest_m - centre
    )
    return np.asarray(motion[:, None, :2] + turned)


def score(clip: Clip, inputs: LoadedInputs, keep: bool) -> list[Score]:
    """Measure a clip and return the errors of each of its targets."""
    truth = dict(np.load(inputs.folder / TRUTH_FILE))
    recording, solution, frame_ms = measured(inputs, keep=keep)
    noise, camera_by_bound = SCENES[clip.scene].noise, np.nan
    if solution.flight is not None:
        ratios = solution.flight.noise_m / camera_bound(inputs, recording, solution, noise)
        camera_by_bound = float(ratios[:2].mean())
    scores = []
    for target in inputs.project.targets:
        history = solution.histories[target.name]
        rest = solution.targets[target.name].rest_m
        true = true_displacement(truth, target.name, rest, target.kind)
        alone = target.relative_to is None
        bound_m = displacement_bound(inputs, recording, solution, target=target, noise=noise) if alone else np.nan
        label = clip.row + (f": {target.name}" if len(inputs.project.targets) > 1 else "")
        one = _scored(
            label,
            history,
            true,
            hidden=truth["hidden"],
            intervals=inputs.project.intervals_s,
            bound_m=bound_m,
            frame_ms=frame_ms,
            scene=clip.scene,
        )
        scores.append(replace(one, camera_by_bound=camera_by_bound))
    return scores


def _scored(
    label: str,
    history: TargetHistory,
    true: Floats,
    *,
    hidden: NDArray[np.bool_],
    intervals: Intervals,
    bound_m: float,
    frame_ms: float,
    scene: str,
) -> Score:
    got = np.stack([history.p1_m, history.p2_m], axis=1)
    sigma = np.stack([history.p1_sigma_m, history.p2_sigma_m], axis=1)
    still = during(history.time_s, intervals.pre_event)
    residual = during(history.time_s, intervals.residual)
    error = got - (true - (true[still].mean(axis=0) if still.any() else true[0]))
    seen = ~hidden
    rms = np.sqrt(np.nanmean(error**2, axis=0))
    scatter = np.nanstd(got[still] - true[still], axis=0) if still.any() else np.full((2, 2), np.nan)
    stated = np.sqrt(np.nanmean(sigma[still] ** 2, axis=0)) if still.any() else np.full((2, 2), np.nan)
    finite = np.isfinite(error)
    return Score(
        name=label,
        rms_mm=rms * 1e3,
        residual_mm=float(np.abs(np.nanmean(error[residual], axis=0)).max() * 1e3) if residual.any() else np.nan,
        lost_share=float(np.mean(history.status[seen] == Status.LOST.value)),
        weak_share=float(np.mean(history.status[seen] == Status.WEAK.value)),
        sigma_by_scatter=stated / scatter,
        within_two_sigma=float(np.mean(np.abs(error[finite]) <= 2 * sigma[finite])),
        rms_by_bound=float(np.sqrt((rms**2).mean()) / bound_m),
        camera_by_bound=np.nan,
        frame_ms=frame_ms,
        limit=LIMITS.get(scene, NO_LIMIT),
    )


# --- the published method --------------------------------------------------------------------------------------------


def score_paper(name: str, inputs: LoadedInputs, keep: bool) -> PaperScore:
    """Measure a scene the published way and return how far raw and filtered series are off."""
    truth = dict(np.load(inputs.folder / TRUTH_FILE))
    target = inputs.project.targets[0]
    apparent = apparent_displacement(truth, target.name, inputs.project)
    _, geometric, _ = measured(inputs, keep=True)
    paper = replace(inputs, project=inputs.project.model_copy(update={"method": "paper"}))
    _, solution, _ = measured(paper, keep=keep)
    corner = PAPER_CORNER_HZ.get(name, PAPER_USUAL_CORNER_HZ)
    history = solution.histories[target.name]
    smooth = filtered(history, Drift(filter="high-pass", corner_hz=corner))
    true = true_displacement(truth, target.name, solution.targets[target.name].rest_m, target.kind)
    return PaperScore(
        name=name,
        raw_mm=_rms_mm(_raw(history) - apparent),
        filtered_mm=_rms_mm(np.stack([smooth.p1_m, smooth.p2_m], axis=1) - true),
        geometric_raw_mm=_rms_mm(_raw(geometric.histories[target.name]) - apparent),
        corner_hz=corner,
    )


def apparent_displacement(truth: Mapping[str, NDArray[np.float64]], name: str, project: Project) -> Floats:
    """Return the exact apparent motion (F, 2, 2) of P1 and P2 at the paper's scale: truth plus parallax."""
    apparent, reference = truth[f"{name}_apparent_m"], project.reference_frame
    true_distance = np.linalg.norm(np.subtract(*truth[f"{name}_rest_m"]))
    scale = true_distance / np.linalg.norm(apparent[reference, 0] - apparent[reference, 1])
    return np.asarray(scale * (apparent - apparent[reference]))


def _raw(history: TargetHistory) -> Floats:
    return np.stack([history.p1_raw_m, history.p2_raw_m], axis=1)


def _rms_mm(error: Floats) -> Floats:
    return np.asarray(np.sqrt(np.nanmean(error**2, axis=0)) * 1e3)


# --- tables ----------------------------------------------------------------------------------------------------------

HEADER = (
    "scene",
    "clips",
    "P1 x / y, mm",
    "P2 x / y, mm",
    "residual, mm",
    "lost / weak, %",
    "σ by scatter",
    "within 2 σ, %",
    "by bound",
    "camera by bound",
    "limit, mm",
    "",
)
PAPER_HEADER = ("scene", "raw − apparent x / y, mm", "filtered − truth x / y, mm", "corner, Hz", "geometric raw, mm")


def table(scores: Sequence[Score]) -> str:
    """Return the table of the geometric method; with several seeds, median and worst."""
    by_name: dict[str, list[Score]] = {}
    for one in scores:
        by_name.setdefault(one.name, []).append(one)
    return markdown_table(HEADER, [_row(name, group) for name, group in by_name.items()])


def _row(name: str, group: Sequence[Score]) -> list[str]:
    limit = group[0].limit
    ratios = np.concatenate([one.sigma_by_scatter.ravel() for one in group])
    shares = [100 * one.within_two_sigma for one in group]
    asked = [f"{value:g}" for value in (limit.rms_mm, limit.residual_mm) if value is not None]
    return [
        name,
        str(len(group)),
        *(
            f"{_middle([one.rms_mm[point, 0] for one in group])} / {_middle([one.rms_mm[point, 1] for one in group])}"
            for point in (0, 1)
        ),
        _middle([one.residual_mm for one in group]),
        f"{100 * max(one.lost_share for one in group):.1f} / {100 * max(one.weak_share for one in group):.1f}",
        f"{np.nanmin(ratios):.2f}–{np.nanmax(ratios):.2f}",
        f"{min(shares):.0f}" if len(group) == 1 else f"{min(shares):.0f}–{max(shares):.0f}",
        *(
            _middle(values, digits=0)
            for values in ([one.rms_by_bound for one in group], [one.camera_by_bound for one in group])
        ),
        " / ".join(asked) or "–",
        ("ok" if all(one.keeps for one in group) else "missed") if limit != NO_LIMIT else "",
    ]


def _middle(values: Sequence[float], digits: int = 2) -> str:
    """Return a value, or of several the median and the worst."""
    if np.isnan(values).all():
        return "–"
    median, worst = np.nanmedian(values), np.nanmax(values)
    return f"{median:.{digits}f}" if len(values) == 1 else f"{median:.{digits}f} ({worst:.{digits}f})"


def paper_table(scores: Sequence[PaperScore]) -> str:
    """Return the table of the published method, P1 and P2 together."""
    rows = [
        [one.name, _axes(one.raw_mm), _axes(one.filtered_mm), f"{one.corner_hz:g}", _axes(one.geometric_raw_mm)]
        for one in scores
    ]
    return markdown_table(PAPER_HEADER, rows)


def _axes(rms_mm: Floats) -> str:
    x, y = np.sqrt((rms_mm**2).mean(axis=0))
    return f"{x:.2f} / {y:.2f}"


# --- the program -----------------------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m sample_data.accuracy`; return 1 where a scene misses its limit."""
    chosen = _parser().parse_args(arguments)
    cv2.setNumThreads(2)
    chosen.cache.mkdir(parents=True, exist_ok=True)
    scores: list[Score] = []
    papers: list[PaperScore] = []
    wanted = [name for name in chosen.scenes.split(",") if name]
    for name, is_paper in _rounds(wanted, chosen.paper):
        for clip in _clips(name, chosen):
            inputs = load_inputs(rendered(clip, chosen.cache))
            if is_paper:
                papers.append(score_paper(name, inputs, chosen.keep))
                _say(f"{clip.folder}: the published way\n{paper_table(papers[-1:])}\n")
            else:
                scores += (new := score(clip, inputs, chosen.keep))
                _say(f"{clip.folder}: {new[0].frame_ms:.0f} ms a frame\n{table(new)}\n")
    text = "\n\n".join(
        part for part in (table(scores) if scores else "", paper_table(papers) if papers else "") if part
    )
    print(text)
    if chosen.write:
        write_between_markers(README, "accuracy", f"\n{text}\n")
    missed = [one.name for one in scores if not one.keeps]
    if missed:
        print(f"\nMissed: {', '.join(dict.fromkeys(missed))}.")
    return 1 if missed else 0


def _clips(scene: str, chosen: argparse.Namespace) -> list[Clip]:
    """Return the clips of a scene that are asked for, or those that lie in the cache."""
    if not chosen.rendered:
        size = _size(chosen.size) if chosen.size else None
        return [Clip(scene, int(seed), size, chosen.seconds, chosen.preset) for seed in chosen.seeds.split(",")]
    found = [Clip.in_folder(video.parent.name) for video in sorted(chosen.cache.glob(f"{scene}-*/video.mp4"))]
    return [clip for clip in found if clip is not None]


def _size(text: str) -> Size:
    width, _, height = text.partition("x")
    return int(width), int(height)


def _rounds(scenes: Iterable[str], paper: str) -> list[tuple[str, bool]]:
    return [*((name, False) for name in scenes), *((name, True) for name in paper.split(",") if name)]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sample_data.accuracy", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default=",".join(USUAL_SCENES), help=f"of {', '.join(sorted(SCENES))}")
    parser.add_argument("--paper", default=",".join(PAPER_SCENES), help="scenes measured the published way too")
    parser.add_argument("--seeds", default="1")
    parser.add_argument(
        "--rendered", action="store_true", help="take the clips of whatever seed, size or preset that lie in the cache"
    )
    parser.add_argument("--size", help="WIDTHxHEIGHT of the videos; the field of view stays")
    parser.add_argument("--seconds", type=float, help="length of the clips")
    parser.add_argument("--preset", help="of the encoder, such as medium")
    parser.add_argument("--cache", type=Path, default=CACHE, help="where rendered scenes are kept")
    parser.add_argument("--keep", action="store_true", help="take earlier measurements: only the solving is on trial")
    parser.add_argument("--write", action="store_true", help="put the table into the README")
    return parser


def _tell(inputs: LoadedInputs, stage: str, done: int, total: int) -> None:
    if done % 30 == 0:
        _say(f"{inputs.folder.name}: {stage} {done} of {total}")


def _say(text: str) -> None:
    sys.stderr.write(f"\r{text} ")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
