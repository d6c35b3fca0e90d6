"""Warm start: give the scene the style's colors before the first step, weighted by visibility in the views.

`warm_start` matches the distribution of the style's colors (see `color_transport`). `with_moments` matches only mean
and covariance, by the linear map that moves colors least (optimal transport between Gaussian distributions; Pitié and
Kokaram, "The Linear Monge-Kantorovitch Linear Color Mapping for Example-Based Color Transfer", 2007):

    A = S^-1/2 (S^1/2 T S^1/2)^1/2 S^-1/2,   c -> A (c - m) + m_style

where S and m are the scene's covariance and mean, and T the style's covariance. Colors outside 0..1, of the scene or
moved there by this map, are clipped. For a dark object and a bright style of two colors, only a pale gray would be
left, which is why `warm_start` does not use it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.scene.color_moments import color_moments, square_root, style_moments
from sgsst_core.scene.luminance import luminance
from sgsst_core.scene.screen import on_screen
from sgsst_core.style import Style, mixed_moments, some_pixels
from sgsst_core.stylizing.color_transport import transported

#: A direction counts as flat if the variance of the colors along it is less than this fraction of their largest
#: variance. It is not stretched to the style's spread, which would amplify rounding errors.
_FLAT = 1e-9


def warm_start(sh_dc: Tensor, weights: Tensor, style: Style) -> Tensor:
    """Return DC coefficients with the distribution of the style's colors, all of them displayable (0..1).

    Args:
        sh_dc: [N, 3] float32.
        weights: [N] float64, total blend weights, at least one positive.
        style: Style, in whose proportions colors then occur.

    Returns:
        [N, 3] float32.
    """
    colors = COLOR_OFFSET + SH_C0 * sh_dc.double()
    wanted = some_pixels(style).to(colors)
    moved = transported(colors, weights.double() / weights.double().amax(), wanted)
    return on_screen(((moved.clamp(0, 1) - COLOR_OFFSET) / SH_C0).to(sh_dc.dtype))


def with_moments(sh_dc: Tensor, weights: Tensor, style: Style) -> Tensor:
    """Return DC coefficients with the style's mean and covariance, clipped to 0..1; arguments as in `warm_start`."""
    colors = (COLOR_OFFSET + SH_C0 * sh_dc.double()).clamp(0, 1)
    mean, covariance = color_moments(colors, weights.double() / weights.double().amax())
    wanted_mean, wanted = style_moments(style)
    matched = (colors - mean) @ _monge_map(covariance, wanted.to(mean)).T + wanted_mean.to(mean)
    return on_screen(((matched.clamp(0, 1) - COLOR_OFFSET) / SH_C0).to(sh_dc.dtype))


def in_colors_of(style: Style, sh_dc: Tensor, weights: Tensor) -> Style:
    """Match the mean and covariance of a style's colors to those of a scene, the inverse of `with_moments`.

    Several images are mapped together, by the moments of their mixture.

    Args:
        style: Images [H, W, 3] in 0..1.
        sh_dc: [N, 3], see `warm_start`.
        weights: [N] float64, see `warm_start`.
    """
    colors = (COLOR_OFFSET + SH_C0 * sh_dc.double()).clamp(0, 1)
    wanted_mean, wanted = color_moments(colors, weights.double() / weights.double().amax())
    mean, covariance = style_moments(style)
    rotated = _monge_map(covariance, wanted.to(mean)).T

    def match(image: Tensor) -> Tensor:
        matched = (image.reshape(-1, 3).double() - mean) @ rotated + wanted_mean.to(mean)
        return matched.clamp(0, 1).to(image.dtype).reshape(image.shape)

    return style.map(match)


def luminance_start(sh_dc: Tensor, weights: Tensor, style: Style) -> Tensor:
    """Return DC coefficients with the style's mean and spread of luminance, clamped to 0..1, and their own chroma.

    Arguments are as in `warm_start`.

    Returns:
        [N, 3] float32.
    """
    colors = COLOR_OFFSET + SH_C0 * sh_dc.double()
    own, shown = luminance(colors), luminance(colors.clamp(0, 1))
    matched = _matched(shown, _luminance_moments(shown, weights.double()), _style_luminance(style))
    return (sh_dc.double() + ((matched - own) / SH_C0)[:, None]).to(sh_dc.dtype)


def in_luminance_of(style: Style, sh_dc: Tensor, weights: Tensor) -> Style:
    """Convert a style to gray, and match the mean and deviation of its luminance to those of a scene.

    Several images are mapped together, by the moments of their mixture.

    Args:
        style: Images [H, W, 3] in 0..1.
        sh_dc: [N, 3], see `warm_start`.
        weights: [N] float64, see `warm_start`.
    """
    wanted = _luminance_moments(luminance((COLOR_OFFSET + SH_C0 * sh_dc.double()).clamp(0, 1)), weights.double())
    own = _style_luminance(style)

    def match(image: Tensor) -> Tensor:
        matched = _matched(luminance(image.double()), own, wanted)
        return matched.to(image.dtype)[..., None].expand(image.shape).contiguous()

    return style.map(match)


def _style_luminance(style: Style) -> tuple[Tensor, Tensor]:
    """Return mean and deviation of the luminance of a style's pixels."""
    luminances = [luminance(image.reshape(-1, 3).double()) for image in style.images]
    parts = [_luminance_moments(values, torch.ones_like(values)) for values in luminances]
    if len(parts) == 1:
        return parts[0]
    moments = [(mean[None], spread.square()[None, None]) for mean, spread in parts]
    mean, variance = mixed_moments(moments, style.weights)
    return mean[0], variance[0, 0].sqrt()


def _luminance_moments(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted mean and deviation of values [n]."""
    fraction = weights / weights.amax()
    fraction = fraction / fraction.sum()
    mean = (fraction * values).sum()
    return mean, (fraction * (values - mean).square()).sum().sqrt()


def _matched(values: Tensor, own: tuple[Tensor, Tensor], wanted: tuple[Tensor, Tensor]) -> Tensor:
    """Map values linearly to another mean and deviation, clamped to 0..1; flat values are only shifted."""
    (mean, deviation), (wanted_mean, wanted_deviation) = own, (part.to(values) for part in wanted)
    flat = deviation <= _FLAT**0.5 * mean.abs().clamp_min(torch.finfo(values.dtype).tiny)
    factor = torch.where(flat, 0.0, wanted_deviation / torch.where(flat, 1.0, deviation))
    return ((values - mean) * factor + wanted_mean).clamp(0, 1)


def _monge_map(source: Tensor, target: Tensor) -> Tensor:
    """Return the symmetric A [3, 3] with A source A = target, in the directions in which the source varies."""
    values, vectors = torch.linalg.eigh(source)
    varies = values > _FLAT * values[-1].clamp_min(torch.finfo(values.dtype).tiny)
    roots = torch.where(varies, values, 0.0).sqrt()
    inverse = torch.where(varies, 1 / torch.where(varies, roots, 1.0), 0.0)
    root = vectors * roots @ vectors.T
    inverse_root = vectors * inverse @ vectors.T
    matrix: Tensor = inverse_root @ square_root(root @ target @ root) @ inverse_root
    return matrix
