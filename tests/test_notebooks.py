"""The notebooks of the documentation run from beginning to end, and display what they should."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path

import pytest

pytest.importorskip("nbformat", reason='needs pip install -e ".[notebook]"')
pytest.importorskip("nbclient", reason='needs pip install -e ".[notebook]"')
pytest.importorskip("ipykernel", reason='needs pip install -e ".[notebook]"')

import nbclient
import nbformat

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
BAR = re.compile(r'<progress max="([0-9.]+)" value="([0-9.]+)"')
NEEDED = {"data_to_parameters": ("sbi",), "search": ("cma",)}


def run(notebook, folder: Path) -> list[dict]:
    """Execute a notebook in a folder; all its outputs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the kernel's own libraries
        nbclient.NotebookClient(
            notebook,
            timeout=300,
            kernel_name="python3",
            resources={"metadata": {"path": str(folder)}},
            env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        ).execute()
    return [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]


def test_there_are_three():
    assert [path.stem for path in NOTEBOOKS] == ["colony", "data_to_parameters", "search"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_outputs_are_stored(path):
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            assert not cell.outputs and cell.execution_count is None


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path):
    for module in NEEDED.get(path.stem, ()):
        pytest.importorskip(module)
    outputs = run(nbformat.read(path, as_version=4), tmp_path)
    assert [o for o in outputs if o.output_type == "error"] == []
    kinds = [kind for o in outputs if "data" in o for kind in o.data]
    assert kinds.count("image/png") >= 2 and kinds.count("text/html") >= 2
    said = "".join(o.text for o in outputs if o.get("name") == "stderr")
    assert "Warning" not in said and "IProgress" not in said
    shown = [o.data.get("text/html", "") for o in outputs if "data" in o]
    bars = [BAR.search(html) for html in shown if "<progress" in html]
    # a search of two replicates may leave one colony of its budget
    assert bars and all(float(b[2]) > 0.9 * float(b[1]) for b in bars)
    assert not any(" object at 0x" in o.data.get("text/plain", "") for o in outputs if "data" in o)
