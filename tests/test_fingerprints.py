import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import gyro_pipeline
from gyro_pipeline import fingerprints
from gyro_pipeline.fingerprints import code_hash, data_hash, fingerprint

ARRAY = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
CODE = '''"""A module."""

import math

LIMIT = 3
"""Of something."""


class Box:
    """A box."""

    size = 1

    def half(self, x: float = 2.0) -> float:
        """Divide."""
        return x / self.size


def area(radius):
    """Of a disc."""
    # pi r squared
    return math.pi * radius**2
'''


@pytest.fixture
def hash_of(tmp_path, monkeypatch):
    """The hash of a package of modules; those of the call before are gone."""
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "made_for_a_test"
    package.mkdir()

    def make(*sources):
        imports = [f"from . import part_{number}" for number in range(len(sources))]
        (package / "__init__.py").write_text("\n".join(imports))
        for number, source in enumerate(sources):
            (package / f"part_{number}.py").write_text(source)
        forget()
        return code_hash(package.name)

    yield make
    forget()


def forget():
    for remembered in (code_hash, fingerprints._parsed, fingerprints._roots):
        remembered.cache_clear()


EDITS = """
import pathlib, sys
from gyro_pipeline import fingerprints
from gyro_pipeline.fingerprints import code_hash

def hashed():
    for remembered in (code_hash, fingerprints._parsed, fingerprints._roots):
        remembered.cache_clear()
    return code_hash("strangers_estimator:Mine")

root, before = pathlib.Path(sys.argv[1]), hashed()
for path in sorted([*root.rglob("*.py"), *root.rglob("*.c")]):
    text = "/* another */" if path.suffix == ".c" else "\\nadded = 1\\n"
    kept = path.read_text()
    path.write_text(kept + text)
    if hashed() != before:
        print(path.relative_to(root).as_posix())
    path.write_text(kept)
assert hashed() == before
"""

STRANGER = """
from beside import helped
from gyro_pipeline.estimators.base import Estimator


class Mine(Estimator):
    def _fit(self, training):
        from gyro_pipeline.learning.jobs import run_training
"""


@pytest.mark.slow
def test_an_installed_module_counts_by_its_version(monkeypatch):
    forget()
    before = code_hash("numpy.linalg:norm")
    for installed, same in (("0.0.1", False), (np.__version__, True)):
        monkeypatch.setattr(fingerprints, "version", lambda _, installed=installed: installed)
        code_hash.cache_clear()
        assert (code_hash("numpy.linalg:norm") == before) == same
    forget()


def test_data_hash_sees_values_shape_type_and_labels_but_no_memory_layout():
    next_one, sign = ARRAY.copy(), ARRAY.copy()
    next_one[1, 2, 3] = np.nextafter(np.float32(23), np.float32(24))
    sign[0, 0, 0] = -0.0
    others = [next_one, sign, ARRAY.astype(np.float64), ARRAY.reshape(3, 2, 4), ARRAY[:, ::-1]]
    assert len({data_hash(other, []) for other in [ARRAY, *others]}) == 6
    assert data_hash(ARRAY, {"rate_hz": 10.0}) != data_hash(ARRAY, {"rate_hz": 20.0})
    assert data_hash(ARRAY, {"a": 1, "b": 2}) == data_hash(ARRAY, {"b": 2, "a": 1})
    fortran, strided = np.asfortranarray(ARRAY), np.repeat(ARRAY, 2, axis=0)[::2]
    assert data_hash(fortran, []) == data_hash(strided, []) == data_hash(ARRAY, [])


def test_fingerprint_sees_content_and_not_its_order():
    content = {"window_s": 10.0, "training": {"epochs": 6, "roles": ["train", "test"]}}
    reordered = {"training": {"roles": ["train", "test"], "epochs": 6}, "window_s": 10.0}
    assert fingerprint(content) == fingerprint(reordered)
    turned = {"training": {"epochs": 6, "roles": ["test", "train"]}}
    for change in ({"window_s": 10.5}, turned, {"code": "x"}):
        assert fingerprint(content | change) != fingerprint(content)


REMARKS = {
    "    # pi r squared\n": "",
    '"""A module."""\n': "",
    '    """A box."""\n': '    """Another box.\n\n    With a story.\n    """\n',
    '    """Of a disc."""\n': "    'Of a circle.'\n",
    '"""Of something."""\n': '"""Of something else."""\n',
    "math.pi * radius**2": "(\n        math.pi * radius ** 2\n    )",
}
CHANGES = {
    "LIMIT = 3": "LIMIT = 4",
    "radius**2": "radius**3",
    "x: float = 2.0": "x: float = 2.5",
    "return x / self.size": "print(x)\n        return x / self.size",
}


def test_code_of_every_module_counts_and_comments_docstrings_and_layout_do_not(hash_of):
    for old, new in (REMARKS | CHANGES).items():
        assert old in CODE
        assert (hash_of(CODE.replace(old, new)) == hash_of(CODE)) == (old in REMARKS)
    assert len({hash_of(CODE), hash_of(CODE, "x = 1"), hash_of(CODE, "x = 2")}) == 3
    with pytest.raises(ModuleNotFoundError, match="no module 'not_there'"):
        code_hash("not_there:Mine")


@pytest.mark.slow
def test_an_edit_of_any_module_that_is_imported_changes_the_hash_and_no_other(tmp_path):
    """Of a file outside the package, and of what it imports, also inside a function."""
    package, counted = Path(gyro_pipeline.__file__).parent, ["strangers_estimator.py", "beside.py"]
    parts = [package / part for part in ("", "estimators", "learning", "physics", "pipelines")]
    for path in [*(path for part in parts for path in part.glob("*.py")), *package.rglob("*.c")]:
        copied = tmp_path / "gyro_pipeline" / path.relative_to(package)
        copied.parent.mkdir(parents=True, exist_ok=True)
        copied.write_text(path.read_text())
    for name, text in zip(counted, (STRANGER, "import numpy, json\nhelped = 1\n"), strict=True):
        (tmp_path / name).write_text(text)
    (tmp_path / "unrelated.py").write_text("")
    command = [sys.executable, "-c", EDITS, str(tmp_path)]
    env = {"PYTHONPATH": str(tmp_path), "PATH": ""}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    counting = set(done.stdout.split())
    names = ["__init__", "conventions", "parameters", "units"]
    names += [f"estimators/{name}" for name in ("__init__", "base", "training_set")]
    names += [f"physics/{name}" for name in ("__init__", "allan", "bias")]
    inside = ("__init__", "jobs", "fused", "examples", "network", "packing", "trainer")
    names += [f"learning/{name}" for name in inside]
    expected = {f"gyro_pipeline/{name}.py" for name in names} | {"gyro_pipeline/learning/fused.c"}
    assert counting >= expected | set(counted)
    assert "unrelated.py" not in counting
    assert not {path for path in counting if path.startswith("gyro_pipeline/pipelines")}
    assert "gyro_pipeline/estimators/linear.py" not in counting
