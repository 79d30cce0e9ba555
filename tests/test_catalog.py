"""The configuration as the pipelines meet it: no dataset by accident in memory, no stray key."""

from functools import cache
from pathlib import Path

import pytest
import yaml
from kedro.config import OmegaConfigLoader
from kedro.framework.startup import bootstrap_project
from kedro.io import CatalogConfigResolver

from gyro_pipeline import pipeline_registry
from gyro_pipeline.settings import CONFIG_LOADER_ARGS

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
ENVS = sorted({path.name for path in CONF.iterdir() if path.is_dir()} - {"base", "local"})
STUDIES = {
    *("augmentation", "estimators", "first_windows", "input_channels", "leakage", "networks"),
    *("real2real", "sweep", "unseen_devices"),
}
PIPELINES = STUDIES | {"__default__", "ground_truth", "reporting", "virtual_gyros"}
MEMORY = "kedro.io.MemoryDataset"
SHARED = {"mlflow.db"}  # by all sources
PUBLISHED = "data/01_raw/published"  # files to read only, of two sources
KINDS = {
    "dot.raw_logs.files": "simulated_logs.SimulatedLogs",
    "dot.ground_truth.allan": "recordings.Recordings",
    "dot.ground_truth.bias": "tables.Table",
    "augmentation.dot.windowed_splits.windows": "tables.Table",
    "augmentation.dot.training.plan": "tables.Table",
    "augmentation.dot.training.runs": "tracked_runs.TrackedRuns",
    "reporting.report": "reports.ReportPage",
}
TYPOS = {
    *("sparkfun.ground_thruth.bias", "augmentation.sparkfun.training.run", "reporting.table"),
    *("augmentation.sparkfun.windowed_splits.window", "augmentation.reporting.result"),
}

# The package says so itself, but pytest sets filters of its own.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:One or more dataset names")]


@cache
def configuration(env):
    """Of an environment alone; what this machine has in conf/local stays out."""
    return OmegaConfigLoader(str(CONF), env=env, **CONFIG_LOADER_ARGS)


@cache
def resolver(env):
    # Typos must not fall through to Kedro's own pattern, which keeps anything in memory.
    return CatalogConfigResolver(configuration(env)["catalog"], {}, {"{default}": {"type": MEMORY}})


def entry_name(env, name):
    """The catalog entry or pattern that a dataset of this name gets; None if there is none."""
    catalog = resolver(env)
    return name if name in catalog.config else catalog.match_dataset_pattern(name)


def entry(name, env="base"):
    return resolver(env).resolve_pattern(name)


@pytest.fixture(scope="module")
def registered(parameters):
    """Pipelines by environment."""
    bootstrap_project(ROOT)
    pipelines = {}
    with pytest.MonkeyPatch.context() as patch:
        for env in ("base", *ENVS):
            patch.setattr(pipeline_registry, "_selected", parameters(env))
            pipelines[env] = pipeline_registry.register_pipelines()
    return pipelines


def datasets_of(pipelines):
    names = set().union(*(pipeline.datasets() for pipeline in pipelines.values()))
    return sorted(name for name in names if not name.startswith("params:"))


@pytest.mark.parametrize("env", ["base", *ENVS])
def test_every_dataset_has_an_entry_and_a_path_of_its_own_with_the_source(registered, env):
    assert set(registered[env]) == PIPELINES
    names = datasets_of(registered[env])
    assert [name for name in names if entry_name(env, name) is None] == []
    source = configuration(env)["globals"]["source"]
    entries, keys = {name: entry(name, env) for name in names}, ("filepath", "path")
    stored = {n: one[key] for n, one in entries.items() for key in keys if one.get(key)}
    elsewhere = {path for path in stored.values() if source not in Path(path).parts}
    assert elsewhere == SHARED | ({PUBLISHED} if env == "published" else set())
    # what is read, and is there already, becomes the recordings in the end
    begun = (".raw_logs.files", ".raw_logs.earlier", ".raw_logs.inspected")
    files = [path for n, path in stored.items() if path != "mlflow.db" and not n.endswith(begun)]
    assert len(files) == len(set(files)) > 5
    # only messages between nodes stay in memory, and the reference to the recordings
    kept = [name for name in names if entry(name, env)["type"] == MEMORY]
    assert all(".windowed_splits." in name for name in kept)
    for name in configuration(env)["catalog"] if env != "base" else ():  # it overrides entries
        assert name in names or name in configuration("base")["catalog"]


def test_names_get_their_own_kind_of_dataset_and_typos_none(registered):
    kinds = {name: entry(name)["type"].removeprefix("gyro_pipeline.datasets.") for name in KINDS}
    assert kinds == KINDS
    assert {entry_name("base", name) for name in TYPOS} == {None}
    for name in datasets_of(registered["base"]):  # kedro viz shows it in the layer of its stage
        assert entry(name)["metadata"]["kedro-viz"]["layer"] in name.split("."), name


def test_every_parameter_and_every_pattern_is_used(registered):
    given = configuration("base")["parameters"]
    for pipeline in registered["base"].values():
        for name in pipeline.inputs():
            value = given
            for key in name.removeprefix("params:").split(".") if "params:" in name else ():
                assert key in value, name
                value = value[key]
    names = datasets_of(registered["base"])
    assert {entry_name("base", name) for name in names} == set(configuration("base")["catalog"])


@pytest.mark.parametrize("env", ENVS)
def test_an_environment_has_keys_that_base_has_and_no_file_that_is_not_read(env, parameters):
    assert {path.stem for path in (CONF / env).iterdir()} <= {"parameters", "globals", "catalog"}
    path = CONF / env / "globals.yml"
    given = yaml.safe_load(path.read_text()) if path.exists() else {}
    assert set(given) <= set(configuration("base")["globals"])
    checked = parameters(env)  # which refuses stray keys, also those of sensors
    assert checked.source == configuration(env)["globals"]["source"]


def test_studies_that_take_long_are_pipelines_of_their_own(registered):
    pipelines = registered["base"]
    for study in ("estimators", "unseen_devices", "leakage"):
        assert f"{study}.memsense.evaluation.runs" in pipelines[study].all_outputs()
        for name in ("__default__", "reporting"):
            assert not [one for one in datasets_of({name: pipelines[name]}) if f"{study}." in one]
    for name, pipeline in pipelines.items():
        assert (name == "leakage") == any("leakage" in node.name for node in pipeline.nodes), name
