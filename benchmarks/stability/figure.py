"""Images of the ten hardest cases: the input, what the published formula gives, and what this program gives.

Each function computes one case, with the published formula in a few lines. Values that are not finite are magenta.
"""

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.stability.case import camera, evaluate, ordinary, repeated, texture, vgg16
from benchmarks.stability.job_cases import Situation, colored, make, views
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.features import vgg
from sgsst_core.features.statistics import layer_statistics, merge
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import TENSORS, Scene, unit_rotations
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.styles import in_colors_of
from sgsst_core.stylizing.stylizer import ADAM_EPS

#: Input, result of the published formula, and result of this program, [H, W, 3] or [H, W] each.
Images = tuple[Tensor, Tensor, Tensor]
_SIDE = 16
#: Color of values that are not finite.
_MAGENTA = torch.tensor([1.0, 0.0, 1.0])
#: Number of partition tiles of 512 x 512 pixels in about a view of 5187 x 3361.
_TILES = 66


def compute_images() -> dict[str, Images]:
    """Compute the images of all cases."""
    images = {}
    for name, compute in CASES.items():
        torch.manual_seed(0)
        images[name] = compute()
    return images


def write_figure(path: Path, images: Mapping[str, Images]) -> None:
    """Write the images of all cases as a JPEG."""
    figure = Figure(figsize=(10.5, 8.6), dpi=100, layout="constrained")
    rows = figure.subplots(5, 6).reshape(10, 3)
    for number, ((name, three), row) in enumerate(zip(images.items(), rows, strict=True), start=1):
        for title, image, axis in zip((f"{number}. {name}", "published", "here"), three, row, strict=True):
            axis.imshow(_shown(image), interpolation="nearest")
            axis.set_title(title, fontsize=8)
            axis.set_axis_off()
    figure.savefig(path, pil_kwargs={"quality": 85})


def _shown(image: Tensor) -> np.ndarray:
    """Return an image as [H, W, 3] in 0 to 1."""
    image = (image[..., None] if image.ndim == 2 else image).double().expand(*image.shape[:2], 3)
    finite = torch.isfinite(image).all(-1, keepdim=True)
    return torch.where(finite, image.nan_to_num(0).clamp(0, 1), _MAGENTA.double()).numpy()


def _hill() -> Tensor:
    """Return a smooth image [16, 16], from 0.2 at the edges to 1."""
    x = torch.linspace(-1.5, 1.5, _SIDE, dtype=torch.float64)
    return 0.2 + 0.8 * torch.exp(-(x[:, None] ** 2) - x**2)


def _one_pass_variance() -> Images:
    """Standard deviations of 256 channels whose means are 1e4."""
    wanted = _hill().flatten()
    features = (1e4 + wanted * torch.randn(64, 64, _SIDE**2, dtype=torch.float64)).float()
    one_pass = (features.square().mean((0, 1)) - features.mean((0, 1)).square()).sqrt()
    ours = layer_statistics(features).std()
    return wanted.view(_SIDE, _SIDE), one_pass.view(_SIDE, _SIDE), ours.view(_SIDE, _SIDE)


def _long_sum() -> Images:
    """Means of 256 constant channels over 17 million positions."""
    wanted, count = _hill().float(), _TILES * 512**2
    values, positions = wanted.unique(return_inverse=True)
    sums = [float(np.cumsum(np.full(count, value))[-1]) for value in values.numpy()]  # one after the other
    tile = layer_statistics(wanted.flatten().expand(512, 512, _SIDE**2))
    ours = functools.reduce(merge, [tile] * _TILES).mean
    return wanted, torch.tensor(sums)[positions] / count, ours.view(_SIDE, _SIDE)


def _gradient(image: Tensor, network: FeatureNetwork) -> Tensor:
    """Return the gradient of an image's style loss, in units of its own size around middle gray."""
    loss = SosLoss(network, content_weight=0)
    gradient = evaluate(loss, image, Style.of(texture(24, 32, 2)), image).image_gradient
    assert gradient is not None
    return 0.5 + gradient / (8 * gradient.abs().nanmedian())


def _long_quaternions() -> Images:
    """Discs with quaternions of lengths from 1e-30 to 1e30; their squares leave the range of float32."""
    scene, view = _wall(6, 4, 0.3, 0.04), camera(96, 72, focal=180.0)
    half = torch.linspace(0, math.pi, 24) / 2
    unit = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], dim=1)
    scene = replace(scene, scales=torch.tensor([0.14, 0.03, 0.03]).log().repeat(24, 1), quats=unit)
    lengths = replace(scene, quats=unit * torch.logspace(-30, 30, 24)[torch.randperm(24)][:, None])
    normalized = F.normalize(lengths.quats)
    lost = normalized.norm(dim=1, keepdim=True) < 0.5  # almost 0, whose rotation matrix is the identity
    published = replace(scene, quats=torch.where(lost, torch.tensor([1.0, 0, 0, 0]), normalized))
    return _render(scene, view), _render(published, view), _render(lengths, view)


def _plain_float16() -> Images:
    """Gradient in float16, without and with units of its own for features and gradients."""
    image = texture(24, 32, 1)
    with patch.multiple(vgg, FLOAT16_FEATURES=1.0, FLOAT16_GRADIENTS=1.0):
        plain = _gradient(image, FeatureNetwork(vgg16(), STYLE_LAYERS, torch.float16))
    return image, plain, _gradient(image, FeatureNetwork(vgg16(), STYLE_LAYERS, torch.float16))


def _render(scene: Scene, view: Camera) -> Tensor:
    return make_rasterizer("cpu", scene).render((COLOR_OFFSET + SH_C0 * scene.sh_dc).clamp_min(0), view)


def _in_float32(scene: Scene, view: Camera) -> tuple[Scene, Camera]:
    """Return a scene in the coordinates of the camera, transformed in float32, and the camera there."""
    pose = view.world_to_camera.float()
    return replace(scene, means=scene.means @ pose[:3, :3].T + pose[:3, 3]), replace(view, world_to_camera=_EYE)


_EYE = torch.eye(4, dtype=torch.float64)


def _placed(rotation: Tensor, center: Tensor, depth: float) -> Tensor:
    """Return a pose [4, 4] that sees a center at a depth."""
    pose = _EYE.clone()
    pose[:3, :3], pose[:3, 3] = rotation, torch.tensor([0, 0, depth]) - rotation @ center
    return pose


def _wall(columns: int, rows: int, spacing: float, scale: float) -> Scene:
    """Return a wall of opaque Gaussians 5 units away, whose colors vary over it."""
    x, y = torch.meshgrid(torch.arange(columns) + 0.5, torch.arange(rows) + 0.5, indexing="xy")
    colors = torch.stack([x / columns, y / rows, 1 - x / columns], dim=-1).reshape(-1, 3)
    means = torch.stack([spacing * (x - columns / 2), spacing * (y - rows / 2), torch.full_like(x, 5)], dim=-1)
    wall = repeated(columns * rows, scale=scale, logit=3.0)
    return replace(wall, means=means.reshape(-1, 3), sh_dc=(colors - COLOR_OFFSET) / SH_C0)


def _far_world() -> Images:
    """A scene 1e6 units from the origin, as in georeferenced captures, at positions that float32 represents."""
    scene, center = _wall(24, 18, 0.125, 0.04), torch.tensor([0, 0, 5.0], dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(torch.tensor([[0, 0.2, 0.3], [-0.2, 0, 0.1], [-0.3, -0.1, 0]]).double())
    offset = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    scene = replace(scene, means=(scene.means * 16).round() / 16)
    far = replace(scene, means=(scene.means + offset).float())
    near, there = (
        replace(camera(96, 72, focal=150.0), world_to_camera=_placed(rotation, each, 5.0))
        for each in (center, center + offset)
    )
    return _render(scene, near), _render(*_in_float32(far, there)), _render(far, there)


def _close_depths() -> Images:
    """Two walls 1e-4 units apart, 1e4 units from the camera, in any order in the file."""
    front = _wall(24, 18, 0.1, 0.06)
    front = replace(front, means=front.means - torch.tensor([0, 0, 5.0]))
    rear = replace(colored(front, 0.1, 0.1, 0.1), means=front.means + torch.tensor([0, 0, 1e-4]))
    both = Scene(*(torch.cat([getattr(front, name), getattr(rear, name)]) for name in TENSORS))
    pose = _placed(_EYE[:3, :3], torch.zeros(3).double(), 1e4)
    view, mixed = replace(camera(96, 72, focal=4e5), world_to_camera=pose), both.subset(torch.randperm(len(both)))
    return _render(front, view), _render(*_in_float32(mixed, view)), _render(mixed, view)


def _needles() -> Images:
    """Gaussians a million times longer than wide; the published formula inverts their covariance in float32."""
    count, view = 18, replace(camera(64, 64, focal=60.0), cx=32.0, cy=32.0, fy=60.0)
    half = (torch.arange(count) + 0.5) * math.pi / count / 2
    zero = torch.zeros(count)
    scene = replace(
        ordinary(count),
        means=torch.stack([0.5 * (4 * half).cos(), 0.5 * (4 * half).sin(), zero + 4], dim=1),
        quats=torch.stack([half.cos(), zero, zero, half.sin()], dim=1),
        scales=torch.tensor([1e3, 1e-3, 1e-3]).log().repeat(count, 1),
        opacities=zero + 3,
    )
    factor = unit_rotations(scene.quats.double()).float() * scene.scales.exp()[:, None, :]
    p, q, r = ((factor @ factor.mT)[:, i, j] * 225.0 + 0.3 * (i == j) for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = p * r - q * q
    pixels = torch.arange(64) + 0.5
    image, left = torch.zeros(64, 64, 3), torch.ones(64, 64, 1)
    for index in (determinant > 0).nonzero().flatten().tolist():
        x, y = (pixels - (15 * scene.means[index, axis] + 32) for axis in (0, 1))
        power = r[index] * x**2 + p[index] * y[:, None] ** 2 - 2 * q[index] * x * y[:, None]
        alpha = (0.95 * (-0.5 * power / determinant[index]).exp()).clamp(0, 0.99)[..., None]
        image += left * alpha * (COLOR_OFFSET + SH_C0 * scene.sh_dc[index]).clamp_min(0)
        left *= 1 - alpha
    wide = replace(scene, scales=torch.tensor([1e3, 2e-2, 2e-2]).log().repeat(count, 1))
    return _render(wide, view), image, _render(scene, view)


def _large_steps() -> Images:
    """A job with a learning rate 25 times too large, with and without the bounds of colors."""
    style, images = 0.2 + 0.6 * texture(72, 96, 7), []
    for bounded in (False, True):
        settings = {"steps_sos": 40, "learning_rate": 5.0, "bounded": bounded, "clamp_aware_gradient": bounded}
        wall = _wall(24, 18, 0.25, 0.1)
        job = make(Situation(wall, style, settings, views(96, 72), network=lambda small: vgg16()))
        run(job)
        images.append(job.job.views.render(0, job.job.views.colors(0, job.sh_dc.detach())))
    return style, images[0], images[1]


def _weak_gradients() -> Images:
    """Values that Adam moves to an image, with gradients from 1e-12 (top row) to 1e3 (bottom)."""
    wanted, sizes = _hill().float(), torch.logspace(-12, 3, _SIDE)[:, None]
    results = []
    for eps in (1e-8, ADAM_EPS):
        values = torch.zeros_like(wanted, requires_grad=True)
        adam = torch.optim.Adam([values], lr=2.5e-3, eps=eps)
        for _ in range(600):
            values.grad = sizes * (values.detach() - wanted)
            adam.step()
        results.append(values.detach())
    return wanted, results[0], results[1]


def _gray_style() -> Images:
    """A gray style in the colors of a scene; the published map divides by the square root of its covariance."""
    style, scene = texture(48, 64, 5).mean(-1, keepdim=True).expand(48, 64, 3), _wall(24, 18, 0.25, 0.1)
    scene = replace(scene, sh_dc=scene.sh_dc * torch.tensor([1, 0.5, 0.2]) + torch.tensor([0.2, 0, -0.5]))
    colors, pixels = COLOR_OFFSET + SH_C0 * scene.sh_dc, style.reshape(-1, 3)
    (own, vectors), (other, others) = (torch.linalg.eigh(torch.cov(each.T)) for each in (pixels, colors))
    rotated = others * other.clamp_min(0).sqrt() @ others.T @ (vectors / own.sqrt()) @ vectors.T
    published = (pixels - pixels.mean(0)) @ rotated.T + colors.mean(0)
    ours = in_colors_of(Style.of(style), scene.sh_dc, torch.ones(len(scene), dtype=torch.float64)).images[0]
    return style, published.view(48, 64, 3), ours


CASES: dict[str, Callable[[], Images]] = {
    "deviations, means of 1e4": _one_pass_variance,
    "means of 17 million": _long_sum,
    "quaternions of any length": _long_quaternions,
    "features in float16": _plain_float16,
    "1e6 units from the origin": _far_world,
    "depths 1e-4 apart": _close_depths,
    "needles": _needles,
    "learning rate of 5": _large_steps,
    "gradients of 1e-12 to 1e3": _weak_gradients,
    "a gray style": _gray_style,
}
