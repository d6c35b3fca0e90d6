"""Tests of the notebook in the documentation: a kernel runs it, and its stored outputs are small and current."""

import json
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

from sgsst_core.features.network_weights import BackboneWeights

FILE = Path(__file__).resolve().parents[1] / "docs" / "notebook.ipynb"
#: Maximum size of the file in bytes.
LARGEST = 500_000


def outputs(notebook: Any) -> list[str]:
    """Return the texts of all outputs, and the types of images; omit the progress bar and the bytes of images."""
    texts = []
    for cell in notebook.cells:
        for each in cell.get("outputs", []):
            data = each.get("data", {})
            if each["output_type"] == "stream":
                texts.append(each["text"])
            elif "image/jpeg" in data:
                texts.append("image/jpeg")
            elif each["output_type"] == "execute_result":
                texts.append(data["text/plain"])
    return texts


def test_stored_outputs_are_small() -> None:
    assert FILE.stat().st_size < LARGEST
    assert outputs(nbformat.read(FILE, as_version=4)).count("image/jpeg") == 4


@pytest.mark.slow
def test_notebook_runs_and_gives_the_stored_outputs(vgg16_weights: BackboneWeights, tmp_path: Path) -> None:
    stored, notebook = (nbformat.read(FILE, as_version=4) for _ in range(2))
    client = NotebookClient(notebook, timeout=1200, kernel_name="python3", resources={"metadata": {"path": tmp_path}})
    client.execute()
    assert outputs(notebook) == outputs(stored)
    assert "all scales" in json.dumps(client.widget_state), "the progress bar is a widget"
