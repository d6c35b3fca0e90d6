"""First image of a job: one view in the style's colors, before the other views are surveyed and the job is planned."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.regions.definition import Regions
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job_styles import JobStyles


def render_first_view(
    scene: Scene, camera: Camera, style: Style, settings: Settings, regions: Regions | None = None
) -> Tensor | None:
    """Render a view with the colors of a warm start whose weights are those of this view alone.

    For a job with this one view, these are the colors of its warm start. It runs on the CPU and shares nothing with the
    job, whose measurements it must not change.

    Args:
        scene: Scene as it was read.
        camera: Camera of the view.
        style: Style of the job.
        settings: Settings of the job.
        regions: Regions of the scene; None if there are none.

    Returns:
        Image [H, W, 3]; None if the view shows nothing that may change.
    """
    scene = scene.attenuated(settings.sh_attenuation)
    rasterizer = make_rasterizer("cpu", scene, background=settings.background, near=settings.near)
    weights = rasterizer.survey(camera)[1].double()
    if regions is not None:
        weights[regions.frozen] = 0
    rows = weights > 0
    if not bool(rows.any()):
        return None
    styles = JobStyles.prepared(style, regions and regions.resolved(weights), settings, scene.sh_dc, weights)
    colors, by_luminance = scene.sh_dc.clone(), settings.preserve_colors == "luminance"
    colors[rows] = styles.transferred(colors[rows], weights[rows], rows, preserve_chroma=by_luminance)
    return rasterizer.render(scene_colors(replace(scene, sh_dc=colors), camera), camera)
