"""Findings of `sgsst doctor` about this machine, checks of its device, and the synthetic inputs of both.

`python -m sgsst_core.bench.device_checks` compiles the kernels that jobs use, which are cached on disk. Otherwise the
first job on a machine compiles them, and so does each of the service's confined processes, which cannot write there.
"""

import math
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.bench.doctor import Diagnosis
from sgsst_core.budget import default_memory_limit
from sgsst_core.compiled import kernel_folders
from sgsst_core.errors import OutputError
from sgsst_core.features.layers import convolve_winograd
from sgsst_core.features.network_weights import BLOCKS, BackboneWeights, list_network_weights
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork, use_whole_float32
from sgsst_core.features.weight_files import cache_folder, damage_of
from sgsst_core.files.atomic import ensure_writable_folder
from sgsst_core.loss.sos import SosLoss
from sgsst_core.parallel import ALONE
from sgsst_core.planning.plan import choose_precision, describe_machine, rasterizer_problem
from sgsst_core.rasterizer import RASTERIZERS, Rasterizer, make_rasterizer, rasterizer_for
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera, look_at
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import stylize

#: Standard deviation of a Gaussian relative to the distance between neighbors. About thirty Gaussians contribute to
#: each point, as in scans.
_OVERLAP = 1.0
_CHANNELS = (64, 128, 256, 512, 512)
#: Gigabytes of memory budget below which only small scenes fit.
_LITTLE_MEMORY = 2.0
#: Background of all renders.
BACKGROUND = (1.0, 0.25, 0.5)
#: Relative error bounds for images and features, for gradients, and for the difference of two rasterizers, which may
#: decide differently whether a Gaussian of the least alpha is drawn.
_BOUND, _GRADIENT_BOUND, _DIFFERENCE_BOUND = 1e-5, 5e-6, 1e-3


def findings() -> Iterator[Diagnosis]:
    """Yield findings about this machine, made in this process."""
    yield _weights()
    yield from _caches()
    yield Diagnosis("program", "works", f"Python {sys.version.split()[0]}, PyTorch {torch.__version__}")
    yield _gpu()
    gpu = torch.cuda.is_available()
    device = torch.device("cuda", torch.cuda.current_device()) if gpu else torch.device("cpu")
    yield _memory(device)
    rasterizer, finding = _rasterizer(gpu=gpu)
    yield finding
    yield _precision()
    yield from _results(rasterizer, device)
    compile_kernels()  # those that no check has used, so that the first job does not wait for them
    yield Diagnosis("kernels", "works", "compiled for all jobs")


def _weights() -> Diagnosis:
    installed = {entry.name: entry.path for entry in list_network_weights() if entry.path is not None}
    damages = [damage for name, path in installed.items() if (damage := damage_of(path, name))]
    networks = [name for name in installed if name in ("vgg19", "vgg16")]
    if damages or not networks:
        fetch = "Run `sgsst weights fetch vgg19` (575 MB) or `sgsst weights fetch vgg16` (64 MB)."
        return Diagnosis("weights", "problem", damages[0] if damages else f"no network is installed. {fetch}")
    return Diagnosis("weights", "works", f"{' and '.join(networks)} installed and undamaged")


def _caches() -> Iterator[Diagnosis]:
    """Yield a finding for each folder that cannot be written."""
    triton = Path(os.environ.get("TRITON_CACHE_DIR") or Path(os.environ.get("TRITON_HOME") or Path.home()) / ".triton")
    variables = {
        cache_folder(): "SGSST_CACHE",
        triton: "TRITON_CACHE_DIR",
        **dict.fromkeys(kernel_folders(), "NUMBA_CACHE_DIR"),
    }
    for folder, variable in variables.items():
        try:
            ensure_writable_folder(folder)
        except (OutputError, OSError):
            text = f"{folder} cannot be written, so every process compiles or downloads again. Set {variable}."
            yield Diagnosis("cache", "warning", text)
    if not kernel_folders():
        yield Diagnosis("cache", "warning", "no folder for compiled kernels can be written. Set NUMBA_CACHE_DIR.")


def _gpu() -> Diagnosis:
    if torch.cuda.is_available():
        device = torch.device("cuda", torch.cuda.current_device())
        capability = ".".join(map(str, torch.cuda.get_device_capability(device)))
        name, library = torch.cuda.get_device_name(device), torch.version.cuda or torch.version.hip
        text = f"{torch.cuda.device_count()} x {name}, compute capability {capability}, CUDA {library}"
        return Diagnosis("GPU", "works", text)
    devices = ("/dev/nvidia0", "/proc/driver/nvidia/version", "/dev/kfd")
    if not any(Path(path).exists() for path in devices) and shutil.which("nvidia-smi") is None:
        return Diagnosis("GPU", "works", "there is none; jobs run on the CPU")
    if torch.version.cuda is None and torch.version.hip is None:
        text = "there is one, but this PyTorch is built for CPUs only. Install a build for its CUDA or ROCm version."
        return Diagnosis("GPU", "warning", text)
    try:
        torch.zeros(1, device="cuda")
    except Exception as error:  # whatever the exception, it says why
        return Diagnosis("GPU", "warning", f"PyTorch cannot use it: {str(error).splitlines()[0]} Update its driver.")
    return Diagnosis("GPU", "warning", "PyTorch sees none. Check CUDA_VISIBLE_DEVICES and the driver.")


def _memory(device: torch.device) -> Diagnosis:
    gigabytes = default_memory_limit(device) / 1e9
    text = f"jobs plan with {gigabytes:.1f} GB of {'the GPU' if device.type == 'cuda' else 'the machine'}'s memory"
    if gigabytes >= _LITTLE_MEMORY:
        return Diagnosis("memory", "works", text)
    return Diagnosis("memory", "warning", f"{text}, enough for small views only. End other programs.")


def _rasterizer(*, gpu: bool) -> tuple[str, Diagnosis]:
    """Return the rasterizer of jobs on this machine, and the finding about it."""
    problem = rasterizer_problem(ALONE, TritonRasterizer.name) if gpu else None
    name = rasterizer_for("cuda" if gpu else "cpu", problem)
    text = f"{RASTERIZERS[name].title} works here" if RASTERIZERS[name].on_gpu else "views are rendered on the CPU"
    if problem:
        text += f"; {TritonRasterizer.title} cannot be used: {problem}"
    return name, Diagnosis("rasterizer", "warning" if problem else "works", text)


def _results(rasterizer: str, device: torch.device) -> Iterator[Diagnosis]:
    """Yield a finding for each wrong result; if all are right, a single finding."""
    on_gpu = RASTERIZERS[rasterizer].on_gpu
    cpu = torch.device("cpu")
    checks = list(check_device(rasterizer, device) if on_gpu else check_device(rasterizer, cpu, repeats=3, channels=16))
    wrong = [check for check in checks if not check.passed]
    for check in wrong:
        text = f"wrong {check.name}: {check.error:.3g} exceeds {check.bound:.3g}"
        yield Diagnosis("results", "problem", f"{text}. Do not trust results of this machine.")
    if not wrong:
        yield Diagnosis("results", "works", f"{len(checks)} checks pass, and results repeat bit by bit")


def _precision() -> Diagnosis:
    """Return the precision that jobs choose, and those that can be requested."""
    machine, settings = describe_machine(make_settings(), ALONE), make_settings(precision="auto")
    names = ", ".join(("float32", *machine.precisions))
    return Diagnosis("precision", "works", f"jobs use {choose_precision(settings, machine)}; possible: {names}")


@dataclass(frozen=True)
class Check:
    """Result of a check.

    Attributes:
        error: Error, or the number of results that differ.
    """

    name: str
    error: float
    bound: float

    @property
    def passed(self) -> bool:
        """Whether the error is finite and within its bound."""
        return math.isfinite(self.error) and self.error <= self.bound


def check_device(
    name: str,
    device: torch.device,
    *,
    gaussians: int = 2000,
    size: tuple[int, int] = (96, 64),
    repeats: int = 10,
    channels: int | None = None,
) -> Iterator[Check]:
    """Yield the result of each check, the most telling first.

    Args:
        name: Rasterizer that jobs on this device use.
        size: Width and height of the view in pixels.
        repeats: Number of repeated steps that must be bit-identical.
        channels: Channels of the network's blocks; None for VGG16's own.
    """
    use_whole_float32()
    scene, (camera,) = surface_scene(gaussians, degree=1), views(1, *size)
    rasterizer = make_rasterizer(name, scene, background=BACKGROUND, device=device)
    yield from rasterizer_checks(rasterizer, scene, camera)
    weights = random_weights("vgg16") if channels is None else random_weights("vgg16", (channels,) * 5)
    image = texture(camera.height, camera.width)
    exact = FeatureNetwork(weights, STYLE_LAYERS, torch.float64).forward(image, cache=False).features
    actual = FeatureNetwork(weights, STYLE_LAYERS, device=device).forward(image.to(device), cache=False).features
    errors = [float(_off(actual[layer], exact[layer]).norm() / exact[layer].norm()) for layer in exact]
    yield Check("features", max(errors), _BOUND)
    step = make_step(rasterizer, scene, camera, weights)
    yield Check(f"different results of {repeats} repeated steps", different_repeats(step, repeats), 0.0)


def rasterizer_checks(fast: Rasterizer, scene: Scene, camera: Camera) -> Iterator[Check]:
    """Check properties of images and gradients that hold in exact arithmetic; on a GPU, compare with the CPU's too."""
    colors, background = scene_colors(scene, camera), torch.tensor(BACKGROUND, dtype=torch.float64)
    pixels = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    behind = (1 - fast.coverage(camera).cpu().double())[..., None]
    white, black = (fast.render(torch.full_like(colors, level), camera) for level in (1.0, 0.0))
    # The weights of a pixel and its transmittance add up to 1.
    yield Check("image", float(_off(white, 1 - behind + behind * background).max()), _BOUND)
    yield Check("coverage", float(_off(black, behind * background).max()), _BOUND)
    shown = (fast.render(colors, camera) - black).cpu().double()
    # The gradient is the transpose of rendering.
    gradient = fast.color_gradient(pixels, camera).cpu().double()
    error = float((shown * pixels).sum() - (gradient * colors.double()).sum())
    yield Check("gradient", abs(error) / float(shown.norm() * pixels.norm()), _GRADIENT_BOUND)
    if fast.on_gpu:
        expected = make_rasterizer("cpu", scene, background=BACKGROUND).render(colors, camera).double()
        error = float(_off(fast.render(colors, camera), expected).norm() / expected.norm())
        yield Check("difference from the CPU", error, _DIFFERENCE_BOUND)


def make_step(
    rasterizer: Rasterizer,
    scene: Scene,
    camera: Camera,
    weights: BackboneWeights,
    dtype: torch.dtype = torch.float32,
) -> Callable[[], Tensor]:
    """Return a function that renders a view and computes loss and color gradient, with a synthetic style.

    The function returns their values as one float64 tensor on the CPU. The network computes in `dtype` on the
    rasterizer's device.
    """
    loss = SosLoss(FeatureNetwork(weights, dtype=dtype, device=rasterizer.device), content_weight=0.0)
    size = camera.height, camera.width
    style = loss.targets.of_style(Style.of(texture(*size, seed=1)), size)
    colors = scene_colors(scene, camera).to(rasterizer.device)

    def step() -> Tensor:
        image = rasterizer.render(colors, camera)
        result = loss.evaluate(image, style, loss.targets.of_view(image))
        assert result.image_gradient is not None
        gradient = rasterizer.color_gradient(result.image_gradient.to(image), camera)
        return torch.cat([result.values.flatten().cpu().double(), gradient.flatten().cpu().double()])

    return step


def different_repeats(step: Callable[[], Tensor], repeats: int) -> float:
    """Return how many repetitions have another result than the first run; NaN differs from everything."""
    expected = step()
    return float(sum(not torch.equal(step(), expected) for _ in range(repeats)))


def _off(actual: Tensor, expected: Tensor) -> Tensor:
    return (actual.cpu().double() - expected).abs()


def surface_scene(count: int, degree: int = 0) -> Scene:
    """Return Gaussians on a ball of radius 1, sized to cover it, with opacities like those of scans."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    size = math.log(_OVERLAP * math.sqrt(4 * math.pi / count))
    return Scene(
        means=F.normalize(normal(count, 3), dim=1) * (1 + 0.01 * normal(count, 1)),
        quats=normal(count, 4),
        scales=size + 0.5 * normal(count, 3),
        opacities=-0.5 + 2 * normal(count),
        sh_dc=normal(count, 3),
        sh_rest=0.1 * normal(count, (degree + 1) ** 2 - 1, 3),
    )


def views(count: int, width: int, height: int, zoom: float = 1.0) -> list[Camera]:
    """Return cameras around the ball, which fills most of each view's height; with a zoom of 2.1, whole 3:2 views."""
    up, center = torch.tensor([0.0, -1.0, 0.0]), torch.zeros(3)
    angles = torch.arange(count) * (2 * math.pi / max(count, 1))
    return [
        look_at(
            f"view_{index}", torch.stack([3 * angle.sin(), torch.zeros(()), -3 * angle.cos()]), center, up,
            width=width, height=height, focal=1.3 * height * zoom,
        )
        for index, angle in enumerate(angles)
    ]  # fmt: skip


def texture(height: int, width: int, seed: int = 0) -> Tensor:
    """Return an image [height, width, 3], float32 from 0 to 1, with structure at several scales."""
    generator = torch.Generator().manual_seed(seed)
    planes = torch.zeros((1, 3, height, width))
    for cell, strength in ((64, 0.5), (16, 0.3), (4, 0.2)):
        coarse = torch.rand((1, 3, height // cell + 2, width // cell + 2), generator=generator)
        planes += strength * F.interpolate(coarse, size=(height, width), mode="bilinear", align_corners=False)
    return planes[0].permute(1, 2, 0).contiguous()


def random_weights(name: str = "vgg19", channels: tuple[int, ...] = _CHANNELS) -> BackboneWeights:
    """Return random weights of VGG16 or VGG19, whose blocks have these numbers of channels.

    He initialization preserves the magnitude of features from layer to layer.
    """
    generator = torch.Generator().manual_seed(16)
    layers, before = {}, 3
    for block, (count, after) in enumerate(zip(BLOCKS[name], channels, strict=True), start=1):
        for index in range(1, count + 1):
            weight = torch.randn(after, before, 3, 3, generator=generator) * (2 / (9 * before)) ** 0.5
            layers[f"conv{block}_{index}"] = weight, torch.randn(after, generator=generator)
            before = after
    scale, shift = torch.full((3,), 255.0), torch.full((3,), -120.0)
    return BackboneWeights(name, "random", "", layers, scale, shift)


def compile_kernels() -> None:
    """Stylize small scenes without and with spherical harmonics for two steps, and convolve as wide networks do."""
    weights, style = random_weights("vgg16", (16,) * 5), texture(32, 32, seed=3)
    for degree in (0, 1):
        scene = surface_scene(200, degree=degree)
        stylize(scene, views(2, 48, 32), style, weights=weights, preset="preview", steps_sos=2)
    convolve_winograd(torch.zeros((1, 64, 8, 8)), torch.zeros((36, 64, 64)))


if __name__ == "__main__":
    torch.set_num_threads(1)
    compile_kernels()
