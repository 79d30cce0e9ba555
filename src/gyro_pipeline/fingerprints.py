"""Hashes that decide whether a result is still the result of its inputs."""

import ast
import hashlib
import importlib
import inspect
import json
import pkgutil
from collections.abc import Iterable
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

_DIGITS = 16


def data_hash(array: np.ndarray, labels: Any) -> str:
    """Hash of an array's values and labels."""
    described = json.dumps([array.shape, str(array.dtype), labels], sort_keys=True)
    digest = hashlib.sha256(described.encode())
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:_DIGITS]


def code_hash(modules: Iterable[ModuleType]) -> str:
    """Hash of what modules do: comments, docstrings and layout do not count."""
    digest = hashlib.sha256()
    for module in modules:
        tree = ast.parse(inspect.getsource(module))
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                node.body = [statement for statement in node.body if not _is_text(statement)]
        digest.update(ast.dump(tree).encode())
    return digest.hexdigest()[:_DIGITS]


@cache  # of what was imported, which does not change
def package_hash(package: ModuleType) -> str:
    """Hash of what all modules of a package do."""
    found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    return code_hash([package, *(importlib.import_module(module.name) for module in found)])


def fingerprint(content: Any) -> str:
    """Hash of anything that JSON can hold."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:_DIGITS]


def _is_text(statement: ast.stmt) -> bool:
    """Whether it is a docstring, be it of a module, a class, a function or a constant."""
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)
