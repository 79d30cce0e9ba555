"""The examples of docs/extending.md; that of a network is in pipelines/test_own_network.py."""

import re
from pathlib import Path

import numpy as np
import yaml

from gyro_pipeline.estimators import make_estimator
from gyro_pipeline.pipelines.assembly import assemble

TEXT = (Path(__file__).parents[2] / "docs" / "extending.md").read_text()


def example(heading, kind):
    section = TEXT.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    return re.search(rf"```{kind}\n(.*?)```", section, re.DOTALL)[1]


def test_the_estimator_is_halfway_between_window_and_training_recordings(
    tmp_path, monkeypatch, make_recordings, training_set, parameters
):
    (tmp_path / "my_estimators.py").write_text(example("An estimator", "python"))
    monkeypatch.syspath_prepend(tmp_path)
    studies = yaml.safe_load(example("An estimator", "yaml"))["studies"]
    name = studies["augmentation"]["estimators"][-1]
    bias = np.full((1, 4, 3), [0.1, -0.2, 0.3])
    recordings = make_recordings(bias, samples=500, rate_hz=10.0, noise_dps_rts=1e-4)
    fitted = make_estimator(name, parameters().training, 0).fit(training_set(recordings))
    biases, sigma = fitted.estimate(np.zeros((2, 3, 100)))
    np.testing.assert_allclose(biases, [[0.05, -0.1, 0.15]] * 2, atol=1e-4)
    assert np.isnan(sigma).all()


def test_the_sensor_and_the_study_are_pipelines(parameters):
    sensors = yaml.safe_load(example("A sensor", "yaml"))["sensors"]
    studies = yaml.safe_load(example("A study", "yaml"))["studies"]
    pipelines = assemble(parameters("base", sensors=sensors, studies=studies))
    names = {node.name.partition(".")[2] for node in pipelines["my_study"].nodes}
    assert {"train_my_study_dot", "write_report_my_study"} <= names
    assert not any("my_study" in node.name for node in pipelines["__default__"].nodes)
    assert any("device" in node.name for node in pipelines["ground_truth"].nodes)
