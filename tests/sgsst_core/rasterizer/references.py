"""Independent renderer, and comparison of renders outside the band where rounding decides."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.splat_scenes import colors_of, pixels_like

Array = NDArray[np.float64]


def render(scene: Scene, camera: Camera, colors: Array, *, antialiased: bool, eps2d: float = 0.3) -> Array:
    """Return the image [height, width, 3] over black of Gaussians with colors [N, 3].

    The rendering of the scene itself is ignored.
    """
    mean, quat, log_scale, logit = (
        np.asarray(tensor, dtype=np.float64) for tensor in (scene.means, scene.quats, scene.scales, scene.opacities)
    )
    world = camera.world_to_camera.numpy().astype(np.float64)
    turn = world[:3, :3]
    x, y, z = (mean @ turn.T + world[:3, 3]).T
    front = np.flatnonzero(z >= 0.2)
    front = front[np.argsort(z[front], kind="stable")]
    x, y, z = x[front], y[front], z[front]
    spread = np.array([covariance(quat[i], np.exp(log_scale[i])) for i in front])
    limit_x, limit_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    slope_x = np.clip(x / z, -camera.cx / camera.fx - limit_x, (camera.width - camera.cx) / camera.fx + limit_x)
    slope_y = np.clip(y / z, -camera.cy / camera.fy - limit_y, (camera.height - camera.cy) / camera.fy + limit_y)
    jacobian = np.zeros((len(front), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 2] = camera.fx / z, -camera.fx * slope_x / z
    jacobian[:, 1, 1], jacobian[:, 1, 2] = camera.fy / z, -camera.fy * slope_y / z
    flat = jacobian @ turn @ spread @ turn.T @ jacobian.transpose(0, 2, 1)
    blurred = flat + eps2d * np.eye(2)
    before, after = (m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0] for m in (flat, blurred))
    opacity = 1 / (1 + np.exp(-logit[front]))
    if antialiased:
        opacity = opacity * np.sqrt(np.maximum(before / after, 0))
    center_x, center_y = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inverse = np.linalg.inv(blurred)
    image = np.zeros((camera.height, camera.width, 3))
    for row in range(camera.height):
        for column in range(camera.width):
            dx, dy = column + 0.5 - center_x, row + 0.5 - center_y
            power = inverse[:, 0, 0] * dx * dx + 2 * inverse[:, 0, 1] * dx * dy + inverse[:, 1, 1] * dy * dy
            alpha = np.minimum(opacity * np.exp(-power / 2), 0.99)
            left = 1.0
            for i in np.flatnonzero(alpha >= 1 / 255):
                if left * (1 - alpha[i]) <= 1e-4:
                    break
                image[row, column] += left * alpha[i] * colors[front[i]]
                left *= 1 - alpha[i]
    return image


def covariance(quat: Array, scale: Array) -> Array:
    """Return the covariance of a Gaussian with a wxyz quaternion of any length and deviations along its axes."""
    w, x, y, z = quat / np.linalg.norm(quat)
    axes = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    return axes @ np.diag(scale**2) @ axes.T


def psnr(actual: Array, expected: Array) -> float:
    """Return the PSNR in dB for values in 0..1."""
    return float(-10 * np.log10(np.mean(np.square(actual - expected))))


#: Largest difference at a cutoff: a contribution just above ALPHA_MIN, or one of a Gaussian at a transmittance of up to
#: 1e-2, times a color of up to 2.
LARGEST_STEP = 2e-2


def assert_close_outside_band(
    actual: Tensor,  # [h, w, ...]
    expected: Tensor,  # [h, w, ...]
    band: Tensor,  # [h, w] bool, close to a cutoff
    *,
    tolerance: float,
) -> None:
    """Assert equality within `tolerance` where `band` is False, and within `LARGEST_STEP` where it is True.

    Also assert that within the band, at most a thousandth of all pixels exceeds the tolerance.
    """
    assert actual.shape == expected.shape, f"shapes {tuple(actual.shape)} and {tuple(expected.shape)}"
    difference = (actual.double() - expected.double()).abs()
    assert bool(difference.isfinite().all()), "a value is not finite"
    worst = difference.flatten(2).amax(-1) if difference.dim() > 2 else difference
    outside = worst[~band]
    assert outside.numel() == 0 or float(outside.max()) <= tolerance, (
        f"{int((outside > tolerance).sum())} pixels outside the band differ, by up to {float(outside.max()):.3g}"
    )
    flipped = worst > tolerance
    assert float(worst.max()) <= LARGEST_STEP, f"a flipped cut-off cannot explain a step of {float(worst.max()):.3g}"
    share = float(flipped.double().mean())
    assert share <= 1e-3, f"{share:.2%} of the pixels flip"


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """Return |actual - expected| / |expected| in the Euclidean norm; 0 if both are 0."""
    difference = float((actual.double() - expected.double()).norm())
    return difference / float(expected.double().norm()) if difference else 0.0


def assert_background(rasterizer: Rasterizer, scene: Scene, camera: Camera, background: tuple[float, ...]) -> None:
    """Assert that a view shows none of a scene's Gaussians, and that no gradient reaches them."""
    expected = torch.tensor(background).expand(camera.height, camera.width, 3)
    assert torch.equal(rasterizer.render(colors_of(scene), camera).cpu().float(), expected)
    assert not rasterizer.coverage(camera).any()
    assert not any(values.any() for values in rasterizer.survey(camera))
    gradient = rasterizer.color_gradient(pixels_like(camera), camera)
    assert gradient.shape == (len(scene), 3)
    assert not gradient.any()
