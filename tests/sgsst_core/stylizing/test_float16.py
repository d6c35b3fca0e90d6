"""Tests of jobs in float16: they follow float32, and continue in bfloat16 where float16 overflows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core import Stylizer, make_settings
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.quality.measure import Difference
from sgsst_core.settings import PlannedPrecision
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, prepare_job
from sgsst_core.stylizing.planner import plan_job
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.small_scenes import cameras, style, wall

#: Layers of all terms.
LAYERS = ("relu1_1", "relu2_1", "relu3_1", "relu3_2", "relu3_3", "relu4_1", "relu4_2", "relu5_1")
pytestmark = pytest.mark.usefixtures("one_thread")


def make(weights: BackboneWeights, precision: PlannedPrecision, **values: Any) -> Stylizer:
    """Make a job with a fixed plan, so that the precision does not depend on the processor."""
    inputs = wall(40, 30), cameras(), Style.of(style())
    settings = make_settings(**{"steps_coarse": 2, "steps_sos": 4, "coarsest_side": 24, "early_stop": False, **values})
    plan = plan_job(JobInputs(*inputs, settings, weights=weights)).plan
    return Stylizer(prepare_job(replace(plan, precision=precision), JobInputs(*inputs, settings, weights=weights)))


@pytest.mark.parametrize(("style_loss", "weighted"), [("sos", True), ("mixed", False)])
def test_loss_and_gradient_are_those_of_float64(
    vgg16_weights: BackboneWeights, style_loss: Any, weighted: bool
) -> None:
    """Powers of two cancel in the loss and its gradient, with a content term and position weights too."""
    image, other = (synthetic_image(48, 64, seed=seed).float() for seed in (1, 2))
    coverage = torch.rand((48, 64), generator=torch.Generator().manual_seed(0)) if weighted else None
    results = []
    for dtype in (torch.float64, torch.float16, torch.bfloat16):
        network = FeatureNetwork(vgg16_weights, dtype=dtype, layers=LAYERS)
        loss = SosLoss(network, style_loss=style_loss, coarsest=24, content_weight=100.0)
        target = loss.targets.of_view(other, coverage)
        results.append(loss.evaluate(image, loss.targets.of_style(Style.of(style()), (48, 64)), target))
    exact, half, _ = results
    assert (half.values - exact.values).abs().max() < 2e-3 * exact.values.abs().max()
    gradients = [each.image_gradient for each in results if each.image_gradient is not None]
    errors = [Difference.of(each, gradients[0]).relative_error for each in gradients[1:]]
    assert errors[0] < 0.6 * errors[1]


def test_overflowing_step_is_repeated_in_bfloat16(tiny_weights: BackboneWeights) -> None:
    """A content weight of 1e12 makes gradients too large for float16."""
    half, expected = (make(tiny_weights, name, content_weight=1e12) for name in ("float16", "bfloat16"))
    for _ in range(3):
        assert half.run_step().terms == expected.run_step().terms
    assert half.job.plan.precision == half.job.network.precision == "bfloat16"
    assert torch.equal(half.sh_dc, expected.sh_dc)
    line = half.job.plan.decisions[-1]
    assert (line.item, line.decision) == ("precision", "features in bfloat16 from step 1 on")


def test_steps_follow_those_of_float32(tiny_weights: BackboneWeights) -> None:
    half, exact = (make(tiny_weights, name) for name in ("float16", "float32"))
    for _ in range(half.job.total_steps):
        assert half.run_step().loss == pytest.approx(exact.run_step().loss, rel=0.1)
    assert half.job.network.dtype == torch.float16
    assert torch.isfinite(half.sh_dc).all()
