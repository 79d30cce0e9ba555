"""Fits that a run server did not take: files that are kept until it answers again."""

import hashlib
import logging
import pickle
from collections.abc import Iterator
from pathlib import Path

from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.tracking import FittedRun

logger = logging.getLogger(__name__)

_FOLDER = "unsaved_fits"


def keep_fit(folder: Path, fitted: FittedRun) -> bool:
    """Write a fit to a file of its study, named by its digest; return whether it is the first."""
    content, first = pickle.dumps(fitted), not any((folder / _FOLDER).glob("*/*.pkl"))
    with replacing(folder / _FOLDER / fitted.run.study / f"{_digest(content)}.pkl") as path:
        path.write_bytes(content)
    return first


def kept_fits(folder: Path, study: str | None) -> Iterator[tuple[Path, FittedRun]]:
    """The kept fits of a study, or of all, and their files; damaged files are removed."""
    for path in sorted((folder / _FOLDER).glob(f"{study or '*'}/*.pkl")):
        content = path.read_bytes()
        if _digest(content) == path.stem:
            yield path, pickle.loads(content)
        else:
            logger.warning("%s: damaged, so it is removed, and the fit is made again", path)
            path.unlink()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
