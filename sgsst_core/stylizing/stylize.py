"""Stylization of a scene in one call."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, cast

from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.library import F, as_scene, stylized
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.files.stylized_ply import check_sh_attenuation
from sgsst_core.progress import Progress
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.rendering import RenderMode
from sgsst_core.settings import PresetName, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.photo_prefetch import PhotoLoader
from sgsst_core.stylizing.progress_bar import JobBar, job_bar
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.timing import seconds_left


def stylize(
    scene: F,
    cameras: Sequence[Camera],
    style: Tensor | NDArray[Any] | Style,
    *,
    preset: PresetName = "standard",
    render_mode: RenderMode = "auto",
    eps2d: float | None = None,
    photos: PhotoLoader | None = None,
    progress: bool = False,
    callbacks: Callbacks | None = None,
    weights: BackboneWeights | None = None,
    **settings: Any,
) -> F:
    """Stylize a scene from start to finish. The given scene is not changed.

    Args:
        scene: Result of `load_scene`, a `Scene`, or a dictionary of tensors of gsplat (`scene_of_splats`).
        style: Style image, such as from `load_image`; or a mixture of several.
        preset: Preset of the settings: "preview", "standard" or "paper".
        render_mode: Render mode of the scene's training, "classic" or "antialiased"; "auto" for that of its file, which
            is classic for checkpoints and tensors.
        eps2d: Blur of projected Gaussians in square pixels; None for that of the file or the mode.
        photos: Function that loads the content image of a view by its index, at the size of the view; None for
            unstylized renders.
        progress: Whether to show a progress bar, on a terminal or in a notebook (which needs ipywidgets).
        callbacks: Callbacks for progress, checkpoints and previews.
        weights: Weights of the feature network; None for VGG19 if it is installed, else VGG16.
        settings: Further fields of `Settings`, such as `steps_sos=100`.

    Returns:
        Stylized scene, of the type of the given one. `save` writes it to a file.

    Raises:
        InvalidInputError: If an input or a setting cannot be used.

    Example:
        >>> scene, cameras = load_scene("scene.ply"), load_cameras("cameras.json")
        >>> result = stylize(scene, cameras, load_image("style.png"), preset="preview", steps_sos=2)
        >>> save("stylized.ply", result)
        >>> torch.equal(load_scene("stylized.ply").scene.sh_dc, result.scene.sh_dc)
        True
    """
    chosen = make_settings(preset, **settings)
    left = seconds_left(chosen.within)
    if isinstance(scene, SceneFile):
        check_sh_attenuation(scene, chosen.sh_attenuation)
    with job_bar(Console(highlight=False, markup=False, emoji=False)) if progress else nullcontext() as bar:
        show = bar.show if bar else None
        given = as_scene(scene)
        given = replace(given, rendering=given.rendering.requested(render_mode, eps2d))
        stylizer = Stylizer.planned(given, cameras, style, chosen, weights=weights, photos=photos, show=show, left=left)
        job = stylizer.job
        if isinstance(scene, SceneFile):
            scene.refined(job.plan.refinement)  # raises before the steps if the file cannot hold the result
        callbacks = callbacks or Callbacks()
        run(stylizer, _shown(bar, replace(callbacks, left=callbacks.left or left)))
    result = replace(job.scene, sh_dc=stylizer.stylized())
    return cast(F, stylized(scene, result, job.plan.refinement, chosen.sh_attenuation))


def _shown(bar: JobBar | None, callbacks: Callbacks) -> Callbacks:
    """Return callbacks that update a progress bar, if there is one, and call the given ones."""
    if bar is None:
        return callbacks

    def show(progress: Progress) -> None:
        bar.show(progress)
        if callbacks.progress:
            callbacks.progress(progress)

    return replace(callbacks, progress=show)
