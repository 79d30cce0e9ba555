"""Files that appear complete or not at all."""

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
"""Of tables, labels and what the file system itself writes, beside the samples of a file."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file beside its final name and rename it when the block ends without an error.

    Args:
        path: The final name. Folders above it are made.

    Yields:
        An empty file in the same folder, with the same suffix, that no other process uses.

    Raises:
        InputError: A file is where a folder is needed or the other way round.
        OSError: The folder cannot be written to.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    check_writable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        temporary.touch()
        yield temporary
        os.replace(temporary, path)
    except BaseException:  # an interrupt from the keyboard as well
        temporary.unlink(missing_ok=True)
        raise


def remove_leftovers(folder: Path) -> int:
    """Remove what killed processes left of :func:`replacing` in a folder that nobody writes to.

    Returns:
        How many files there were.
    """
    left = [path for path in folder.glob(".*") if _TEMPORARY.fullmatch(path.name)]
    for path in left:
        path.unlink()
    return len(left)


def require_room(path: Path, size: int) -> None:
    """Refuse to write a file that there is no room for: libraries that map files crash on it.

    Args:
        path: In a folder that is there.
        size: Bytes.

    Raises:
        OSError: Its error number is ENOSPC.
    """
    if shutil.disk_usage(path.parent).free < size + _SPARE_BYTES:
        reason = f"no space left, where {size / 1e6:.1f} MB are needed"
        raise OSError(errno.ENOSPC, reason, str(path))


def check_writable(path: Path) -> None:
    """Refuse before a long run what :func:`replacing` would refuse at its end; makes nothing.

    Raises:
        InputError: A file is where a folder is needed or the other way round.
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
