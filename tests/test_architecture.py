"""Imports point one way; read from the source, so that imports inside functions count as well."""

import ast
import sys
from functools import cache
from pathlib import Path

import gyro_pipeline

PACKAGE = Path(gyro_pipeline.__file__).parent
NAME = "gyro_pipeline"
STAGES = [path.name for path in (PACKAGE / "pipelines").iterdir() if (path / "nodes.py").exists()]

# What the modules of each part may import of this package, besides their own part.
WORDS = dict.fromkeys(("conventions", "fingerprints", "units", "markup", "pipelines"), "")
WORDS |= dict.fromkeys(("__init__", "__main__"), "")
WORDS |= dict.fromkeys(("logs", "physics", "boundary", "run_lock", "store"), "conventions")
WORDS |= {
    "parameters": "conventions units",
    "executors": "conventions parameters",
    "studies": "conventions estimators parameters",
    "readers": "conventions logs parameters units",
    "tracking": "conventions estimators",
    "estimators": "conventions executors learning parameters physics",
    "quality": "conventions logs parameters physics",
    "calibrator": "__init__ conventions parameters physics quality readers units",
    "recordings": "conventions fingerprints logs physics",
    "splits": "conventions parameters",
    "windows": "conventions physics",
    "scoring": "conventions physics windows",
    "learning": "conventions executors parameters physics",
    "datasets": "conventions estimators fingerprints logs markup parameters physics readers "
    "tracking",
    "pipeline_registry": "parameters pipelines.assembly",
    "runner": "conventions datasets estimators fingerprints",
    "session": "boundary conventions parameters pipeline_registry run_lock runner",
    "hooks": "boundary conventions datasets parameters session studies",
    "settings": "hooks session",
}
OF_A_STAGE = (
    "conventions estimators executors fingerprints learning logs markup parameters "
    "physics quality recordings scoring splits studies tracking windows"
)
ALLOWED = {part: set(words.split()) for part, words in WORDS.items()}
ALLOWED |= {f"pipelines.{stage}": set(OF_A_STAGE.split()) for stage in STAGES}
STAGE_PARTS = {f"pipelines.{stage}" for stage in STAGES}
ALLOWED["pipelines.assembly"] = {"parameters", "pipelines", "studies"} | STAGE_PARTS


@cache
def imported(source, package, at_import=False):
    """Full names of all that a module of ``package`` imports, or only when it is imported."""
    names = set()
    nodes = [ast.parse(source)]
    while nodes:
        node = nodes.pop()
        deferred = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        if at_import and deferred:
            continue
        nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*(parents if node.level else []), *filter(None, [node.module])])
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def part_of(name):
    """The part of the package that a full name lies in; None for other packages."""
    if name.split(".")[0] != NAME:
        return None
    inner = [word for word in name.split(".")[1:] if word]
    for length in (2, 1):
        if ".".join(inner[:length]) in ALLOWED:
            return ".".join(inner[:length])
    return inner[0] if inner else "__init__"


def modules():
    """Dotted name, enclosing package and source of every module."""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = [NAME, *path.relative_to(PACKAGE).with_suffix("").parts]
        package = ".".join(parts[:-1])
        dotted = package if parts[-1] == "__init__" and len(parts) > 2 else ".".join(parts)
        yield dotted, package, path.read_text()


MODULES = {name: (package, source) for name, package, source in modules()}


def names_of(part, at_import=False):
    """What each module of a part imports."""
    return {
        name: imported(source, package, at_import)
        for name, (package, source) in MODULES.items()
        if part_of(name) == part or part_of(name).startswith(f"{part}.")
    }


def roots(names):
    return {name.split(".")[0] for name in names}


def violations(name, package, source):
    """Imports that point the wrong way."""
    own = part_of(name)
    targets = {target: part_of(target) for target in imported(source, package)}
    allowed = {None, own} | ALLOWED.get(own, set())
    return {target for target, part in targets.items() if part not in allowed}


def test_imports_point_one_way_between_seven_stages_and_all_else():
    stages = "raw_logs ground_truth virtual_gyros windowed_splits training evaluation reporting"
    assert sorted(STAGES) == sorted(stages.split())
    assert {part_of(name) for name in MODULES} == set(ALLOWED)
    wrong = {name: violations(name, *MODULES[name]) for name in MODULES}
    assert {name: targets for name, targets in wrong.items() if targets} == {}


def test_an_import_of_the_wrong_direction_is_seen():
    for name, source in (
        ("physics.bias", "from gyro_pipeline.parameters import Sensor"),
        ("learning.trainer", "from ..tracking import StoredRun"),
        ("datasets.recordings", "def load():\n    from gyro_pipeline import learning"),
        ("pipelines.training.nodes", "from ..raw_logs.nodes import label_recordings"),
    ):
        dotted = f"{NAME}.{name}"
        assert violations(dotted, dotted.rpartition(".")[0], source)


def test_what_the_parts_need_beside_numpy():
    """Neither the science nor nodes know Kedro and MLflow, and what starts slowly comes late."""
    needed = {
        "physics": "scipy allantools threadpoolctl",
        "quality.rest": "",
        # matplotlib for --plot and pyserial for --port
        "calibrator": "click filelock platformdirs pydantic scipy matplotlib serial",
    }
    for part, packages in needed.items():
        modules = {n: own for n, own in names_of(part.split(".")[0]).items() if f".{part}" in n}
        assert modules
        for name, own in modules.items():
            assert roots(own) <= {NAME, "numpy", *packages.split(), *sys.stdlib_module_names}, name
    for part in ("scoring", "quality", "estimators", "learning", "pipelines"):
        for name, own in names_of(part).items():
            wiring = part == "pipelines" and not name.endswith(".nodes")
            unknown = {"mlflow"} if wiring else {"kedro", "kedro_datasets", "mlflow"}
            assert not roots(own) & unknown, name
    late = {"calibrator": {"matplotlib", "serial", "scipy", "pydantic"}, "datasets": {"torch"}}
    for part, packages in late.items():
        for name, own in names_of(part, at_import=True).items():
            assert not roots(own) & packages, name
    for package, part in (("mlflow", "datasets"), ("torch", "learning")):
        users = {n for n, (p, source) in MODULES.items() if package in roots(imported(source, p))}
        assert {part_of(name) for name in users} == {part}
