"""Quality measurements of a job at its end: novel views, and the error of the job's approximations."""

from __future__ import annotations

from dataclasses import asdict
from functools import cached_property, partial
from typing import Any

from sgsst_core.budget import measuring_memory
from sgsst_core.loss.terms import has_statistics
from sgsst_core.quality.float32_reference import ExactLoss, Float32Reference, approximations, rasterizer_beside
from sgsst_core.quality.judge import Judge
from sgsst_core.quality.lpips import LPIPS_NETWORK, Lpips, load_lpips_or_none
from sgsst_core.quality.novel_views import NovelViews
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import WHOLE_FLOAT32
from sgsst_core.stylizing.job import StylizationJob
from sgsst_core.stylizing.steps import Evaluation, ShowViews, show_nothing
from sgsst_core.stylizing.stylizer import Stylizer


class Measurements:
    """Quality measurements of a job, for as many novel views as its plan says.

    The unstylized scene (step 0) and the result each append a JSON-serializable entry to `Stylizer.measured`, with the
    fields "step", "novel_views" and "approximation" (None if there is nothing to measure). The first entry names the
    views. If AlexNet is installed, the last entry holds the `Judgment` of the result as "judged", with the fields
    "before" and "after". Networks and views are created at first use.

    Args:
        show: Callback before each view of a measurement, with the number of completed and of all views.
    """

    def __init__(self, stylizer: Stylizer, show: ShowViews = show_nothing) -> None:
        self._stylizer, self._show = stylizer, show
        self.approximated = approximations(stylizer)

    @cached_property
    def exact(self) -> Float32Reference:
        """Exact loss and gradient of the job."""
        return Float32Reference(self._stylizer, measuring_memory(self._stylizer.job.memory))

    @cached_property
    def _seen_by(self) -> tuple[Scene, Rasterizer]:
        """Scene of the novel views, and its rasterizer."""
        scene = self._stylizer.job.scene.without_zero_bands()
        return scene, rasterizer_beside(self._stylizer, scene)

    def evaluate(self, *, unstylized: bool = False) -> Evaluation:
        """Return the exact loss on the evaluation views, for the current colors or the unstylized scene."""
        stylizer = self._stylizer
        if unstylized and not self.approximated:
            return stylizer.start(self._show)
        with stylizer.measuring():
            if not self.approximated:
                return stylizer.evaluate(stylizer.job.evaluation_views, stylizer.shown(), self._show)
            colors = stylizer.job.scene.sh_dc if unstylized else stylizer.stylized()
            return self.exact.evaluate(stylizer.job.evaluation_views, colors, self._show)

    def at_the_end(self) -> None:
        """Measure the unstylized scene and the result, and judge the result."""
        if self._stylizer.job.plan.novel_views and not self._stylizer.measured:
            with self._stylizer.measuring():
                self._measure(start=True)
                self._measure(start=False)
                self._judge()

    def _judge(self) -> None:
        """Judge the result and the unstylized scene on the first rank.

        The judgment is added to the last entry as "judged".
        """
        stylizer, novel_views = self._stylizer, self._novel_views
        if novel_views.lpips is None or stylizer.job.collectives.rank:
            return
        judge = make_judge(stylizer, novel_views, novel_views.lpips)
        colors = {"before": stylizer.job.scene.sh_dc, "after": stylizer.stylized()}
        judgments = {name: judge.judge(sh_dc) for name, sh_dc in colors.items()}
        stylizer.measured[-1]["judged"] = {name: asdict(one) for name, one in judgments.items() if one} or None

    def _measure(self, *, start: bool) -> None:
        """Measure the unstylized scene or the result, and append an entry."""
        stylizer, novel_views, own = self._stylizer, self._novel_views, dict[str, Any]()
        colors = (stylizer.job.scene.sh_dc if start else stylizer.stylized()).to(novel_views.rasterizer.device)
        if start:
            own["novel_view_names"] = [novel_views.cameras[index].name for index in novel_views.views]
            own["lpips"] = LPIPS_NETWORK if novel_views.lpips else None
            own["approximated"] = self.approximated
        approximation = asdict(self.exact.gradient_error(start=start)) if self.approximated else None
        step, seconds, moment = (0, 0.0, None) if start else (stylizer.step, stylizer.seconds, None)
        if novel_views.views:
            moment = novel_views.measure(colors, self._show).as_dict(step, seconds)
        stylizer.measured.append({"step": step, "novel_views": moment, "approximation": approximation, **own})

    @cached_property
    def _novel_views(self) -> NovelViews:
        """Novel views of the job."""
        stylizer, (scene, rasterizer) = self._stylizer, self._seen_by
        # Features that define Gram distances are float32, and have Gram statistics even if the job optimizes another
        # loss.
        source: StylizationJob | ExactLoss = stylizer.job
        if not has_statistics(stylizer.job.settings.style_loss):
            source = ExactLoss(stylizer, "sos")
        elif stylizer.job.plan.precision not in WHOLE_FLOAT32:
            source = self.exact
        return NovelViews(
            stylizer.job.views.cameras,
            stylizer.job.views.covered,
            scene,
            rasterizer,
            source.loss,
            source.style_targets,
            weighted=stylizer.job.plan.weighted,
            lpips=load_lpips_or_none(stylizer.job.network.device),
            memory=measuring_memory(stylizer.job.memory),
            most=stylizer.job.plan.novel_views,
            rasterizer_of=partial(rasterizer_beside, stylizer),
            maps=stylizer.job.styles.maps(rasterizer),
        )


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
