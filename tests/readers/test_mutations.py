"""Good files with bytes flipped, cut or inserted, and lines dropped or repeated.

Whatever the damage, a file ends in a table or in a message, and no value moves to another column.
"""

import io

import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.table import read_table

PLACE = st.floats(0, 1, exclude_max=True)
SEVERAL = settings(
    max_examples=30,
    deadline=None,
    derandomize=True,  # the same files each time
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
BYTES = st.binary(min_size=1, max_size=8) | st.sampled_from(
    [b",", b";", b"\t", b"\n", b"\r", b'"', b"\0", b".", b"-", b"e9", b"sep=;\n", b" "]
)
KINDS = st.sampled_from(["flip", "cut", "end", "insert", "drop", "repeat", "replace"])
EDITS = st.lists(st.tuples(KINDS, PLACE, BYTES), min_size=1, max_size=3)


def mutated(data, edits):
    """The bytes with edits, each of a kind, at a place from 0 to 1, with other bytes."""
    for kind, place, new in edits:
        if kind in ("drop", "repeat"):
            lines = data.splitlines(keepends=True)
            at = int(place * len(lines))
            again = lines[at : at + 1] * (2 * (kind == "repeat"))
            data = b"".join(lines[:at] + again + lines[at + 1 :])
            continue
        at = int(place * len(data))
        data = {
            "flip": data[:at] + bytes(byte ^ new[0] for byte in data[at : at + 1]) + data[at + 1 :],
            "cut": data[:at] + data[at + 5 * len(new) :],
            "end": data[:at],
            "insert": data[:at] + new + data[at:],
            "replace": data[:at] + new + data[at + len(new) :],
        }[kind]
    return data


def read_or_refused(path, data):
    path.write_bytes(data)
    try:
        return read_table(path, ReaderOptions())
    except InputError as error:
        assert path.name in str(error)
        return None


# What Arrow cannot raise, it warns of. Libraries leave the logs of vehicles open, which Hypothesis
# makes of the bytes that it sees in the source.
@pytest.mark.filterwarnings("error", "ignore:unclosed file:ResourceWarning")
@pytest.mark.parametrize("logger", ["dot", "angles", "general"])
@SEVERAL
@given(edits=EDITS)
def test_a_mutated_text_gives_the_good_rows_or_a_message(logger, edits, good, tmp_path):
    whole = read_or_refused(tmp_path / "log.csv", good[logger].encode())
    columns = dict(zip(whole.names, whole.columns, strict=True))
    damaged = read_or_refused(tmp_path / "log.csv", mutated(good[logger].encode(), edits))
    for name, values in zip(damaged.names, damaged.columns, strict=True) if damaged else ():
        assert len(values) <= 60 + 5 * len(edits)
        if name and name in columns and values.dtype == float:
            strange = ~np.isin(values[np.isfinite(values)], columns[name])
            assert strange.sum() <= 2 * len(edits)


@SEVERAL
@given(edits=EDITS, kind=st.sampled_from(["npy", "npz", "parquet", "mat"]))
def test_a_mutated_stored_file_gives_a_table_or_a_message(edits, kind, rates, tmp_path):
    write = {
        "npy": lambda file: np.save(file, rates),
        "npz": lambda file: np.savez(file, gyro_dps=rates),
        "mat": lambda file: scipy.io.savemat(file, {"log": {"gyro_dps": rates}}),
        "parquet": pd.DataFrame(rates, columns=[*"xyz"]).to_parquet,
    }
    write[kind](buffer := io.BytesIO())
    log = read_or_refused(tmp_path / f"log.{kind}", mutated(buffer.getvalue(), edits))
    assert log is None or len(log.names) == len(log.columns)


@pytest.mark.parametrize(("logger", "delimiter"), [("dot", b","), ("general", b";")])
def test_an_edit_of_a_header_moves_no_column(logger, delimiter, good, tmp_path):
    data, path = good[logger].encode(), tmp_path / "log.csv"
    whole = read_or_refused(path, data)
    start = data.rindex(b"\n", 0, data.index(b"Acc_X")) + 1 if logger == "dot" else 0
    for at in range(start, data.index(b"\n", start), 2):
        for change in (data[:at] + data[at + 1 :], data[:at] + delimiter + data[at:]):
            log = read_or_refused(path, change)
            for number, name in enumerate(log.names if log else ()):
                if name and name in whole.names:
                    assert whole.names.index(name) == number, change[start : start + 200]
                    np.testing.assert_array_equal(log.columns[number], whole.columns[number])
