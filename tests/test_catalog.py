"""The configuration as the pipelines meet it: no dataset by accident in memory, no stray key."""

from functools import cache
from itertools import combinations
from pathlib import Path

import pytest
import yaml
from kedro.config import OmegaConfigLoader
from kedro.framework.startup import bootstrap_project
from kedro.io import CatalogConfigResolver

from gyro_pipeline import pipeline_registry
from gyro_pipeline.parameters import Only, Sensor, WarmUp
from gyro_pipeline.settings import CONFIG_LOADER_ARGS

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
ENVS = sorted(
    path.name for path in CONF.iterdir() if path.is_dir() and path.name not in ("base", "local")
)
STUDIES = {
    *("augmentation", "estimators", "first_windows", "input_channels", "leakage", "networks"),
    *("real2real", "sweep", "unseen_devices"),
}
PIPELINES = STUDIES | {"__default__", "ground_truth", "reporting", "virtual_gyros"}
MEMORY = "kedro.io.MemoryDataset"
SHARED = {"mlflow.db"}  # by all sources
PUBLISHED = "data/01_raw/published"  # files to read only, of two sources

# The package says so itself, but pytest sets filters of its own.
pytestmark = pytest.mark.filterwarnings("ignore:One or more dataset names contain")


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
    found = resolver(env)
    return name if name in found.config else found.match_dataset_pattern(name)


def entry(name, env="base"):
    return resolver(env).resolve_pattern(name)


@pytest.fixture(scope="module")
def registered(parameters):
    """Pipelines by environment."""
    bootstrap_project(ROOT)
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        for env in ("base", *ENVS):
            patch.setattr(pipeline_registry, "_selected", parameters(env))
            found[env] = pipeline_registry.register_pipelines()
    return found


def datasets_of(pipelines):
    names = set().union(*(pipeline.datasets() for pipeline in pipelines.values()))
    return sorted(name for name in names if not name.startswith("params:"))


def paths(env, names):
    """Where each dataset is stored."""
    found = {}
    for name in names:
        config = entry(name, env)
        path = config.get("filepath") or config.get("path")
        if path is not None:
            found[name] = path
    return found


# the catalog


@pytest.mark.parametrize("env", ["base", *ENVS])
def test_every_dataset_has_an_entry_and_a_path_of_its_own_with_the_source(registered, env):
    assert set(registered[env]) == PIPELINES
    names = datasets_of(registered[env])
    assert [name for name in names if entry_name(env, name) is None] == []
    source = configuration(env)["globals"]["source"]
    stored = paths(env, names)
    elsewhere = {path for path in stored.values() if source not in Path(path).parts}
    assert elsewhere == SHARED | ({PUBLISHED} if env == "published" else set())
    # what is read, and is there already, becomes the recordings in the end
    begun = (".raw_logs.files", ".raw_logs.earlier", ".raw_logs.inspected")
    files = [
        path for name, path in stored.items() if path != "mlflow.db" and not name.endswith(begun)
    ]
    assert len(files) == len(set(files)) > 5
    # only messages between nodes stay in memory, and the reference to the recordings
    kept = [name for name in names if entry(name, env)["type"] == MEMORY]
    assert all(".windowed_splits." in name for name in kept)
    for name in configuration(env)["catalog"] if env != "base" else ():  # it overrides entries
        assert name in names or name in configuration("base")["catalog"]


@pytest.mark.parametrize(
    "typo",
    [
        "sparkfun.ground_thruth.bias",
        "augmentation.sparkfun.training.run",
        "augmentation.sparkfun.windowed_splits.window",
        "augmentation.reporting.result",
        "reporting.table",
    ],
)
def test_a_typo_has_none(typo):
    assert entry_name("base", typo) is None


def test_every_parameter_and_every_pattern_is_used(registered):
    given = configuration("base")["parameters"]
    for pipeline in registered["base"].values():
        for name in pipeline.inputs():
            found = given
            for key in name.removeprefix("params:").split(".") if "params:" in name else ():
                assert key in found, name
                found = found[key]
    names = datasets_of(registered["base"])
    assert {entry_name("base", name) for name in names} == set(configuration("base")["catalog"])


def test_kedro_viz_shows_every_dataset_in_the_layer_of_its_stage(registered):
    for name in datasets_of(registered["base"]):
        assert entry(name)["metadata"]["kedro-viz"]["layer"] in name.split("."), name


def test_studies_that_take_long_are_pipelines_of_their_own(registered):
    pipelines = registered["base"]
    for study in ("estimators", "unseen_devices", "leakage"):
        assert f"{study}.memsense.evaluation.runs" in pipelines[study].all_outputs()
        for name in ("__default__", "reporting"):
            assert not [one for one in datasets_of({name: pipelines[name]}) if f"{study}." in one]


def test_a_studys_runs_are_narrowed_to_it_and_tracked_ones_are_not():
    runs = entry("real2real.ng.evaluation.runs")
    assert (runs["study"], runs["sensor"], runs["source"]) == ("real2real", "ng", "simulated")
    assert "study" not in entry("ng.training.tracked")


def test_sources_never_share_a_path(registered):
    names = datasets_of(registered["base"])
    by_source = {
        configuration(env)["globals"]["source"]: set(paths(env, names).values())
        for env in ("base", "smoke", "memsense_real", "published")
    }
    assert set(by_source) == {"simulated", "simulated_smoke", "published", "published_all"}
    for (one, theirs), (other, others) in combinations(by_source.items(), 2):
        both_published = one.startswith("published") and other.startswith("published")
        assert theirs & others == SHARED | ({PUBLISHED} if both_published else set())


# environments


def leaves(tree, place=()):
    """Places of all values that are no mappings."""
    if not isinstance(tree, dict):
        return {place}
    return set().union(*(leaves(value, (*place, key)) for key, value in tree.items()))


def additions(tree, base):
    """Keys of a tree that a base lacks; the keys of ``only`` and of sensors are their models'."""
    known = leaves(base) | {("only", key) for key in Only.model_fields}
    known |= {("sensors", name, key) for name in base["sensors"] for key in Sensor.model_fields}
    warm_up = {("simulated", "warm_up", key) for key in WarmUp.model_fields}
    known |= {("sensors", name, *key) for name in base["sensors"] for key in warm_up}
    return {place for place in leaves(tree) if place not in known}


@pytest.mark.parametrize("env", ENVS)
def test_an_environment_adds_no_key_that_base_lacks_and_no_file_that_is_not_read(env, parameters):
    assert {path.stem for path in (CONF / env).iterdir()} <= {"parameters", "globals", "catalog"}
    for kind in ("parameters", "globals"):
        path = CONF / env / f"{kind}.yml"
        given = yaml.safe_load(path.read_text()) if path.exists() else {}
        assert additions(given, dict(configuration("base")[kind])) == set()
    assert parameters(env).source == configuration(env)["globals"]["source"]
