"""Whether the tests notice mutations: a sign, a unit, a swapped axis, a leak, a stale fingerprint.

    python benchmarks/mutations.py [--tree FOLDER] [--table FILE] [--list] [WORDS ...]

Each mutation of ``mutations.toml`` names what it breaks, a text that stands once in the sources,
what takes its place, and the tests that should fail. They are run on a copy of the tree; where
all of them pass, the rest of their folders is tried. A failure counts only if the test passes
without the mutation, which is seen at the end. The program ends with 1 if a mutation was not caught
or has no place left.
"""

import argparse
import importlib
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PATIENCE_S = 900
PRELOADED = ("torch", "mlflow", "kedro.framework.session", "xarray", "scipy.stats", "allantools")
LEFT_OUT = shutil.ignore_patterns(".*_cache", "__pycache__", "data", "mlruns", "*.db", "*.egg-info")


class Mutation(NamedTuple):
    """A row of the table."""

    breaks: str
    text: str
    replacement: str
    tests: list[str]  # paths below tests

    def place(self, tree: Path) -> tuple[Path | None, str]:
        """The source file in which the text stands, or why there is none."""
        sources = [path for path in (tree / "src").rglob("*.*") if path.suffix in (".py", ".c")]
        counts = {path: path.read_text().count(self.text) for path in sorted(sources)}
        places = [path for path, count in counts.items() for _ in range(count)]
        if len(places) == 1:
            return places[0], ""
        return None, f"no such text: {self.text}" if not places else f"{len(places)} such texts"


def run_tests(tree: Path, tests: list[str], *options: str) -> list[str]:
    """Tests that fail, in a fork of this process, which has imported what takes long."""
    with tempfile.NamedTemporaryFile("w+") as output:
        arguments = ["-q", "-p", "no:cacheprovider", *options, *tests]
        child = multiprocessing.get_context("fork").Process(
            target=_run_pytest, args=(tree, arguments, output.name)
        )
        child.start()
        child.join(PATIENCE_S)
        if child.is_alive():
            child.kill()
            return [tests[0]]
        text = Path(output.name).read_text()
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+?::.*?|\S+\.py)(?: - .*)?$", text, re.M)
    if child.exitcode and not failed:
        raise SystemExit(f"pytest {' '.join(arguments)} in {tree}:\n{text}")
    return failed


def _run_pytest(tree: Path, arguments: list[str], output: str) -> None:
    os.chdir(tree)
    os.environ["PYTHONPATH"] = str(tree / "src")
    sys.path.insert(0, str(tree / "src"))
    with Path(output).open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        code = pytest.main(arguments)
        sys.stdout.flush()
    os._exit(code)


def paths_of(tests: list[str], tree: Path) -> list[str]:
    """Test files where they are now: those that moved are looked for by their name."""
    paths = []
    for name in tests:
        here = [tree / "tests" / name] if (tree / "tests" / name).exists() else []
        paths += here or sorted((tree / "tests").rglob(Path(name).name))
    return [str(path.relative_to(tree)) for path in paths]


def rest_of_folders(paths: list[str], tree: Path) -> list[str]:
    """The other test files of these files' folders."""
    folders = sorted({(tree / path).parent for path in paths})
    files = [str(file.relative_to(tree)) for of in folders for file in sorted(of.glob("test_*.py"))]
    return [file for file in files if file not in paths]


def noticed_by(mutation: Mutation, tree: Path) -> str:
    """The first test that fails with the mutation; empty if there is none."""
    named = paths_of(mutation.tests, tree)
    for tests in (named, rest_of_folders(named, tree)):
        if tests and (failed := run_tests(tree, tests, "-x")):
            return failed[0]
    return ""


def result_of(mutation: Mutation, tree: Path) -> tuple[str, str]:
    """The test that notices a mutation, and where it was made or why it was not."""
    path, problem = mutation.place(tree)
    if path is None:
        return "", problem
    source = path.read_text()
    path.write_text(source.replace(mutation.text, mutation.replacement))
    try:
        return noticed_by(mutation, tree), str(path.relative_to(tree / "src/gyro_pipeline"))
    finally:
        path.write_text(source)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tree", type=Path, default=ROOT, help="whose code and tests")
    parser.add_argument("--table", type=Path, default=Path(__file__).with_suffix(".toml"))
    parser.add_argument("--list", action="store_true", help="only show where each one is made")
    parser.add_argument("words", nargs="*", help="only mutations with one of these words")
    asked = parser.parse_args()
    rows = tomllib.loads(asked.table.read_text())["mutation"]
    mutations = [Mutation(**row) for row in rows]
    mutations = [m for m in mutations if any(w in m.breaks for w in asked.words or [""])]
    if asked.list:
        for mutation in mutations:
            print(f"{mutation.breaks}: {mutation.place(asked.tree)}")
            assert paths_of(mutation.tests, asked.tree), mutation.tests
        return 0
    for name in PRELOADED:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(shutil.copytree(asked.tree, Path(folder, "copy"), ignore=_ignored))
        tests = []
        for mutation in mutations:
            start = time.monotonic()
            test, place = result_of(mutation, tree)
            tests.append(test)
            seconds = f"{time.monotonic() - start:.0f} s"
            print(f"{mutation.breaks}\n    {place}: {test or 'NOT CAUGHT'} ({seconds})", flush=True)
        wrong = set(run_tests(tree, sorted({*tests} - {""})))
    for test in wrong:
        print(f"fails without a mutation as well: {test}")
    caught = sum(test not in {"", *wrong} for test in tests)
    print(f"{caught} of {len(mutations)} mutations are caught")
    return int(caught < len(mutations))


def _ignored(folder: str, names: list[str]) -> set[str]:
    """What a copy of a tree does not need; the package has a folder of datasets, not of data."""
    return LEFT_OUT(folder, names) | {name for name in names if name in (".git", ".venv")}


if __name__ == "__main__":
    sys.exit(main())
