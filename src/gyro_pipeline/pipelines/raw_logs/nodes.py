"""Nodes of the raw-logs stage."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, DIMENSIONS, TEST_IMU, InputError
from gyro_pipeline.executors import run_jobs
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, LogEntry, Logs
from gyro_pipeline.parameters import Execution, Quality
from gyro_pipeline.protocol.inspection import Inspection, Judged, judge

logger = logging.getLogger(__name__)

_WORTH_PROCESSES = 10**8
"""Bytes to read; fewer are read by this process before others have started."""

_NAMED = 10
"""So many are named in a message; all are in the table."""

Row = tuple[LogEntry, Judged]


def inspect_logs(
    files: Logs, quality: Quality, execution: Execution
) -> tuple[xr.Dataset, pd.DataFrame]:
    """Read and judge all recordings of a sensor, one at a time in each process.

    Args:
        files: The recordings that the source lists.
        quality: How they are judged, and to what length they are cut.
        execution: In how many processes.

    Returns:
        Recordings as :mod:`gyro_pipeline.conventions` describes them. All are cut to the shortest
        one that is kept, or to ``quality.length_s``, from the first row that can be used on; none
        is padded. One that is rejected for some IMUs is NaN for these, one that is rejected for
        all is left out. The rate is the median of those measured from timestamps, or the expected
        one where there are none.

        And a row per IMU and recording: ``sensor, imu, recording, file, outcome``; ``rows`` of the
        file; the rows that are used, from ``start`` to before ``stop``; ``rate_hz``, measured;
        ``findings``.
    """
    rows = sorted(_judge(files, quality, execution), key=lambda row: _place(row[0]))
    rows = _without_copies(rows)
    used = [row for row in rows if row[1].outcome != REJECTED]
    length = _common_length(files, used, quality)
    table = pd.DataFrame(_described(files.sensor, row, length) for row in rows)
    return _labelled(files, used, length), table.astype({"start": "Int64", "stop": "Int64"})


def require_enough(recordings: xr.Dataset, table: pd.DataFrame, quality: Quality) -> xr.Dataset:
    """Stop where too many recordings were rejected, so that a study never shrinks unseen.

    Args:
        recordings: From :func:`inspect_logs`.
        table: Likewise.
        quality: How many of those listed must remain.

    Returns:
        The recordings.

    Raises:
        InputError: Fewer than ``quality.needed_pct`` percent remain, of all or of the tested IMU.
    """
    sensor = recordings.attrs["sensor"]
    counts = Counter(table.outcome)
    logger.info(
        "%s: %d recordings, %s",
        *(sensor, len(table)),
        ", ".join(f"{counts[outcome]} {outcome}" for outcome in (KEPT, REPAIRED, REJECTED)),
    )
    lost = sorted(set(table.imu) - set(recordings.imu.values.tolist()))
    if lost:
        shown = ", ".join(map(str, lost[:_NAMED])) + (", …" if len(lost) > _NAMED else "")
        logger.warning("%s: no recording is left of IMU %s", sensor, shown)
    tested = table.imu == TEST_IMU
    for label, listed in ((sensor, table), (f"{sensor}, the tested IMU {TEST_IMU}", table[tested])):
        bad = listed[listed.outcome == REJECTED]
        remain = len(listed) - len(bad)
        if 100 * remain < quality.needed_pct * len(listed):
            raise InputError(
                f"{label}: {remain} of {len(listed)} recordings can be used, quality.needed_pct "
                f"asks for {quality.needed_pct:g} %. Repair or remove the others, or lower it:\n  "
                + "\n  ".join(_named(bad))
            )
    return recordings


def _place(entry: LogEntry) -> tuple[int, int]:
    return entry.imu, entry.recording


def _judge(files: Logs, quality: Quality, execution: Execution) -> Iterator[Row]:
    """All recordings, in any order, here or in several processes."""
    jobs = [Inspection(entry, files.rate_hz, quality) for entry in files.entries]
    if sum(entry.size for entry in files.entries) < _WORTH_PROCESSES:
        return ((job.entry, judge(job, lambda work: None)) for job in jobs)
    judged = run_jobs(jobs, judge, execution, files.sensor, "recordings", short=True)
    return ((job.entry, one) for job, one in judged)


def _without_copies(rows: Sequence[Row]) -> list[Row]:
    """Reject recordings that are there before under another number."""
    first, found = dict[str, LogEntry](), list[Row]()
    for entry, judged in rows:
        if judged.outcome == REJECTED:
            found.append((entry, judged))
            continue
        same = first.setdefault(judged.content, entry)
        problem = f"the same samples as {same.where}, so one of the two is not what its name says"
        copy = Finding("duplicate", REJECTED, problem)
        found.append((entry, judged if same is entry else judged.rejected(copy)))
    return found


def _common_length(files: Logs, used: Sequence[Row], quality: Quality) -> int:
    """Rows of the shortest recording; a warning where it costs the others much."""
    if not used:
        return 0
    lengths = [judged.stop - judged.start for _, judged in used]
    shortest = int(np.argmin(lengths))
    length, usual = lengths[shortest], float(np.median(lengths))
    rate_hz = _agreed_rate(used, files.rate_hz)
    if length < quality.least_share * usual:
        logger.warning(
            "%s: all recordings are cut to %.4g s, as long as IMU %d recording %d, %s; half of "
            "them have %.4g s or more. Remove or repair it, or raise quality.least_s",
            *(files.sensor, length / rate_hz, used[shortest][0].imu),
            *(used[shortest][0].recording, used[shortest][0].where, usual / rate_hz),
        )
    return length


def _read(
    used: Sequence[Row], imus: Sequence[int], recordings: Sequence[int], length: int
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Samples, (imu, recording, axis, sample), and temperatures, without axis, if there are any."""
    there = np.zeros((len(imus), len(recordings)), bool)
    rates = np.empty((*there.shape, len(AXES), length), np.float32)
    warmth = None
    for entry, judged in used:
        log, rows = entry.read(), slice(judged.start, judged.start + length)
        place = imus.index(entry.imu), recordings.index(entry.recording)
        there[place], rates[place] = True, log.samples[rows].T
        if log.temperature_c is not None:
            if warmth is None:
                warmth = np.full((*there.shape, length), np.nan, np.float32)
            warmth[place] = log.temperature_c[rows]
    rates[~there] = np.nan
    return rates, warmth


def _labelled(files: Logs, used: Sequence[Row], length: int) -> xr.Dataset:
    """The recordings, with names of their dimensions and where they come from."""
    imus = sorted({entry.imu for entry, _ in used})
    recordings = sorted({entry.recording for entry, _ in used})
    rates, warmth = _read(used, imus, recordings, length)
    coordinates: dict[str, Any] = {"imu": imus, "recording": recordings, "axis": list(AXES)}
    splits = {entry.recording: entry.split for entry, _ in used}
    if any(splits.values()):
        coordinates["given_split"] = ("recording", [splits[number] for number in recordings])
    logs = xr.Dataset({"angular_rate": (DIMENSIONS, rates, {"units": "deg/s"})}, coordinates)
    logs.attrs = {
        "sensor": files.sensor,
        "source": files.source,
        "simulated": 0,
        "rate_hz": _agreed_rate(used, files.rate_hz),
    }
    labels = {str(name): label.values.tolist() for name, label in logs.coords.items()}
    # of the measured samples alone, as runs in the store know it
    logs.attrs["data_hash"] = data_hash(rates, [labels, logs.attrs])
    if warmth is not None:
        units = {"units": "degrees Celsius"}
        logs["temperature_c"] = (("imu", "recording", "sample"), warmth, units)
    if files.drawn is not None:
        logs = logs.assign(files.drawn.sel(imu=imus, recording=recordings).data_vars)
    return logs.assign_attrs(simulated=int(files.simulated))


def _described(sensor: str, row: Row, length: int) -> dict[str, Any]:
    """A row of the table."""
    entry, judged = row
    used = judged.outcome != REJECTED
    return {
        "sensor": sensor,
        "imu": entry.imu,
        "recording": entry.recording,
        "file": entry.where,
        "outcome": judged.outcome,
        "rows": judged.rows,
        "start": judged.start if used else None,
        "stop": judged.start + length if used else None,
        "rate_hz": None if judged.rate_hz is None else _rounded(judged.rate_hz),
        "findings": "; ".join(f"{one.check}: {one.detail}" for one in judged.findings) or None,
    }


def _agreed_rate(used: Sequence[Row], expected_hz: float | None) -> float:
    """The median of the measured rates; the reader has rejected those far from the expected one."""
    measured = [judged.rate_hz for _, judged in used if judged.rate_hz is not None]
    return _rounded(np.median(measured)) if measured else expected_hz or np.nan


def _rounded(rate_hz: np.floating | float) -> float:
    """To a millionth, which is better than any logger's clock."""
    return float(f"{rate_hz:.6g}")


def _named(rejected: pd.DataFrame) -> list[str]:
    """The first rejected recordings, and why."""
    lines = [
        f"IMU {row.imu} recording {row.recording}, {row.file}: {row.findings}"
        for row in rejected.head(_NAMED).itertuples()
    ]
    further = len(rejected) - len(lines)
    return [*lines, f"and {further} more, in the table of their quality"] if further else lines
