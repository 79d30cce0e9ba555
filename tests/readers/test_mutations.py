"""Good files with bytes flipped, cut or inserted, and lines dropped or repeated.

Whatever the damage, a file ends in a recording or in a message, and no sample comes back in
another unit: rows are those of the good file, up to the few that were touched.
"""

import io
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.file_logs import FileLogs
from gyro_pipeline.datasets.recordings import Recordings
from gyro_pipeline.parameters import Execution, ReaderOptions
from gyro_pipeline.pipelines.raw_logs.nodes import inspect_logs, require_enough
from gyro_pipeline.readers import read_log

LOGGERS = ["movella_dot", "movella_dot_angles", "openlog_artemis", "ngimu", "general"]
PLACE = st.floats(0, 1, exclude_max=True)
SEVERAL = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,  # the same files each time
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)

EDITS = st.one_of(
    st.tuples(st.just("flip"), PLACE, st.integers(1, 255)),
    st.tuples(st.just("cut"), PLACE, st.integers(1, 40)),
    st.tuples(st.just("end"), PLACE, st.just(0)),
    st.tuples(
        st.just("insert"), PLACE, st.binary(min_size=1, max_size=8) | st.sampled_from(
            [b",", b";", b"\t", b"\n", b"\r", b'"', b"\0", b".", b"-", b"e9", b"sep=;\n", b" "]
        )
    ),
    st.tuples(st.just("drop"), PLACE, st.just(0)),
    st.tuples(st.just("repeat"), PLACE, st.just(0)),
    st.tuples(st.just("replace"), PLACE, st.binary(min_size=1, max_size=8)),
)  # fmt: skip


def mutated(data, edit):
    """The bytes with one edit, at a place from 0 to 1."""
    kind, place, what = edit
    if kind in ("drop", "repeat"):
        lines = data.splitlines(keepends=True)
        at = int(place * len(lines))
        return b"".join(
            lines[:at] + lines[at : at + 1] * (2 * (kind == "repeat")) + lines[at + 1 :]
        )
    at = int(place * len(data))
    if kind == "flip":
        return data[:at] + bytes([data[at] ^ what]) + data[at + 1 :] if data else data
    if kind == "cut":
        return data[:at] + data[at + what :]
    if kind == "insert":
        return data[:at] + what + data[at:]
    return data[:at] if kind == "end" else data[:at] + what + data[at + len(what) :]


def read_or_refused(path, data):
    path.write_bytes(data)
    try:
        return read_log(path, ReaderOptions(), 100.0)
    except InputError as error:
        assert path.name in str(error)
        return None


def strange_rows(samples, good):
    """How many rows are not rows of the good file, to float precision, in any of their axes."""
    near = np.abs(samples[:, None] - good[None]) <= 1e-7
    return int((~near.all(axis=2).any(axis=1)).sum())


@pytest.mark.filterwarnings("error")  # what Arrow cannot raise, it warns of
@pytest.mark.parametrize("logger", LOGGERS)
@SEVERAL
@given(edits=st.lists(EDITS, min_size=1, max_size=3))
def test_a_mutated_text_gives_the_good_rows_or_a_message(logger, edits, good, rates, tmp_path):
    data = good[logger].encode()
    for edit in edits:
        data = mutated(data, edit)
    log = read_or_refused(tmp_path / "log.csv", data)
    if log is None:
        return
    assert log.samples.dtype == np.float64
    assert log.samples.shape == (len(log.samples), 3)
    assert (np.diff(log.gap_rows) > 0).all()
    readable = np.isfinite(log.samples).all(axis=1)
    assert strange_rows(log.samples[readable], rates) <= 2 * len(edits)
    assert (~readable).sum() <= 3 + len(edits)
    assert len(log.samples) <= len(rates) + 5 * len(edits)


@SEVERAL
@given(
    edits=st.lists(EDITS, min_size=1, max_size=3),
    kind=st.sampled_from(["npy", "npz", "parquet", "mat"]),
)
def test_a_mutated_binary_file_gives_a_recording_or_a_message(edits, kind, rates, frame, tmp_path):
    buffer = io.BytesIO()
    if kind == "npy":
        np.save(buffer, rates)
    elif kind == "npz":
        np.savez(buffer, gyro_dps=rates)
    elif kind == "mat":
        scipy.io.savemat(buffer, {"log": {"gyro_dps": rates}, "t": rates[:, 0]})
    else:
        frame.to_parquet(buffer)
    data = buffer.getvalue()
    for edit in edits:
        data = mutated(data, edit)
    log = read_or_refused(tmp_path / f"log.{kind}", data)
    assert log is None or log.samples.shape[1] == 3


@pytest.mark.parametrize("logger", LOGGERS)
def test_no_byte_lost_or_delimiter_added_in_a_header_moves_columns_or_units(
    logger, good, rates, tmp_path
):
    data = good[logger].encode()
    end = len(data) - len(data[data.index(b"\n", data.index(rates_header(data))) :])
    delimiter = b";" if logger == "general" else b","
    read = 0
    for at in range(end):
        for change in (data[:at] + data[at + 1 :], data[:at] + delimiter + data[at:]):
            log = read_or_refused(tmp_path / "log.csv", change)
            if log is not None:
                read += 1
                assert strange_rows(log.samples, rates) == 0, change[: end + 1]
                assert len(log.samples) == len(rates)
    assert read


def rates_header(data):
    """The first of the names of the rates that a header has."""
    return next(name for name in (b"Gyr_X", b"w_x", b"gX", b"Gyroscope", b"gx") if name in data)


SENSOR = {
    **{"imus": 2, "recordings": 2, "train_recordings": 1, "samples": 1200, "recording_s": 12},
    "simulated": {
        "noise_mdps_rts": [5, 5, 5],
        "turn_on_spread_mdps": [0, 0, 0],
        "unit_bias_dps": 1,
    },
}
TWELVE_S = np.random.default_rng(8).normal([3.0, -0.9, 0.4], 0.06, (1200, 3)).round(5)
SOUND = "".join(
    ["t (s);gx (deg/s);gy (deg/s);gz (deg/s)\n"]
    + [f"{k / 100:.2f};{x};{y};{z}\n" for k, (x, y, z) in enumerate(TWELVE_S.tolist())]
).encode()


@settings(SEVERAL, max_examples=12)
@given(edits=st.lists(EDITS, min_size=1, max_size=3))
def test_a_folder_with_a_mutated_file_is_stored_whole_and_the_same_again(edits, parameters):
    damaged = SOUND
    for edit in edits:
        damaged = mutated(damaged, edit)
    asked = parameters("base").quality.model_copy(update={"needed_pct": 1.0})
    serial = Execution(executor="serial", workers=None)
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "1.csv").write_bytes(SOUND)
        (folder / "2.csv").write_bytes(damaged)
        source = FileLogs("dot", "mine", name, {"dot": SENSOR}, "{imu}.csv")
        recordings, table = inspect_logs(source.load(), asked, serial)
        store = Recordings(f"{name}/recordings.nc")
        store.save(require_enough(recordings, table, asked))
        again, table_again = inspect_logs(source.load(), asked, serial)  # from what was kept
        stored = store.load()
    pd.testing.assert_frame_equal(table, table_again)
    assert again.attrs == recordings.attrs == stored.attrs
    assert set(recordings.imu.values) == set(table.imu[table.outcome != "rejected"])
    assert "1.csv" in table.file[table.outcome != "rejected"].tolist()
    means = recordings.angular_rate.mean("sample").squeeze("recording").values
    np.testing.assert_allclose(
        means - TWELVE_S.mean(axis=0), 0, atol=0.02
    )  # in deg/s, and in order
    assert table.findings[table.outcome != "kept"].notna().all()
