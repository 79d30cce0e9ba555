"""What documents name is there, links lead somewhere, and notebooks run without stored results."""

import re
import shutil
import subprocess
from pathlib import Path

import nbformat
import pytest
from markdown_it import MarkdownIt
from nbclient import NotebookClient

from gyro_pipeline.pipeline_registry import register_pipelines

PROJECT = Path(__file__).parents[1]
# names that a text leaves to its reader
PLACEHOLDERS = {"NAME", "mine", "my_study"}
FILES = [*sorted(PROJECT.glob("*.md")), PROJECT / "benchmarks" / "README.md"]  # MkDocs: docs/


def test_pipelines_environments_and_targets_that_a_text_names_are_there(monkeypatch):
    monkeypatch.chdir(PROJECT / "notebooks")  # the registry works from a subfolder as well
    make = ["make", "--silent", "-C", "..", "help"]
    told = subprocess.run(make, capture_output=True, text=True, check=True).stdout
    pages = [PROJECT / "README.md", PROJECT / "CONTRIBUTING.md", *(PROJECT / "docs").glob("*.md")]
    targets = set(re.findall(r"^([a-z-]+):", (PROJECT / "Makefile").read_text(), re.M))
    environments = {path.name for path in (PROJECT / "conf").iterdir()}
    pipelines = set(register_pipelines())
    for page, text in [(page.name, page.read_text()) for page in pages] + [("make help", told)]:
        for pattern, there in (
            (r"--pipelines?[= ](\w+)", pipelines),
            (r"--env[= ](\w+)", environments),
            (r"(?:^|`|\$ )make ([a-z-]+)", targets),
        ):
            assert set(re.findall(pattern, text, re.M)) - there <= PLACEHOLDERS, page
    assert [name for name in pipelines - {"__default__"} if name not in told] == []


def links(path):
    for block in MarkdownIt().enable("table").parse(path.read_text()):
        for token in block.children or ():
            if target := token.attrGet("href") or token.attrGet("src"):
                yield target


def anchors(path):
    headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-") for text in headings}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PROJECT)))
def test_relative_links_lead_to_a_file_and_a_heading(path):
    for target in links(path):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        page = (path.parent / name) if name else path
        assert page.exists(), target
        assert not anchor or anchor in anchors(page), target


@pytest.mark.filterwarnings("ignore")  # of another process, the kernel
@pytest.mark.parametrize(
    "path", sorted(PROJECT.glob("notebooks/*.ipynb")), ids=lambda path: path.stem
)
def test_a_notebook_is_stored_without_results_and_runs_on_the_smoke_environment(
    path, smoke, monkeypatch
):
    code = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert code
    assert [(cell.outputs, cell.execution_count) for cell in code] == [([], None)] * len(code)
    monkeypatch.setenv("KEDRO_ENV", "smoke")
    monkeypatch.setenv("PYTHONPATH", str(PROJECT / "src"))
    folder = smoke.project.folder / "notebooks"
    folder.mkdir(exist_ok=True)
    copy = nbformat.read(shutil.copy(path, folder), as_version=4)
    NotebookClient(copy, timeout=120, resources={"metadata": {"path": str(folder)}}).execute()
    outputs = [output for cell in copy.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert pictures
    assert "simulated" in str(copy.cells)
