"""What a run measures at moments between its steps: held-out views, and its approximations against exact."""

from __future__ import annotations

from typing import Any

from sgsst_core.quality.exact import ExactTwin, approximations
from sgsst_core.quality.held_out import HeldOut, moments
from sgsst_core.quality.lpips import load_lpips_or_none
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.stylizing.evaluation import Evaluation
from sgsst_core.stylizing.stylizer import Stylizer


class Measurements:
    """Measures a job; pass an object of this as `loop.Callbacks.measure` and `moments` beside it.

    Everything is built at first use. Results go to `Stylizer.measured`, one entry a moment, ready for JSON: "step",
    "held_out" and "approximation" (None where there is nothing to measure).

    Args:
        stylizer: the job, at any step.
    """

    def __init__(self, stylizer: Stylizer) -> None:
        self._stylizer = stylizer
        self.moments = moments(stylizer.total)
        self.approximated = approximations(stylizer)
        self._exact: ExactTwin | None = None
        self._held_out: HeldOut | None = None

    @property
    def exact(self) -> ExactTwin:
        """The exact twin."""
        if self._exact is None:
            self._exact = ExactTwin(self._stylizer, self._stylizer.memory // 16)
        return self._exact

    def evaluate(self, *, unstylized: bool = False) -> Evaluation:
        """Exact loss on the evaluation views, of the present colours or of the unstylized scene."""
        stylizer = self._stylizer
        if not self.approximated:
            return stylizer.start() if unstylized else stylizer.evaluate(stylizer.evaluation_views)
        colours = stylizer.scene.sh_dc if unstylized else stylizer.stylized()
        return self.exact.evaluate(stylizer.evaluation_views, colours)

    def __call__(self, stylizer: Stylizer) -> None:
        """Measure now."""
        held_out = self._of_held_out_views()
        views = [held_out.cameras[index].name for index in held_out.views]
        moment = None
        if views:
            colours = stylizer.stylized() if stylizer.step else stylizer.scene.sh_dc
            measured = held_out.measure(colours.to(held_out.rasterizer.device))
            moment = measured.as_dict(stylizer.step, stylizer.seconds)
        approximation = self.exact.gradient_error().as_dict() if self.approximated else None
        entry: dict[str, Any] = {"step": stylizer.step, "held_out": moment, "approximation": approximation}
        if not stylizer.measured:
            entry["held_out_views"] = views
            entry["lpips"] = held_out.lpips.network if held_out.lpips else None
            entry["approximated"] = self.approximated
        stylizer.measured.append(entry)

    def _of_held_out_views(self) -> HeldOut:
        if self._held_out is None:
            stylizer = self._stylizer
            scene = stylizer.scene.without_zero_bands()
            settings = stylizer.settings
            source = self.exact if stylizer.network.precision != "float32" else stylizer
            first = stylizer.measured[0]["held_out"] if stylizer.measured else None
            self._held_out = HeldOut(
                stylizer.views.cameras,
                stylizer.views.covered,
                scene,
                make_rasterizer(stylizer.plan.anew, scene, background=settings.background, near=settings.near),
                source.loss,
                source.style_targets,
                weighted=stylizer.plan.weighted,
                lpips=load_lpips_or_none(stylizer.network.device),
                memory=stylizer.memory // 16,
                first={int(scale): value for scale, value in first["gram"].items()} if first else None,
            )
        return self._held_out
