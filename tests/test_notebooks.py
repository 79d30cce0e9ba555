"""The notebooks run from top to bottom on the smoke environment, and are stored without results."""

import shutil
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))

# The kernel is another process; what it is sent and how is not our concern.
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_stored_without_results_and_runs(path, smoke, monkeypatch):
    code = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert code
    assert [(cell.outputs, cell.execution_count) for cell in code] == [([], None)] * len(code)
    monkeypatch.setenv("KEDRO_ENV", "smoke")
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "src"))
    folder = smoke.project.folder / "notebooks"
    folder.mkdir(exist_ok=True)
    copy = nbformat.read(shutil.copy(path, folder), as_version=4)
    NotebookClient(copy, timeout=120, resources={"metadata": {"path": str(folder)}}).execute()
    outputs = [output for cell in copy.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert pictures
    assert "simulated" in str(copy.cells)
