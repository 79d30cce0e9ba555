"""Types: what a file says, and how one is made from the pipeline's fits."""

import json
from importlib.resources import files

import numpy as np
import pytest

from gyro_pipeline.calibrator.device_types import read_type, type_names, type_of, type_of_models
from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import constant_bias


def models(devices, seconds=120, flicker=0.0):
    rng = np.random.default_rng(1)
    whites = 3e-3 * (1 + 0.1 * rng.standard_normal(devices))
    return [
        [constant_bias(seconds * 100, 100.0, NoiseFigures(w, flicker, 0.0), 0.0, 1e-3)] * 3
        for w in whites
    ]


def test_a_type_is_made_from_fits_and_read_again(tmp_path):
    content = type_of_models("bench", models(30), "30 devices of 120 s")
    (tmp_path / "types").mkdir()
    (tmp_path / "types/bench.json").write_text(json.dumps(content))
    kind = read_type("bench", tmp_path)
    np.testing.assert_allclose(kind.noise.white, 3e-3, rtol=0.03)
    np.testing.assert_allclose(kind.dps("turn_on_mdps"), 1e-3, rtol=1e-3)
    assert 25 < kind.noise_freedom < 100  # a spread of a tenth is worth 50
    assert type_names(tmp_path) == ["bench", "consumer", "dot", "memsense"]


def test_flicker_that_short_recordings_show_as_turn_on_spread_is_counted_once():
    """Recordings of 60 s leave flicker from 120 to 240 s in tau: B^2 ln(2) / pi."""
    content = type_of_models("bench", models(5, seconds=60, flicker=1e-3), "")
    expected = np.sqrt(1 - np.log(2) / np.pi)
    np.testing.assert_allclose(content["turn_on_mdps"], expected, rtol=1e-3)


def test_every_shipped_type_is_read_and_each_number_has_a_source():
    with pytest.raises(InputError, match="expected consumer, dot, memsense, got 'dott'"):
        read_type("dott")
    with pytest.raises(InputError, match=r"here: noise: unexpected keyword argument, got 3; corr"):
        type_of({"noise": 3}, "here")
    for path in (files("gyro_pipeline.calibrator") / "types").iterdir():
        content = json.loads(path.read_text())
        assert read_type(content["type"]).noise_freedom > 0
        numbers = {key for key in content if "_mdps" in key and key != "conflict_mdps"}
        assert numbers <= set(content["sources"]), path.name
