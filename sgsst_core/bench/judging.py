"""Novel views of a job, and the judge of its results on them."""

from __future__ import annotations

from sgsst_core.budget import measuring_memory
from sgsst_core.quality.float32_reference import ExactLoss, rasterizer_beside
from sgsst_core.quality.judge import Judge
from sgsst_core.quality.lpips import Lpips
from sgsst_core.quality.novel_views import NovelViews
from sgsst_core.stylizing.stylizer import Stylizer


def make_novel_views(stylizer: Stylizer) -> NovelViews:
    """Create the novel views of a job, with all Gaussians of its scene."""
    exact = ExactLoss(stylizer, "sos")
    return NovelViews(
        stylizer.job.views.cameras,
        stylizer.job.views.covered,
        stylizer.job.scene,
        rasterizer_beside(stylizer, stylizer.job.scene),
        exact.loss,
        exact.style_targets,
        weighted=stylizer.job.plan.weighted,
        memory=measuring_memory(stylizer.job.memory),
    )


def make_judge(stylizer: Stylizer, novel_views: NovelViews, lpips: Lpips) -> Judge:
    """Create the judge of a job's colors on its novel views."""
    cameras = [novel_views.cameras[index] for index in novel_views.views]
    background = stylizer.job.settings.background
    return Judge(lpips, stylizer.job.styles, novel_views.scene, novel_views.rasterizer, cameras, background)
