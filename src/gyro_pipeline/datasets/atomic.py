"""Files that appear complete or not at all."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gyro_pipeline.conventions import InputError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file beside its final name and rename it when the block ends without an error.

    Args:
        path: The final name. Folders above it are made.

    Yields:
        An empty file in the same folder, with the same suffix, that no other process uses.

    Raises:
        InputError: A file is where a folder is needed or the other way round, or the folder
            cannot be written to.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as error:
        raise InputError(in_the_way(path, error)) from error
    try:
        if path.is_dir():
            raise InputError(f"cannot write {path}: a folder has that name; move it away")
        yield temporary
        os.replace(temporary, path)
    except BaseException:  # an interrupt from the keyboard as well
        temporary.unlink(missing_ok=True)
        raise


def check_writable(path: Path) -> None:
    """Refuse before a long run what :func:`replacing` would refuse at its end; makes nothing.

    Raises:
        InputError: A file is where a folder is needed, or the folder cannot be written to.
    """
    nearest = next(folder for folder in path.parents if folder.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise InputError(in_the_way(path, PermissionError(errno.EACCES, "no permission to write")))


def check_made(path: Path) -> None:
    """Refuse to read a file that no stage has made yet.

    Raises:
        InputError: It is not there.
    """
    if not path.is_file():
        raise InputError(f"{path} is not there; first run what makes it, such as kedro run")


def in_the_way(path: Path, error: OSError) -> str:
    """Say which of the folders above a path is the trouble, and what to do."""
    nearest = next(folder for folder in path.parents if folder.exists())
    if not nearest.is_dir():
        return f"cannot write {path}: {nearest} is a file where a folder is needed; move it away"
    return (
        f"cannot write {path}: {error.strerror} in {nearest}; make that folder writable, with "
        "space left, or choose another path in the catalog"
    )
