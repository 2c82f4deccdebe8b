"""From measurements in raw pixels and a person's decisions to displacement: a pure function, about a second.

One word chooses the method; relative motion and the high-pass filter are the same for both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from core.drift import high_pass
from core.lens import Lens
from core.measurements import Recording
from core.project import Drift, Project
from core.relief import Relief
from core.results import TargetHistory, relative_history
from core.solution import Solution, TargetSolution
from core.solve_geometric import solve_geometric
from core.solve_paper import solve_paper


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
    if project.method == "paper":
        solution = solve_paper(recording, project, lens, relief, has_lens=has_lens)
    else:
        solution = solve_geometric(recording, project, lens, relief)
    histories = _relative(dict(solution.histories), solution.targets, project)
    return replace(solution, histories={name: filtered(history, project.drift) for name, history in histories.items()})


def _relative(
    histories: dict[str, TargetHistory], targets: Mapping[str, TargetSolution], project: Project
) -> dict[str, TargetHistory]:
    result = dict(histories)
    for target in project.targets:
        if target.relative_to is not None:
            base = target.relative_to
            result[target.name] = relative_history(
                histories[target.name],
                histories[base],
                rest_m=targets[target.name].rest_m,
                base_rest_m=targets[base].rest_m,
            )
    return result


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
