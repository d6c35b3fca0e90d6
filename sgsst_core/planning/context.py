"""Objects that are created to measure a job before its first step, and that the job continues to use."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.budget import default_memory_limit, memory_for
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import (
    FeatureNetwork,
    convolutions,
    has_bfloat16,
    has_bfloat16_instructions,
    has_tf32,
    use_whole_float32,
)
from sgsst_core.loss.gradient_error import Difference
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import layers_of
from sgsst_core.parallel.collectives import Collectives
from sgsst_core.planning.choices import precision_of
from sgsst_core.planning.facts import Machine
from sgsst_core.planning.plan import Device
from sgsst_core.rasterizer import Rasterizer, drawing_problem, gpu_rasterizers, make_rasterizer, rasterizer_for
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import downscale
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import Precision, Settings
from sgsst_core.style import Style
from sgsst_core.timing import Timer

DTYPES: dict[Precision, torch.dtype] = {"float32": torch.float32, "tf32": torch.float32, "bfloat16": torch.bfloat16}
#: Channels and side of the timed convolution: about a millisecond of work on a CPU core, and enough to fill a GPU.
_CHANNELS: dict[Device, int] = {"cpu": 128, "cuda": 256}
_SIDE: dict[Device, int] = {"cpu": 24, "cuda": 256}
#: Minimum total seconds of the repetitions, so that the launch time is negligible.
_LEAST_SECONDS: dict[Device, float] = {"cpu": 0.0, "cuda": 5e-3}
#: Maximum longer side of the view on which another precision is compared with float32.
_COMPARED_SIDE: dict[Device, int] = {"cpu": 384, "cuda": 2048}
#: Number of measurements, of which the fastest counts: another process can interrupt one.
_MEASUREMENTS = 5


@dataclass(frozen=True)
class PlanningContext:
    """Objects that are created for measuring before the job, and that the job continues to use.

    Attributes:
        scene: Whole scene, with the SH attenuation of the settings applied.
        cameras: Cameras at the size used for stylization.
        settings: Settings of the job.
        machine: Facts about the machine.
        weights: Weights of the network.
        network: Network in the precision in which it will run.
        precision_ratio: See `Facts`.
        rasterizer: Rasterizer of the whole scene that computes blend weights.
        sh_degree: SH degree of the original scene.
    """

    scene: Scene
    cameras: tuple[Camera, ...]
    settings: Settings
    machine: Machine
    weights: BackboneWeights
    network: FeatureNetwork
    precision_ratio: float | None
    rasterizer: Rasterizer
    sh_degree: int

    @property
    def precision(self) -> Precision:
        """Precision of the network."""
        return precision_of(self.settings.precision, self.precision_ratio)


def equip(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: Settings,
    weights: BackboneWeights,
    collectives: Collectives,
    rasterizer: str | None = None,
) -> PlanningContext:
    """Create the planning context. Every rank must call this, and gets the same result up to rounding.

    Args:
        scene: Scene as it was read.
        cameras: Cameras at the size used for stylization.
        settings: Settings of the job.
        weights: Weights of the network.
        collectives: Ranks of the job.
        rasterizer: Rasterizer that computes blend weights; None to choose one.
    """
    sh_degree, scene = scene.sh_degree, scene.attenuated(settings.sh_attenuation)
    device = common_device(collectives)
    problems = gpu_problems(collectives) if device == "cuda" else {}
    ratio = precision_ratio(settings.precision, device, collectives)
    network = make_network(weights, settings, precision_of(settings.precision, ratio), device)
    limit = settings.memory_limit or default_memory_limit(network.device)
    machine = Machine(
        device,
        # The partition, and thereby rounding, depends on the limit, so it must be identical on all ranks.
        memory_limit=min(collectives.all_gather(limit)),
        sharing=sharing_memory(collectives, device),
        ranks=collectives.size,
        problems=problems,
    )
    name = rasterizer or rasterizer_for(device, problems)
    memory = memory_for("rasterizer", machine.memory)
    of_scene = make_rasterizer(name, scene, background=settings.background, near=settings.near, memory=memory)
    return PlanningContext(scene, tuple(cameras), settings, machine, weights, network, ratio, of_scene, sh_degree)


def common_device(collectives: Collectives) -> Device:
    """Return the device that is available on all ranks."""
    return "cuda" if all(collectives.all_gather(torch.cuda.is_available())) else "cpu"


def gpu_problems(collectives: Collectives) -> dict[str, str]:
    """Return the problem of each GPU rasterizer that does not work on some rank, by the rasterizer's name.

    Rasterizers are tried in order of preference, until one works.
    """
    problems: dict[str, str] = {}
    for name in gpu_rasterizers():
        problem = rasterizer_problem(collectives, name)
        if problem is None:
            break
        problems[name] = problem
    return problems


def rasterizer_problem(collectives: Collectives, name: str) -> str | None:
    """Return the reason why a GPU rasterizer does not work on some rank; None if it works on all."""
    return next(filter(None, collectives.all_gather(drawing_problem(name))), None)


def sharing_memory(collectives: Collectives, device: Device) -> int:
    """Return the maximum number of ranks that share the memory of a machine, or of a GPU."""
    return collectives.gpu_sharing if device == "cuda" else max(collectives.all_gather(collectives.local_size))


def make_network(weights: BackboneWeights, settings: Settings, precision: Precision, device: Device) -> FeatureNetwork:
    """Create the feature network with layers up to the deepest one used."""
    layers = layers_of(settings.style_loss, weights, content=settings.content_weight > 0, settings=settings)
    use_whole_float32()
    return FeatureNetwork(weights, layers, DTYPES[precision], device, tf32=precision == "tf32")


def precision_ratio(requested: Precision, device: Device, collectives: Collectives) -> float | None:
    """Return how many times faster a convolution is in the requested precision than in float32.

    If float32 was requested, measure bfloat16, so that the plan can recommend it. All ranks must call this.

    Returns:
        Ratio measured on the first rank. None if some rank lacks the precision, or would have to emulate one that was
            not requested.
    """
    if requested == "float32":
        measured: Precision = "bfloat16"
        supported = has_bfloat16_instructions(device)
    else:
        measured = requested
        supported = has_tf32(device) if requested == "tf32" else has_bfloat16(device)
    if not all(collectives.all_gather(supported)):
        return None
    return collectives.broadcast(lambda: convolution_ratio(measured, device))


def convolution_ratio(precision: Precision, device: Device) -> float:
    """Return the ratio of a convolution's time in float32 to its time in another precision.

    On a CPU, one thread is measured: several would wait for each other while other processes use their cores.
    """
    threads = torch.get_num_threads()
    if device == "cpu":
        torch.set_num_threads(1)
    try:
        return _convolution_seconds("float32", device) / _convolution_seconds(precision, device)
    finally:
        torch.set_num_threads(threads)


def _convolution_seconds(precision: Precision, device: Device) -> float:
    """Return the time in seconds of a 3x3 convolution, the fastest of some."""
    channels, side, dtype = _CHANNELS[device], _SIDE[device], DTYPES[precision]
    image = torch.ones((1, channels, side, side), dtype=dtype, device=device)
    kernel = torch.ones((channels, channels, 3, 3), dtype=dtype, device=device)
    if device == "cuda":
        image, kernel = (tensor.contiguous(memory_format=torch.channels_last) for tensor in (image, kernel))

    def run(times: int) -> float:
        timer = Timer(device)
        with convolutions(image.device, tf32=precision == "tf32"), timer("convolution"):
            for _ in range(times):
                torch.nn.functional.conv2d(image, kernel, padding=1)
        return timer.read()["convolution"]

    return min(seconds_of(run, _LEAST_SECONDS[device]) for _ in range(_MEASUREMENTS))


def seconds_of(run: Callable[[int], float], least: float) -> float:
    """Return the time in seconds of one repetition, from enough repetitions to take `least` seconds after a warm-up.

    Args:
        run: Function that repeats something a number of times and returns the total seconds.
        least: Minimum total seconds.
    """
    run(1)
    times = 1
    while (seconds := run(times)) < least:
        times *= 2
    return seconds / times


def gradient_error(context: PlanningContext, camera: Camera) -> Difference | None:
    """Compare the pixel gradient of a view with that of the same network in full float32, for a synthetic style.

    Args:
        context: Objects to measure with.
        camera: View, which is rendered unstylized and then downscaled.

    Returns:
        Difference of the gradients; None if the network runs in float32.
    """
    network, rasterizer = context.network, context.rasterizer
    if network.precision == "float32":
        return None
    colors = scene_colors(context.scene, camera)
    image = rasterizer.render(colors.to(rasterizer.device), camera).to(network.device)
    longer, shorter = max(image.shape[:2]) / _COMPARED_SIDE[context.machine.device], min(image.shape[:2])
    image = downscale(
        image,
        min(max(0, math.ceil(math.log2(longer))), shorter.bit_length() - 1),
    )
    reference = FeatureNetwork(context.weights, network.layers, torch.float32, network.device)
    memory, gradients = memory_for("activations", context.machine.memory), []
    for each in (network, reference):
        loss = SosLoss(each, content_weight=0, style_loss=context.settings.style_loss, memory=memory)
        style = loss.targets.of_style(Style.of(soft_image(max(image.shape[:2]))), (image.shape[0], image.shape[1]))
        result = loss.evaluate(image, style, loss.targets.of_view(image), [0])
        assert result.image_gradient is not None
        gradients.append(result.image_gradient)
    return Difference.of(*gradients)


def soft_image(side: int) -> Tensor:
    """Return a smooth synthetic image [side, side, 3] in 0..1: fixed random colors 16 pixels apart, interpolated."""
    cells = torch.rand((1, 3, side // 16 + 1, side // 16 + 1), generator=torch.Generator().manual_seed(0))
    image = torch.nn.functional.interpolate(cells, size=(side, side), mode="bilinear")[0]
    return image.permute(1, 2, 0).contiguous()
