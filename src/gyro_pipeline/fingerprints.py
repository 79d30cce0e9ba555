"""Hashes that decide whether a result is still the result of its inputs."""

import ast
import hashlib
import importlib.util
import json
import sysconfig
from collections.abc import Iterable
from functools import cache
from importlib.metadata import packages_distributions, version
from pathlib import Path
from typing import Any

import numpy as np

_DIGITS = 16
_SOURCES = (".c", ".h", ".j2")
_THIS = __name__.partition(".")[0]


def data_hash(array: np.ndarray, labels: Any) -> str:
    """Hash of an array's values and labels."""
    described = json.dumps([array.shape, str(array.dtype), labels], sort_keys=True)
    digest = hashlib.sha256(described.encode())
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:_DIGITS]


def fingerprint(content: Any) -> str:
    """Hash of anything that JSON can hold."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:_DIGITS]


@cache  # of what was imported, which does not change
def code_hash(*entries: str) -> str:
    """Hash of what modules do, with all modules that they import, directly or not.

    Imports inside functions count; modules of Python and of installed packages do not. Neither do
    comments, docstrings and layout. C sources and templates that lie beside a module count as they
    are.

    Args:
        entries: ``package.module`` or ``package.module:Class``; of a package, all its modules.

    Raises:
        ModuleNotFoundError: There is no such module.
    """
    asked = [name for entry in entries for name in _members(entry.partition(":")[0])]
    contents = {name: _version(name).encode() for name in asked if _source(name) is None}
    for name, path in _imported(asked).items():
        package = _package(name, path)
        contents[name], _ = _parsed(path, package)
        beside = [file for file in path.parent.iterdir() if file.suffix in _SOURCES]
        contents |= {f"{package}/{file.name}": file.read_bytes() for file in beside}
    digest = hashlib.sha256()
    for name in sorted(contents):
        digest.update(b"\0".join([name.encode(), contents[name], b""]))
    return digest.hexdigest()[:_DIGITS]


def own_code(entry: str) -> list[Path]:
    """Files and folders of packages that a class needs, of neither this package nor installed ones.

    Args:
        entry: As for :func:`code_hash`.
    """
    tops = {name.partition(".")[0] for name in _imported([entry.partition(":")[0]])}
    return sorted({path for top in tops - {_THIS} for path in _roots(top)})


def _imported(names: Iterable[str]) -> dict[str, Path]:
    """The files of modules and of all that they import, directly or not, but installed ones."""
    paths, waiting = dict[str, Path](), [*names]
    while waiting:
        name = waiting.pop()
        path = _source(name)
        if path is not None and name not in paths:
            paths[name] = path
            package = _package(name, path)
            waiting += [package, *_parsed(path, package)[1]]
    return paths


def _package(name: str, path: Path) -> str:
    return name if path.name == "__init__.py" else name.rpartition(".")[0]


def _members(name: str) -> list[str]:
    """The module, and all modules in it if it is a package."""
    path = _source(name)
    if path is None and importlib.util.find_spec(name) is None:
        raise ModuleNotFoundError(f"no module {name!r}", name=name)
    if path is None:  # installed: its version counts
        return [name]
    inside = path.parent.rglob("*.py") if path.name == "__init__.py" else []
    parts = [file.relative_to(path.parent).with_suffix("").parts for file in inside]
    return [name, *(".".join([name, *part]) for part in parts if part[-1] != "__init__")]


def _version(name: str) -> str:
    """Name and version of the package that an installed module is of."""
    packages = packages_distributions().get(name.partition(".")[0], [])
    return ", ".join(f"{package} {version(package)}" for package in packages)


def _source(name: str) -> Path | None:
    """The file of a module, which is not imported; None of one that is installed or not there."""
    first, *rest = name.split(".")
    for path in _roots(first):
        if not rest and path.is_file():
            return path
        place = path.joinpath(*rest)
        for file in (place / "__init__.py", place.with_suffix(".py")):
            if file.is_file():
                return file
    return None


@cache
def _roots(name: str) -> tuple[Path, ...]:
    """The file of a module that is in no package, or the folders of a package; none if installed.

    This package counts wherever it is.
    """
    spec = importlib.util.find_spec(name) if name else None
    if spec is None:
        return ()
    folders = spec.submodule_search_locations
    found = [Path(place) for place in ([spec.origin] if folders is None else folders) if place]
    return tuple(path for path in found if name == _THIS or not _installed(path))


def _installed(path: Path) -> bool:
    """Whether it is of Python or of an installed package."""
    python = [Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")]
    of_python = any(path.is_relative_to(place) for place in python)
    return (
        of_python or not path.exists() or bool({"site-packages", "dist-packages"} & {*path.parts})
    )


@cache
def _parsed(path: Path, package: str) -> tuple[bytes, tuple[str, ...]]:
    """What a module does, without docstrings, and the full names of all that it imports.

    Names of attributes are among them, which are no modules.
    """
    tree, imported = ast.parse(path.read_text(encoding="utf-8")), []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")
            base = parents[: len(parents) - node.level + 1] if node.level else []
            module = ".".join([*base, *filter(None, [node.module])])
            imported += [module, *(f"{module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [statement for statement in node.body if not _is_text(statement)]
    return ast.dump(tree).encode(), tuple(imported)


def _is_text(statement: ast.stmt) -> bool:
    """Whether it is a docstring, be it of a module, a class, a function or a constant."""
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)
