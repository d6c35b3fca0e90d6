"""Trade-off of the feature network's precision: its speed-up over float32 on this machine, and its gradient error."""

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
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import Precision, StyleLossName
from sgsst_core.timing import Timer

DTYPES: dict[Precision, torch.dtype] = {"float32": torch.float32, "tf32": torch.float32, "bfloat16": torch.bfloat16}
#: Channels and side of the timed convolution: about a millisecond of work on a CPU core, and enough to fill a GPU.
_CHANNELS: dict[Device, int] = {"cpu": 128, "cuda": 256}
_SIDE: dict[Device, int] = {"cpu": 24, "cuda": 256}
#: Minimum total seconds of the repetitions, so that the launch time is negligible.
_LEAST_SECONDS: dict[Device, float] = {"cpu": 0.0, "cuda": 5e-3}


def precision_ratio(asked: Precision, device: Device, collectives: Collectives) -> float | None:
    """Return how many times faster a convolution is in the requested precision than in float32.

    All ranks must call this.

    Returns:
        Ratio measured on the first rank. None if float32 was requested, or TF32 is missing on some rank.
    """
    if asked == "float32" or (asked == "tf32" and not all(collectives.all_gather(has_tf32(device)))):
        return None
    return collectives.broadcast(lambda: convolution_ratio(asked, device))


def convolution_ratio(precision: Precision, device: Device) -> float:
    """Return the ratio of a convolution's time in float32 to its time in another precision."""
    return _convolution_seconds("float32", device) / _convolution_seconds(precision, device)


def _convolution_seconds(precision: Precision, device: Device) -> float:
    """Return the time in seconds of a 3x3 convolution."""
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
    """Compare the pixel gradient of a view with that of the same network in full float32, for a synthetic style.

    Args:
        network: Network as the job will run it.
        weights: Weights of the network.
        scene: Whole scene.
        camera: View, which is rendered unstylized and then downscaled.
        rasterizer: Rasterizer of the whole scene.
        memory: Memory budget for activations in bytes.
        side: Maximum longer side of the downscaled view in pixels.
        style_loss: Style loss of the job.

    Returns:
        Difference of the gradients; None if the network runs in float32.
    """
    if network.precision == "float32":
        return None
    colors = scene_colors(scene, camera)
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
