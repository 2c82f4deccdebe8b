"""The program `rooftrack`: the headless engine, checks, lens calibration and the browser interface.

Exit codes: 0 done; 1 with one sentence on standard error; 130 after Ctrl-C, partial results kept.
"""

from __future__ import annotations

import argparse
import io
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from app.terminal import TerminalProgress
from core.errors import Cancelled, InputError, disk_problem
from core.progress import CancelToken
from core.version import program_version

# The stages are imported by the command that needs them: `rooftrack --help` answers at once.

STOPPED = 130
DESCRIPTION = "Roof displacement from drone video, LiDAR and a few clicks."
EXAMPLES = """\
from files to displacement:
  rooftrack lens checkerboard/*.jpg --board 9x6 --square-m 0.025 --out lens.yaml
  rooftrack new eq7 --video eq7.mp4 --cloud site.laz --lens lens.yaml
  rooftrack serve .                 click correspondences, regions and bands in the browser
  rooftrack check eq7               is anything missing or contradictory?
  rooftrack run eq7                 eq7/results/<target>.csv, summary.json, figures, report.html

rooftrack COMMAND --help tells more.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; return its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Better a ? than no word at all where the terminal has no such letter.
            stream.reconfigure(errors="replace")
    try:
        options = _parser().parse_args(argv)
        command: Callable[[argparse.Namespace], int] = options.command
        return command(options)
    except (Cancelled, KeyboardInterrupt):
        print("\nStopped.", file=sys.stderr)
        return STOPPED
    except BrokenPipeError:
        # Whoever read our output has gone: nothing more can be said to them, not even at exit.
        sys.stdout = None
        return 1
    except Exception as error:
        return _refused(error)


def _refused(error: Exception) -> int:
    """Say in a sentence what went wrong."""
    if isinstance(error, InputError):
        sentence = str(error)
    else:
        sentence = disk_problem(error) if isinstance(error, OSError) else _unexpected(error)
    print("rooftrack: " + " ".join(sentence.split()), file=sys.stderr)
    return 1


def _unexpected(error: Exception) -> str:
    """Keep the traceback for whoever will mend this, and say where it is."""
    with tempfile.NamedTemporaryFile(
        "w", prefix="rooftrack-error-", suffix=".txt", delete=False, encoding="utf-8"
    ) as account:
        traceback.print_exception(error, file=account)
    return f"unexpected {type(error).__name__} ({error}); please report it with {account.name}, which tells where."


# The commands


def _run(options: argparse.Namespace) -> int:
    folders = _project_folders(options.folders)
    from core.run import run_project

    failures = 0
    for folder in folders:
        if len(folders) > 1:
            print(f"\n{folder}")
        progress = TerminalProgress(sys.stdout)
        try:
            with _stoppable(progress) as cancel:
                summary = run_project(
                    folder,
                    workers=options.workers,
                    scheduler=options.scheduler,
                    fresh=options.fresh,
                    progress=progress,
                    cancel=cancel,
                )
        except (Cancelled, KeyboardInterrupt):
            progress.close()
            print(f"Stopped; partial results kept in {folder / 'results'}; run again to resume.", file=sys.stderr)
            return STOPPED
        except BrokenPipeError:
            raise
        except Exception as error:
            # Whatever is wrong with one project, the others of a campaign are measured.
            progress.close()
            failures += 1
            _refused(error)
            continue
        progress.close()
        print("\n".join(_outcome(summary.summary)))
        print(f"Results: {folder / 'results'}")
        if cancel.cancelled:
            return STOPPED
    return 1 if failures else 0


def _outcome(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines that tell a person what `summary.json` says."""
    for name, target in summary["targets"].items():
        counts = ", ".join(f"{count} {status}" for status, count in target["counts"].items() if count)
        yield f"{name}: {counts} of {summary['frames']} frames"
        for axis in "xy":
            low, high = (target[f"peak_{sign}_m"][axis] for sign in ("negative", "positive"))
            peaks = [f"{1000 * peak['value']:+.1f} mm at {peak['time_s']:.2f} s" for peak in (low, high) if peak]
            residual = (target.get("residual_m") or {}).get(axis)
            rest = "" if residual is None else f", residual {1000 * residual:+.1f} mm"
            if peaks:
                yield f"  {axis}: peaks {' and '.join(peaks)}{rest}"
    yield from (f"Warning: {warning}" for warning in summary["warnings"])


def _check(options: argparse.Namespace) -> int:
    folders = _project_folders(options.folders)
    from core.check import check_project, check_warnings

    with_problems = 0
    for folder in folders:
        problems = check_project(folder)
        for problem in problems:
            print(problem)
        for warning in check_warnings(folder):
            print(f"Warning: {warning}")
        if problems:
            with_problems += 1
        else:
            print(f"{folder}: ready to run.")
    if with_problems:
        number = "1 project has" if with_problems == 1 else f"{with_problems} projects have"
        return _refused(InputError(f"{number} problems, listed above; correct them and check again."))
    return 0


def _new(options: argparse.Namespace) -> int:
    from core.create import create_project
    from core.storage import file_at

    project = create_project(
        options.folder,
        video=file_at(Path(), options.video),
        cloud=options.cloud,
        lens=options.lens,
        gps=options.gps,
        name=options.name,
    )
    print(f'Made project "{project.name}" in {options.folder}.')
    print(f"Next: rooftrack serve {options.folder.resolve().parent}, to click correspondences, regions and bands.")
    return 0


def _lens(options: argparse.Namespace) -> int:
    from core.lens import write_lens
    from core.lens_calibration import calibrate, require_place_for_lens

    require_place_for_lens(options.out, options.sources)
    progress = TerminalProgress(sys.stdout)
    with _stoppable(progress) as cancel:
        calibration = calibrate(
            options.sources, board=options.board, square_m=options.square_m, progress=progress, cancel=cancel
        )
    progress.close()
    write_lens(options.out, calibration.lens)
    print(calibration.report())
    print(f"Lens: {options.out}")
    return 0


def _serve(options: argparse.Namespace) -> int:
    from app.server import serve

    if not options.workspace.is_dir():
        raise InputError(f"{options.workspace}: there is no such folder; make it, or name the folder of your projects.")
    serve(options.workspace, options.host, options.port)
    return 0


def _project_folders(named: Sequence[Path]) -> list[Path]:
    """Return the project folders among those named: each itself, or, of a workspace, the projects in it."""
    from core.project import PROJECT_FILE

    folders: list[Path] = []
    for folder in named:
        if not folder.is_dir():
            raise InputError(f"{folder}: there is no such folder; make a project with rooftrack new.")
        inside = sorted(file.parent for file in folder.glob(f"[!.]*/{PROJECT_FILE}"))
        folders += inside if inside and not (folder / PROJECT_FILE).exists() else [folder]
    return list(dict.fromkeys(folders))


@contextmanager
def _stoppable(progress: TerminalProgress) -> Iterator[CancelToken]:
    """Turn the first Ctrl-C into a request to stop cleanly; the second stops at once."""
    cancel = CancelToken()

    def stop(number: int, frame: FrameType | None) -> None:
        if cancel.cancelled:
            raise KeyboardInterrupt
        cancel.cancel()
        progress.close()
        print("Stopping: what is measured is being kept. Ctrl-C again stops at once.", file=sys.stderr)

    if threading.current_thread() is not threading.main_thread():
        yield cancel
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield cancel
    finally:
        signal.signal(signal.SIGINT, before)


# Its arguments


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one sentence, as everything else here does."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; {self.prog} --help shows how.")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="rooftrack", description=DESCRIPTION, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"rooftrack {program_version()}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_run(commands)
    _add_check(commands)
    _add_new(commands)
    _add_lens(commands)
    _add_serve(commands)
    return parser


def _add_run(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "run",
        help="measure projects, from inputs to displacement",
        description="Measure each project from its inputs to displacement histories, figures and report in its "
        "results folder. What an earlier run measured is used again as far as the inputs are the same; a run that "
        "was stopped goes on where it was.",
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="a project folder, or a folder of them")
    parser.add_argument(
        "--workers",
        type=_positive_number,
        metavar="N",
        help="measure in up to N processes at once, as many as cores and the clip's length repay; four without it",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="measure on the workers of this Dask scheduler (rooftrack[cluster])"
    )
    parser.add_argument("--fresh", action="store_true", help="measure everything anew, ignoring earlier results")
    parser.set_defaults(command=_run)


def _add_check(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "check",
        help="say what keeps projects from being measured",
        description="Check each project and its inputs without measuring: one line for each problem, with what to do.",
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="a project folder, or a folder of them")
    parser.set_defaults(command=_check)


def _add_new(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "new",
        help="make a project folder",
        description="Make a project folder around input files. They stay where they are; nothing is overwritten.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="the folder to make")
    parser.add_argument(
        "--video", required=True, metavar="FILE", help="the drone video, or its address such as s3://campaign/eq7.mp4"
    )
    parser.add_argument(
        "--cloud", type=Path, metavar="FILE", help="LiDAR points: LAS, LAZ, PLY, PCD, XYZ, PTS, CSV, E57"
    )
    parser.add_argument("--lens", type=Path, metavar="FILE", help="lens calibration made by rooftrack lens or OpenCV")
    parser.add_argument("--gps", type=Path, metavar="FILE", help="GPS record with time_s, east_m, north_m (CSV)")
    parser.add_argument("--name", help="what people call the project (default: the folder's name)")
    parser.set_defaults(command=_new)


def _add_lens(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "lens",
        help="calibrate a lens from pictures of a checkerboard",
        description="Calibrate a lens from images or a video of a checkerboard and report how well it is known.",
    )
    parser.add_argument(
        "sources",
        nargs="+",
        type=Path,
        metavar="IMAGE_OR_VIDEO",
        help="10 to 30 views, tilted, to the edges; or a folder of them",
    )
    parser.add_argument(
        "--board", type=_board, required=True, metavar="9x6", help="inner corners along and across the board"
    )
    parser.add_argument("--square-m", type=_positive_length, required=True, metavar="0.025", help="edge of a square")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the lens file to write (YAML)")
    parser.set_defaults(command=_lens)


def _add_serve(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser = commands.add_parser(
        "serve",
        help="open the browser interface over a folder of projects",
        description="Serve the browser interface over a folder of projects, to this computer only by default.",
    )
    parser.add_argument(
        "workspace",
        nargs="?",
        type=Path,
        default=Path(),
        metavar="WORKSPACE",
        help="folder of projects (default: here)",
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default 127.0.0.1)")
    parser.add_argument(
        "--port", type=_port, metavar="N", help="port to listen on (default 8000, or the next free one)"
    )
    parser.set_defaults(command=_serve)


def _positive_number(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, a number from 0 to 65535")
    return int(text)


def _positive_length(text: str) -> float:
    try:
        length = float(text)
    except ValueError:
        length = float("nan")
    if not 0 < length < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a length in metres above 0")
    return length


def _board(text: str) -> tuple[int, int]:
    columns, cross, rows = text.lower().partition("x")
    if not (cross and columns.isdecimal() and rows.isdecimal() and int(columns) > 2 and int(rows) > 2):
        raise argparse.ArgumentTypeError(f"{text!r} is not a board such as 9x6, three or more inner corners each way")
    return int(columns), int(rows)


if __name__ == "__main__":
    sys.exit(main())
