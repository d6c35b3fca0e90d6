"""The feature network's precision: what another one than float32 gains here, and what it costs in accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork, convolutions, has_tf32
from sgsst_core.loss.difference import Difference
from sgsst_core.loss.sos import SosLoss
from sgsst_core.parallel.collectives import Collectives
from sgsst_core.planning.pictures import soft_picture
from sgsst_core.planning.plan import Device
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import downscale
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from sgsst_core.settings import Precision, StyleLossName
from sgsst_core.timing import Timer

DTYPES: dict[Precision, torch.dtype] = {"float32": torch.float32, "tf32": torch.float32, "bfloat16": torch.bfloat16}
#: Channels and side of the convolution that is timed: what a core computes in a millisecond, and what fills a GPU.
_CHANNELS: dict[Device, int] = {"cpu": 128, "cuda": 256}
_SIDE: dict[Device, int] = {"cpu": 24, "cuda": 256}
#: Seconds that its repetitions take together at least, so that those of a launch do not count.
_LEAST_SECONDS: dict[Device, float] = {"cpu": 0.0, "cuda": 5e-3}


def precision_ratio(asked: Precision, device: Device, collectives: Collectives) -> float | None:
    """Seconds of a convolution in float32, over those in the precision that was asked for. Every rank calls this.

    Returns:
        The ratio that the first rank has measured; None where float32 was asked for, or TF32 where a rank has none.
    """
    if asked == "float32" or (asked == "tf32" and not all(collectives.all_gather(has_tf32(device)))):
        return None
    return collectives.broadcast(lambda: convolution_ratio(asked, device))


def convolution_ratio(precision: Precision, device: Device) -> float:
    """Seconds of a convolution in float32, over those in another precision."""
    return _convolution_seconds("float32", device) / _convolution_seconds(precision, device)


def _convolution_seconds(precision: Precision, device: Device) -> float:
    """Of a 3x3 convolution."""
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

    return seconds_of(run, _LEAST_SECONDS[device])


def seconds_of(run: Callable[[int], float], least: float) -> float:
    """Seconds of one of so many repetitions that they take `least` seconds together. What comes first prepares.

    Args:
        run: repeats something some times and returns the seconds of them all.
    """
    run(1)
    times = 1
    while (seconds := run(times)) < least:
        times *= 2
    return seconds / times


def gradient_error(
    network: FeatureNetwork,
    weights: BackboneWeights,
    scene: Scene,
    camera: Camera,
    rasterizer: Rasterizer,
    memory: int,
    side: int,
    style_loss: StyleLossName = "sos",
) -> Difference | None:
    """The pixel gradient of a view against that of the same network in whole float32, with a made-up style.

    Args:
        network: as it will run.
        camera: of the view, rendered unstylized and brought down until its longer side is at most `side`.
        rasterizer: of the whole scene.
        memory: bytes that activations may take.
        style_loss: of the job.

    Returns:
        The difference; None where the network is in float32.
    """
    if network.precision == "float32":
        return None
    colors = view_colors(scene.sh_dc, rest_colors(scene.sh_rest, scene.means, camera))
    image = rasterizer.render(colors.to(rasterizer.device), camera).to(network.device)
    longer, shorter = max(image.shape[:2]), min(image.shape[:2])
    image = downscale(image, min(max(0, math.ceil(math.log2(longer / side))), shorter.bit_length() - 1))
    exact = FeatureNetwork(weights, network.layers, torch.float32, network.device)
    gradients = []
    for each in (network, exact):
        loss = SosLoss(each, content_weight=0, style_loss=style_loss, memory=memory)
        style = loss.style_targets(soft_picture(max(image.shape[:2])), (image.shape[0], image.shape[1]))
        result = loss.evaluate(image, style, loss.view_target(image), [0])
        assert result.image_gradient is not None
        gradients.append(result.image_gradient)
    return Difference.of(*gradients)
