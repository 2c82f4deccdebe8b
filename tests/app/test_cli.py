"""The program's commands, its exit codes, and one sentence for every mistake."""

from __future__ import annotations

import errno
import io
import os
import shutil
import signal
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from app.cli import main
from core.errors import InputError
from core.lens import Lens, read_lens
from core.project import read_project
from tests import small_project

Run = Callable[..., None]
SUMMARY = {
    "frames": 600,
    "warnings": ["The roof height leaves 3 sigma."],
    "targets": {
        "roof": {
            "peak_positive_m": {"x": {"value": 0.3097, "time_s": 11.3}, "y": None},
            "peak_negative_m": {"x": {"value": -0.3599, "time_s": 9.87}, "y": None},
            "residual_m": {"x": 0.0848, "y": None},
            "counts": {"ok": 598, "weak": 0, "lost": 2, "excluded": 0},
        }
    },
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    small_project.write_inputs(folder)
    return folder


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Callable[[Run], list[dict[str, Any]]]:
    """Put another engine in the place of the real one; return the list of what it was asked to do."""

    def install(run: Run) -> list[dict[str, Any]]:
        asked: list[dict[str, Any]] = []

        def run_project(folder: Path, **options: Any) -> types.SimpleNamespace:
            asked.append({"folder": folder, **options})
            run(folder, **options)
            return types.SimpleNamespace(summary=SUMMARY)

        monkeypatch.setattr("core.run.run_project", run_project)
        return asked

    return install


def project_at(folder: Path) -> Path:
    folder.mkdir(parents=True)
    small_project.write_document(folder, small_project.document())
    return folder


def one_sentence(text: str) -> str:
    assert len(text.strip().splitlines()) == 1, text
    assert text.startswith("rooftrack: ")
    assert text.rstrip().endswith(".")
    assert "Traceback" not in text
    return text


# run


def test_run_hands_everything_to_the_engine(tmp_path: Path, engine: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def run(folder: Path, *, progress: Any, **rest: Any) -> None:
        progress("measuring", 3, 3)

    asked = engine(run)
    project = project_at(tmp_path / "eq7")
    assert main(["run", str(project), "--workers", "2", "--scheduler", "tcp://127.0.0.1:1", "--fresh"]) == 0
    (order,) = asked
    assert order["folder"] == project
    assert (order["workers"], order["scheduler"], order["fresh"]) == (2, "tcp://127.0.0.1:1", True)
    out, err = capsys.readouterr()
    assert "measuring" in out
    assert "roof: 598 ok, 2 lost of 600 frames" in out
    assert "x: peaks -359.9 mm at 9.87 s and +309.7 mm at 11.30 s, residual +84.8 mm" in out
    assert "Warning: The roof height leaves 3 sigma." in out
    assert str(project / "results") in out
    assert err == ""


def test_run_queues_folders_and_the_projects_of_a_workspace(tmp_path: Path, engine: Any) -> None:
    asked = engine(lambda folder, **rest: None)
    single = project_at(tmp_path / "single")
    for name in ("b", "a", ".trash"):
        project_at(tmp_path / "workspace" / name)
    assert main(["run", str(single), str(tmp_path / "workspace"), str(single)]) == 0
    assert [order["folder"].name for order in asked] == ["single", "a", "b"]


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (InputError("a: has no video;\nadd one."), "a: has no video; add one."),
        (OSError(errno.ENOSPC, "No space left on device", "a"), "a: No space left on device; make room on the disk"),
        (ZeroDivisionError("a mistake of ours"), "a mistake of ours"),
    ],
)
def test_run_goes_on_after_a_project_that_cannot_be_measured(
    tmp_path: Path, engine: Any, capsys: pytest.CaptureFixture[str], error: Exception, told: str
) -> None:
    def run(folder: Path, **rest: Any) -> None:
        if folder.name == "a":
            raise error

    asked = engine(run)
    for name in ("a", "b"):
        project_at(tmp_path / name)
    assert main(["run", str(tmp_path)]) == 1
    assert [order["folder"].name for order in asked] == ["a", "b"]
    assert told in one_sentence(capsys.readouterr().err)


def test_a_word_the_terminal_cannot_show_ends_no_command(tmp_path: Path) -> None:
    project = project_at(tmp_path / "東")
    command = [sys.executable, "-m", "app.cli", "check", str(project)]
    done = subprocess.run(command, env={**os.environ, "PYTHONIOENCODING": "ascii"}, capture_output=True, check=False)
    assert os.fsencode(tmp_path / "?") in done.stdout
    assert b"Unicode" not in done.stderr


def test_ctrl_c_keeps_what_is_measured(tmp_path: Path, engine: Any, capsys: pytest.CaptureFixture[str]) -> None:
    def run(folder: Path, *, cancel: Any, **rest: Any) -> None:
        assert not cancel.cancelled
        signal.raise_signal(signal.SIGINT)
        cancel.raise_if_cancelled()

    asked = engine(run)
    for name in ("a", "b"):
        project_at(tmp_path / name)
    before = signal.getsignal(signal.SIGINT)
    assert main(["run", str(tmp_path)]) == 130
    assert len(asked) == 1
    assert "partial results kept" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGINT) is before


def test_no_other_project_begins_after_ctrl_c(tmp_path: Path, engine: Any) -> None:
    asked = engine(lambda folder, **rest: signal.raise_signal(signal.SIGINT))
    for name in ("a", "b"):
        project_at(tmp_path / name)
    assert main(["run", str(tmp_path)]) == 130
    assert [order["folder"].name for order in asked] == ["a"]


def test_a_second_ctrl_c_stops_at_once(tmp_path: Path, engine: Any) -> None:
    def run(folder: Path, **rest: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("still running")

    engine(run)
    assert main(["run", str(project_at(tmp_path / "eq7"))]) == 130


def test_an_unexpected_error_is_kept_in_a_file(
    tmp_path: Path, engine: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(folder: Path, **rest: Any) -> None:
        raise ZeroDivisionError("a mistake of ours")

    engine(run)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["run", str(project_at(tmp_path / "eq7"))]) == 1
    assert "a mistake of ours" in one_sentence(capsys.readouterr().err)
    (account,) = tmp_path.glob("rooftrack-error-*.txt")
    assert "Traceback" in account.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("code", "told"),
    [
        (errno.ENOSPC, "frames.sqlite: No space left on device; make room on the disk"),
        (errno.EISDIR, "frames.sqlite: Is a directory; move away what lies in its place"),
        (errno.EACCES, "frames.sqlite: Permission denied; make it accessible"),
    ],
)
def test_a_disk_that_refuses_is_told(
    tmp_path: Path, engine: Any, capsys: pytest.CaptureFixture[str], code: int, told: str
) -> None:
    def run(folder: Path, **rest: Any) -> None:
        raise OSError(code, os.strerror(code), "frames.sqlite")

    engine(run)
    assert main(["run", str(project_at(tmp_path / "eq7"))]) == 1
    assert told in one_sentence(capsys.readouterr().err)


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["run"],
        ["run", "nowhere"],
        ["run", ".", "--workers", "0"],
        ["run", ".", "--workers", "two"],
        ["check", "nowhere"],
        ["new", "eq7"],
        ["lens", "a.jpg", "--board", "9", "--square-m", "0.025", "--out", "lens.yaml"],
        ["lens", "a.jpg", "--board", "9x6", "--square-m", "-1", "--out", "lens.yaml"],
        ["serve", "nowhere"],
        ["serve", ".", "--port", "99999"],
    ],
)
def test_a_mistake_in_the_command_gets_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 1
    one_sentence(capsys.readouterr().err)


def test_a_lens_is_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["lens", "a.jpg", "--board", "9x6", "--square-m", "0.025", "--out", str(tmp_path)]) == 1
    assert f"{tmp_path}: is a folder" in one_sentence(capsys.readouterr().err)


def lens_of(monkeypatch: pytest.MonkeyPatch, out: Path, *sources: Path) -> int:
    """Calibrate with another calibration in the place of the real one; return the exit code."""
    found = types.SimpleNamespace(lens=Lens.ideal((160, 120), 150.0), report=lambda: "fx 150 ± 0.1")
    monkeypatch.setattr("core.lens_calibration.calibrate", lambda *given, **how: found)
    files = map(str, sources or (out.with_name("a.jpg"),))
    return main(["lens", *files, "--board", "9x6", "--square-m", "0.025", "--out", str(out)])


def test_a_lens_takes_the_place_of_a_lens_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    picture, notes = tmp_path / "b1.jpg", tmp_path / "notes.txt"
    picture.write_bytes(b"\xff\xd8 a picture")
    notes.write_text("taken indoors")
    assert lens_of(monkeypatch, picture, picture) == 1
    assert f"{picture}: is one of the pictures to calibrate from" in one_sentence(capsys.readouterr().err)
    for other in (picture, notes):
        before = other.read_bytes()
        assert lens_of(monkeypatch, other, tmp_path) == 1
        assert f"{other}: exists and is no lens file" in one_sentence(capsys.readouterr().err)
        assert other.read_bytes() == before
    for _ in range(2):
        assert lens_of(monkeypatch, tmp_path / "lens.yaml") == 0
    assert read_lens(tmp_path / "lens.yaml").image_size_px == (160, 120)


class _Gone(io.StringIO):
    """An output whose reader has gone."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        raise BrokenPipeError


@pytest.mark.parametrize(("out", "code"), [(_Gone(), 1), (io.TextIOWrapper(io.BytesIO(), encoding="ascii"), 0)])
def test_a_lens_is_kept_whatever_becomes_of_its_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: io.TextIOBase, code: int
) -> None:
    monkeypatch.setattr(sys, "stdout", out)
    assert lens_of(monkeypatch, tmp_path / "lens.yaml") == code
    assert read_lens(tmp_path / "lens.yaml").image_size_px == (160, 120)


# check


def test_check_of_a_sound_project(inputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small_project.write_document(inputs, small_project.document())
    assert main(["check", str(inputs)]) == 0
    assert "ready to run" in capsys.readouterr().out


def test_check_warns_of_what_can_be_measured_all_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small_project.write_inputs(tmp_path)
    small_project.write_document(tmp_path, small_project.document())
    assert main(["check", str(tmp_path)]) == 0
    assert "Warning" not in capsys.readouterr().out
    small_project.write_interlaced_video(tmp_path / "video.mp4")
    assert main(["check", str(tmp_path)]) == 0
    warning, ready = capsys.readouterr().out.splitlines()
    assert warning.startswith(f"Warning: {tmp_path / 'video.mp4'}: says that it is interlaced")
    assert ready.endswith("ready to run.")


def test_check_warns_of_what_cannot_be_meant(inputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = small_project.document()
    document["intervals_s"]["event"] = [0.2, 1.4]
    small_project.write_document(inputs, document)
    assert main(["check", str(inputs)]) == 0
    warning, ready = capsys.readouterr().out.splitlines()
    assert warning.startswith(f"Warning: {inputs / 'project.json'}: intervals_s: pre_event and event share 0.3 s")
    assert ready.endswith("ready to run.")


def test_check_says_each_problem_in_a_line(inputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = small_project.document()
    document["targets"] = []
    document["reference_frame"] = 1000
    small_project.write_document(inputs, document)
    assert main(["check", str(inputs)]) == 1
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 2
    one_sentence(err)


# new


def test_new_refers_to_inputs_from_its_folder(inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "campaign" / "eq7"
    files = {
        name: inputs / file for name, file in {"video": "video.mp4", "cloud": "site.csv", "gps": "gps.csv"}.items()
    }
    arguments = [part for name, file in files.items() for part in (f"--{name}", str(file))]
    assert main(["new", str(folder), *arguments, "--lens", str(inputs / "lens.yaml")]) == 0
    project = read_project(folder)
    assert project.name == "eq7"
    assert project.inputs.gps is not None
    assert not Path(project.inputs.video).is_absolute()
    assert (folder / project.inputs.video).resolve() == files["video"].resolve()
    assert (folder / project.inputs.gps.file).resolve() == files["gps"].resolve()
    assert [file.name for file in folder.iterdir()] == ["project.json"]
    assert "eq7" in capsys.readouterr().out


def test_new_names_a_video_that_lies_far_away_by_its_address(inputs: Path, tmp_path: Path) -> None:
    address = (inputs / "video.mp4").resolve().as_uri()
    assert main(["new", str(tmp_path / "eq7"), "--video", address, "--lens", str(inputs / "lens.yaml")]) == 0
    assert read_project(tmp_path / "eq7").inputs.video == address
    assert read_project(tmp_path / "eq7").inputs.lens is not None


def test_new_leaves_an_existing_project_as_it_is(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = project_at(tmp_path / "eq7")
    before = (folder / "project.json").read_bytes()
    assert main(["new", str(folder), "--video", str(inputs / "video.mp4")]) == 1
    assert "exists already" in one_sentence(capsys.readouterr().err)
    assert (folder / "project.json").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--video", "gone.mp4"], "gone.mp4: there is no such file"),
        (["--video", "gps.csv"], "gps.csv: cannot be opened as a video"),
        (["--video", "memory://campaign/gone.mp4"], "memory://campaign/gone.mp4: not found"),
        (["--video", "s3://me:secret@campaign/eq7.mp4"], "an address holds a password"),
        (["--video", "video.mp4", "--cloud", "gone.laz"], "gone.laz: there is no such file"),
        (["--video", "video.mp4", "--lens", "gps.csv"], "gps.csv: is not an OpenCV FileStorage file"),
    ],
)
def test_new_refuses_what_cannot_be_used(
    inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    told: str,
) -> None:
    monkeypatch.chdir(inputs)
    assert main(["new", str(tmp_path / "eq7"), *arguments]) == 1
    assert told in one_sentence(capsys.readouterr().err)
    assert not (tmp_path / "eq7").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere names are text")
@pytest.mark.parametrize("unnamed", ["video", "folder"])
def test_new_refuses_names_that_are_no_text(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], unnamed: str
) -> None:
    no_text = Path(os.fsdecode(os.fsencode(tmp_path) + b"/d\xfcse.mp4"))
    shutil.copy(inputs / "video.mp4", no_text)
    video, folder = (
        (no_text, tmp_path / "eq7") if unnamed == "video" else (inputs / "video.mp4", no_text.with_suffix(""))
    )
    assert main(["new", str(folder), "--video", str(video)]) == 1
    assert "has letters in its name that are not UTF-8; rename it" in one_sentence(capsys.readouterr().err)
    assert not folder.exists()


# the program itself


def test_help_and_version_answer_without_loading_the_engine() -> None:
    source = "import sys, app.cli; print(*({'cv2', 'scipy', 'av', 'open3d', 'viser'} & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True)
    assert loaded.stdout.split() == []
    shown = subprocess.run([sys.executable, "-m", "app.cli", "--help"], capture_output=True, text=True, check=True)
    for command in ("run", "check", "new", "lens", "serve"):
        assert f"\n    {command} " in shown.stdout
