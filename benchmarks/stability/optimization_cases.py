"""Hard cases of the optimizer: gradients of all magnitudes, too large or too many steps, colors out of range."""

import math
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.stability.case import (
    FLOAT32,
    Case,
    CaseResult,
    Group,
    Way,
    compare_losses,
    in_ways,
    planned,
    small_network,
    texture,
    vgg16,
)
from sgsst_core.constants import ALPHA_MIN, COLOR_OFFSET, SH_C0, TRANSMITTANCE_MIN
from sgsst_core.errors import DivergedError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, versions
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.stylizer import ADAM_EPS, Stylizer

_END = "loss and gradient of the last picture, relative to float64"
_GROUP: Group = "stiff optimization"
_SIDE = 16
#: Total blend weight below which a Gaussian changes no pixel of any view by a gray level.
HARDLY_SEEN = 1.0 / 255.0


def cases() -> list[Case]:
    """Return all cases of this group."""
    compared: list[tuple[str, str, Callable[[Way, bool], CaseResult]]] = [
        ("total weights from 1e-6 to 1e2 in one scene", _END, _weights),
        ("learning rate 100 times too large", _END, _large_steps),
        ("content weighs 1e-8 of style", _END, partial(_unbalanced, 1e-4)),
        ("content weighs 1e8 times style", _END, partial(_unbalanced, 1e12)),
        ("colors of 1e3 and -1e3", _END, _far_colors),
        ("colors beyond what float32 can optimize", "steps taken", _diverged),
        ("stopped and resumed in the middle", "values against an uninterrupted run", _resumed),
    ]
    single: list[tuple[str, str, Callable[[bool], CaseResult]]] = [
        ("Adam on gradients from 1e-12 to 1e3", "values against float64", _adam),
        ("20,000 steps, as many as the paper's", "rise of the loss above its lowest", _many_steps),
    ]
    return [
        *(case for name, measure, run in compared for case in in_ways(name, _GROUP, measure, run)),
        *(Case(name, _GROUP, measure, run) for name, measure, run in single),
    ]


def _camera() -> Camera:
    return Camera("view", _SIDE, _SIDE, 20.0, 20.0, _SIDE / 2, _SIDE / 2, torch.eye(4, dtype=torch.float64))


def _walls(*walls: tuple[float, int]) -> Scene:
    """Return several walls of Gaussians at increasing depth, each of which fills the view.

    Args:
        walls: Logit of the opacity and number of Gaussians per side, for each wall.
    """
    means, scales, logits = [], [], []
    for index, (logit, columns) in enumerate(walls):
        depth = 3.0 + index
        side = 0.45 * depth * ((torch.arange(columns) + 0.5) * 2 / columns - 1)
        x, y = torch.meshgrid(side, side, indexing="xy")
        means.append(torch.stack([x, y, torch.full_like(x, depth)], dim=-1).reshape(-1, 3))
        scales.append(torch.full((columns**2, 3), math.log(0.8 * depth / columns)))
        logits.append(torch.full((columns**2,), logit))
    count = sum(map(len, means))
    return Scene(
        means=torch.cat(means),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.cat(scales),
        opacities=torch.cat(logits),
        sh_dc=torch.randn(count, 3, generator=torch.Generator().manual_seed(1)),
        sh_rest=torch.zeros(count, 0, 3),
    )


def _stylizer(
    scene: Scene,
    steps: int,
    way: Way = FLOAT32,
    *,
    content: bool = False,
    weights: BackboneWeights | None = None,
    **values: Any,
) -> Stylizer:
    values |= {} if content else {"content_weight": 0}
    settings = make_settings(steps_coarse=0, steps_sos=steps, memory_limit=1 << 30, **values)
    return planned(scene, [_camera()], _style(), settings, weights or vgg16(), way)


def _style() -> Tensor:
    return texture(48, 40, 9)


def _last_image(stylizer: Stylizer) -> Tensor:
    return stylizer.job.views.render(0, stylizer.job.views.colors(0, stylizer.sh_dc.detach()))


def _at_the_end(stylizer: Stylizer, way: Way, note: str) -> CaseResult:
    if not bool(torch.isfinite(stylizer.sh_dc).all()):
        return CaseResult(math.inf, 0.0, "colors are not finite")
    content = stylizer.job.view_targets.content(0)
    result = compare_losses(_last_image(stylizer), _style(), content, way=way)
    return CaseResult(result.error, result.bound, f"{note}; {result.note}")


def _outside(stylizer: Stylizer, rows: Tensor) -> float:
    """Return the maximum distance of the colors of `rows` ([n] bool) from the range 0 to 1."""
    colors = COLOR_OFFSET + SH_C0 * stylizer.sh_dc.detach()[rows]
    return float(torch.maximum(colors - 1, -colors).amax()) if len(colors) else 0.0


def _weights(way: Way, full: bool) -> CaseResult:
    """Check Gaussians behind opaque walls, with blend weights down to nearly the smallest possible value."""
    faint = math.log(1.1 * ALPHA_MIN / (1 - 1.1 * ALPHA_MIN))
    scene = _walls((2.0, 5), (3.0, 1), (faint, 5), (2.0, 5), (1.0, 5), (faint, 8))
    stylizer = _stylizer(scene, 2000 if full else 200, way, learning_rate=0.05)
    total = stylizer.job.plan.survey.total_blend_weights[stylizer.job.plan.seen]
    run(stylizer)
    hardly, well = total < HARDLY_SEEN, total > 1
    if float(total.min()) < ALPHA_MIN * TRANSMITTANCE_MIN:
        return CaseResult(math.inf, 0.0, "a weight below what the cut-offs allow")
    return _at_the_end(
        stylizer,
        way,
        f"total weights {float(total.min()):.1e} to {float(total.max()):.1e}; after {stylizer.step} steps colors lie "
        f"up to {_outside(stylizer, well):.1f} outside 0..1 where the weight is above 1, and up to "
        f"{_outside(stylizer, hardly):.1f} where it is below 1/255 ({int(hardly.sum())} of {len(total)})",
    )


def _adam(full: bool) -> CaseResult:
    """Check Adam on gradients from 1e-12 to 1e3.

    Adam normalizes each gradient by its own magnitude, so all values change equally, in float32 and in float64.
    """
    sizes = torch.logspace(-12, 3, 16, dtype=torch.float64)
    ends = []
    for dtype in (torch.float32, torch.float64):
        values = torch.zeros(16, dtype=dtype, requires_grad=True)
        adam = torch.optim.Adam([values], lr=2.5e-3, eps=ADAM_EPS)
        for _ in range(2000 if full else 600):
            values.grad = (sizes * (values.detach().double() - 1)).to(dtype)
            adam.step()
        ends.append(values.detach().double())
    error = float((ends[0] - ends[1]).abs().max())
    spread = float(ends[1].max() - ends[1].min())
    return CaseResult(error, 1e-4, f"all values go to 1 together: they end {spread:.1e} apart")


def _large_steps(way: Way, full: bool) -> CaseResult:
    stylizer = _stylizer(_walls((2.0, 5)), 1000 if full else 100, way, learning_rate=5.0, learning_rate_end=1.0)
    run(stylizer)
    colors = COLOR_OFFSET + SH_C0 * stylizer.sh_dc.detach()
    stuck = float((colors <= 0).float().mean())
    losses = [record.loss for record in stylizer.history]
    return _at_the_end(
        stylizer,
        way,
        f"loss {losses[-1] / losses[0]:.2g} of the first; colors up to {float(colors.max()):.0f}; {stuck:.0%} of the "
        "values are negative: black, and without gradient for good",
    )


def _unbalanced(weight: float, way: Way, full: bool) -> CaseResult:
    image, style, content = (texture(32, 40, seed) for seed in (1, 2, 3))
    return compare_losses(image, style, content, way=way, content_weight=weight)


def _far_colors(way: Way, full: bool) -> CaseResult:
    stylizer = _stylizer(_walls((2.0, 5)), 4, way, content=True)
    with torch.no_grad():
        stylizer.sh_dc.mul_(1e3 / SH_C0)
    run(stylizer)
    return _at_the_end(stylizer, way, f"colors up to {float(_last_image(stylizer).max()):.0f}")


def _diverged(way: Way, full: bool) -> CaseResult:
    """Check that divergence raises an error, and leaves the colors unchanged instead of NaN."""
    stylizer = _stylizer(_walls((2.0, 5)), 3, way, content=True)
    with torch.no_grad():
        stylizer.sh_dc.copy_(stylizer.sh_dc.abs() * 1e8)
    before = stylizer.sh_dc.detach().clone()
    try:
        run(stylizer)
    except DivergedError as error:
        same = torch.equal(before, stylizer.sh_dc.detach())
        return CaseResult(float(stylizer.step) if same else math.inf, 0.0, f"refused: {error}")
    return CaseResult(math.inf, 0.0, "was not refused")


def _many_steps(full: bool) -> CaseResult:
    """Check that the loss stays near its lowest level, apart from the noise of a constant learning rate.

    The network is small: what steps add up to does not depend on its weights.
    """
    steps, walls = 20_000 if full else 500, _walls((2.0, 5), (1.0, 5))
    stylizer = _stylizer(walls, steps, learning_rate=2.5e-3, early_stop=False, weights=small_network())
    run(stylizer)
    if not bool(torch.isfinite(stylizer.sh_dc).all()):
        return CaseResult(math.inf, 0.0, "colors are not finite")
    window = max(stylizer.job.total_steps // 50, 1)
    losses = torch.tensor([record.loss for record in stylizer.history], dtype=torch.float64)
    levels = losses.view(-1, window).mean(1)
    rise = float(levels[-1] / levels.min()) - 1
    return CaseResult(
        rise, 0.05, f"{stylizer.job.total_steps} steps; loss {float(levels[-1] / losses[0]):.2g} of the first"
    )


def _resumed(way: Way, full: bool) -> CaseResult:
    whole, first, second = (_stylizer(_walls((2.0, 5)), 8, way, content=True) for _ in range(3))
    run(whole)
    for _ in range(3):
        first.run_step()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.safetensors"
        save_checkpoint(path, Checkpoint(first.state(), first.job.plan, 1, "run", versions()), "job")
        second.load_state(load_checkpoint(path, "job").state)
    run(second)
    return CaseResult(float((whole.sh_dc - second.sh_dc).detach().abs().max()), 0.0, "the same bits")
