"""One run at a time in a project's folder, and a Ctrl-C that always ends it."""

import json
import logging
import os
import platform
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from filelock import FileLock, Timeout
from kedro.framework.hooks import hook_impl

from gyro_pipeline.conventions import InputError

logger = logging.getLogger(__name__)

_MISREAD = '?*[]{}#%"'
"""Characters that Kedro or MLflow reads in a path as a pattern, an address or a quoted text."""


def check_folder(project: Path) -> None:
    """Refuse a project whose path Kedro or MLflow would misread.

    Raises:
        InputError: The path has a character that has a meaning for Kedro or MLflow.
    """
    special = [character for character in _MISREAD if character in str(project)]
    if special:
        raise InputError(
            f"{project}: Kedro and MLflow read {' '.join(special)} in a path as a pattern, an "
            "address or a quoted text, and would use other files; move the project to a folder "
            "whose path has no such character"
        )


@contextmanager
def only_run(path: Path) -> Iterator[None]:
    """Hold the lock of a project; wait while another run holds it.

    Args:
        path: The lock file; a process that has ended no longer holds it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        logger.warning("%s; waiting until it ends (Ctrl-C ends the wait)", _owner(path))
        lock.acquire(poll_interval=0.5)
        logger.info("the other run has ended; this run continues")
    with lock:
        lock.release()  # the lock was acquired twice
        owner = {"pid": os.getpid(), "host": platform.node(), "since": time.strftime("%F %T")}
        path.write_text(json.dumps(owner | {"command": shlex.join(sys.argv)}))
        yield


def _owner(path: Path) -> str:
    """Describe the process that holds a lock."""
    try:
        owner = json.loads(path.read_text())
        process = "process {pid} on {host} since {since}: {command}".format(**owner)
    except (OSError, ValueError, LookupError, TypeError):
        process = "which is just starting"
    return f"another run works in {path.parent}, {process}"


class Interrupts:
    """Ends a run on Ctrl-C, also where Python could only print and ignore the exception.

    An exception that a signal raises in a finaliser or in a callback of C code is not passed on,
    and inside ``submit`` it leaves a thread that nobody ends, for which Python waits on exit. So
    the signal is remembered, and the exception is raised (again) once the next result is stored.
    """

    def __init__(self) -> None:
        self._interrupted = False

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Remember Ctrl-C inside the block, and end the block with an exception if it came."""
        default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if not default or threading.current_thread() is not threading.main_thread():
            yield
            return
        signal.signal(signal.SIGINT, self._remember)
        try:
            yield
            self._raise()
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    @hook_impl
    def before_node_run(self) -> None:
        """Raise an interrupt that was lost while inputs were loaded."""
        self._raise()

    @hook_impl
    def after_dataset_saved(self) -> None:
        """Raise an interrupt that was lost since the last result."""
        self._raise()

    def _remember(self, _signal: int, frame: FrameType | None) -> None:
        self._interrupted = True
        while frame is not None:
            if frame.f_code is ThreadPoolExecutor.submit.__code__:
                return
            frame = frame.f_back
        raise KeyboardInterrupt

    def _raise(self) -> None:
        if self._interrupted:
            raise KeyboardInterrupt
