"""The base class of all sources of raw logs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kedro.io import AbstractDataset, DatasetError
from pydantic import ValidationError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.fingerprints import fingerprint
from gyro_pipeline.logs import Logs
from gyro_pipeline.parameters import Sensor


class LogSource(AbstractDataset[Logs, Logs]):
    """Logs of a sensor in a folder, read only.

    Args:
        sensor: Name of the sensor.
        sensors: All sensors, as in ``conf/base/globals.yml``; None if the sensor has no entry.
        source: Name of the source, as in stored paths.
        path: Folder of the files.
        metadata: For other tools, such as Kedro-Viz.

    Raises:
        InputError: The sensor is unknown, or its entry is invalid.
    """

    def __init__(
        self,
        sensor: str,
        sensors: Mapping[str, Mapping[str, Any]] | None,
        source: str,
        path: str,
        metadata: dict[str, Any] | None,
    ) -> None:
        self.entry = Sensor.model_validate({}) if sensors is None else _entry(sensor, sensors)
        if not isinstance(path, str):
            raise InputError(
                f"{sensor}: path in the catalog entry: expected a folder, got {path!r}"
            )
        self._sensor = sensor
        self._source = source
        self._path = Path(path)
        self.metadata = metadata

    def state(self) -> str:
        """A hash of the listed recordings and the state of their files."""
        return fingerprint(
            [(entry.imu, entry.recording, entry.key) for entry in self.load().entries]
        )

    def save(self, data: Logs) -> None:
        """Refuse: logs are read only."""
        raise DatasetError(f"{self._sensor}: logs are read only; {self._path} is never written to")

    def _describe(self) -> dict[str, Any]:
        return {"sensor": self._sensor, "source": self._source, "path": str(self._path)}


def _entry(sensor: str, sensors: Mapping[str, Mapping[str, Any]]) -> Sensor:
    if sensor not in sensors:
        raise InputError(
            f"unknown sensor {sensor!r}; expected one of {', '.join(sensors)}, or a new entry in "
            "conf/base/globals.yml"
        )
    try:
        return Sensor.model_validate(sensors[sensor])
    except ValidationError as error:
        raise InputError(f"sensor {sensor} in globals.yml: {error}") from error
