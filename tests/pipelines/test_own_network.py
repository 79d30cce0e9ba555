"""The network of docs/extending.md beside the paper's, from its two lines of configuration."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from gyro_pipeline import fingerprints
from gyro_pipeline.studies import CNN

TEXT = (Path(__file__).parents[2] / "docs" / "extending.md").read_text()
NETWORK, LINES = (
    re.search(rf"```{kind}\n(.*?)```", TEXT, re.DOTALL)[1] for kind in ("python", "yaml")
)


@pytest.fixture
def file(tmp_path, monkeypatch):
    path = tmp_path / "my_networks.py"
    path.write_text(NETWORK)
    monkeypatch.syspath_prepend(tmp_path)
    yield path
    sys.modules.pop(path.stem, None)


def test_its_rows_differ_and_have_curves_weights_and_intervals(
    file, world, parameters, as_stored, monkeypatch
):
    estimators = parameters("smoke", **yaml.safe_load(LINES)).studies["augmentation"].estimators
    assert estimators[0] == CNN
    name = estimators[1]
    study = world.study.model_copy(update={"estimators": [*estimators, f"{name} width=8"]})
    both = replace(world, study=study)
    fits = {fit.run.fingerprint: fit for fit in both.train()}
    assert len(fits) == 1 + 3 * 4
    own = [fit for fit in fits.values() if fit.run.params["estimator"] == name]
    estimates = {fit.estimator.estimate(fit.example)[0].tobytes() for fit in own}
    assert len(estimates) == 4
    for fit in own:
        assert list(fit.estimator.history) == ["epoch", "learning_rate", "train_loss", "val_loss"]
        params = fit.run.params
        assert (params["width"], params["heads"], params["epochs"]) == (16, 2, 3)
        assert "channels" not in params
        assert fit.estimator.source.__module__ == file.stem
    for run in both.evaluate(as_stored(list(fits.values()))):
        gain, lo, hi = (run.metrics[f"accuracy_gain_pct{end}"] for end in ("", "_lo", "_hi"))
        assert np.isfinite([gain, lo, hi]).all()
    before = both.fingerprints
    file.write_text(NETWORK.replace("bias", "offset").replace(".mean(1)", ".amax(1)"))
    for remembered in (fingerprints.code_hash, fingerprints._parsed):
        remembered.cache_clear()
    after = replace(both).fingerprints
    changed = {key[0] for key in before if before[key] != after[key]}
    assert changed == {name, f"{name} width=8"}
