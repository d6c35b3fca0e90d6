"""Plugin of LichtFeld Studio that paints the splats of the open scene on a service of sgsst.

Its panel: choose a painting, watch the colors in the open scene, compare and undo.
"""

from pathlib import Path
from typing import Any

import numpy as np

import lichtfeld as lf

from .sgsst_rest import BackgroundJob, Service, orbit_options, read_colors

_PRESETS = ["preview", "standard", "paper"]
_UP = ["auto", "-y", "y", "-z", "z", "-x", "x"]


class Painting:
    """Splat of the open scene whose colors are being painted, or have been.

    Args:
        name: Name of the splat's node.
        original: Its colors, [N, 3] float32.
        painted: Colors of the painting so far, or the result.

    Attributes:
        amount: Weight of the style; 0 is the original, 1 the result.
    """

    def __init__(self, name: str, original: Any) -> None:
        self.name, self.original, self.painted = name, original, original
        self.amount = 1.0

    def show(self, colors: Any = None) -> None:
        """Set the splat's colors to the given ones, [N, 3], or to the blend of original and painted.

        Raises:
            ValueError: If the splat is gone, or has changed.
        """
        if colors is None:
            amount = np.float32(self.amount)
            colors = (1 - amount) * self.original + amount * self.painted  # exactly the result at 1
        scene = lf.get_scene()
        sh0 = splat_of(self.name).sh0_raw
        if sh0.shape[0] != len(colors):
            raise ValueError(f"{self.name} has {sh0.shape[0]:,} Gaussians now, not {len(colors):,}. Start again.")
        values = lf.Tensor.from_numpy(np.ascontiguousarray(colors[:, None], np.float32))
        sh0[0 : len(colors)] = values.cuda() if sh0.is_cuda else values
        scene.notify_changed()

    def finish(self, result: Any) -> None:
        """Show the result, [N, 3], as a step that LichtFeld Studio can undo."""
        self.painted = result
        self.show()
        lf.undo.push("Stylize", lambda: self.show(self.original), lambda: self.show(self.painted))


class Running:
    """Job that paints a splat."""

    def __init__(self, name: str, style: Path, service: Service, options: dict[str, Any]) -> None:
        columns = splat_columns(splat_of(name))
        self.painting = Painting(name, np.stack([columns[f"f_dc_{i}"] for i in range(3)], axis=1))
        self.job = BackgroundJob(service, columns, style, live=True, **options)
        self._shown: bytes | None = None
        self.job.start()

    def update(self) -> bool:
        """Show newer colors in the scene, or the result; return whether the job is still running.

        Raises:
            ValueError: If the job failed or was canceled, which restores the original colors.
        """
        painting, job = self.painting, self.job
        if job.is_alive():
            colors = job.colors
            if colors is not None and colors is not self._shown and len(colors) == 6 * len(painting.original):
                self._shown = colors
                painting.painted = np.frombuffer(colors, "<f2").reshape(-1, 3).astype(np.float32)
                painting.show()
            return True
        result = None if job.error else read_colors(job.out)
        if result is None or len(result) != len(painting.original):
            painting.show(painting.original)
            raise ValueError(job.error or "The result has fewer Gaussians: delete those without size or color first.")
        painting.finish(result)
        return False


def splat_of(name: str) -> Any:
    """Return the data of a splat node.

    Raises:
        ValueError: If there is no such splat.
    """
    scene = lf.get_scene()
    node = scene.get_node(name) if scene is not None and name else None
    splat = None if node is None else node.splat_data()
    if splat is None:
        raise ValueError("Select a splat in the scene tree." if not name else f"{name} is no splat. Select one.")
    return splat


def splat_columns(splat: Any) -> dict[str, Any]:
    """Return splat data as arrays by the property of a PLY."""
    count = splat.num_points
    rest = splat.shN_raw.cpu().numpy().reshape(count, -1, 3).transpose(0, 2, 1).reshape(count, -1)
    parts = {
        "f_dc_": splat.sh0_raw.cpu().numpy().reshape(count, 3),
        "f_rest_": rest,
        "scale_": splat.scaling_raw.cpu().numpy(),
        "rot_": splat.rotation_raw.cpu().numpy(),
    }
    columns = {f"{name}{i}": part[:, i] for name, part in parts.items() for i in range(part.shape[1])}
    columns |= dict(zip("xyz", splat.means_raw.cpu().numpy().T, strict=True))
    return {**columns, "opacity": splat.opacity_raw.cpu().numpy().reshape(count)}


class SgsstPanel(lf.ui.Panel):
    """Tab in the right panel."""

    id = "sgsst.main_panel"
    label = "SGSST"
    space = lf.ui.PanelSpace.MAIN_PANEL_TAB
    order = 210

    #: Job that runs; class-wide, so that unloading the plugin can cancel it.
    running: Running | None = None

    def __init__(self) -> None:
        self._service, self._style = Service().url, ""
        self._preset, self._minutes, self._views, self._up = 1, 10.0, 0, 0
        self._painting: Painting | None = None
        self._message = ""

    def draw(self, ui: Any) -> None:
        """Draw the panel, and show newer colors."""
        try:
            if SgsstPanel.running is None:
                self._draw_settings(ui)
            else:
                self._draw_progress(ui, SgsstPanel.running)
            if self._painting is not None:
                self._draw_comparison(ui, self._painting)
        except (ValueError, OSError) as error:
            self._message = str(error)
        if self._message:
            ui.text_wrapped(self._message)

    def _draw_settings(self, ui: Any) -> None:
        _, self._style = ui.path_input("Painting", self._style, folder_mode=False, dialog_title="Painting")
        _, self._preset = ui.combo("Preset", self._preset, _PRESETS)
        _, self._minutes = ui.input_float("Minutes (0: no limit)", self._minutes)
        _, self._views = ui.input_int("Views (0: automatic)", self._views)
        _, self._up = ui.combo("Up", self._up, _UP)
        _, self._service = ui.input_text("Service", self._service)
        if ui.button_styled("Stylize", "primary"):
            self._message = ""
            SgsstPanel.running = self._start()
            self._painting = SgsstPanel.running.painting

    def _start(self) -> Running:
        options = orbit_options(_PRESETS[self._preset], self._views, _UP[self._up], self._minutes)
        return Running(lf.get_selected_node_name(), Path(self._style), Service(self._service), options)

    def _draw_progress(self, ui: Any, running: Running) -> None:
        ui.progress_bar(running.job.fraction, running.job.text)
        if ui.button("Cancel"):
            running.job.canceled.set()
        try:
            if running.update():
                lf.ui.request_redraw()
                return
            self._message = f"{running.painting.name} is painted. Edit > Undo restores it."
        except (ValueError, OSError):
            running.job.canceled.set()
            self._painting = SgsstPanel.running = None
            raise
        SgsstPanel.running = None

    def _draw_comparison(self, ui: Any, painting: Painting) -> None:
        changed, painting.amount = ui.slider_float("Amount of style", painting.amount, 0.0, 1.5)
        if changed:
            painting.show()


def on_load() -> None:
    """Add the panel."""
    lf.register_class(SgsstPanel)


def on_unload() -> None:
    """Cancel a running job, and remove the panel."""
    if SgsstPanel.running is not None:
        SgsstPanel.running.job.canceled.set()
    lf.unregister_class(SgsstPanel)
