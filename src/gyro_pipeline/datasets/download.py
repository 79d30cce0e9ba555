"""Downloads files from a public git repository and verifies them.

docs/decisions/0010-download-of-the-published-files.md says why requests and tenacity are used.
"""

import hashlib
import logging
import os
import time
from functools import partial
from io import FileIO
from pathlib import Path

import requests
from filelock import FileLock
from requests.exceptions import ConnectionError, Timeout
from tenacity import (
    before_sleep_log,
    retry,
    retry_if_exception,
    stop_after_attempt,
    wait_exponential,
)
from tqdm import tqdm
from urllib3.exceptions import HTTPError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import check_writable

_LOG = logging.getLogger(__name__)

_TIMEOUT_S = 30
"""Longest silence of a server, and longest time below the least speed."""
_LEAST_SPEED = 1e4
"""Bytes per second, on average since the answer began."""
_LARGEST = 10**9
"""Bytes of a file; the published files have up to 10^8."""
_PIECE = 1 << 16
"""Largest number of bytes that are read, and so kept after an interruption, at a time."""


def ensure(url: str, path: Path, blob: str) -> None:
    """Download a file unless it exists, and verify it.

    An interrupted download is kept beside the file and continued, also by a later run. A second
    process that downloads into the same folder waits for the first.

    Args:
        url: Address of the file.
        path: Local path; an existing file is never overwritten.
        blob: Git blob id of the file.

    Raises:
        InputError: The file cannot be downloaded or written, or is not the published one.
    """
    if not path.exists():
        check_writable(path)
        try:
            _fetch(url, path, blob)
        except (requests.RequestException, HTTPError) as error:  # before OSError, a base class
            raise InputError(_failure(url, path, error)) from error
    try:
        actual = blob_id(path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; move it away") from error
    if actual != blob:
        raise InputError(
            f"{path} is not the published file: expected git blob id {blob}, got {actual}. It is "
            "left as it is; move it away and type the same command again to fetch the published "
            "file, or read it as your own data (docs/your_data.md)"
        )


def blob_id(path: Path) -> str:
    """Git's name for the content of a file: SHA-1 of ``blob <size>``, a zero byte, the content.

    Raises:
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        header = b"blob %d\0" % os.fstat(file.fileno()).st_size
        start = partial(hashlib.sha1, header, usedforsecurity=False)
        return hashlib.file_digest(file, start).hexdigest()


def _part_of(path: Path) -> Path:
    """Path of an incomplete download."""
    return path.with_name(f".{path.name}.part")


def _fetch(url: str, path: Path, blob: str) -> None:
    """Download a file completely, verify it, and rename it to its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = _part_of(path)
    with FileLock(path.with_name(".lock")):
        if path.exists():  # another process has downloaded it
            return
        _append_rest(url, part)
        actual, size = blob_id(part), part.stat().st_size
        if actual != blob:
            part.unlink()
            raise InputError(
                f"{url}: expected the file of git blob id {blob}, got {actual}, {size} bytes; "
                "nothing of it is kept. Type the same command again; if this repeats, the address "
                "leads to another file: correct published_address, or put the right file at "
                f"{path} by hand"
            )
        os.replace(part, path)


def _is_temporary(error: BaseException) -> bool:
    """Whether another attempt may succeed."""
    answer = getattr(error, "response", None)
    if answer is not None:
        return bool(answer.status_code in {416, 429} or answer.status_code >= 500)  # noqa: PLR2004
    return isinstance(error, ConnectionError | Timeout | HTTPError)


@retry(
    retry=retry_if_exception(_is_temporary),
    stop=stop_after_attempt(5),
    wait=wait_exponential(max=30),
    before_sleep=before_sleep_log(_LOG, logging.WARNING),
    reraise=True,
)
def _append_rest(url: str, part: Path) -> None:
    """Download the rest of a file, or all of it if the server does not support ranges.

    Raises:
        requests.RequestException: No complete answer, after several attempts if these may help.
        OSError: The file cannot be written.
    """
    offset = part.stat().st_size if part.exists() else 0
    # with compression, the bytes of a range would not be those of the file
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={offset}-"} if offset else {})
    with requests.get(url, headers=headers, stream=True, timeout=_TIMEOUT_S) as answer:
        if answer.status_code == 416:  # noqa: PLR2004 - the file ends before the offset
            part.unlink()
        answer.raise_for_status()
        offset = offset if answer.status_code == 206 else 0  # noqa: PLR2004 - partial content
        _LOG.info("fetching %s%s", url, f", from byte {offset} on" if offset else "")
        with part.open("ab" if offset else "wb", buffering=0) as file:
            _write_body(answer, file, offset)


def _write_body(answer: requests.Response, file: FileIO, offset: int) -> None:
    """Write an answer piece by piece, without trust in its stated length."""
    length, started, size = answer.headers.get("Content-Length"), time.monotonic(), 0
    total = None if length is None else offset + int(length)
    with tqdm(initial=offset, total=total, unit="B", unit_scale=True, disable=None) as bar:
        while piece := answer.raw.read1(_PIECE):  # returns as soon as any bytes have arrived
            size += file.write(piece)
            bar.update(len(piece))
            if offset + size > _LARGEST:
                file.truncate(0)
                raise requests.RequestException(f"more than {_LARGEST / 1e6:g} MB came")
            if time.monotonic() - started > _TIMEOUT_S + size / _LEAST_SPEED:
                raise Timeout(f"fewer than {_LEAST_SPEED / 1e3:g} kB a second came")


def _failure(url: str, path: Path, error: Exception) -> str:
    """Explain a failed download."""
    part, reason = _part_of(path), error.args[0] if error.args else error  # may wrap urllib3's
    size = part.stat().st_size if part.exists() else 0
    return (
        f"cannot fetch {path.name} from {url}: {getattr(reason, 'reason', reason)}. "
        + (f"{size} bytes are kept, and the next run continues from there. " if size else "")
        + "Check the network and published_address (conf/base/globals.yml), or put the file at "
        f"{path} by hand: it is then verified instead of fetched"
    )
