"""Shows errors of a run in one line that says what is wrong, where, and what to type.

Code raises :class:`InputError` where it knows more than the original error says. Errors of the file
system, the run store, the configuration and of workers are explained here and nowhere else. Any
other exception is a defect, whose traceback is shown and stored.
"""

import errno
import logging
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

from gyro_pipeline.conventions import InputError

logger = logging.getLogger(__name__)

_PASSWORD = re.compile(r"(?<=://)([^/@\s:]*):[^/\s]+@")
_ERRNO_OF_HDF5 = re.compile(r"errno = (\d+)")
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
_CONFIGURATION = re.compile(r"-packages/(kedro/config|omegaconf|yaml)/")
_NO_THREAD = "can't start new thread"
"""Python's message when memory, or the allowed number of threads, is used up."""
_OTHER_ARGUMENTS = "must only contain arguments valid for the constructor"
"""Part of Kedro's message about an unknown or missing key of a catalog entry."""


def install(project: Path) -> None:
    """Explain uncaught errors, and mask passwords in everything that is logged."""
    sys.excepthook = partial(_show, project)
    # Python would print a traceback for each incomplete object that Ctrl-C leaves behind
    sys.unraisablehook = lambda ignored: logger.debug("ignored: %r", ignored.exc_value)
    if logging.getLogRecordFactory() is logging.LogRecord:
        logging.setLogRecordFactory(_record_without_passwords)


def mask_passwords(text: str) -> str:
    """Mask the passwords of addresses in a text."""
    return _PASSWORD.sub(r"\1:***@", text)


def explanation(error: BaseException, project: Path) -> str | None:
    """Say what is wrong, where, and what to type; None for a defect of this package."""
    causes = [*_causes(error)]
    for cause in causes:
        if isinstance(cause, InputError):
            return mask_passwords(str(cause))
    for cause in reversed(causes):  # from the original error on
        for kind in type(cause).__mro__:
            explain = _EXPLAINED.get(f"{kind.__module__.partition('.')[0]}.{kind.__name__}")
            if explain is not None and (text := explain(cause)):
                return mask_passwords(text)
    files = [Path(frame.f_code.co_filename) for frame, _ in traceback.walk_tb(error.__traceback__)]
    if any(_CONFIGURATION.search(file.as_posix()) for file in files):
        return f"configuration: {_faulty_file(project / 'conf') or mask_passwords(_line(error))}"
    if _OTHER_ARGUMENTS in str(error):
        return f"catalog: {mask_passwords(_line(error))}"
    if isinstance(error, ValueError) and _is_about_the_command(files):
        return mask_passwords(_line(error))
    return None


def _show(
    project: Path, kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Show an uncaught error, as a replacement of ``sys.excepthook``."""
    message = explanation(error, project)
    if message is not None:
        logger.error("error: %s", message)
        return
    text = mask_passwords("".join(traceback.format_exception(kind, error, trace)))
    sys.stderr.write(text)
    log, command = project / "data" / "defect.log", " ".join(sys.argv)
    with suppress(OSError):
        log.write_text(mask_passwords(f"{time.strftime('%F %T')} {command}\n{text}"))
        logger.error("error: this is a defect; please report it with %s", log)


def _record_without_passwords(*arguments: Any, **options: Any) -> logging.LogRecord:
    record = logging.LogRecord(*arguments, **options)
    record.msg, record.args = mask_passwords(record.getMessage()), ()
    if record.exc_info and record.exc_info[0]:
        record.exc_text = mask_passwords("".join(traceback.format_exception(*record.exc_info)))
    return record


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and the errors that it was raised from, also those from a worker."""
    while error is not None:
        yield error
        error = error.__cause__


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _of_files(error: Any) -> str:
    """Explain why a file cannot be read or written."""
    text = _line(error)
    match = _ERRNO_OF_HDF5.search(text)
    number = int(match[1]) if match else error.errno
    where = error.filename or "a file"
    if number in _NO_ROOM:
        reason = error.strerror or "no space left"
        return f"cannot write {where}: {reason}; free some, or move the project to a larger disk"
    if number in _FORBIDDEN:
        return (
            f"cannot use {where}: {error.strerror or text}; make it and its folder readable and "
            "writable, or choose another path in the catalog"
        )
    if number == errno.ENOENT:
        return f"{where}: there is no such file or folder; put it there, or correct its path"
    return f"{where}: {error.strerror or text}"


def _of_store(error: BaseException) -> str:
    return (
        f"the run store cannot be used ({_line(error)}); stored results are kept: make sure that "
        "it can be reached and written to, with space left, and type the same command again"
    )


def _of_workers(error: BaseException) -> str:
    return (
        f"a worker process was killed, probably because memory ran out ({_line(error)}); type the "
        "same command with --params=execution.workers=1 to use less: finished work is kept"
    )


def _of_threads(error: BaseException) -> str | None:
    return _of_memory(error) if _NO_THREAD in str(error) else None


def _of_memory(error: BaseException) -> str:
    return (
        f"memory ran out ({_line(error)}); close other programs, or use less: "
        "--params=execution.workers=1"
    )


_EXPLAINED: dict[str, Callable[[Any], str | None]] = {
    "requests.RequestException": _of_store,  # also an OSError
    "builtins.OSError": _of_files,
    "builtins.MemoryError": _of_memory,
    "builtins.RuntimeError": _of_threads,
    "numpy._ArrayMemoryError": _of_memory,
    "concurrent.BrokenExecutor": _of_workers,
    "sqlalchemy.SQLAlchemyError": _of_store,
    "sqlite3.Error": _of_store,
    "mlflow.MlflowException": _of_store,
}
"""Explanations by package and class name, so that no package is imported for them."""


def _faulty_file(conf: Path) -> str | None:
    """Name the first configuration file that cannot be read, and the line."""
    from omegaconf import DictConfig, OmegaConf  # noqa: PLC0415

    for path in sorted(conf.rglob("*.yml")):
        try:
            content = OmegaConf.load(path)
        except UnicodeDecodeError as error:
            line = path.read_bytes()[: error.start].count(b"\n") + 1
            return f"{path}, line {line}: not UTF-8; save it as UTF-8"
        except Exception as error:  # YAML's errors and OmegaConf's have no common base
            mark = getattr(error, "problem_mark", None)
            where = f"{path}, line {mark.line + 1}" if mark else path
            return f"{where}: {getattr(error, 'problem', None) or _line(error)}; correct it"
        if not isinstance(content, DictConfig):
            return f"{path}, line 1: expected keys and their values, got a list; correct it"
    return None


def _is_about_the_command(files: list[Path]) -> bool:
    """Whether Kedro itself refused the command, before a node ran."""
    import kedro  # noqa: PLC0415

    package = Path(kedro.__file__).parent
    in_runner = any(file.is_relative_to(package / "runner") for file in files)
    return bool(files) and files[-1].is_relative_to(package) and not in_runner
