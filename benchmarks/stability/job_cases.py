"""Hard cases of whole jobs: degenerate and extreme styles, scenes and settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.stability.case import Case, CaseResult, flat, repeated, texture, vgg16
from benchmarks.stability.situations import (
    Situation,
    colored,
    crowd,
    even_network,
    make,
    small_network,
    strain,
    views,
)
from sgsst_core.errors import SgsstError
from sgsst_core.features.vgg import PIXELS
from sgsst_core.loss.feature_scale import PUBLISHED, with_scales
from sgsst_core.scene.colors import luminance
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import held

_MEASURE = "loss and gradient at the end, relative to float64; finite, bounded, repeated, not above the start"


def cases() -> list[Case]:
    """Return all cases of this group."""
    entries = [Case(name, "jobs", _MEASURE, partial(_strained, situation)) for name, situation in _SITUATIONS.items()]
    entries += [
        Case(name, "jobs", "jobs that were not refused", partial(_refused, situation))
        for name, situation in _REFUSED.items()
    ]
    return [*entries, Case("chroma of colors from 1e-6 to 1e3", "jobs", "change of chroma, relative", _chroma)]


def _strained(situation: Callable[[], Situation], full: bool) -> CaseResult:
    return strain(situation())


def _refused(situation: Callable[[], Situation], full: bool) -> CaseResult:
    """Check that a job raises an `SgsstError` no later than in its first step."""
    try:
        make(situation()).run_step()
    except SgsstError as error:
        return CaseResult(0.0, 0.0, f"refused: {error}")
    return CaseResult(1.0, 0.0, "was not refused")


def _flat(red: float, green: float, blue: float, height: int = 12, width: int = 16) -> Tensor:
    return flat(red, green, blue, height, width)


def _gray(scene: Scene) -> Scene:
    return replace(scene, sh_dc=scene.sh_dc[:, :1].expand(-1, 3).clone())


def _shaped(scale: tuple[float, float, float], count: int = 40) -> Scene:
    scene = crowd(count)
    return replace(scene, scales=torch.tensor(scale).log().repeat(count, 1))


def _coincident() -> Scene:
    return replace(repeated(40, scale=1.0), sh_dc=torch.randn(40, 3, generator=torch.Generator().manual_seed(2)))


def _opacities(*logits: float) -> Scene:
    scene = crowd(60)
    return replace(scene, opacities=torch.tensor(logits).repeat(60)[:60])


def _with_harmonics(size: float, degree: int = 2) -> Scene:
    scene = crowd(degree=degree)
    return replace(scene, sh_rest=held(scene.sh_rest) * size)


def _scan(**settings: object) -> Situation:
    """Return a job with a scene of one color that covers little of the view, and a style of the same color."""
    scene = colored(replace(crowd(20), scales=torch.full((20, 3), math.log(0.2))), 0.4, 0.4, 0.4)
    return Situation(scene, _flat(0.4, 0.4, 0.4), settings, falls=False)


def _job(
    scene: Callable[[], Scene] = crowd, style: Callable[[], Tensor] | None = None, **settings: object
) -> Situation:
    return Situation(scene(), texture(30, 26, 7) if style is None else style(), settings)


def _unlike(scene: Callable[[], Scene], style: Callable[[], Tensor], **settings: object) -> Situation:
    """Return a job like `_job` whose loss is not required to decrease.

    Scene and style match from the start, or can never match.
    """
    return replace(_job(scene, style, **settings), falls=False)


def _scaled(factor: float) -> Situation:
    scales = dict.fromkeys(("relu1_1", "relu2_1", "relu3_1", "relu4_1", "relu4_2", "relu5_1"), factor)
    return replace(_job(), weights=with_scales(small_network(), scales))


def _black_views(scale: str) -> Situation:
    """Return a job on black views with the trained network.

    The factors of the feature scale "paper" are fixed to avoid computing them.
    """
    weights = vgg16()
    if scale == "paper":
        weights = with_scales(weights, dict.fromkeys(PUBLISHED, 20.0))
    job = _job(lambda: colored(crowd(), 0.0, 0.0, 0.0), feature_scale=scale, steps_coarse=0, steps_sos=1)
    return replace(job, weights=weights, cameras=views()[:1])


def _pixels(situation: Situation, factor: float | None = None) -> Situation:
    """Return the same job with pixel colors as an additional feature layer; None for the default factor."""
    weights = even_network()
    scales = weights.scales if factor is None else weights.scales | {PIXELS: factor}
    return replace(situation, weights=replace(weights, scales=scales))


def _white_on_white() -> Situation:
    """Return a job with a nearly white scene (0.95), and a white style and background.

    The loss depends on small differences of large values, which amplifies rounding errors.
    """
    style = partial(_flat, 1, 1, 1, 64, 64)
    settings = {"background": (1.0, 1.0, 1.0), "content_weight": 0, "learning_rate": 0.01}
    job = _unlike(lambda: colored(crowd(), 0.95, 0.95, 0.95), style, **settings)
    return replace(_pixels(job), cameras=views(32, 32))


def _tiny_views(width: int, height: int, **settings: Any) -> Situation:
    return replace(_job(**settings), cameras=views(width, height), falls=False)


_SITUATIONS: dict[str, Callable[[], Situation]] = {
    "style of one pixel, 1 x 1, in a job": lambda: _job(style=lambda: _flat(0.9, 0.5, 0.1, 1, 1)),
    "style of one row": lambda: _job(style=lambda: texture(1, 60, 3)),
    "style of one column": lambda: _job(style=lambda: texture(60, 1, 3)),
    "flat style: black": lambda: _job(style=lambda: _flat(0, 0, 0)),
    "flat style: white": lambda: _job(style=lambda: _flat(1, 1, 1)),
    "flat style: one color": lambda: _job(style=lambda: _flat(0.9, 0.3, 0.1)),
    "strokes larger than the view": lambda: _job(style_scale=4),
    "strokes larger than a view of 3 x 2": lambda: _tiny_views(3, 2, style_scale=4),
    "strokes smaller than a pixel": lambda: _job(style=lambda: texture(3, 3, 1), style_scale=0.25),
    "thin style turned by 33 degrees": lambda: _job(style=lambda: texture(2, 200, 1), style_rotation=33),
    "thin style turned by -271 degrees": lambda: _job(style=lambda: texture(300, 3, 1), style_rotation=-271),
    "style of one pixel turned by 45 degrees": lambda: _job(
        style=lambda: _flat(0.1, 0.2, 0.9, 1, 1), style_rotation=45
    ),
    "colors matched to a scene of one color": lambda: _job(
        lambda: colored(crowd(), 0.2, 0.5, 0.7), preserve_colors="match"
    ),
    "colors matched to a gray scene": lambda: _job(lambda: _gray(crowd()), preserve_colors="match"),
    "colors of a flat style matched": lambda: _job(style=lambda: _flat(1, 1, 1), preserve_colors="match"),
    "luminance of a scene of one color": lambda: _job(
        lambda: colored(crowd(), 0.2, 0.5, 0.7), preserve_colors="luminance"
    ),
    "luminance of a gray scene": lambda: _job(lambda: _gray(crowd()), preserve_colors="luminance"),
    "luminance of a black scene": lambda: _job(lambda: colored(crowd(), 0, 0, 0), preserve_colors="luminance"),
    "luminance of a flat style": lambda: _job(style=lambda: _flat(0, 0, 0), preserve_colors="luminance"),
    "one Gaussian in a job": lambda: _job(lambda: repeated(1, scale=1.0)),
    "all Gaussians at one place": lambda: _job(_coincident),
    "needles": lambda: _job(lambda: _shaped((3.0, 1e-5, 1e-5))),
    "points": lambda: _job(lambda: _shaped((1e-8, 1e-8, 1e-8))),
    "Gaussians larger than the world": lambda: _job(lambda: _shaped((1e5, 1e5, 1e5))),
    "opacity 0 and 1": lambda: _job(lambda: _opacities(-80.0, 80.0, 0.0)),
    "opacity 1 alone": lambda: _job(lambda: _opacities(90.0)),
    "hardly any opacity": lambda: _job(lambda: _opacities(-5.4)),
    "background in the object's color": lambda: _scan(training_background="palette"),
    "random background colors, style of one color": lambda: _scan(training_background="random"),
    "scan of one color, warm start": lambda: _scan(warm_start=True, training_background="background"),
    "scan of one color, warm start in luminance": lambda: _scan(
        warm_start=True, training_background="palette", preserve_colors="luminance"
    ),
    "nearest neighbors in a flat style": lambda: _unlike(crowd, lambda: _flat(0.5, 0.5, 0.5), style_loss="nnfm"),
    "nearest neighbors of a black scene": lambda: _unlike(
        lambda: colored(crowd(), 0, 0, 0), lambda: _flat(0, 0, 0), style_loss="nnfm"
    ),
    "both losses, a flat style": lambda: _unlike(crowd, lambda: _flat(1, 1, 1), style_loss="mixed"),
    "content weight 0": lambda: _job(content_weight=0),
    "content weight 1e12 in a job": lambda: _unlike(crowd, lambda: texture(30, 26, 7), content_weight=1e12),
    "content weight 1e12, and hardly a change": lambda: _unlike(
        crowd, lambda: texture(30, 26, 7), content_weight=1e12, learning_rate=1e-5
    ),
    "features 1e4 times as large": lambda: _scaled(1e4),
    "features 1e4 times as small": lambda: _scaled(1e-4),
    "black views, features at the paper's scale": lambda: _black_views("paper"),
    "black views, features at one scale": lambda: _black_views("even"),
    "harmonics of 1e4 that fade by half": lambda: _unlike(
        lambda: _with_harmonics(1e4), lambda: texture(30, 26, 7), sh_attenuation=0.5
    ),
    "harmonics of 1e30 that fade out": lambda: _job(lambda: _with_harmonics(1e30), sh_attenuation=1.0),
    "pixels of one color, style of the same": lambda: _pixels(_scan()),
    "pixels of one color, style of another": lambda: _pixels(
        _unlike(lambda: colored(crowd(), 0.4, 0.4, 0.4), lambda: _flat(0.9, 0.3, 0.1))
    ),
    "pixels of one color, style of many": lambda: _pixels(_job(lambda: colored(crowd(), 0.2, 0.5, 0.7))),
    "pixels in luminance, a gray scene": lambda: _pixels(_job(lambda: _gray(crowd()), preserve_colors="luminance")),
    "pixels, a style of one pixel": lambda: _pixels(_job(style=lambda: _flat(0.9, 0.5, 0.1, 1, 1))),
    "pixels, views of 3 x 2": lambda: _pixels(_tiny_views(3, 2)),
    "pixels 1e6 times as large": lambda: _pixels(_job(), 1e6),
    "pixels, harmonics of 100": lambda: _pixels(_unlike(lambda: _with_harmonics(100.0), lambda: texture(30, 26, 7))),
    "white scene before white, flat style: white": _white_on_white,
    "scales weighted 1e12 to 1e-12": lambda: _job(scales=(1e12, 1e-12)),
    "the coarsest scale of a tiny view alone": lambda: _job(scales=(0.0, 1.0)),
}

_REFUSED: dict[str, Callable[[], Situation]] = {
    "nearest neighbors in a style without a cell": lambda: _job(style=lambda: texture(3, 3, 1), style_loss="nnfm"),
    "both losses, a style without a cell": lambda: _job(style=lambda: texture(1, 60, 1), style_loss="mixed"),
    "a scale that no view has": lambda: _job(scales=(0.0, 0.0, 1.0)),
}


def _chroma(full: bool) -> CaseResult:
    """Check that stylizing luminance alone preserves the chroma of colors of very different magnitudes.

    The error bound is one float32 rounding of the larger color, before or after the job.
    """
    scene = crowd(60)
    sizes = torch.logspace(-6, 3, 60)[:, None]
    scene = replace(scene, sh_dc=scene.sh_dc * sizes)
    job = make(Situation(scene, texture(30, 26, 7), {"preserve_colors": "luminance", "steps_sos": 20 if full else 4}))
    while job.step < job.job.total_steps:
        job.run_step()
    stylized = job.stylized().double()
    change = stylized - scene.sh_dc.double()
    size = torch.maximum(stylized.abs(), scene.sh_dc.double().abs()).amax(1, keepdim=True)
    error = float(((change - change.mean(1, keepdim=True)).abs() / size).max())
    if not bool(torch.isfinite(stylized).all()):
        error = math.inf
    return CaseResult(error, 2**-23, f"luminance moved by up to {float(luminance(change).abs().max()):.2g}")
