import copy
import hashlib
import logging
import os

import numpy as np
import pytest
import xarray as xr
from kedro.io import DatasetError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets import simulated_logs
from gyro_pipeline.datasets.recordings import Recordings
from gyro_pipeline.datasets.simulated_logs import SimulatedLogs
from gyro_pipeline.logs import Logs

NOISE, SPREAD = [3.0, 6.0, 12.0], [0.0, 50.0, 500.0]
MODEL = {"noise_mdps_rts": NOISE, "turn_on_spread_mdps": SPREAD, "unit_bias_dps": 3}
SENSOR = {"imus": 2, "recordings": 40, "train_recordings": 30, "samples": 400, "recording_s": 4}
WARM_UP = {"amplitude_mdps": 2000, "spread_mdps": 500, "time_constant_s": [0.5, 2]}


def simulated(folder, seed=1, sensor="dot", model=(), **changes):
    entry = SENSOR | {"simulated": MODEL | dict(model)} | changes
    return SimulatedLogs(sensor, {sensor: copy.deepcopy(entry)}, "simulated", str(folder), seed)


def recordings(source):
    """What was drawn, and all samples, of which no IMU lacks any."""
    logs = source.load()
    rates = np.array([entry.read().samples.T for entry in logs.entries], dtype=np.float32)
    shape = (logs.truth.sizes["imu"], logs.truth.sizes["recording"], *rates.shape[1:])
    labelled = (("imu", "recording", "axis", "sample"), rates.reshape(shape))
    splits = "recording", [entry.split for entry in logs.entries[: shape[1]]]
    drawn = logs.truth.assign_coords(split=splits).assign_attrs(rate_hz=logs.rate_hz)
    return drawn.assign(angular_rate=labelled)


def test_what_it_takes_to_simulate_a_sensor_is_named(tmp_path):
    for changes, words in (
        ({"imus": None, "simulated": None}, "dot has no files: .*globals.yml: imus, s"),
        ({"rate_hz": 90}, "rate_hz is 90, samples / recording_s 100; correct one"),
        ({"model": {"warm_up": WARM_UP | {"time_constant_s": [2, 1]}}}, "time_constant_s"),
    ):
        with pytest.raises(InputError, match=words):
            simulated(tmp_path, **changes)


def test_files_have_the_published_layout_and_changed_ones_are_refused(tmp_path):
    logs = simulated(tmp_path).load()
    written = {"dot_train.npy", "dot_test.npy", "dot_truth.nc", "dot_truth.nc.made.json"}
    assert set(os.listdir(tmp_path)) == written
    train, test = np.load(tmp_path / "dot_train.npy"), np.load(tmp_path / "dot_test.npy")
    assert (train.shape, test.shape) == ((30, 6, 400), (10, 6, 400))
    assert train.dtype == test.dtype == np.float32
    assert not (train[:10] == test).any()
    rate = recordings(simulated(tmp_path)).angular_rate
    np.testing.assert_array_equal(rate.sel(imu=2, recording=30, axis="x"), train[29, 3])
    np.testing.assert_array_equal(rate.sel(imu=2, recording=31, axis="z"), test[0, 5])
    assert [entry.split for entry in logs.entries] == 2 * [*["train"] * 30, *["test"] * 10]
    assert (logs.simulated, logs.source, logs.rate_hz) == (True, "simulated", 100)
    with pytest.raises(DatasetError, match="read only"):
        simulated(tmp_path).save(Logs("dot", "simulated", True, 100, []))
    np.save(tmp_path / "dot_test.npy", test + np.float32(0.001))
    with pytest.raises(DatasetError, match="changed since it was written"):
        simulated(tmp_path).load()


@pytest.mark.slow
def test_a_seed_gives_the_samples_that_it_always_gave_and_colour_reaches_them(tmp_path):
    coloured = {"flicker_mdps": 3, "lag1_correlation": -0.15}
    for colour, digests in (
        ({}, ["eec5e2778ced583b", "56e521b8166a3850"]),
        (coloured, ["3eead9cee4acff9f", "49168560a86be389"]),
    ):
        simulated(tmp_path, model=colour, recordings=3, train_recordings=2, samples=50).load()
        arrays = np.load(tmp_path / "dot_train.npy")[0], np.load(tmp_path / "dot_test.npy")
        found = [hashlib.sha256(array.tobytes()).hexdigest()[:16] for array in arrays]
        assert found == digests
    correlated = recordings(simulated(tmp_path / "a", model={"lag1_correlation": -0.3}))
    noise = (correlated.angular_rate - correlated.true_bias).values
    lag1 = (noise[..., 1:] * noise[..., :-1]).mean() / (noise**2).mean()
    assert lag1 == pytest.approx(-0.3, abs=0.02)


@pytest.mark.slow
def test_the_seed_and_the_settings_decide_the_draws_and_a_second_load_only_reads(tmp_path, caplog):
    caplog.set_level(logging.INFO, "gyro_pipeline")

    def stamps():
        files = (tmp_path / "a").iterdir()
        return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}

    first = recordings(simulated(tmp_path / "a"))
    before = stamps()
    for folder in ("a", "b"):
        xr.testing.assert_identical(recordings(simulated(tmp_path / folder)), first)
    assert stamps() == before
    other_sensor = simulated(tmp_path / "d", sensor="ng").load().truth
    assert (other_sensor.true_unit_bias != first.true_unit_bias).all()
    for changes in ({"seed": 2}, {"seed": 2, "recording_s": 8}):
        caplog.clear()
        new = recordings(simulated(tmp_path / "a", **changes))
        assert "since their settings have changed" in caplog.text
        fresh = recordings(simulated(tmp_path / f"fresh {len(changes)}", **changes))
        xr.testing.assert_identical(new, fresh)
        assert not (new.angular_rate == first.angular_rate).any()


def test_samples_are_drawn_biases_plus_noise_of_the_stated_model(tmp_path):
    logs = recordings(simulated(tmp_path))
    np.testing.assert_allclose(logs.true_noise, [3e-3, 6e-3, 12e-3], rtol=1e-12)
    np.testing.assert_allclose(logs.true_turn_on_spread, [0, 0.05, 0.5], rtol=1e-12)
    assert (abs(logs.true_unit_bias) <= 3).all()
    assert len(np.unique(logs.true_unit_bias)) == 6
    turn_on = logs.true_bias - logs.true_unit_bias
    assert (turn_on.sel(axis="x") == 0).all()
    # 80 draws: the standard deviation is known to about 8 %
    np.testing.assert_allclose(turn_on.std(("imu", "recording"))[1:], [0.05, 0.5], rtol=0.3)
    noise = logs.angular_rate - logs.true_bias
    sigma = logs.true_noise * np.sqrt(logs.rate_hz)
    # 32,000 samples an axis: 1 standard error is 0.4 %
    np.testing.assert_allclose(noise.std(("imu", "recording", "sample")), sigma, rtol=0.02)


def test_random_walk_and_warm_up_are_added_and_what_was_drawn_is_kept(tmp_path):
    added = {"noise_mdps_rts": [0.1] * 3, "random_walk_mdps_per_rts": 10, "warm_up": WARM_UP}
    logs = recordings(simulated(tmp_path, model=added))
    assert float(logs.true_random_walk) == pytest.approx(10e-3)
    assert float(logs.true_amplitude_mean) == pytest.approx(2)
    assert float(logs.true_amplitude_spread) == pytest.approx(0.5)
    assert logs.true_amplitude.dims == logs.true_time_constant.dims == logs.true_bias.dims
    # 240 draws: a mean is known to 3 %, a standard deviation to 5 %
    assert float(logs.true_amplitude.mean()) == pytest.approx(2, rel=0.06)
    assert float(logs.true_amplitude.std()) == pytest.approx(0.5, rel=0.15)
    assert 0.5 <= float(logs.true_time_constant.min()) < 0.52
    assert 1.98 < float(logs.true_time_constant.max()) <= 2
    time_s = xr.DataArray((np.arange(400) + 0.5) / 100, dims="sample")
    settling = logs.true_amplitude * np.exp(-time_s / logs.true_time_constant)
    walk = logs.angular_rate - logs.true_bias - settling
    # K sqrt(t) at the end and a quarter of the way
    ends = walk.isel(sample=[99, 399]).std(("imu", "recording", "axis"))
    np.testing.assert_allclose(ends, [10e-3, 20e-3], rtol=0.15)
    constant = simulated(tmp_path, model={"warm_up": WARM_UP | {"time_constant_s": 1.5}})
    assert set(np.ravel(constant.load().truth.true_time_constant)) == {1.5}


@pytest.mark.slow
@pytest.mark.parametrize("at", [(simulated_logs, "simulate_noise"), (Recordings, "save")])
def test_what_was_interrupted_is_not_there_and_is_written_again(tmp_path, monkeypatch, at):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    expected = recordings(simulated(tmp_path))
    with monkeypatch.context() as patch:
        patch.setattr(*at, interrupt)
        for folder in (tmp_path, tmp_path / "new"):
            with pytest.raises(KeyboardInterrupt):
                simulated(folder, seed=2).load()
    # the arrays of seed 2 may be there: the mark of seed 1 must not vouch for them
    assert not simulated(tmp_path / "new").exists()
    assert {path.suffix for path in (tmp_path / "new").iterdir()} <= {".npy"}
    xr.testing.assert_identical(recordings(simulated(tmp_path)), expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dot_test.npy", "dot_truth.nc"])
def test_a_missing_file_or_a_damaged_mark_is_made_again(tmp_path, name):
    expected = recordings(simulated(tmp_path))
    (tmp_path / name).unlink()
    xr.testing.assert_identical(recordings(simulated(tmp_path)), expected)
    (tmp_path / "dot_truth.nc").write_bytes(b"damaged")
    xr.testing.assert_identical(recordings(simulated(tmp_path)), expected)
