import importlib.util
from itertools import count

import numpy as np
import pytest

from gyro_pipeline.fingerprints import code_hash, data_hash, fingerprint

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
def hash_of(tmp_path):
    numbers = count()

    def make(*sources):
        modules = []
        for source in sources:
            path = tmp_path / f"module_{next(numbers)}.py"
            path.write_text(source)
            spec = importlib.util.spec_from_file_location(path.stem, path)
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            modules.append(module)
        return code_hash(modules)

    return make


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("    # pi r squared\n", ""),
        ("LIMIT = 3\n", "LIMIT = 3  # at most\n"),
        ('"""A module."""\n', ""),
        ('    """A box."""\n', '    """Another box.\n\n    With a story.\n    """\n'),
        ('        """Divide."""\n', ""),
        ('    """Of a disc."""\n', "    'Of a circle.'\n"),
        ('"""Of something."""\n', '"""Of something else."""\n'),
        ('"""Of something."""\n', ""),
        ("math.pi * radius**2", "(\n        math.pi * radius ** 2\n    )"),
        ("LIMIT = 3", "\n\n\nLIMIT  =  3"),
    ],
)
def test_comments_docstrings_and_layout_do_not_count(hash_of, old, new):
    assert old in CODE
    assert hash_of(CODE.replace(old, new)) == hash_of(CODE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("LIMIT = 3", "LIMIT = 4"),
        ("radius**2", "radius**3"),
        ("math.pi * radius", "math.pi + radius"),
        ("x: float = 2.0", "x: float = 2.5"),
        ("size = 1", "width = 1"),
        ("return x / self.size", "print(x)\n        return x / self.size"),
        ("return math.pi", "return 'pi' and math.pi"),
    ],
)
def test_code_counts(hash_of, old, new):
    assert old in CODE
    assert hash_of(CODE.replace(old, new)) != hash_of(CODE)


def test_every_module_counts(hash_of):
    assert hash_of(CODE, "x = 1") != hash_of(CODE)
    assert hash_of(CODE, "x = 1") != hash_of(CODE, "x = 2")


ARRAY = np.arange(24, dtype=np.float32).reshape(2, 3, 4)


def changed(index, value):
    array = ARRAY.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    "other",
    [
        changed((1, 2, 3), np.nextafter(np.float32(23), np.float32(24))),
        changed((0, 0, 0), -0.0),
        ARRAY.astype(np.float64),
        ARRAY.view(np.int32),
        ARRAY.reshape(3, 2, 4),
        ARRAY[:, ::-1],
        ARRAY[:1],
    ],
)
def test_data_hash_sees_values_shape_and_type(other):
    assert data_hash(other, ["x"]) != data_hash(ARRAY, ["x"])


def test_data_hash_sees_labels():
    assert data_hash(ARRAY, {"rate_hz": 10.0}) != data_hash(ARRAY, {"rate_hz": 20.0})
    assert data_hash(ARRAY, {"a": 1, "b": 2}) == data_hash(ARRAY, {"b": 2, "a": 1})


def test_data_hash_does_not_see_memory_layout():
    fortran, strided = np.asfortranarray(ARRAY), np.repeat(ARRAY, 2, axis=0)[::2]
    assert not fortran.flags.c_contiguous
    assert data_hash(fortran, []) == data_hash(strided, []) == data_hash(ARRAY, [])


def test_fingerprint_sees_content_and_not_its_order():
    content = {"window_s": 10.0, "training": {"epochs": 6, "roles": ["train", "test"]}}
    reordered = {"training": {"roles": ["train", "test"], "epochs": 6}, "window_s": 10.0}
    assert fingerprint(content) == fingerprint(reordered)
    for other in (
        content | {"window_s": 10.5},
        content | {"training": {"epochs": 6, "roles": ["test", "train"]}},
        content | {"code": "x"},
    ):
        assert fingerprint(other) != fingerprint(content)
