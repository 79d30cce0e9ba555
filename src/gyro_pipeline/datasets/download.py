"""Files from a public git repository: whole and verified under their name, or not there at all.

Why requests and tenacity: docs/decisions/0010-download-of-the-published-files.md.
"""

import hashlib
import logging
import os
from functools import partial
from pathlib import Path

import requests
from filelock import FileLock
from requests.exceptions import ChunkedEncodingError, ConnectionError, Timeout
from tenacity import (
    RetryCallState,
    retry,
    retry_if_exception_type,
    stop_after_attempt,
    wait_exponential,
)
from tqdm import tqdm

from gyro_pipeline.conventions import InputError

_LOG = logging.getLogger(__name__)

_TIMEOUT_S = 30
"""The longest silence of a server."""

_PIECE = 1 << 16
"""Bytes that are written, and shown as progress, at a time; an interruption loses fewer."""

_OK, _PART, _NO_SUCH_PART, _TOO_MANY_REQUESTS, _SERVER_ERRORS = 200, 206, 416, 429, 500


class _Passing(requests.RequestException):
    """An answer of a server that may be another one a moment later."""


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
        try:
            _fetch(url, path, blob)
        except requests.RequestException as error:  # also an OSError
            raise InputError(_no_answer(url, path, error)) from error
    found = _blob_id_of(path)
    if found != blob:
        raise InputError(
            f"{path} is not the published file: expected git blob id {blob}, got {found}. It is "
            "left as it is; move it away and run again to fetch the published one, or read it by "
            "a source of your own (README, Real recordings)"
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


def _blob_id_of(path: Path) -> str:
    try:
        return blob_id(path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; move it away") from error


def _fetch(url: str, path: Path, blob: str) -> None:
    """Put a file in its place once all of it is there and is the right one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = _part_of(path)
    with FileLock(path.with_name(".lock")):
        if path.exists():  # another process was first
            return
        _append_rest(url, part)
        found = blob_id(part)
        if found != blob:
            size = part.stat().st_size
            part.unlink()
            raise InputError(
                f"{url}: expected the file of git blob id {blob}, got {found}, {size} bytes; "
                "nothing of it is kept. Run again; if it comes again, the address gives another "
                f"file: correct published_address, or put the right one at {path} by hand"
            )
        os.replace(part, path)


def _part_of(path: Path) -> Path:
    """Where a file is until it is whole."""
    return path.with_name(f".{path.name}.part")


def _say(state: RetryCallState) -> None:
    error = state.outcome.exception() if state.outcome else None
    wait_s = state.next_action.sleep if state.next_action else 0
    _LOG.warning("%s; trying again in %.0f s", _reason(error), wait_s)


def _reason(error: BaseException | None) -> object:
    """What went wrong, without the address and the count of tries that urllib3 wraps it in."""
    inner = error.args[0] if error is not None and error.args else error
    return getattr(inner, "reason", error)


@retry(
    retry=retry_if_exception_type((ConnectionError, Timeout, ChunkedEncodingError, _Passing)),
    stop=stop_after_attempt(5),
    wait=wait_exponential(max=30),
    before_sleep=_say,
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
        _check_status(answer, part)
        have = have if answer.status_code == _PART else 0
        rest = answer.headers.get("Content-Length")
        _LOG.info("fetching %s%s", url, f", from byte {have} on" if have else "")
        with (
            part.open("ab" if have else "wb") as file,
            tqdm(
                desc=part.stem.removeprefix("."),
                initial=have,
                total=None if rest is None else have + int(rest),
                unit="B",
                unit_scale=True,
                disable=None,  # shown on a terminal only
            ) as bar,
        ):
            for piece in answer.iter_content(_PIECE):
                bar.update(file.write(piece))


def _check_status(answer: requests.Response, part: Path) -> None:
    code = answer.status_code
    if code in (_OK, _PART):
        return
    said = f"the server answered {code} {answer.reason}"
    if code == _NO_SUCH_PART:  # as long as the file or longer, so not the beginning of it
        part.unlink()
    if code in (_NO_SUCH_PART, _TOO_MANY_REQUESTS) or code >= _SERVER_ERRORS:
        raise _Passing(said)
    raise requests.HTTPError(said)


def _no_answer(url: str, path: Path, error: requests.RequestException) -> str:
    part = _part_of(path)
    kept = part.stat().st_size if part.exists() else 0
    return (
        f"cannot fetch {path.name} from {url}: {_reason(error)}. "
        + (f"{kept} bytes are kept, and the next run goes on from there. " if kept else "")
        + "Check the network and published_address (conf/base/globals.yml), or put the file at "
        f"{path} by hand: it is then verified and not fetched"
    )
