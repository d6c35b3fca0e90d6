"""Colors of one view from spherical harmonics, and their gradient.

    c_j = max(0, 0.5 + SH_C0 * sh_dc_j + sum over l >= 1 of sh_rest_j * Y_l(direction_j))

Only `sh_dc` is optimized, so the sum over l >= 1 is frozen. It is computed once per view (`rest_colors`); after that,
the colors of a view cost one multiply-add and a clamp. Functions operate on plain tensors in the dtype of their
arguments. The sum also has compiled versions: Numba on the CPU, Triton on a GPU.
"""

import functools

import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0, SH_C1, SH_DEGREES, spherical_harmonics
from sgsst_core.devices import on_device
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Gaussians per chunk: limits the basis [chunk, 15] and the float64 copies to some tens of megabytes.
_CHUNK = 1 << 17


def view_directions(
    means: Tensor,  # [N, 3]
    center: Tensor,  # [3] float64
) -> Tensor:
    """Return unit vectors [N, 3] float64 from the camera center to the Gaussians.

    The difference is computed in float64: if the world is far from its origin, both points are large and nearly equal.
    A Gaussian exactly at the center has no direction; it gets the zero vector, so that its color stays finite. (It is
    in front of the near plane and never drawn.)
    """
    offsets = means.double() - center.to(device=means.device, dtype=torch.float64)
    # Like hypot: divided by the largest component first, so that no square overflows or underflows.
    largest = offsets.abs().amax(dim=-1, keepdim=True)
    scaled = offsets / torch.where(largest > 0, largest, torch.ones_like(largest))
    length = scaled.norm(dim=-1, keepdim=True)
    return scaled / torch.where(length > 0, length, torch.ones_like(length))


def basis(
    directions: Tensor,  # [..., 3] unit vectors
    degree: int,
) -> Tensor:
    """Return the real spherical harmonics of degrees 1 to `degree` (at most 3): [..., (degree + 1)^2 - 1]."""
    terms = spherical_harmonics(*directions.unbind(-1))[: (degree + 1) ** 2 - 1]
    return torch.stack(terms, dim=-1) if terms else directions.new_zeros((*directions.shape[:-1], 0))


def rest_colors(
    sh_rest: Tensor,  # [N, K, 3], K = 0, 3, 8 or 15
    means: Tensor,  # [N, 3]
    camera: Camera,
) -> Tensor:
    """Return the frozen part of a view's colors, the sum over l >= 1, [N, 3].

    The result has the dtype and device of `sh_rest`. The sum is computed in float64 and rounded once, except for
    float32 on a GPU, which is summed in float32 (`kernel_rest_colors`).

    Raises:
        ValueError: If K does not match a degree of 0 to 3.
    """
    degree = SH_DEGREES.get(int(sh_rest.shape[1]))
    if degree is None:
        raise ValueError(f"sh_rest must have 0, 3, 8 or 15 coefficients per Gaussian, not {sh_rest.shape[1]}")
    if degree == 0:
        return torch.zeros(sh_rest.shape[0], 3, dtype=sh_rest.dtype, device=sh_rest.device)
    if sh_rest.dtype == torch.float32 and sh_rest.device.type == "cpu":
        return _compiled_rest_colors(sh_rest, means, camera, degree)
    if sh_rest.dtype == torch.float32 and sh_rest.is_cuda and triton_runs_on(sh_rest.device):
        return kernel_rest_colors(sh_rest, means, camera, degree)
    return reference_rest_colors(sh_rest, means, camera, degree)


def reference_rest_colors(
    sh_rest: Tensor,  # [N, K, 3]
    means: Tensor,  # [N, 3]
    camera: Camera,
    degree: int,
) -> Tensor:
    """Compute `rest_colors` [N, 3] of degree 1 to 3 with tensor functions.

    Computes in float64 and rounds to the dtype of `sh_rest`.
    """
    colors = torch.empty(sh_rest.shape[0], 3, dtype=sh_rest.dtype, device=sh_rest.device)
    count = (degree + 1) ** 2 - 1
    for start in range(0, sh_rest.shape[0], _CHUNK):
        chunk = slice(start, start + _CHUNK)
        values = basis(view_directions(means[chunk], camera.center), degree)
        colors[chunk] = torch.einsum("nk,nkc->nc", values, sh_rest[chunk, :count].double()).to(sh_rest.dtype)
    return colors


def _compiled_rest_colors(sh_rest: Tensor, means: Tensor, camera: Camera, degree: int) -> Tensor:
    """Compute `rest_colors` for float32 on all CPU cores. The last bit may differ from the reference."""
    from sgsst_core.compiled import kernel_threads
    from sgsst_core.scene import kernels as kernels

    colors = torch.empty((len(sh_rest), 3))
    values, points = (tensor.detach().cpu().contiguous().numpy() for tensor in (sh_rest, means))
    with kernel_threads():
        kernels.rest_colors(values, points, camera.center.numpy(), degree, colors.numpy())
    return colors


def kernel_rest_colors(
    sh_rest: Tensor,  # [N, K, 3] float32
    means: Tensor,  # [N, 3]
    camera: Camera,
    degree: int,
) -> Tensor:
    """Compute `rest_colors` of degree 1 to 3 in one launch of a Triton kernel: [N, 3] float32.

    Directions are float64 differences; basis and sum are float32, which differs from `rest_colors` by up to 1e-6 of
    the sum of the coefficients' magnitudes. Runs on a GPU, or on the CPU if Triton's interpreter is on.
    """
    from sgsst_core.scene import triton_kernels as kernels

    count, block = len(sh_rest), kernels.BLOCK.value
    colors = torch.empty((count, 3), device=sh_rest.device)
    if count:
        center = camera.center.to(device=sh_rest.device, dtype=torch.float64, non_blocking=True)
        with on_device(sh_rest.device):
            kernels.rest_colors[(-(-count // block),)](
                sh_rest.contiguous(), means.to(sh_rest.device).contiguous(), center, colors, count,
                DEGREE=degree, COEFFICIENTS=sh_rest.shape[1], BLOCK=block,
            )  # fmt: skip
    return colors


@functools.cache
def triton_runs_on(device: torch.device) -> bool:
    """Return whether Triton kernels run on a GPU, by trying the spherical harmonics kernel once per process.

    Triton may be missing, or may not find a C compiler for the code around its kernels.
    """
    one, center = torch.ones((1, 3, 3), device=device), torch.eye(4, dtype=torch.float64)
    camera = Camera("trial", 1, 1, 1.0, 1.0, 0.5, 0.5, center)
    try:
        colors = kernel_rest_colors(one, torch.tensor([[0.0, 0.0, 1.0]], device=device), camera, 1)
    except Exception:  # the tensor functions are used instead
        return False
    return abs(float(colors[0, 0]) - SH_C1) < 1e-6


def harmonics_energy(scene: Scene, weights: Tensor) -> float:
    """Return the fraction of a scene's color energy, without the mean color, that depends on the view direction.

    Spherical harmonics are orthonormal, so the mean square of a Gaussian's color over all directions is the sum of its
    squared coefficients, up to a factor that all degrees share. All sums are float64.

    Args:
        weights: [N] float64, weight of each Gaussian; at least one is positive.
    """
    weights = weights / weights.sum()
    energy = 0.0
    for rows in torch.arange(len(scene)).split(_CHUNK):
        energy += float(weights[rows] @ scene.sh_rest[rows].double().square().sum(dim=(1, 2)))
    colors = scene.sh_dc.double()
    variance = float(weights @ (colors - weights @ colors).square().sum(dim=1))
    return energy / (energy + variance) if energy else 0.0


def view_colors(
    sh_dc: Tensor,  # [N, 3]
    rest: Tensor,  # [N, 3]
) -> Tensor:
    """Return the colors [N, 3] of one view, clamped at zero: `max(0, 0.5 + SH_C0 * sh_dc + rest)`."""
    return torch.add(rest + COLOR_OFFSET, sh_dc, alpha=SH_C0).clamp_min(0)


def scene_colors(scene: Scene, camera: Camera, device: torch.device | str = "cpu") -> Tensor:
    """Return the colors [N, 3] of a scene's Gaussians in one view, computed on a device."""
    rest = rest_colors(scene.sh_rest.to(device), scene.means.to(device), camera)
    return view_colors(scene.sh_dc.to(device), rest)


def view_colors_gradient(
    color_gradient: Tensor,  # [N, 3]
    colors: Tensor,  # [N, 3], of `view_colors`
    *,
    clamp_aware_gradient: bool = False,
) -> Tensor:
    """Return dL/dsh_dc [N, 3]: `SH_C0 * dL/dcolors` where the color is above the clamp, else 0.

    With `clamp_aware_gradient`, colors clamped at 0 also get gradients that would raise them. This is not the
    derivative: it recovers colors that a large step has thrown below 0, which otherwise never move again.
    """
    passes = (colors > 0) | (color_gradient < 0) if clamp_aware_gradient else colors > 0
    return torch.where(passes, SH_C0 * color_gradient, torch.zeros_like(color_gradient))
