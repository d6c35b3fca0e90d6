"""Tests of the LichtFeld Studio plugin with a stand-in of its published Python API, and of its manifests."""

import importlib
import json
import sys
import threading
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx2
import numpy as np
import pytest

from api.integrations.build import build
from sgsst_core.files.scene_file import read_scene
from tests.api.integrations.lichtfeld_stand_in import Studio, Ui
from tests.api.service import ROOT, Service, wait_for
from tests.small_scenes import wall

FOLDER = ROOT / "api" / "integrations" / "lichtfeld"


@pytest.fixture
def studio() -> Studio:
    return Studio(wall(sh_degree=1))


@pytest.fixture
def plugin(studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Load the built plugin from LichtFeld Studio's folder of plugins."""
    with zipfile.ZipFile(build("lichtfeld", tmp_path)) as archive:
        archive.extractall(tmp_path / "plugins")
    monkeypatch.setitem(sys.modules, "lichtfeld", studio.module())
    monkeypatch.syspath_prepend(tmp_path / "plugins")
    module = importlib.import_module("sgsst")
    module.on_load()
    yield module
    module.on_unload()
    assert studio.panels == []
    for name in [name for name in sys.modules if name.split(".")[0] == "sgsst"]:
        del sys.modules[name]


def entries(service: Service, style: Path, **changed: Any) -> dict[str, Any]:
    """Return what a user enters."""
    return {"painting": str(style), "preset": "preview", "minutes": 0.0, "views": 4, "service": service.url, **changed}


class User:
    """Somebody who uses the panel, and reads its texts."""

    def __init__(self, studio: Studio) -> None:
        (self._kind,) = studio.panels
        self._panel = self._kind()
        self.texts: list[str] = []

    def draw(self, clicked: str = "", **entered: Any) -> None:
        ui = Ui(clicked, **entered)
        self._panel.draw(ui)
        self.texts += ui.texts

    def sees_the_end(self) -> bool:
        self.draw()
        return self._kind.running is None


@pytest.mark.slow
def test_panel_paints_compares_and_undoes(
    plugin: ModuleType, studio: Studio, service: Service, files: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    user, colors = User(studio), studio.splat.sh0_raw.numpy
    original = colors()
    user.draw("Stylize", **entries(service, files[2]))
    wait_for(user.sees_the_end, "the job to end", lambda: str(user.texts))
    assert user.texts[-1] == "Splat is painted. Edit > Undo restores it."
    newest = httpx2.get(f"{service.url}/v1/jobs").json()["jobs"][0]
    (tmp_path / "result.ply").write_bytes(httpx2.get(f"{service.url}{newest['links']['result']}").content)
    painted = read_scene(tmp_path / "result.ply").scene.sh_dc.numpy()[:, None]
    assert np.array_equal(colors(), painted)
    ((_, undo, redo),) = studio.steps
    undo()
    assert np.array_equal(colors(), original)
    redo()
    assert np.array_equal(colors(), painted)
    user.draw(amount=0.5)
    assert np.allclose(colors(), (original + painted) / 2)


def test_colors_appear_while_they_are_being_painted(
    plugin: ModuleType, studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = importlib.import_module("sgsst")
    colors = np.linspace(-1, 1, 3 * studio.splat.num_points).astype(np.float16)
    started = threading.Event()

    class Job(threading.Thread):
        """Job that has painted `colors` so far."""

        colors, error = None, "The job was canceled."

        def __init__(self, service: Any, columns: Any, style: Path, *, live: bool, **options: Any) -> None:
            super().__init__(target=started.wait, daemon=True)
            assert live

    monkeypatch.setattr(panel, "BackgroundJob", Job)
    running = panel.Running("Splat", tmp_path / "style.png", None, {})
    original = studio.splat.sh0_raw.numpy()
    assert running.update()
    assert np.array_equal(studio.splat.sh0_raw.numpy(), original)
    running.job.colors = colors.tobytes()
    assert running.update()
    assert np.array_equal(studio.splat.sh0_raw.numpy().ravel(), colors.astype(np.float32))
    assert studio.changes == 1
    started.set()
    running.job.join()
    with pytest.raises(ValueError, match="canceled"):
        running.update()
    assert np.array_equal(studio.splat.sh0_raw.numpy(), original)


@pytest.mark.slow
def test_canceling_restores_the_colors(
    plugin: ModuleType, studio: Studio, service: Service, files: tuple[Path, Path, Path]
) -> None:
    user, original = User(studio), studio.splat.sh0_raw.numpy()
    user.draw("Stylize", **entries(service, files[2], preset="paper"))
    user.draw("Cancel")
    wait_for(user.sees_the_end, "the job to end")
    assert user.texts[-1] == "The job was canceled."
    assert np.array_equal(studio.splat.sh0_raw.numpy(), original)
    assert studio.steps == []


@pytest.mark.parametrize(
    ("selected", "changed", "message"),
    [
        ("Splat", {"painting": "missing.jpg"}, "There is no style image 'missing.jpg'. Choose a file."),
        ("", {}, "Select a splat in the scene tree."),
        ("Camera", {}, "Camera is no splat. Select one."),
        ("Splat", {}, "No service answers at http://127.0.0.1:9."),
    ],
)
def test_what_cannot_be_done_is_said(
    plugin: ModuleType, studio: Studio, tmp_path: Path, selected: str, changed: dict[str, Any], message: str
) -> None:
    studio.selected = selected
    style = tmp_path / "style.png"
    style.write_bytes(b"image")
    user = User(studio)
    user.draw("Stylize", **{"painting": str(style), "service": "http://127.0.0.1:9", **changed})
    wait_for(user.sees_the_end, "the job to end")
    assert user.texts[-1].startswith(message)


def test_manifest_and_marketplace_agree() -> None:
    manifest = tomllib.loads((FOLDER / "pyproject.toml").read_text())
    project, host = manifest["project"], manifest["tool"]["lichtfeld"]
    assert host.keys() == {"hot_reload", "plugin_api", "lichtfeld_version", "required_features"}
    entry = json.loads((FOLDER / "marketplace.json").read_text())
    assert entry["id"] == f"{entry['namespace']}:{project['name']}"
    assert (entry["name"], entry["latestVersion"]) == (project["name"], project["version"])
    assert (entry["pluginApi"], entry["lichtfeldVersion"]) == (host["plugin_api"], host["lichtfeld_version"])
    assert entry["requiredFeatures"] == host["required_features"]
    texts = ("displayName", "summary", "description", "author")
    assert all(isinstance(entry[name], str) and entry[name] for name in texts)
    assert entry["repository"].startswith("https://")
