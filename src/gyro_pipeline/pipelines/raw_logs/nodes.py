"""Nodes of the raw-logs stage."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.executors import run_jobs
from gyro_pipeline.fingerprints import code_hash, fingerprint
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Listing, Logs, Recording
from gyro_pipeline.parameters import Execution, Quality, Splits
from gyro_pipeline.pipelines.raw_logs import inspection
from gyro_pipeline.pipelines.raw_logs.inspection import Inspection, judge
from gyro_pipeline.quality.rejections import NAMED, reasons
from gyro_pipeline.splits import split_recordings

logger = logging.getLogger(__name__)

_MIN_PARALLEL_BYTES = 10**8
"""Reading fewer bytes here is faster than starting other processes."""
_BATCH, _BATCH_BYTES = 16, 16 * 10**6
"""Maximum number of recordings, and their bytes, that go to a process together."""
_USED_COLUMNS = ["start", "stop", "masked"]
"""Columns of the quality table that are empty for rejected recordings."""


def inspect_logs(
    files: Logs, earlier: Sequence[Recording], quality: Quality, execution: Execution
) -> Iterator[Listing | Recording]:
    """Read and judge all recordings of a sensor, each of them once.

    Args:
        files: The recordings that the source lists.
        earlier: Recordings that were read in an earlier, perhaps interrupted, run.
        quality: Settings of quality control.
        execution: Number of processes.

    Yields:
        The list of recordings, then the recordings that were not read before, in any order.
    """
    code = code_hash("gyro_pipeline.quality", inspection.__name__)
    # needed_pct concerns all recordings together
    judged_by = quality.model_dump(mode="json", exclude={"needed_pct"})
    jobs = {
        (entry.imu, entry.recording): Inspection(
            *(entry, files.rate_hz, quality),
            key=fingerprint([entry.key, [judged_by, files.rate_hz, code]]),
        )
        for entry in files.entries
    }
    yield Listing({number: job.key for number, job in jobs.items()})
    stored = {recording.labels: recording.key for recording in earlier}
    missing = [job for number, job in jobs.items() if stored.get(number) != job.key]
    if len(missing) < len(jobs):
        count = len(jobs) - len(missing)
        logger.info("%s: %d of %d recordings were read before", files.sensor, count, len(jobs))
    sizes = [job.entry.size for job in missing]
    if sum(sizes) < _MIN_PARALLEL_BYTES:
        yield from map(judge, missing)
    else:
        batch = int(np.clip(_BATCH_BYTES // max(sizes), 1, _BATCH))
        results = run_jobs(missing, judge, execution, files.sensor, "recordings", batch)
        yield from (recording for _, recording in results)


def quality_table(files: Logs, inspected: Sequence[Recording]) -> pd.DataFrame:
    """The quality table: outcome and findings of each recording; a duplicate is rejected.

    Args:
        files: The source, with the name of the sensor.
        inspected: All recordings, by IMU and number.

    Returns:
        A row per IMU and recording: ``sensor, imu, recording, file, outcome``; ``rows``, the number
        of rows read; the rows used, counted from 0, from ``start`` to before ``stop``, and how many
        of them are ``masked``; ``rate_hz``, measured; and ``findings``, which count the rows of the
        file.
    """
    labels = "imu recording where outcome rows".split()
    columns = [*labels, *_USED_COLUMNS, "rate_hz", "findings"]
    table = pd.DataFrame(map(vars, _without_copies(inspected)))[columns]
    table.insert(0, "sensor", files.sensor)
    table["findings"] = [
        "; ".join(f"{finding.check}: {finding.detail}" for finding in findings) or None
        for findings in table.findings
    ]
    table["rate_hz"] = table.rate_hz.map(_rounded)
    table[_USED_COLUMNS] = table[_USED_COLUMNS].astype("Int64").mask(table.outcome == REJECTED)
    return table.rename(columns={"where": "file"})


def label_recordings(
    files: Logs,
    inspected: Sequence[Recording],
    table: pd.DataFrame,
    quality: Quality,
    splits: Splits,
) -> xr.Dataset:
    """Label the usable recordings, if enough of them remain.

    Args:
        files: The source.
        inspected: All recordings, by IMU and number.
        table: The table from :func:`quality_table`.
        quality: Settings of quality control, with the percentage that must remain.
        splits: How recordings are held out.

    Returns:
        The dataset of :mod:`gyro_pipeline.conventions` without measured samples. Its rate is the
        median of the rates measured from timestamps, or the expected rate without timestamps.

    Raises:
        InputError: Fewer than ``quality.needed_pct`` percent remain, of all or of the tested IMU.
    """
    require_enough(table, quality)
    used = table[table.outcome != REJECTED].set_index(["imu", "recording"])
    imus, numbers = (sorted(table[name].unique().tolist()) for name in ("imu", "recording"))
    lengths = (used["stop"] - used["start"]).unstack(fill_value=0)
    samples = lengths.reindex(index=imus, columns=numbers, fill_value=0).to_numpy(np.int64)
    coordinates: dict[str, Any] = {"imu": imus, "recording": numbers, "axis": list(AXES)}
    fixed = {entry.recording: entry.split for entry in files.entries if entry.split}
    tested = used.loc[[used.index[0][0]]].index.get_level_values("recording").tolist()
    split = split_recordings(numbers, tested, splits, fixed or None)
    if split is not None:
        coordinates["split"] = ("recording", [split[number] for number in numbers])
    measured = used.rate_hz.dropna()
    attributes = {
        "sensor": files.sensor,
        "source": files.source,
        "simulated": int(files.simulated),
        # recordings with a rate far from the expected one were rejected
        "rate_hz": _rounded(measured.median()) if len(measured) else files.rate_hz,
    }
    contents = [[*item.labels, item.content] for item in inspected if item.labels in used.index]
    attributes["data_hash"] = fingerprint([attributes, contents])
    labels = xr.Dataset({"samples": (("imu", "recording"), samples)}, coordinates, attributes)
    if files.truth is not None:
        labels = labels.assign(files.truth.sel(imu=imus, recording=numbers).data_vars)
    return labels


def require_enough(table: pd.DataFrame, quality: Quality) -> None:
    """Stop if too many recordings were rejected, so that a study never shrinks unnoticed.

    Args:
        table: The table from :func:`quality_table`.
        quality: Settings of quality control, with the percentage that must remain.

    Raises:
        InputError: Fewer than ``quality.needed_pct`` percent remain, of all or of the tested IMU.
    """
    sensor, first, counts = table.sensor.iloc[0], table.imu.min(), Counter(table.outcome)
    outcomes = ", ".join(f"{counts[outcome]} {outcome}" for outcome in (KEPT, REPAIRED, REJECTED))
    logger.info("%s: %d recordings, %s", sensor, len(table), outcomes)
    tested = table[table.imu == first]
    for label, listed in ((sensor, table), (f"{sensor}, the tested IMU {first}", tested)):
        rejected = listed[listed.outcome == REJECTED]
        remain = len(listed) - len(rejected)
        if 100 * remain < quality.needed_pct * len(listed):
            raise InputError(
                f"{label}: {remain} of {len(listed)} recordings can be used, quality.needed_pct "
                f"asks for {quality.needed_pct:g} %. Repair or remove the others, or lower it:\n  "
                + "\n  ".join(reasons(rejected))
            )
    lost = sorted(set(table.imu) - set(table.imu[table.outcome != REJECTED]))
    if lost:
        named = ", ".join(map(str, lost[:NAMED])) + (", …" if len(lost) > NAMED else "")
        logger.warning("%s: no recording is left of IMU %s", sensor, named)


def _without_copies(inspected: Sequence[Recording]) -> Iterator[Recording]:
    """Reject recordings whose samples have occurred before under another number."""
    first = dict[str, Recording]()
    for recording in inspected:
        same = first.setdefault(recording.content, recording)
        if same is recording or recording.outcome == REJECTED:
            yield recording
            continue
        problem = f"the same samples as {same.where}, so one of the two is not what its name says"
        findings = (*recording.findings, Finding("duplicate", REJECTED, problem))
        yield replace(recording, outcome=REJECTED, findings=findings)


def _rounded(rate_hz: float | None) -> float | None:
    """A rate rounded to a millionth, which is more accurate than the clock of any logger."""
    return None if rate_hz is None else float(f"{rate_hz:.6g}")
