"""Module with what the plugin uses of LichtFeld Studio's Python API 1.0, for tests on machines without it."""

from __future__ import annotations

import enum
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from sgsst_core.scene.gaussians import Scene


class PanelSpace(enum.Enum):
    MAIN_PANEL_TAB = 0
    FLOATING = 1


class Tensor:
    """Tensor on the CPU that shares memory with an array."""

    is_cuda = False

    def __init__(self, array: Any) -> None:
        self._array = array
        self.shape = array.shape

    @staticmethod
    def from_numpy(arr: Any, copy: bool = True) -> Tensor:
        assert arr.dtype == np.float32
        return Tensor(arr.copy() if copy else arr)

    def cpu(self) -> Tensor:
        return self

    def numpy(self, copy: bool = True) -> Any:
        return self._array.copy() if copy else self._array

    def __setitem__(self, key: slice, value: Tensor) -> None:
        assert isinstance(value, Tensor)
        self._array[key] = value.numpy()


class Splat:
    """Data of a splat node."""

    def __init__(self, scene: Scene) -> None:
        self.num_points = len(scene)
        self.means_raw, self.scaling_raw = Tensor(scene.means.numpy()), Tensor(scene.scales.numpy())
        self.rotation_raw, self.opacity_raw = Tensor(scene.quats.numpy()), Tensor(scene.opacities.numpy()[:, None])
        self.sh0_raw, self.shN_raw = Tensor(scene.sh_dc.numpy()[:, None].copy()), Tensor(scene.sh_rest.numpy())


class Studio:
    """Open scene with one splat, its undo history, and the selection."""

    def __init__(self, scene: Scene) -> None:
        self.splat, self.changes, self.selected = Splat(scene), 0, "Splat"
        self.steps: list[tuple[str, Callable[[], None], Callable[[], None]]] = []
        self.panels: list[Any] = []

    def get_node(self, name: str) -> Any:
        return SimpleNamespace(splat_data=lambda: self.splat) if name == "Splat" else None

    def notify_changed(self) -> None:
        self.changes += 1

    def module(self) -> ModuleType:
        """Return the module `lichtfeld`."""
        module = ModuleType("lichtfeld")
        vars(module).update(
            Tensor=Tensor,
            ui=SimpleNamespace(Panel=object, PanelSpace=PanelSpace, request_redraw=lambda: None),
            undo=SimpleNamespace(push=lambda name, undo, redo: self.steps.append((name, undo, redo))),
            get_scene=lambda: self,
            get_selected_node_name=lambda: self.selected,
            register_class=self.panels.append,
            unregister_class=self.panels.remove,
        )
        return module


class Ui:
    """Layout whose widgets return what a user enters."""

    def __init__(self, clicked: str = "", **entered: Any) -> None:
        self._clicked, self._entered = clicked, entered
        self.texts: list[str] = []

    def _entry(self, label: str, value: Any) -> tuple[bool, Any]:
        name = label.split(" ")[0].lower()
        return name in self._entered, self._entered.get(name, value)

    def path_input(self, label: str, value: str, folder_mode: bool = True, dialog_title: str = "") -> tuple[bool, str]:
        assert not folder_mode
        return self._entry(label, value)

    def combo(self, label: str, current_idx: int, items: list[str]) -> tuple[bool, int]:
        changed, value = self._entry(label, items[current_idx])
        return changed, items.index(value)

    def input_float(self, label: str, value: float) -> tuple[bool, float]:
        return self._entry(label, value)

    def input_int(self, label: str, value: int) -> tuple[bool, int]:
        return self._entry(label, value)

    def input_text(self, label: str, value: str) -> tuple[bool, str]:
        return self._entry(label, value)

    def slider_float(self, label: str, value: float, min: float, max: float) -> tuple[bool, float]:
        return self._entry(label, value)

    def button(self, label: str) -> bool:
        return label == self._clicked

    def button_styled(self, label: str, style: str) -> bool:
        assert style in ("success", "error", "warning", "primary", "secondary")
        return label == self._clicked

    def progress_bar(self, fraction: float, overlay: str = "") -> None:
        assert 0 <= fraction <= 1
        self.texts.append(overlay)

    def text_wrapped(self, text: str) -> None:
        self.texts.append(text)
