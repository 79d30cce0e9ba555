"""Files from a public git repository: whole and verified under their name, or not there at all.

Why requests and tenacity: docs/decisions/0010-download-of-the-published-files.md.
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
"""The longest silence of a server, and how long it may be slower than the least speed."""
_LEAST_SPEED = 1e4
"""Bytes a second, on average since the answer began."""
_LARGEST = 10**9
"""Bytes of a file; the published ones have up to 10^8."""
_PIECE = 1 << 16
"""Bytes that are read at a time, at most; what was read is kept after an interruption."""


def ensure(url: str, path: Path, blob: str) -> None:
    """See that a file is there and is the published one; fetch it only where it is not there.

    What was fetched before an interruption is kept beside it and continued, also by a later run.
    A second process that fetches into the same folder waits for the first.

    Args:
        url: Where it is published.
        path: Where it belongs. Nothing else ever stands there, and nothing is overwritten.
        blob: Its git blob id.

    Raises:
        InputError: It cannot be fetched or written, or what came or is there is another file.
    """
    if not path.exists():
        check_writable(path)
        try:
            _fetch(url, path, blob)
        except (requests.RequestException, HTTPError) as error:  # the first is an OSError as well
            raise InputError(_no_answer(url, path, error)) from error
    try:
        found = blob_id(path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; move it away") from error
    if found != blob:
        raise InputError(
            f"{path} is not the published file: expected git blob id {blob}, got {found}. It is "
            "left as it is; move it away and run again to fetch the published one, or read it by "
            "a source of your own (docs/your_data.md)"
        )


def blob_id(path: Path) -> str:
    """Name that git gives to a file's content: SHA-1 of ``blob <size>``, a zero byte, the bytes.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        header = b"blob %d\0" % os.fstat(file.fileno()).st_size
        start = partial(hashlib.sha1, header, usedforsecurity=False)
        return hashlib.file_digest(file, start).hexdigest()


def _part_of(path: Path) -> Path:
    """Where a file is until it is whole."""
    return path.with_name(f".{path.name}.part")


def _fetch(url: str, path: Path, blob: str) -> None:
    """Put a file in its place once all of it is there and is the right one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = _part_of(path)
    with FileLock(path.with_name(".lock")):
        if path.exists():  # another process was first
            return
        _append_rest(url, part)
        found, size = blob_id(part), part.stat().st_size
        if found != blob:
            part.unlink()
            raise InputError(
                f"{url}: expected the file of git blob id {blob}, got {found}, {size} bytes; "
                "nothing of it is kept. Run again; if it comes again, the address gives another "
                f"file: correct published_address, or put the right one at {path} by hand"
            )
        os.replace(part, path)


def _may_pass(error: BaseException) -> bool:
    """Whether another try may help."""
    answer = getattr(error, "response", None)
    if answer is not None:
        return bool(answer.status_code in {416, 429} or answer.status_code >= 500)  # noqa: PLR2004
    return isinstance(error, ConnectionError | Timeout | HTTPError)


@retry(
    retry=retry_if_exception(_may_pass),
    stop=stop_after_attempt(5),
    wait=wait_exponential(max=30),
    before_sleep=before_sleep_log(_LOG, logging.WARNING),
    reraise=True,
)
def _append_rest(url: str, part: Path) -> None:
    """Fetch what a part of a file lacks, or all of it from a server that gives no parts.

    Raises:
        requests.RequestException: No whole answer, after several tries where another may help.
        OSError: It cannot be written.
    """
    have = part.stat().st_size if part.exists() else 0
    # compressed, the bytes of a part would not be those of the file
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={have}-"} if have else {})
    with requests.get(url, headers=headers, stream=True, timeout=_TIMEOUT_S) as answer:
        if answer.status_code == 416:  # noqa: PLR2004 - it is no longer than what is there
            part.unlink()
        answer.raise_for_status()
        have = have if answer.status_code == 206 else 0  # noqa: PLR2004 - a part
        _LOG.info("fetching %s%s", url, f", from byte {have} on" if have else "")
        with part.open("ab" if have else "wb", buffering=0) as file:
            _write_body(answer, file, have)


def _write_body(answer: requests.Response, file: FileIO, have: int) -> None:
    """Write an answer as it comes, whatever its size is said to be."""
    rest, begun, size = answer.headers.get("Content-Length"), time.monotonic(), 0
    total = None if rest is None else have + int(rest)
    with tqdm(initial=have, total=total, unit="B", unit_scale=True, disable=None) as bar:
        while piece := answer.raw.read1(_PIECE):  # what has come, however little
            size += file.write(piece)
            bar.update(len(piece))
            if have + size > _LARGEST:
                file.truncate(0)
                raise requests.RequestException(f"more than {_LARGEST / 1e6:g} MB came")
            if time.monotonic() - begun > _TIMEOUT_S + size / _LEAST_SPEED:
                raise Timeout(f"fewer than {_LEAST_SPEED / 1e3:g} kB a second came")


def _no_answer(url: str, path: Path, error: Exception) -> str:
    part, reason = _part_of(path), error.args[0] if error.args else error  # urllib3's own in it
    kept = part.stat().st_size if part.exists() else 0
    return (
        f"cannot fetch {path.name} from {url}: {getattr(reason, 'reason', reason)}. "
        + (f"{kept} bytes are kept, and the next run goes on from there. " if kept else "")
        + "Check the network and published_address (conf/base/globals.yml), or put the file at "
        f"{path} by hand: it is then verified and not fetched"
    )
