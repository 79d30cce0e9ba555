"""The files that the paper's authors publish."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from pydantic import Field, ValidationError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.array_logs import ArrayLogs
from gyro_pipeline.datasets.download import ensure
from gyro_pipeline.logs import Logs
from gyro_pipeline.parameters import Parameter

_LOG = logging.getLogger(__name__)


class PublishedFile(Parameter):
    """A file of a public git repository."""

    # not `path`, as Kedro turns values of this name into absolute local paths
    remote: str = Field(min_length=1, description="path below the base address")
    blob: str = Field(pattern="^[0-9a-f]{40}$", description="git blob id of the content")


class PublishedLogs(ArrayLogs):
    """Array files that are downloaded once and verified at every load.

    Args:
        sensor, sensors, source, axes_order, metadata: As for :class:`~.array_logs.ArrayLogs`.
        address: Base address, to which the files' paths are relative.
        path: Local folder of the files. Existing files are verified, not downloaded.
        files: ``remote`` (path below the address) and ``blob`` (git blob id) of each file:
            ``{"train": …, "test": …}``, or ``{"all": …}``.

    Raises:
        InputError: The sensor is unknown, or an argument is not as described here.
    """

    def __init__(
        self,
        sensor: str,
        sensors: Mapping[str, Mapping[str, Any]],
        source: str,
        address: str,
        path: str,
        files: Mapping[str, Mapping[str, str]],
        axes_order: Sequence[str] | None = None,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        self._published = {split: _published_file(sensor, split, files[split]) for split in files}
        names = {split: PurePosixPath(file.remote).name for split, file in self._published.items()}
        super().__init__(sensor, sensors, source, path, names, axes_order, metadata)
        self._address = address.rstrip("/")

    def load(self) -> Logs:
        """Download missing files, verify all files, and list the recordings.

        Raises:
            InputError: A file cannot be downloaded, is not the published one, or cannot be used; as
                the cause of Kedro's ``DatasetError``.
        """
        for split, file in self._published.items():
            ensure(f"{self._address}/{file.remote}", self._path / self._files[split], file.blob)
        _LOG.info("published %s files verified: %s", self._sensor, self._path)
        return super().load()

    def _describe(self) -> dict[str, Any]:
        files = {split: file.model_dump() for split, file in self._published.items()}
        return super()._describe() | {"address": self._address, "files": files}


def _published_file(sensor: str, split: str, file: Mapping[str, str]) -> PublishedFile:
    try:
        return PublishedFile.model_validate(file)
    except ValidationError as error:
        raise InputError(
            f"{sensor}: files: {split}: expected remote, a path below the address, and blob, 40 "
            f"hexadecimal digits: {error}"
        ) from error
