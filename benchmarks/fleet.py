"""A fleet's folder of CSV files: the raw-logs stage against a bare pandas loop, in one run.

    python benchmarks/fleet.py [--files 2000] [--processes 2] [--layout public|export]

Writes the files to a temporary folder (4.5 GB for 2,000 like the public ones), reads them once so
that both sides find them in memory as far as it goes, and then, on as many processes each:

* a bare loop of ``pandas.read_csv``, of which nothing is kept;
* the raw-logs stage as ``kedro run --pipeline=ground_truth`` calls it: files are read, judged and
  stored;
* the same once more, with all files read before.

Prints the time of each, the ratio, and the peak memory of this process and its children.
"""

import argparse
import logging
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import psutil
import yaml

CONF = Path(__file__).parents[1] / "conf" / "base"
RATE_HZ, ROWS = 120, 13_000
MB = 1e6


def write_export(folder: Path, number: int) -> None:
    """A DOT export: counter, time in us, then values of six decimals."""
    generator = np.random.default_rng(number)
    rows = np.arange(ROWS)
    columns = {"PacketCounter": rows, "SampleTimeFine": (rows * 1e6 / RATE_HZ).astype(np.int64)}
    for name, centre, scatter in (
        *(("Euler_X", -0.9, 1e-3), ("Euler_Y", 2.5, 1e-3)),
        *(("Acc_X", -0.4, 0.02), ("Acc_Y", -0.1, 0.02), ("Acc_Z", 9.9, 0.02)),
        *((f"Gyr_{axis}", generator.uniform(-3, 3), 0.055) for axis in "XYZ"),
    ):
        columns[name] = generator.normal(centre, scatter, ROWS).round(6)
    _write(columns, folder, number)


def write_public(folder: Path, number: int) -> None:
    """Like the public DOT files: seconds, angles, accelerations and rates of 15 digits."""
    generator = np.random.default_rng(number)
    columns = {"Time": np.arange(ROWS) / RATE_HZ}
    for name, centre, scatter in (
        *(("phi", -0.9, 1e-3), ("theta", 2.5, 1e-3), ("psi", 13.5, 1e-3)),
        *(("f_x", -0.4, 0.02), ("f_y", -0.1, 0.02), ("f_z", 9.9, 0.02)),
        *((f"w_{axis}", generator.uniform(-3, 3), 0.055) for axis in "xyz"),
    ):
        columns[name] = generator.normal(centre, scatter, ROWS)
    _write(columns, folder, number)


LAYOUTS = {"export": write_export, "public": write_public}


def _write(columns: dict[str, Any], folder: Path, number: int) -> None:
    path = folder / f"imu{number // 100 + 1}" / f"{number % 100 + 1}.csv"
    path.parent.mkdir(exist_ok=True)
    pd.DataFrame(columns).to_csv(path, index=False, float_format="%.15g")


def parse(path: Path) -> int:
    return len(pd.read_csv(path))


def read_bytes(path: Path) -> int:
    return len(path.read_bytes())


@contextmanager
def measured(what: str, files: int) -> Iterator[dict[str, float]]:
    """Wall time of a block, and the peak memory of this process and its children meanwhile."""
    found = {"s": 0.0, "bytes": 0.0}
    stop = threading.Event()
    watcher = threading.Thread(target=_watch, args=(found, stop), daemon=True)
    watcher.start()
    began = time.perf_counter()
    yield found
    found["s"] = time.perf_counter() - began
    stop.set()
    watcher.join()
    print(
        f"{what:<44} {found['s']:7.1f} s {1e3 * found['s'] / files:6.1f} ms a file "
        f"{found['bytes'] / MB:6.0f} MB peak"
    )


def _watch(found: dict[str, float], stop: threading.Event) -> None:
    """Sum resident memory; what processes share is counted in each, so it is an upper bound."""
    me = psutil.Process()
    while not stop.wait(0.1):
        total = 0
        for process in (me, *me.children(recursive=True)):
            with suppress(psutil.Error):
                total += process.memory_info().rss
        found["bytes"] = max(found["bytes"], total)


def in_processes(function: Callable[[Any], object], items: list[Any], processes: int) -> None:
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        for _ in pool.map(function, items, chunksize=4):
            pass


def pipeline(folder: Path, scratch: Path, processes: int) -> Callable[[], Any]:
    """The raw-logs stage on a folder."""
    # here, so that the processes of the bare loop do not wait for them
    from gyro_pipeline.datasets.file_logs import FileLogs  # noqa: PLC0415
    from gyro_pipeline.datasets.recordings import (  # noqa: PLC0415
        InspectedRecordings,
        Recordings,
    )
    from gyro_pipeline.parameters import Execution, Quality, Splits  # noqa: PLC0415
    from gyro_pipeline.pipelines.raw_logs.nodes import (  # noqa: PLC0415
        inspect_logs,
        label_recordings,
        quality_table,
    )

    stages = yaml.safe_load((CONF / "parameters" / "stages.yml").read_text())
    quality, splits = Quality(**stages["quality"]), Splits(**stages["splits"])
    sensor = yaml.safe_load((CONF / "globals.yml").read_text())["sensors"]["dot"]
    imus = sum(1 for _ in folder.iterdir())
    sensors = {"dot": sensor | {"imus": imus, "samples": ROWS, "recording_s": ROWS / RATE_HZ}}
    source = FileLogs(
        *("dot", "fleet", str(folder)), sensors=sensors, pattern="imu{imu}/{recording}.csv"
    )
    scratch.mkdir()
    path = str(scratch / "recordings.nc")
    reading, final = InspectedRecordings(path), Recordings(path)
    execution = Execution(executor="processes", workers=processes)

    def run() -> Any:
        files = source.load()
        for item in inspect_logs(files, reading.load(), quality, execution):
            reading.save(item)
        table = quality_table(files, reading.load())
        final.save(label_recordings(files, reading.load(), table, quality, splits))
        return final.load()

    return run


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--files", type=int, default=2000)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--layout", choices=LAYOUTS, default="public")
    arguments = parser.parse_args()
    logging.getLogger("gyro_pipeline").setLevel(logging.INFO)
    files, processes = arguments.files, arguments.processes
    with tempfile.TemporaryDirectory() as temporary:
        folder, scratch = Path(temporary) / "files", Path(temporary) / "scratch"
        folder.mkdir()
        in_processes(partial(LAYOUTS[arguments.layout], folder), list(range(files)), processes)
        paths = sorted(folder.rglob("*.csv"))
        size = sum(path.stat().st_size for path in paths)
        print(f"{files} files of {ROWS} rows, {size / MB:.0f} MB, on {processes} processes")
        in_processes(read_bytes, paths, processes)
        with measured("pandas.read_csv alone", files) as bare:
            in_processes(parse, paths, processes)
        run = pipeline(folder, scratch, processes)
        with measured("read, judged and stored", files) as ours:
            print(f"  {dict(run().sizes)}")
        with measured("the same, all files read before", files):
            run()
    print(f"ratio {ours['s'] / bare['s']:.2f}, peak {ours['bytes'] / MB:.0f} MB")


if __name__ == "__main__":
    main()
