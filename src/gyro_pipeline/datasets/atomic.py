"""Writes files completely or not at all."""

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gyro_pipeline.conventions import InputError

_TEMPORARY = re.compile(r"\..+\.\d+(\.\w+)?")
_SPARE_BYTES = 1 << 16
"""Room for a file's tables and labels, and for the file system, besides the samples."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file beside its final name and rename it when the block ends without an error.

    Args:
        path: The final name. Its parent folders are created.

    Yields:
        An empty file in the same folder, with the same suffix, that no other process uses.

    Raises:
        InputError: A file exists where a folder is needed, or a folder where a file is.
        OSError: The folder cannot be written to.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    check_writable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        temporary.touch()
        yield temporary
        os.replace(temporary, path)
    except BaseException:  # including KeyboardInterrupt
        temporary.unlink(missing_ok=True)
        raise


def remove_leftovers(folder: Path) -> int:
    """Remove temporary files of killed processes from a folder that nobody writes to.

    Returns:
        Number of removed files.
    """
    leftovers = [path for path in folder.glob(".*") if _TEMPORARY.fullmatch(path.name)]
    for path in leftovers:
        path.unlink()
    return len(leftovers)


def require_room(path: Path, size: int) -> None:
    """Refuse to write a file for which the disk has no room; libraries that map files would crash.

    Args:
        path: A file in an existing folder.
        size: Bytes.

    Raises:
        OSError: The disk has less room; the error number is ENOSPC.
    """
    if shutil.disk_usage(path.parent).free < size + _SPARE_BYTES:
        reason = f"no space left, where {size / 1e6:.1f} MB are needed"
        raise OSError(errno.ENOSPC, reason, str(path))


def check_writable(path: Path) -> None:
    """Check, without writing anything, that :func:`replacing` will succeed.

    Raises:
        InputError: A file exists where a folder is needed, or a folder where a file is.
        OSError: The folder cannot be written to.
    """
    nearest = next(folder for folder in path.parents if folder.exists())
    if not nearest.is_dir():
        raise InputError(
            f"cannot write {path}: {nearest} is a file where a folder is needed; move it away"
        )
    if path.is_dir():
        raise InputError(f"cannot write {path}: a folder has that name; move it away")
    if not os.access(nearest, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
