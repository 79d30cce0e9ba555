"""What is loaded is what was written, whatever kind of file it is in."""

import errno
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from kedro.io import DatasetError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import remove_leftovers, replacing, require_room
from gyro_pipeline.datasets.recordings import Recordings
from gyro_pipeline.datasets.tables import Table

TABLE = pd.DataFrame({"imu": [1, 2], "bias_dps": [0.25, 0.5]})
ARRAY = xr.Dataset({"variance": ("time", np.arange(100.0))})
KINDS = {"bias.csv": (Table, TABLE), "windows.parquet": (Table, TABLE), "a.nc": (Recordings, ARRAY)}


@pytest.fixture(params=KINDS)
def stored(request, tmp_path):
    """A file of each kind, as saved."""
    kind, data = KINDS[request.param]
    dataset = kind(str(tmp_path / "new" / request.param))
    with pytest.raises(DatasetError, match="no such file; type kedro run"):
        dataset.load()
    assert dataset.state() is None
    dataset.save(data)
    assert dataset.load().equals(data)
    return dataset, data, dataset._filepath


def test_what_is_not_what_was_written_is_refused_and_can_be_made_again(stored):
    dataset, data, path = stored
    content, record = path.read_bytes(), path.with_name(f"{path.name}.made.json")
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 1
    for damage in (
        lambda: path.write_bytes(flipped),
        lambda: path.write_bytes(content[:-1]),
        record.unlink,
        lambda: record.write_text("{"),
    ):
        digest = dataset.state()
        damage()
        assert dataset.state() is None
        with pytest.raises(DatasetError, match="type kedro run, with the --env") as caught:
            dataset.load()
        assert isinstance(caught.value.__cause__, InputError)
        assert str(path) in str(caught.value)
        dataset.save(data)
        assert dataset.load().equals(data)
        assert (dataset.state() == digest) or path.suffix == ".nc"  # which may hold its time


def test_a_file_of_other_settings_or_sources_is_named(tmp_path):
    bias = Table(str(tmp_path / "bias.csv"))
    drawn = Recordings(str(tmp_path / "sub" / "drawn.nc"))
    settings = {"virtual_gyros": {"imus": 8, "seed": 1}, "ground_truth": {"tolerance_mdps": 5.0}}
    bias.settings = {"ground_truth": settings["ground_truth"]}
    drawn.settings, drawn.sources = {"virtual_gyros": settings["virtual_gyros"]}, [bias]
    drawn.check_made_with(settings)  # nothing is there
    bias.save(TABLE)
    drawn.save(ARRAY)
    drawn.check_made_with(settings | {"training": {"epochs": 3}})
    for changed, words in (
        ({"virtual_gyros": {"imus": 8, "seed": 2}}, "virtual_gyros.seed 1, .* 2; type kedro run"),
        ({"ground_truth": {"tolerance_mdps": 6.0}}, "bias.csv: .*tolerance_mdps 5.0, .* 6.0"),
        ({"virtual_gyros": {"imus": 8, "seed": 1, "x": 3}}, "virtual_gyros.x None, this run has 3"),
    ):
        with pytest.raises(InputError, match=words):
            drawn.check_made_with(settings | changed)
    drawn.check_made_with(settings)
    bias.save(TABLE + 1)
    with pytest.raises(InputError, match="drawn.nc: made from another .*bias.csv than there is"):
        drawn.check_made_with(settings)


def test_what_kills_left_is_removed_and_nothing_else(tmp_path):
    for name in (".bias.4711.csv", ".table.4711", ".gitkeep", "bias.4711.csv", ".hidden.csv"):
        (tmp_path / name).touch()
    assert remove_leftovers(tmp_path) == 2
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept == {".gitkeep", "bias.4711.csv", ".hidden.csv"}


def test_room_is_looked_for_before_a_large_file_is_written(tmp_path, monkeypatch):
    free = SimpleNamespace(free=10**6)
    monkeypatch.setattr("shutil.disk_usage", lambda _: free)
    require_room(tmp_path / "a.nc", 900_000)
    with pytest.raises(OSError, match="1.0 MB are needed") as caught:
        require_room(tmp_path / "a.nc", 10**6)
    assert caught.value.errno == errno.ENOSPC
    large = xr.Dataset({"rate": ("sample", np.zeros(10**6))})
    with pytest.raises(DatasetError, match="8.0 MB are needed"):
        Recordings(str(tmp_path / "a.nc")).save(large)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_write_leaves_the_old_file_and_what_is_in_the_way_is_named(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), replacing(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"table.csv": "old"}
    with pytest.raises(InputError, match=f"{path} is a file"), replacing(path / "sub" / "a.csv"):
        pass
    (tmp_path / "b.csv").mkdir()
    with pytest.raises(InputError, match="a folder has that name"), replacing(tmp_path / "b.csv"):
        pass


@pytest.fixture
def table(tmp_path):
    return Table(str(tmp_path / "new" / "bias.csv"))


def test_numbers_come_back_exactly(table):
    bits = np.random.default_rng(0).integers(0, 2**64, 20_000, dtype=np.uint64)
    values = bits.view(np.float64)
    values = np.append(values[~np.isnan(values)], [np.nan, 0.1, 5e-324, np.inf, -np.inf, -0.0])
    table.save(pd.DataFrame({"bias_dps": values}))
    back = table.load().bias_dps.to_numpy()
    np.testing.assert_array_equal(back.view(np.uint64)[:-6], values.view(np.uint64)[:-6])
    np.testing.assert_array_equal(back[-6:], values[-6:])
    assert np.signbit(back[-1])


def test_columns_keep_their_kinds_and_the_index_is_not_stored(table):
    data = pd.DataFrame(
        {"sensor": ["ng", "NA"], "imu": [1, 2], "real": [True, False], "bias_dps": [0.5, np.nan]},
        index=[7, 9],
    )
    table.save(data)
    pd.testing.assert_frame_equal(table.load(), data.reset_index(drop=True))
