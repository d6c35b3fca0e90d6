"""Modules with what the nodes use of ComfyUI 0.25, for tests on machines without it."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import torch

from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.scene.gaussians import Scene


class InterruptProcessingException(Exception):  # noqa: N818 (ComfyUI's name)
    """The user interrupts."""


class Interruption:
    """Whether the user interrupts at the next question."""

    wanted = False

    @classmethod
    def raise_if_wanted(cls) -> None:
        if cls.wanted:
            cls.wanted = False
            raise InterruptProcessingException


class ProgressBar:
    """Bar that remembers what it shows."""

    last: ProgressBar

    def __init__(self, total: int, node_id: str | None = None) -> None:
        self.total = total
        self.values: list[int] = []
        self.previews: list[Any] = []
        ProgressBar.last = self

    def update_absolute(self, value: int, total: int | None = None, preview: Any = None) -> None:
        self.values.append(value)
        self.previews += [preview] if preview else []


class SPLAT:
    """Batch of splats, padded to the same number of Gaussians."""

    def __init__(self, positions: Any, scales: Any, rotations: Any, opacities: Any, sh: Any, counts: Any = None):
        self.positions, self.scales, self.rotations = positions, scales, rotations
        self.opacities, self.sh, self.counts = opacities, sh, counts


class File3D:
    """File on the disk."""

    def __init__(self, source: str, file_format: str = "") -> None:
        self.source, self.format = source, file_format

    def save_to(self, path: str) -> str:
        Path(path).write_bytes(Path(self.source).read_bytes())
        return path


class NodeOutput:
    """Outputs of a node."""

    def __init__(self, *args: Any) -> None:
        self.args = args

    def __getitem__(self, index: int) -> Any:
        return self.args[index]


def splat_of(scene: Scene) -> SPLAT:
    sh = torch.cat([scene.sh_dc[:, None], scene.sh_rest], dim=1)
    parts = (scene.means, scene.scales.exp(), scene.quats, scene.opacities.sigmoid()[:, None], sh)
    return SPLAT(*(part[None] for part in parts))


class SplatToFile3D:
    """ComfyUI's node `Create 3D File (from Splat)`."""

    @classmethod
    def execute(cls, splat: SPLAT, format: str = "ply") -> NodeOutput:
        n = int(splat.counts[0]) if splat.counts is not None else splat.positions.shape[1]
        sh, opacities = splat.sh[0, :n], splat.opacities[0, :n, 0]
        scene = Scene(
            means=splat.positions[0, :n],
            quats=splat.rotations[0, :n],
            scales=splat.scales[0, :n].log(),
            opacities=torch.logit(opacities, 1e-6),
            sh_dc=sh[:, 0],
            sh_rest=sh[:, 1:],
        )
        path = Path(tempfile.mkdtemp()) / f"splat.{format}"
        write_scene(path, scene)
        return NodeOutput(File3D(str(path), format))


class File3DToSplat:
    """ComfyUI's node `Get Splat`."""

    @classmethod
    def execute(cls, model_3d: File3D) -> NodeOutput:
        return NodeOutput(splat_of(read_scene(Path(model_3d.source)).scene))


def _type(io_type: str) -> Any:
    def given(id: str, *, optional: bool = False, tooltip: str = "", advanced: bool = False, **more: Any) -> Any:
        assert more.keys() <= {"default", "min", "max", "step", "options", "force_input"}, more
        return SimpleNamespace(id=id, io_type=io_type, optional=optional, **more)

    def shown(display_name: str) -> Any:
        return SimpleNamespace(io_type=io_type, display_name=display_name)

    return SimpleNamespace(Input=given, Output=shown)


def modules() -> dict[str, ModuleType]:
    """Return the modules by name."""
    kinds = {name: _type(name.upper()) for name in ("Splat", "Image", "String", "Int", "Float", "Boolean", "Combo")}
    io = SimpleNamespace(ComfyNode=object, Schema=SimpleNamespace, NodeOutput=NodeOutput, **kinds)
    management = SimpleNamespace(
        InterruptProcessingException=InterruptProcessingException,
        throw_exception_if_processing_interrupted=Interruption.raise_if_wanted,
    )
    contents: dict[str, dict[str, Any]] = {
        "comfy": {"model_management": management},
        "comfy.utils": {"ProgressBar": ProgressBar},
        "comfy_api": {},
        "comfy_api.latest": {"IO": io, "ComfyExtension": object, "Types": SimpleNamespace(SPLAT=SPLAT, File3D=File3D)},
        "comfy_extras": {},
        "comfy_extras.nodes_gaussian_splat": {"SplatToFile3D": SplatToFile3D, "File3DToSplat": File3DToSplat},
    }
    for name, members in contents.items():
        sys.modules.setdefault(name, ModuleType(name))
        vars(sys.modules[name]).update(members)
    return {name: sys.modules[name] for name in contents}
