import os
import pickle
import shutil
import tracemalloc
from dataclasses import replace

import h5py
import numpy as np
import pytest
import xarray as xr
from xarray.backends.file_manager import FILE_CACHE

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.recordings import InspectedRecordings, Recordings
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import KEPT, Finding, Listing, Recording


def made(samples=50, offset=0.0):
    rate = np.arange(2 * 3 * 3 * samples, dtype=np.float32).reshape(2, 3, 3, samples) + offset
    rate[1, 2] = np.nan
    data = {
        "angular_rate": (("imu", "recording", "axis", "sample"), rate, {"units": "deg/s"}),
        "settles_after": ("recording", [1.5, np.nan, 3.0], {"units": "s"}),
        "count": ("recording", [1, 2, 3]),
    }
    coords = {"imu": [1, 2], "recording": [1, 2, 3], "axis": ["x", "y", "z"]}
    coords["given_split"] = ("recording", ["train", "train", "test"])
    return xr.Dataset(data, coords, {"sensor": "dot", "simulated": 1, "rate_hz": 108.25})


def kept(tmp_path):
    return Recordings(str(tmp_path / "new" / "dot.nc"))


def test_round_trip_is_identical_and_open_readers_keep_what_they_opened(tmp_path):
    kept(tmp_path).save(made())
    old = kept(tmp_path).load()
    xr.testing.assert_identical(old, made())
    for name, variable in made().variables.items():
        assert old[name].dtype == variable.dtype
    types = {name: type(value) for name, value in old.attrs.items()}
    assert types == {"sensor": str, "simulated": int, "rate_hz": float}
    assert sorted(os.listdir(tmp_path / "new")) == ["dot.nc", "dot.nc.made.json"]
    new = old + 1
    new["count"] = new["count"].copy(data=[0.5, 1.5, 2.5])  # was stored as integers
    kept(tmp_path).save(new)
    np.testing.assert_array_equal(kept(tmp_path).load().angular_rate, made().angular_rate + 1)
    assert kept(tmp_path).load()["count"].values.tolist() == [0.5, 1.5, 2.5]
    np.testing.assert_array_equal(old.angular_rate, made().angular_rate)
    FILE_CACHE.clear()  # as in another process
    with pytest.raises(InputError, match="replaced or changed since this run loaded it"):
        pickle.loads(pickle.dumps(old)).angular_rate.load()


def test_values_stay_in_the_file_and_pickles_refer_to_it(tmp_path):
    kept(tmp_path).save(made(samples=100_000))  # 7 MB
    tracemalloc.start()
    back = kept(tmp_path).load()
    assert tracemalloc.get_traced_memory()[1] < 2e6
    tracemalloc.stop()
    assert float(back.angular_rate.sum()) > 0
    window = back.angular_rate.sel(imu=1, axis="y").isel(sample=slice(10, 12))
    for lazy in (back, window):
        assert len(pickle.dumps(lazy)) < 20_000
    expected = made(100_000).angular_rate[0, :, 1, 10:12]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(window)), expected)


def recording(imu, number, samples=100, **changes):
    rates = np.random.default_rng(100 * imu + number).normal(size=(3, samples)).astype(np.float32)
    given = {
        **{"imu": imu, "recording": number, "where": f"{imu}_{number}.csv", "key": f"k{number}"},
        **{"outcome": KEPT, "findings": (Finding("time", KEPT, "jitter of 3 ms"),)},
        **{"rows": samples + 5, "start": 5, "stop": samples + 5},
        "content": data_hash(rates, None),
        "variables": {"angular_rate": rates},
    }
    return Recording(**given | changes)


def reading(tmp_path):
    return InspectedRecordings(str(tmp_path / "dot.nc"))


def listing(*recordings):
    return Listing({one.labels: one.key for one in recordings})


def described(one):
    return replace(one, variables={})


def test_recordings_come_back_without_their_samples_by_imu_and_number(tmp_path):
    warm = {"temperature_c": np.arange(100, dtype=np.float32)}
    ones = [recording(1, 7), recording(2, 7, samples=150, rate_hz=99.5), recording(2, 9)]
    ones[2] = replace(ones[2], variables=ones[2].variables | warm)
    assert reading(tmp_path).load() == []
    reading(tmp_path).save(listing(*ones))
    for one in reversed(ones):  # in any order
        reading(tmp_path).save(one)
    assert reading(tmp_path).load() == [described(one) for one in ones]
    assert [path.name for path in tmp_path.iterdir()] == ["dot.unfinished.nc"]
    lengths = xr.DataArray([[100, 0], [150, 100]], {"imu": [1, 2], "recording": [7, 9]})
    final = Recordings(str(tmp_path / "dot.nc"))
    final.save(xr.Dataset({"samples": lengths}, attrs={"sensor": "dot", "rate_hz": 10.0}))
    back = final.load()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dot.nc", "dot.nc.made.json"]
    assert set(back.data_vars) == {"samples", "angular_rate", "temperature_c"}
    assert back.attrs == {"sensor": "dot", "rate_hz": 10.0}
    assert (back.angular_rate.units, back.temperature_c.units) == ("deg/s", "degrees Celsius")
    for one in ones:
        stored = back.sel(imu=one.imu, recording=one.recording)
        for name, values in one.variables.items():
            np.testing.assert_array_equal(stored[name][..., : values.shape[-1]], values)
            assert np.isnan(stored[name][..., values.shape[-1] :]).all()
    assert np.isnan(back.angular_rate.sel(imu=1, recording=9)).all()


def test_a_damaged_unfinished_file_is_begun_anew(tmp_path, size=5000):
    one = recording(1, 1, samples=2000)
    reading(tmp_path).save(listing(one))
    reading(tmp_path).save(one)
    path = tmp_path / "dot.unfinished.nc"
    path.write_bytes(path.read_bytes()[:size])
    assert reading(tmp_path).load() == []
    reading(tmp_path).save(listing(one))
    reading(tmp_path).save(one)
    assert reading(tmp_path).load() == [described(one)]
    content = path.read_bytes()
    assert content.count(b'"rows": 2005') == 1
    path.write_bytes(content.replace(b'"rows": 2005', b'"rows": 2006'))  # a changed digit
    assert reading(tmp_path).load() == []
    path.write_bytes(content)
    with h5py.File(path, "r+") as file:
        file["angular_rate"][0, 0, 0, 50] = 7.0  # as a process that is killed may leave it
    reading(tmp_path).save(listing(one))
    assert reading(tmp_path).load() == []
    path.write_bytes(content)
    changed = replace(one, key="of a changed source")
    for listed, kept in ((one, [described(one)]), (changed, [])):
        reading(tmp_path).save(listing(listed))
        assert reading(tmp_path).load() == kept


def test_a_process_that_is_killed_loses_the_last_second_at_most(tmp_path, monkeypatch):
    now, growing = [5.0], reading(tmp_path)
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    ones = [recording(1, number) for number in range(1, 5)]
    growing.save(listing(*ones))
    for one, seconds, there in zip(ones, (0, 0.5, 0.6, 0.1), (1, 1, 3, 3), strict=True):
        now[0] += seconds
        growing.save(one)
        (tmp_path / "killed").mkdir(exist_ok=True)
        shutil.copy(tmp_path / "dot.unfinished.nc", tmp_path / "killed")
        assert reading(tmp_path / "killed").load() == [described(one) for one in ones[:there]]
    assert growing.load() == [described(one) for one in ones]
