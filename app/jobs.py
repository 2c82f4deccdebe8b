"""Long work in processes of its own: started, watched, cancelled, and gone on with after a restart.

A job is `python -m app.worker`. It is told what to do in one JSON line on its standard input, and reports in JSON
lines on its standard output. A second line `cancel`, or the end of its input because the server is gone, asks it to
stop after the unit it is in; what it has measured so far is kept by the engine.
"""

from __future__ import annotations

import json
import logging
import secrets
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from app.errors import Busy, Missing
from app.events import Hub
from app.store import ProjectFolder, read_json
from core.errors import InputError
from core.storage import write_atomically

JOB_FILE = "job.json"
State = Literal["running", "done", "failed", "cancelled", "interrupted"]
# Reading a cloud for the eye disturbs nobody, so it may run beside one of the others.
_BESIDE = "cloud"
# What goes on by itself when the server comes back: nothing a person has to decide, and hours may have gone into it.
_RESUMED = "track"
_EVENTS_PER_S = 5.0
_RATE_WINDOW_S = 6.0
_JOBS_KEPT = 200
# A worker that is in a step which cannot be left is killed after this time; the engine is made so that it may be.
_PATIENCE_S = 6.0

log = logging.getLogger("rooftrack")

Finish = Callable[[ProjectFolder, Any], Any]


@dataclass
class Job:
    """One piece of long work, as the browser sees it."""

    id: str
    project: str
    kind: str
    parameters: dict[str, Any]
    state: State = "running"
    stage: str = ""
    done: int = 0
    total: int = 0
    message: str = ""
    result: Any = None
    started_s: float = field(default_factory=time.time)
    asked_to_stop: bool = False
    stopped_with_server: bool = False
    # When how much was done, over the last few seconds: from this comes the rate.
    _recent_progress: deque[tuple[float, int]] = field(default_factory=deque)
    _tabs_told_s: float = 0.0

    def advance(self, stage: str, done: int, total: int) -> None:
        """Take note of progress; a new stage starts a new rate."""
        now = time.monotonic()
        if stage != self.stage or done < self.done:
            self._recent_progress.clear()
        self.stage, self.done, self.total = stage, done, total
        self._recent_progress.append((now, done))
        while len(self._recent_progress) > 2 and now - self._recent_progress[0][0] > _RATE_WINDOW_S:
            self._recent_progress.popleft()

    @property
    def is_running(self) -> bool:
        """Whether it has not ended yet."""
        return self.state == "running"

    @property
    def rate_per_s(self) -> float | None:
        """Units a second over the last few seconds."""
        if len(self._recent_progress) < 2:
            return None
        (first_s, first), (last_s, last) = self._recent_progress[0], self._recent_progress[-1]
        return (last - first) / (last_s - first_s) if last_s > first_s and last > first else None

    def as_json(self) -> dict[str, Any]:
        """Return the job as the browser gets it."""
        rate = self.rate_per_s if self.is_running else None
        return {
            "id": self.id,
            "project": self.project,
            "kind": self.kind,
            "state": self.state,
            "stage": self.stage,
            "done": self.done,
            "total": self.total,
            "rate_per_s": rate,
            "seconds_left": (self.total - self.done) / rate if rate else None,
            "message": self.message,
            "result": self.result,
            "started_s": self.started_s,
        }

    def may_tell(self) -> bool:
        """Whether it is time to tell the tabs again; they need no more than a few pictures a second."""
        now = time.monotonic()
        if now - self._tabs_told_s < 1.0 / _EVENTS_PER_S:
            return False
        self._tabs_told_s = now
        return True


class Jobs:
    """All jobs of this server: at most one at a time for each project, and one beside it that only reads."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._jobs: dict[str, Job] = {}
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._watchers: dict[str, threading.Thread] = {}
        self._lock = threading.RLock()

    def start(
        self, project: ProjectFolder, kind: str, parameters: dict[str, Any] | None = None, finish: Finish | None = None
    ) -> Job:
        """Start a job; `finish` turns what the worker returns into the job's result, in the server.

        Raises:
            Busy: another job of this project is running.
            InputError: this computer cannot start one now.
        """
        with self._lock:
            running = self.running(project.id, kind)
            if running is not None:
                raise Busy(
                    f"{_spoken(running.kind)} is running for this project; wait for it or cancel it.",
                    job=running.as_json(),
                )
            job = Job(id=secrets.token_hex(8), project=project.id, kind=kind, parameters=parameters or {})
            try:
                self._launch(project, job, finish)
            except (OSError, RuntimeError) as error:
                reason = getattr(error, "strerror", error)
                raise InputError(
                    f"{_spoken(kind)} could not be started ({reason}); make room on the disk and in memory, try again."
                ) from None
            self._forget_oldest()
        self._tell(job)
        return job

    def _launch(self, project: ProjectFolder, job: Job, finish: Finish | None) -> None:
        """Start a job's worker and its watcher; a job that cannot have both leaves nothing behind."""
        process = _spawn()
        try:
            self._note(project, job)
            order = {"kind": job.kind, "folder": str(project.folder), "parameters": job.parameters}
            _send(process, json.dumps(order))
            args = (project, job, process, finish)
            watcher = threading.Thread(target=self._watch, args=args, name=f"job {job.kind}", daemon=True)
            watcher.start()
        except BaseException:
            process.kill()
            process.communicate()
            raise
        self._jobs[job.id], self._processes[job.id], self._watchers[job.id] = job, process, watcher

    def get(self, job_id: str) -> Job:
        """Return a job.

        Raises:
            Missing: this server knows no such job.
        """
        job = self._jobs.get(job_id)
        if job is None:
            raise Missing("This server knows no such job; look at the project's state instead.", path=job_id)
        return job

    def running(self, project_id: str, kind: str) -> Job | None:
        """Return the running job of a project that a job of this kind would have to wait for."""
        for job in list(self._jobs.values()):
            beside = (job.kind == _BESIDE) != (kind == _BESIDE)
            if job.project == project_id and job.is_running and not beside:
                return job
        return None

    def latest(self, project_id: str, kind: str) -> Job | None:
        """Return the newest job of a kind, running or not."""
        found = [job for job in list(self._jobs.values()) if job.project == project_id and job.kind == kind]
        return found[-1] if found else None

    def cancel(self, job: Job) -> None:
        """Ask a job to stop; the answer comes when it has."""
        process = self._processes.get(job.id)
        if job.is_running and process is not None and not job.asked_to_stop:
            job.asked_to_stop = True
            job.message = "Stopping after the frame it is in."
            _send(process, "cancel")
            impatience = threading.Timer(_PATIENCE_S, process.kill)
            impatience.daemon = True
            impatience.start()
            self._tell(job)

    def cancel_all(self, project_id: str) -> None:
        """Stop every job of a project and wait until none of them writes any more."""
        for job in [job for job in list(self._jobs.values()) if job.project == project_id and job.is_running]:
            self.cancel(job)
            self._await_end(job)

    def close(self) -> None:
        """Stop every job because the server stops; tracking will go on when it is back."""
        active = [job for job in list(self._jobs.values()) if job.is_running]
        for job in active:
            process = self._processes.get(job.id)
            if job.kind == _BESIDE and process is not None:
                process.kill()  # it has nothing to lose
            job.stopped_with_server = not job.asked_to_stop
            self.cancel(job)
        for job in active:
            self._await_end(job)

    def go_on(self, project: ProjectFolder, finish: Finish) -> Job | None:
        """Go on with the tracking of a project that ran when the last server stopped; None where none did."""
        note = read_json(project.results / JOB_FILE)
        if not isinstance(note, dict) or note.get("state") not in ("running", "interrupted"):
            return None
        if note.get("kind") != _RESUMED:
            (project.results / JOB_FILE).unlink(missing_ok=True)
            return None
        return self.start(project, _RESUMED, {**(note.get("parameters") or {}), "fresh": False}, finish)

    def _await_end(self, job: Job) -> None:
        watcher = self._watchers.get(job.id)
        if watcher is not None:
            watcher.join(2.0 * _PATIENCE_S)

    def _watch(self, project: ProjectFolder, job: Job, process: subprocess.Popen[str], finish: Finish | None) -> None:
        assert process.stdout is not None
        assert process.stderr is not None
        complaints: deque[str] = deque(maxlen=200)
        drain = threading.Thread(target=complaints.extend, args=(process.stderr,), daemon=True)
        drain.start()
        end: dict[str, Any] | None = None
        for line in process.stdout:
            report = _report_in(line)
            if "event" in report:
                self._hub.publish(job.project, report["event"], report["data"])
            elif "stage" in report:
                job.advance(report["stage"], report["done"], report["total"])
                if job.may_tell():
                    self._tell(job)
            elif report:
                end = report
        process.wait()
        drain.join(2.0)
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream is not None and not (stream is process.stderr and drain.is_alive()):
                _close(stream)
        self._end(project, job, end=end, finish=finish, complaints="".join(complaints))

    def _end(
        self, project: ProjectFolder, job: Job, *, end: dict[str, Any] | None, finish: Finish | None, complaints: str
    ) -> None:
        try:
            if end is None and job.asked_to_stop:
                end = {"cancelled": True}
            elif end is None:
                log.error("job %s of %s ended without a word:\n%s", job.kind, job.project, complaints)
                raise InputError(f"{_spoken(job.kind)} broke off unexpectedly; start it again to go on from there.")
            if "failed" in end:
                raise InputError(end["failed"])
            if "broken" in end:
                log.error("job %s of %s failed:\n%s", job.kind, job.project, end["traceback"])
                raise InputError(end["broken"])
            if "cancelled" in end:
                state: State = "interrupted" if job.stopped_with_server else "cancelled"
                message = "Stopped; what was measured is kept."
            else:
                job.result = finish(project, end["done"]) if finish else end["done"]
                state, message = "done", ""
        except Exception as error:  # whatever finishing met, the tab has to hear that the job is over
            state, message = "failed", str(error)
        with self._lock:
            job.message, job.state = message, state
            try:
                self._note(project, job)
            except OSError as error:  # the tabs have to hear all the more that it is over
                log.error("the end of job %s of %s could not be noted: %s", job.kind, job.project, error)
            self._processes.pop(job.id, None)
            self._watchers.pop(job.id, None)
        self._tell(job)
        if job.kind == _RESUMED:
            self._hub.publish(job.project, "results", {})

    def _note(self, project: ProjectFolder, job: Job) -> None:
        """Leave word on the disk of what runs, for a server that comes after this one."""
        if job.kind == _BESIDE or not project.folder.is_dir():
            return
        note = {"kind": job.kind, "state": job.state, "parameters": job.parameters, "message": job.message}
        write_atomically(project.results / JOB_FILE, json.dumps(note).encode())

    def _tell(self, job: Job) -> None:
        self._hub.publish(job.project, "job", job.as_json())

    def _forget_oldest(self) -> None:
        over = [job.id for job in self._jobs.values() if not job.is_running][: len(self._jobs) - _JOBS_KEPT]
        for job_id in over if len(self._jobs) > _JOBS_KEPT else ():
            del self._jobs[job_id]


def _report_in(line: str) -> dict[str, Any]:
    """Return the report in a line; nothing where the worker was killed in the middle of it."""
    try:
        report: dict[str, Any] = json.loads(line)
    except ValueError:
        return {}
    return report


def _spoken(kind: str) -> str:
    names = {
        "track": "Tracking",
        "orthoimage": "Making the orthoimage",
        "calibrate": "Calibrating the lens",
        "cloud": "Reading the cloud",
        "report": "Writing the report",
    }
    return names.get(kind, kind)


def _spawn() -> subprocess.Popen[str]:
    # A group of its own: Ctrl-C in the server's terminal reaches the server, which then stops its workers in order.
    group: dict[str, Any]
    if sys.platform == "win32":
        group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    else:
        group = {"start_new_session": True}
    return subprocess.Popen(
        [sys.executable, "-m", "app.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        errors="replace",
        cwd=Path(__file__).resolve().parent.parent,
        **group,
    )


def _send(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    try:
        process.stdin.write(line + "\n")
        process.stdin.flush()
    except (OSError, ValueError):
        log.info("a worker ended before it could be told %r", line[:40])


def _close(stream: Any) -> None:
    try:
        stream.close()
    except OSError:
        log.debug("a worker's pipe was already broken")
