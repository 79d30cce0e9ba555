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
from gyro_pipeline.parameters import Only, Sensor
from gyro_pipeline.settings import CONFIG_LOADER_ARGS

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
ENVS = sorted(
    path.name for path in CONF.iterdir() if path.is_dir() and path.name not in ("base", "local")
)
PIPELINES = {
    "__default__",
    "augmentation",
    "estimators",
    "ground_truth",
    "input_channels",
    "leakage",
    "real2real",
    "reporting",
    "unseen_devices",
    "virtual_gyros",
}
MEMORY = "kedro.io.MemoryDataset"
SHARED = {"mlflow.db", "data/08_reporting/report"}  # by all sources
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


@pytest.fixture
def pipelines(monkeypatch, parameters):
    def register(env="base"):
        bootstrap_project(ROOT)
        monkeypatch.setattr(pipeline_registry, "_selected", parameters(env))
        return pipeline_registry.register_pipelines()

    return register


def datasets_of(pipelines):
    names = set().union(*(pipeline.datasets() for pipeline in pipelines.values()))
    return sorted(name for name in names if not name.startswith("params:"))


def paths(env, names):
    """Where each dataset is stored."""
    found = {}
    for name in names:
        config = resolver(env).resolve_pattern(name)
        path = config.get("filepath") or config.get("path")
        if path is not None:
            found[name] = path
    return found


# the catalog


@pytest.mark.parametrize("env", ["base", *ENVS])
def test_every_dataset_of_every_pipeline_has_an_entry(pipelines, env):
    registered = pipelines(env)
    assert set(registered) == PIPELINES
    names = datasets_of(registered)
    assert len(names) > 10
    assert [name for name in names if entry_name(env, name) is None] == []


@pytest.mark.parametrize(
    "typo",
    [
        "sparkfun.ground_thruth.bias",
        "sparkfun.raw_logs.recording",
        "augmentation.sparkfun.training.run",
        "augmentation.reporting.result",
        "reporting.table.dataset_hours",
        "augmentation.sparkfun.windowed_splits.window",
        "recordings",
    ],
)
def test_a_typo_has_none(typo):
    assert entry_name("base", typo) is None


def test_every_parameter_that_a_node_asks_for_is_there(pipelines):
    given = configuration("base")["parameters"]
    wanted = {
        name.removeprefix("params:")
        for pipeline in pipelines().values()
        for name in pipeline.inputs()
        if name.startswith("params:")
    }
    assert "splits" in wanted
    for name in wanted:
        found = given
        for key in name.split("."):
            assert key in found, name
            found = found[key]


def test_every_pattern_is_used(pipelines):
    names = datasets_of(pipelines())
    assert {entry_name("base", name) for name in names} == set(configuration("base")["catalog"])


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("dot.raw_logs.files", "simulated_logs.SimulatedLogs"),
        ("dot.raw_logs.quality", "tables.Table"),
        ("dot.ground_truth.allan", "recordings.Recordings"),
        ("dot.ground_truth.bias", "tables.Table"),
        ("augmentation.dot.windowed_splits.windows", "tables.Table"),
        ("augmentation.dot.training.plan", "tables.Table"),
        ("augmentation.dot.training.runs", "tracked_runs.TrackedRuns"),
        ("augmentation.reporting.tables.results", "reports.ReportTable"),
        ("estimators.reporting.figures.ng", "reports.ReportFigure"),
        ("reporting.folder", "report_page.ReportFolder"),
        ("reporting.tables.dataset_hours", "reports.ReportTable"),
        ("reporting.figures.allan_deviation", "reports.ReportFigure"),
    ],
)
def test_names_get_their_own_kind_of_dataset(name, kind):
    assert resolver("base").resolve_pattern(name)["type"] == f"gyro_pipeline.datasets.{kind}"


def test_kedro_viz_shows_every_dataset_in_the_layer_of_its_stage(pipelines):
    for name in datasets_of(pipelines()):
        layer = resolver("base").resolve_pattern(name)["metadata"]["kedro-viz"]["layer"]
        assert layer in name.split("."), name


def test_data_that_a_report_may_lack_name_the_pipeline_that_makes_them(pipelines):
    registered = pipelines()
    reports = registered["reporting"].inputs()
    kinds = (".training.plan", ".raw_logs.recordings", ".ground_truth.allan", ".quality")
    stored = [name for name in reports if name.endswith(kinds)]
    assert {"ng.ground_truth.allan", "augmentation.dot.training.plan"} <= set(stored)
    for name in stored:
        sensor = name.split(".")[-3]
        made_by = resolver("base").resolve_pattern(name)["made_by"]
        pipeline, only = made_by.removeprefix("kedro run --pipeline=").split(" --params=")
        assert only == f"only.sensor={sensor}"
        assert name in registered[pipeline].all_outputs()


def test_the_estimators_are_a_pipeline_of_their_own(pipelines):
    registered = pipelines()
    study = "estimators.sparkfun.evaluation.runs"
    assert study in registered["estimators"].all_outputs()
    for name in ("__default__", "reporting"):
        assert not {one for one in datasets_of({name: registered[name]}) if "estimators." in one}


def test_a_studys_runs_are_narrowed_to_it_and_tracked_ones_are_not():
    runs = resolver("base").resolve_pattern("real2real.ng.evaluation.runs")
    assert (runs["study"], runs["sensor"], runs["source"]) == ("real2real", "ng", "simulated")
    tracked = resolver("base").resolve_pattern("ng.training.tracked")
    assert "study" not in tracked
    assert tracked["sensor"] == "ng"
    everywhere = resolver("base").resolve_pattern("real2real.reporting.all_runs")
    assert everywhere["study"] == "real2real"
    assert not {"sensor", "source"} & set(everywhere)


@pytest.mark.parametrize("env", ["base", *ENVS])
def test_every_stored_path_has_the_source_and_a_name_of_its_own(pipelines, env):
    source = configuration(env)["globals"]["source"]
    stored = paths(env, datasets_of(pipelines(env)))
    elsewhere = {path for path in stored.values() if source not in Path(path).parts}
    assert elsewhere == SHARED | ({PUBLISHED} if env == "published" else set())
    # what is read, and is there already, becomes the recordings in the end
    begun = (".raw_logs.files", ".raw_logs.earlier", ".raw_logs.inspected")
    files = [
        path for name, path in stored.items() if path != "mlflow.db" and not name.endswith(begun)
    ]
    assert len(files) > 5
    assert len(files) == len(set(files))
    for name, path in stored.items():
        assert path == "mlflow.db" or path.startswith("data/0"), name


def test_sources_never_share_a_path(pipelines):
    by_source = {
        configuration(env)["globals"]["source"]: set(paths(env, datasets_of(pipelines())).values())
        for env in ("base", "smoke", "memsense_real", "published")
    }
    assert set(by_source) == {"simulated", "simulated_smoke", "published", "published_all"}
    for (one, theirs), (other, others) in combinations(by_source.items(), 2):
        both_published = one.startswith("published") and other.startswith("published")
        assert theirs & others == SHARED | ({PUBLISHED} if both_published else set())


@pytest.mark.parametrize("env", ["base", *ENVS])
def test_only_messages_between_nodes_stay_in_memory(pipelines, env):
    names = datasets_of(pipelines(env))
    kept = {name for name in names if resolver(env).resolve_pattern(name)["type"] == MEMORY}
    assert kept
    cut = {name for name in kept if ".windowed_splits." in name}  # a reference to the recordings
    assert all(".reporting.gaps." in f".{name}" for name in kept - cut)


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
    return {place for place in leaves(tree) if place not in known}


def files_of(env, kind):
    """Everything that an environment says, its files merged; as it is written."""
    merged = {}
    for path in [*(CONF / env).glob(f"{kind}*.yml"), *(CONF / env).glob(f"{kind}*/**/*.yml")]:
        merged |= yaml.safe_load(path.read_text()) or {}
    return merged


def test_the_environments_are_there():
    assert set(ENVS) >= {"smoke", "full", "memsense_real", "published"}


@pytest.mark.parametrize("kind", ["parameters", "globals"])
@pytest.mark.parametrize("env", ENVS)
def test_an_environment_adds_no_key_that_base_lacks(env, kind):
    given, base = files_of(env, kind), dict(configuration("base")[kind])
    assert additions(given, base) == set()


@pytest.mark.parametrize("env", ENVS)
def test_an_environment_says_something_in_files_that_are_read(env):
    assert {path.name for path in (CONF / env).iterdir()} <= {
        "parameters.yml",
        "globals.yml",
        "catalog.yml",
    }
    assert files_of(env, "parameters")


def test_an_added_key_is_seen():
    base = configuration("base")["parameters"]
    assert additions({"training": {"epoch": 3}}, base) == {("training", "epoch")}
    assert additions({"only": {"sensor": "dot", "gyros": 3}}, base) == {("only", "gyros")}
    assert additions({"training": {"epochs": 3}, "seeds": [1]}, base) == set()


def test_an_environments_catalog_overrides_entries_of_its_pipelines(pipelines):
    for env in ENVS:
        names = datasets_of(pipelines(env))
        for entry in files_of(env, "catalog"):
            assert entry in names or entry in configuration("base")["catalog"], entry


@pytest.mark.parametrize("env", ["base", *ENVS])
def test_every_environment_is_a_usable_configuration(parameters, env):
    assert parameters(env).source == configuration(env)["globals"]["source"]
