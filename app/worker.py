"""The process in which one job runs: reads its order, calls the engine, reports in JSON lines (see `app.jobs`)."""

from __future__ import annotations

import json
import os
import sys
import threading
import traceback
from pathlib import Path
from typing import TextIO

from app.reporter import Reporter
from core.errors import Cancelled, InputError, disk_problem
from core.progress import CancelToken


def main() -> int:
    """Do the one job ordered on standard input; 0 however it ended, since the report says how."""
    reports = _own_stdout()
    order = json.loads(sys.stdin.readline())
    cancel = CancelToken()
    threading.Thread(target=_cancel_on_word, args=(cancel,), daemon=True).start()
    reporter = Reporter(reports)
    try:
        # Imported here, so that a job that cannot be imported is told like any other that fails.
        from app.work import WORK

        result = WORK[order["kind"]](Path(order["folder"]), order["parameters"], reporter, cancel)
        reporter.send({"done": result})
    except (Cancelled, KeyboardInterrupt):
        reporter.send({"cancelled": True})
    except InputError as error:
        reporter.send({"failed": str(error)})
    except OSError as error:
        reporter.send({"failed": disk_problem(error)})
    except Exception as error:
        sentence = f"Rooftrack itself failed ({type(error).__name__}: {error}); its terminal tells more."
        reporter.send({"broken": sentence, "traceback": traceback.format_exc()})
    return 0


def _own_stdout() -> TextIO:
    """Keep standard output for reports; whatever a library prints goes to standard error."""
    reports = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return reports


def _cancel_on_word(cancel: CancelToken) -> None:
    sys.stdin.readline()
    cancel.cancel()


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    # Threads of a decoder that was stopped in the middle must not hold the process.
    os._exit(code)
