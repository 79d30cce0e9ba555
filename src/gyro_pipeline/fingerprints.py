"""Hashes that decide whether a stored result is up to date."""

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
    header = json.dumps([array.shape, str(array.dtype), labels], sort_keys=True)
    digest = hashlib.sha256(header.encode())
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:_DIGITS]


def fingerprint(content: Any) -> str:
    """Hash of anything that JSON can hold."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:_DIGITS]


@cache  # the code does not change while it runs
def code_hash(*entries: str) -> str:
    """Hash of the code of modules and of all modules that they import, directly or not.

    Imports inside functions count. Python's own modules, installed packages, comments, docstrings
    and layout do not. C sources and templates beside a module count byte by byte.

    Args:
        entries: ``package.module`` or ``package.module:Class``; a package stands for all its
            modules.

    Raises:
        ModuleNotFoundError: A module does not exist.
    """
    names = [name for entry in entries for name in _members(entry.partition(":")[0])]
    contents = {name: _version(name).encode() for name in names if _source(name) is None}
    for name, path in _imported(names).items():
        package = _package(name, path)
        contents[name], _ = _parsed(path, package)
        sources = [file for file in path.parent.iterdir() if file.suffix in _SOURCES]
        contents |= {f"{package}/{file.name}": file.read_bytes() for file in sources}
    digest = hashlib.sha256()
    for name in sorted(contents):
        digest.update(b"\0".join([name.encode(), contents[name], b""]))
    return digest.hexdigest()[:_DIGITS]


def own_code(entry: str) -> list[Path]:
    """The user's files and package folders that a class needs, besides installed packages.

    Args:
        entry: The class, as for :func:`code_hash`.
    """
    tops = {name.partition(".")[0] for name in _imported([entry.partition(":")[0]])}
    return sorted({path for top in tops - {_THIS} for path in _roots(top)})


def _imported(names: Iterable[str]) -> dict[str, Path]:
    """The files of modules and of all modules that they import, without installed ones."""
    paths, queue = dict[str, Path](), [*names]
    while queue:
        name = queue.pop()
        path = _source(name)
        if path is not None and name not in paths:
            paths[name] = path
            package = _package(name, path)
            queue += [package, *_parsed(path, package)[1]]
    return paths


def _package(name: str, path: Path) -> str:
    return name if path.name == "__init__.py" else name.rpartition(".")[0]


def _members(name: str) -> list[str]:
    """The module itself and, if it is a package, all its modules."""
    path = _source(name)
    if path is None and importlib.util.find_spec(name) is None:
        raise ModuleNotFoundError(f"no module {name!r}", name=name)
    if path is None:  # of an installed package, whose version counts
        return [name]
    files = path.parent.rglob("*.py") if path.name == "__init__.py" else []
    parts = [file.relative_to(path.parent).with_suffix("").parts for file in files]
    return [name, *(".".join([name, *part]) for part in parts if part[-1] != "__init__")]


def _version(name: str) -> str:
    """Name and version of the installed package that has a module."""
    packages = packages_distributions().get(name.partition(".")[0], [])
    return ", ".join(f"{package} {version(package)}" for package in packages)


def _source(name: str) -> Path | None:
    """The file of a module, found without importing it; None if installed or non-existent."""
    first, *rest = name.split(".")
    for root in _roots(first):
        if not rest and root.is_file():
            return root
        stem = root.joinpath(*rest)
        for file in (stem / "__init__.py", stem.with_suffix(".py")):
            if file.is_file():
                return file
    return None


@cache
def _roots(name: str) -> tuple[Path, ...]:
    """The file of a top-level module or the folders of a package; empty if it is installed.

    This package is never taken as installed.
    """
    spec = importlib.util.find_spec(name) if name else None
    if spec is None:
        return ()
    folders = spec.submodule_search_locations
    paths = [Path(path) for path in ([spec.origin] if folders is None else folders) if path]
    return tuple(path for path in paths if name == _THIS or not _installed(path))


def _installed(path: Path) -> bool:
    """Whether a path is part of Python or of an installed package."""
    python = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib")]
    in_packages = not {"site-packages", "dist-packages"}.isdisjoint(path.parts)
    return in_packages or not path.exists() or any(map(path.is_relative_to, python))


@cache
def _parsed(path: Path, package: str) -> tuple[bytes, tuple[str, ...]]:
    """The syntax tree of a module without docstrings, and the full names that it imports.

    Some of these names are attributes of modules.
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
            node.body = [statement for statement in node.body if not _is_docstring(statement)]
    return ast.dump(tree).encode(), tuple(imported)


def _is_docstring(statement: ast.stmt) -> bool:
    """Whether a statement documents a module, a class, a function or a constant."""
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)
