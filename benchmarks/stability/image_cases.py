"""Hard cases of style and content: images without texture or with extreme values, and constant features."""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from benchmarks.stability.case import (
    LOSS_BOUND,
    Case,
    CaseResult,
    Way,
    compare_losses,
    flat,
    in_ways,
    texture,
    vgg16,
)
from benchmarks.stability.sos_reference import applied, layer_statistics_reference, style_loss_reference
from sgsst_core.features.statistics import layer_statistics
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import LayerTarget, style_loss
from sgsst_core.style import Style

_LOSS = "loss and pixel gradient, relative to float64"
_HEIGHT, _WIDTH = 32, 40


def cases() -> list[Case]:
    """Return all cases of this group."""
    compared: dict[str, Callable[[Way, bool], CaseResult]] = {
        **{f"style: {name}": partial(_style, make) for name, make in _IMAGES.items()},
        **{f"view: {name}": partial(_view, make) for name, make in _IMAGES.items()},
        "style and view: the same constant": _equal_constants,
        "view equal to its content and its style": _nothing_to_do,
        "style: 8 x 8": partial(_small_style, 8),
        "style: 1 x 1": partial(_small_style, 1),
    }
    return [
        *(case for name, run in compared.items() for case in in_ways(name, "style and content", _LOSS, run)),
        Case("style: 10000 x 50", "style and content", "targets, relative to float64", _long_style),
        *(
            Case(
                f"channels dead in {where}", "style and content", "gradient, relative to float64", partial(_dead, where)
            )
            for where in ("the style", "the view", "both")
        ),
        *(
            Case(f"mean-to-sigma ratio of 1e{power}", "style and content", "sigma, relative", partial(_ratio, power))
            for power in (3, 4, 5, 6)
        ),
        Case("gradient at a mean-to-sigma ratio of 1e4", "style and content", "gradient, relative to float64", _steep),
    ]


_constant = partial(flat, height=_HEIGHT, width=_WIDTH)


def _checkerboard() -> Tensor:
    """Return a one-pixel checkerboard, the highest possible spatial frequency."""
    return ((torch.arange(_HEIGHT)[:, None] + torch.arange(_WIDTH)) % 2).float()[..., None].expand(-1, -1, 3).clone()


def _contrast() -> Tensor:
    """Return an image with values of -100 and 100, which the network does not clamp."""
    return 200 * (texture(_HEIGHT, _WIDTH, 4) > 0.5).float() - 100


_IMAGES: dict[str, Callable[[], Tensor]] = {
    "black": partial(_constant, 0.0, 0.0, 0.0),
    "white": partial(_constant, 1.0, 1.0, 1.0),
    "constant gray": partial(_constant, 0.4, 0.4, 0.4),
    "one saturated color": partial(_constant, 1.0, 0.0, 0.0),
    "1-pixel checkerboard": _checkerboard,
    "values of +-100": _contrast,
}


def _style(make: Callable[[], Tensor], way: Way, full: bool) -> CaseResult:
    return compare_losses(texture(_HEIGHT, _WIDTH, 1), make(), texture(_HEIGHT, _WIDTH, 3), way=way)


def _view(make: Callable[[], Tensor], way: Way, full: bool) -> CaseResult:
    return compare_losses(make(), texture(_HEIGHT, _WIDTH, 2), texture(_HEIGHT, _WIDTH, 3), way=way)


def _equal_constants(way: Way, full: bool) -> CaseResult:
    return compare_losses(*(_constant(0.4, 0.4, 0.4) for _ in range(3)), way=way)


def _nothing_to_do(way: Way, full: bool) -> CaseResult:
    return compare_losses(*(texture(_HEIGHT, _WIDTH, 1) for _ in range(3)), way=way)


def _small_style(side: int, way: Way, full: bool) -> CaseResult:
    """Check a style image smaller than the stride of the deepest layers, which the loss then skips."""
    result = compare_losses(
        texture(_HEIGHT, _WIDTH, 1), texture(side, side, 2), texture(_HEIGHT, _WIDTH, 3), way=way, untiled=False
    )
    return CaseResult(result.error, result.bound, f"deepest layers have no features and are skipped; {result.note}")


def _long_style(full: bool) -> CaseResult:
    """Check the targets of a style image 200 times as long as wide, scaled to the view's shorter side."""
    size = (50, 60) if full else (16, 20)
    style = texture(10000, 50, 5)
    single, double = (
        SosLoss(FeatureNetwork(vgg16(), STYLE_LAYERS, dtype), content_weight=0, memory=memory)
        .targets.of_style(Style.of(style.to(dtype)), size)[0][0]
        .layers
        for dtype, memory in ((torch.float32, 1 << 28), (torch.float64, 1 << 34))
    )
    errors = [
        float(
            (getattr(single[layer], name) - getattr(double[layer], name)).norm() / getattr(double[layer], name).norm()
        )
        for layer in STYLE_LAYERS
        for name in vars(double[layer])
    ]
    worst = max(errors) if all(map(math.isfinite, errors)) else math.inf
    return CaseResult(worst, LOSS_BOUND, f"used at {10000 * size[0] // 50} x {size[0]} pixels, in partition tiles")


def _features(seed: int, channels: int = 12) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn((17, 23, channels), generator=generator).relu() * 300


def _dead(where: str, full: bool) -> CaseResult:
    """Check constant channels, at zero and at another value.

    The factor (sigma - sigma_v) / sigma of the published code is not finite for them.
    """
    view, style = _features(1), _features(2)
    for name, features in (("the view", view), ("the style", style)):
        if where in (name, "both"):
            features[..., :3] = 0
            features[..., 3:6] = 123.4
    target = LayerTarget.of(layer_statistics(style))
    _, gradient = style_loss(layer_statistics(view), target)
    actual = applied(gradient, view)
    exact = _autograd(view, LayerTarget.of(layer_statistics_reference(style)))
    published = (layer_statistics(view).std() - target.std) / layer_statistics(view).std()
    broken = int((~torch.isfinite(published)).sum())
    error = _relative(actual, exact)
    return CaseResult(error, LOSS_BOUND, f"the published factor is not finite in {broken} of 12 channels")


def _ratio(power: int, full: bool) -> CaseResult:
    """Check sigma for features whose mean is 10^power times sigma.

    The note gives the error of the published code's one-pass formula.
    """
    generator = torch.Generator().manual_seed(power)
    features = (10.0**power + torch.randn((60, 50, 16), generator=generator, dtype=torch.float64)).float()
    exact = layer_statistics_reference(features).std()
    error = float(((layer_statistics(features).std() - exact).abs() / exact).max())
    flat = features.reshape(-1, 16)
    one_pass = ((flat.T @ flat).diagonal() / len(flat) - flat.mean(0).square()).sqrt().double()
    lost = int(torch.isnan(one_pass).sum())
    off = float(((one_pass - exact).abs() / exact).nan_to_num(0).max())
    return CaseResult(
        error, LOSS_BOUND, f"one pass in float32: NaN in {lost} of 16 channels, else off by up to {off:.1e}"
    )


def _steep(full: bool) -> CaseResult:
    generator = torch.Generator().manual_seed(0)
    view, style = (
        (1e4 + spread * torch.randn((60, 50, 8), generator=generator, dtype=torch.float64)).float() for spread in (1, 2)
    )
    target = LayerTarget.of(layer_statistics(style))
    _, gradient = style_loss(layer_statistics(view), target)
    return CaseResult(_relative(applied(gradient, view), _autograd(view, target)), 1e-4)


def _autograd(features: Tensor, target: LayerTarget) -> Tensor:
    """Return the gradient of one layer's style loss, computed from its definition in float64."""
    x = features.double().clone().requires_grad_()
    (gradient,) = torch.autograd.grad(style_loss_reference(x, target), x)
    return gradient


def _relative(actual: Tensor, exact: Tensor) -> float:
    if not bool(torch.isfinite(actual).all()):
        return math.inf
    return float((actual.double() - exact).norm() / exact.norm())
