"""From measurements in raw pixels and a person's decisions to displacement: a pure function, about a second.

One word chooses the method; relative motion and the high-pass filter are the same for both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.drift import high_pass
from core.intervals import during
from core.lens import Lens
from core.measurements import Recording
from core.project import Drift, Intervals, Project, Target, project_doubts
from core.relief import Relief
from core.repeats import repeated_pictures, repeats_sentence, without_pictures
from core.results import TargetHistory, relative_history
from core.solution import Solution, excluded_by
from core.solve_geometric import solve_geometric
from core.solve_paper import solve_paper
from core.uncertainty import held_to_scatter


def solve(
    recording: Recording, project: Project, lens: Lens, relief: Relief | None = None, *, has_lens: bool = True
) -> Solution:
    """Return the displacement of every target, relative motion taken and drift filtered as the project says.

    Args:
        recording: measurements of the project's method.
        lens: interior orientation; an ideal lens where none is known.
        relief: elevation of the ground; a plane where None.

    Raises:
        InputError: the clicks, the lens, a height or the filter do not do.
    """
    repeated = repeated_pictures(recording)
    # What a person has rejected must not tell how the building rests, how the camera flies or what the lens is like.
    passed_over = repeated | excluded_by(project, recording)
    if passed_over.any():
        recording = without_pictures(recording, passed_over)
    if project.method == "paper":
        solution = solve_paper(recording, project, lens, relief, has_lens=has_lens)
    else:
        solution = solve_geometric(recording, project, lens, relief)
    contradiction = solution.reference.contradiction
    warnings = (
        *project_doubts(project),
        *([f"{contradiction}."] if contradiction else []),
        *([repeats_sentence(recording, repeated)] if repeated.any() else []),
        *solution.warnings,
    )
    return with_histories(replace(solution, warnings=warnings), project)


def with_histories(solution: Solution, project: Project) -> Solution:
    """Return a solution with the histories that the project's filter makes of it; quick beside solving.

    Raises:
        InputError: the record is too short for the corner frequency.
    """
    histories = {
        target.name: filtered(unfiltered_history(solution, target, project.intervals_s), project.drift)
        for target in project.targets
    }
    return replace(solution, histories=histories)


def unfiltered_history(solution: Solution, target: Target, intervals: Intervals) -> TargetHistory:
    """Return a target's displacement before any filter, relative to another target where it is told so."""
    solved = solution.targets[target.name]
    if target.relative_to is None:
        return solved.history
    base = solution.targets[target.relative_to]
    relative = relative_history(solved.history, base.history, rest_m=solved.rest_m, base_rest_m=base.rest_m)
    return held_to_scatter(relative, during(relative.time_s, intervals.pre_event))


def filtered(history: TargetHistory, drift: Drift) -> TargetHistory:
    """Return a history freed of slow drift by the project's filter; the raw columns stay as they are.

    Raises:
        InputError: the record is too short for the corner frequency.
    """
    if drift.filter == "none" or not history.measured.any():
        return history
    columns = np.column_stack([history.p1_m, history.p2_m, history.rotation_rad])
    smooth = high_pass(columns, history.time_s, drift.corner_hz, drift.order)
    return replace(history, p1_m=smooth[:, :2], p2_m=smooth[:, 2:4], rotation_rad=smooth[:, 4])
