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
pytestmark = pytest.mark.slow


def forget():
    for remembered in (fingerprints.code_hash, fingerprints._parsed):
        remembered.cache_clear()


@pytest.fixture
def file(tmp_path, monkeypatch):
    path = tmp_path / "my_networks.py"
    path.write_text(NETWORK)
    monkeypatch.syspath_prepend(tmp_path)
    yield path
    forget()
    sys.modules.pop(path.stem, None)


def test_its_rows_differ_and_are_judged_and_its_code_counts(file, world, parameters, as_stored):
    estimators = parameters("smoke", **yaml.safe_load(LINES)).studies["augmentation"].estimators
    assert estimators[0] == CNN
    name = estimators[-1]
    own = replace(world, study=world.study.model_copy(update={"estimators": [name]}))
    fits = {fit.run.fingerprint: fit for fit in own.train()}
    made = [fit for fit in fits.values() if fit.run.params["estimator"] == name]
    assert len({fit.estimator.estimate(fit.example)[0].tobytes() for fit in made}) == 4
    for fit in made:
        assert list(fit.estimator.losses) == ["epoch", "learning_rate", "train_loss", "val_loss"]
        params = fit.run.params
        assert (params["width"], params["heads"], params["epochs"]) == (16, 2, 3)
        assert "channels" not in params
        assert fit.estimator.source.__module__ == file.stem
    for run in own.evaluate(as_stored(list(fits.values()))):
        gain, lo, hi = (run.metrics[f"accuracy_gain_pct{end}"] for end in ("", "_lo", "_hi"))
        assert np.isfinite([gain, lo, hi]).all()
    names = [CNN, name, f"{name} width=8"]
    several = replace(world, study=world.study.model_copy(update={"estimators": names}))
    before = several.fingerprints
    assert len(set(before.values())) == len(before)
    for text, expected in (
        (NETWORK + "\n# A remark.\n", set()),
        (NETWORK.replace("bias", "offset").replace(".mean(1)", ".amax(1)"), set(names[1:])),
    ):
        file.write_text(text)
        forget()
        after = replace(several).fingerprints
        assert {key[0] for key in before if before[key] != after[key]} == expected
