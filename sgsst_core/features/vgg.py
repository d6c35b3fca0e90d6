"""VGG feature networks as plain layers with an explicit backward pass.

The backward pass is written out instead of using autograd for three reasons: only the gradient with respect to the
pixels is needed; saved activations are released as soon as they are used; and the discrete decisions (ReLU masks,
max-pool positions) are accessible, so that tests can distinguish a decision that flips under rounding from an error.

The scale of a layer's features decides how much the layer and its terms count: if its features are s times as large,
its Gram loss is s^4 times as large, and its mean, standard deviation and content losses are s^2 times as large. The
paper uses the original VGG19 (`vgg_conv.pth` of Gatys et al.); torchvision's networks were trained separately, and
their layers have other scales. ReLU networks are positively homogeneous: multiplying a layer's weights by the ratio of
its factor to the previous layer's, and its biases by its own factor, scales its features by exactly that factor. A
factor for `PIXELS` adds the pixels themselves to the comparison, which the paper does not do.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from sgsst_core.features.layers import (
    convolve_pixels,
    convolve_winograd,
    has_pixel_kernels,
    max_pool,
    max_pool_backward,
    pixel_gradient,
    relu_backward,
    transform_weight,
    winograd_pays_off,
)
from sgsst_core.features.network_weights import BLOCKS, CAFFE_MEAN, BackboneWeights
from sgsst_core.scene.colors import gray, gray_gradient
from sgsst_core.settings import FeatureScale, Settings
from sgsst_core.style import STARRY_NIGHT

#: Layers whose Gram matrix, mean and standard deviation form the style loss (Gatys et al.; SGSST).
STYLE_LAYERS = ("relu1_1", "relu2_1", "relu3_1", "relu4_1", "relu5_1")
#: The image itself as an additional layer before the first, which the paper does not have. It has three channels, one
#: cell per pixel, and its features are colors times `PIXEL_UNIT`. The unit is close to that of a 0-255 input; as a
#: power of two, it causes no rounding. The standard deviation of an image of nearly one color is therefore accurate,
#: whereas after the input shift it would be dominated by rounding errors.
PIXELS = "pixels"
PIXEL_UNIT = 256.0
#: Layer whose features form the content loss.
CONTENT_LAYER = "relu4_2"
#: Radius in pixels of the receptive field of relu5_1 (VGG19: 70, VGG16: 58), rounded up to a multiple of 16, the stride
#: of its cells. With a halo of this width, the features that a partition tile owns are exact.
HALO = {"vgg16": 64, "vgg19": 80}
#: Partition tiles start at multiples of the deepest layer's stride, so that every pooling window lies in one tile.
ALIGNMENT = 16
#: PyTorch's cuDNN settings. Untyped, because the type stubs lack the newer attributes.
_CUDNN: Any = torch.backends.cudnn
#: Unit of float16 features, which reach 43,000 in units of a 0-255 input, and factor of gradients with respect to
#: features of such an input. Gradients grow with the inverse of a view's covered pixels: at 240x180, they reach 8e5 and
#: have a root mean square of 1e4.
FLOAT16_FEATURES, FLOAT16_GRADIENTS = 2.0**6, 2.0**-16
#: Relative rounding error of TF32 multiplication, the counterpart of `torch.finfo(...).eps`.
_TF32_EPS = 2.0**-10
#: Number of values from which a tensor overflows 32-bit indices. cuDNN's fused convolution has no fallback, and other
#: operations split such tensors into parts, which takes time and memory.
_INDEXED_VALUES = 2**31
#: Side of the first image on which fused convolutions are tried, and their tolerance relative to the largest value. In
#: TF32 and bfloat16, fused and separate operations round at different points of the computation.
_TRIAL_SIDE, _TRIAL_TOLERANCE = 32, 2**-6


def layer_stride(layer: str) -> int:
    """Return the distance in pixels between neighboring cells: 1 for `PIXELS` and relu1_*, up to 16 for relu5_*."""
    return 1 if layer == PIXELS else 1 << (int(layer[4]) - 1)


#: Callback of `FeatureNetwork.backward` with layer, features and gradient.
FeatureGradient = Callable[[str, Tensor, Tensor], bool | None]


@dataclass
class _Convolution:
    """3x3 convolution with its ReLU."""

    layer: str  # "relu1_1"
    weight: Tensor  # [out, in, 3, 3]
    bias: Tensor  # [out]
    backward_weight: Tensor  # [in, out, 3, 3], transposed and flipped
    winograd: bool = False  # large enough images are convolved by Winograd's algorithm
    fused: bool = False  # cuDNN runs convolution, bias and ReLU in one launch
    tried: int = 0  # most pixels at which the fused convolution was compared with separate operations

    # Transforming all weights takes about as long as a step, and a plan makes none.
    @cached_property
    def transformed(self) -> Tensor | None:
        return transform_weight(self.weight) if self.winograd else None

    @cached_property
    def backward_transformed(self) -> Tensor | None:
        return transform_weight(self.backward_weight) if self.winograd else None


class _Pool:
    """2x2 max pool."""


_Step = _Convolution | _Pool


@dataclass
class Activations:
    """Result of one forward pass: the requested features, and what the backward pass needs.

    Attributes:
        features: Features [h, w, c] by layer, in the network's dtype (an NHWC view); `PIXELS` is float32 or float64.
        outputs: ReLU output [1, c, h, w] of each convolution. The entry of a pooling layer is an empty tensor [0],
            since the positions of its maxima are recomputed.
    """

    features: dict[str, Tensor]
    outputs: list[Tensor] = field(default_factory=list)
    size: tuple[int, int] = (0, 0)


def use_whole_float32() -> None:
    """Disable TF32 for float32 convolutions and matrix products on GPUs.

    By default, PyTorch lets cuDNN round factors to the 10-bit mantissa of TF32. Gradients would be inexact, and
    gradients of a view split into partition tiles would differ from those of the whole view.
    """
    # Set both: other libraries read the older names, which do not turn TF32 off if the newer settings allow it.
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
    _CUDNN.conv.fp32_precision = "ieee"
    torch.backends.cuda.matmul.fp32_precision = "ieee"


def has_tf32(device: torch.device | str) -> bool:
    """Return whether a device supports TF32, as NVIDIA GPUs of compute capability 8.0 and above do.

    A network may run in float16 on the same GPUs.
    """
    return _is_nvidia(device) and torch.cuda.get_device_capability(device) >= (8, 0)


def has_bfloat16(device: torch.device | str) -> bool:
    """Return whether a device computes in bfloat16, as all do but NVIDIA GPUs below compute capability 8.0.

    PyTorch emulates bfloat16 there, and Triton does not compile it.
    """
    return not _is_nvidia(device) or has_tf32(device)


def has_matrix_units() -> bool:
    """Return whether the CPU has matrix units for bfloat16 (AMX), as far as PyTorch knows.

    Vector instructions for bfloat16 (AVX-512, ARM) are about as fast as Winograd's algorithm, and less accurate.
    """
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("amx_bf16"))


def _is_nvidia(device: torch.device | str) -> bool:
    return torch.device(device).type == "cuda" and torch.version.hip is None


@contextmanager
def convolutions(device: torch.device, *, tf32: bool = False) -> Iterator[None]:
    """Set the precision of float32 convolutions on a GPU inside a `with` block.

    cuDNN chooses deterministic algorithms by its heuristics: on an H100, benchmarking all algorithms is no faster
    afterwards, and takes seconds and up to all of the free memory. Settings are restored after the block. Do nothing if
    the device is not a GPU.

    Args:
        tf32: Whether to use TF32 instead of full float32.
    """
    if device.type != "cuda":
        yield
        return
    before = _CUDNN.benchmark, _CUDNN.deterministic, _CUDNN.conv.fp32_precision
    try:
        _CUDNN.benchmark, _CUDNN.deterministic = False, True
        _CUDNN.conv.fp32_precision = "tf32" if tf32 else "ieee"
        yield
    finally:
        _CUDNN.benchmark, _CUDNN.deterministic, _CUDNN.conv.fp32_precision = before


class FeatureNetwork:
    """VGG up to the deepest requested layer.

    Args:
        weights: Convolutions and input normalization, with features in units of a 0-255 input.
        layers: Layers to report (for instance `STYLE_LAYERS` and `CONTENT_LAYER`), at least one of them a convolution.
            The network ends at the deepest of them.
        dtype: torch.float32, torch.float64 (reference), torch.bfloat16 or torch.float16.
        tf32: Whether convolutions of a float32 network round their factors to the 10-bit mantissa of TF32. Only NVIDIA
            GPUs do this.
        winograd: Whether a float32 network on a CPU convolves by Winograd's algorithm (`convolve_winograd`).

    Attributes:
        unit: Factor of the content layer's features relative to the units of a 0-255 input.
        pixel_weight: Weight of the terms of `PIXELS`: the layer's factor squared. The features of `PIXELS` are not
            multiplied by this factor.
        feature_unit: Unit of the features of all layers but `PIXELS`: a power of two in float16, whose range ends at
            65504, and otherwise 1. A ReLU network is homogeneous, so that dividing its input and its biases divides
            its features.
        loss_factor: Factor of a loss whose gradient with respect to such features float16 can represent; otherwise 1.
    """

    def __init__(
        self,
        weights: BackboneWeights,
        layers: Sequence[str] = (*STYLE_LAYERS, CONTENT_LAYER),
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        *,
        tf32: bool = False,
        winograd: bool = False,
    ) -> None:
        if (tf32 or winograd) and dtype != torch.float32:
            raise ValueError(f"TF32 and Winograd's algorithm are ways to multiply float32, not {dtype}")
        self.name = weights.name
        self.layers = tuple(layers)
        self.dtype = dtype
        self.device = torch.device(device)
        self.tf32, self.winograd = tf32, winograd
        self.unit = weights.scales.get(CONTENT_LAYER, 1.0)
        self.pixel_weight = weights.scales.get(PIXELS, 1.0) ** 2
        # Map from pixels to the values that the first convolution reads. In bfloat16, each of the 256 gray levels would
        # be rounded twice.
        precision = torch.promote_types(dtype, torch.float32)
        half = dtype == torch.float16
        self.feature_unit = FLOAT16_FEATURES if half else 1.0
        self.loss_factor = FLOAT16_GRADIENTS / FLOAT16_FEATURES if half else 1.0
        self._scale = weights.input_scale.to(self.device, precision) / self.feature_unit
        self._shift = weights.input_shift.to(self.device, precision) / self.feature_unit
        self._gray = weights.gray
        self._steps = self._build(weights)
        self._fuse()
        self._channels = {f"relu{name[4:]}": len(bias) for name, (_, bias) in weights.convolutions.items()}
        self._channels[PIXELS] = 3

    def _build(self, weights: BackboneWeights) -> list[_Step]:
        steps: list[_Step] = []
        left = set(self.layers) - {PIXELS}
        for block, count in enumerate(BLOCKS[weights.name], start=1):
            if block > 1:
                steps.append(_Pool())
            for index in range(1, count + 1):
                name = f"conv{block}_{index}"
                weight, bias = weights.convolutions[name]
                weight = weight.to(self.device, self.dtype)
                backward_weight = weight.transpose(0, 1).flip(2, 3)
                step = _Convolution(
                    f"relu{block}_{index}",
                    weight.contiguous(memory_format=torch.channels_last),
                    (bias / self.feature_unit).to(self.device, self.dtype),
                    backward_weight.contiguous(memory_format=torch.channels_last),
                    self.winograd,
                )
                steps.append(step)
                left.discard(f"relu{block}_{index}")
                if not left:
                    return steps
        raise ValueError(f"{weights.name} has no layers {sorted(left)}")

    @torch.no_grad()
    def _fuse(self) -> None:
        """Use cuDNN's fused convolution with bias and ReLU wherever a test shows that it works."""
        if not _is_nvidia(self.device) or not torch.backends.cudnn.is_available():
            return
        with convolutions(self.device, tf32=self.tf32):
            for step in self._steps:
                if isinstance(step, _Convolution):
                    _try_fusing(step)

    @property
    def precision(self) -> str:
        """Precision of convolutions: "tf32", "winograd", or the name of `dtype`."""
        return "tf32" if self.tf32 else "winograd" if self.winograd else str(self.dtype).removeprefix("torch.")

    @property
    def rounding(self) -> float:
        """Relative rounding error of the features."""
        return _TF32_EPS if self.tf32 else torch.finfo(self.dtype).eps

    @property
    def largest_tile(self) -> int | None:
        """Maximum pixels of a partition tile on a GPU, whose libraries index tensors with 32 bits; None on a CPU."""
        most = max(max(step.weight.shape[:2]) for step in self._steps[:2] if isinstance(step, _Convolution))
        return None if self.device.type == "cpu" else (_INDEXED_VALUES - 1) // most

    @property
    def halo(self) -> int:
        """Width in pixels of the halo with which the features that a partition tile owns are exact."""
        return HALO[self.name]

    def rounding_of(self, layer: str) -> float:
        """Return the relative rounding error of a layer's features."""
        return torch.finfo(self._scale.dtype).eps if layer == PIXELS else self.rounding

    def channels(self, layer: str) -> int:
        """Return the number of channels of a layer."""
        return self._channels[layer]

    @torch.no_grad()
    def forward(self, rgb: Tensor, *, cache: bool = True, until: str | None = None) -> Activations:
        """Compute the features of an image.

        Args:
            rgb: [h, w, 3], values 0..1 (not clamped), any float dtype.
            cache: Whether to store the activations that `backward` needs; if False, only the requested features are
                returned.
            until: Deepest layer to compute; deeper ones are left out. None for all requested layers.

        Returns:
            Activations. A layer whose stride exceeds the image has zero cells (a dimension of size 0).
        """
        height, width = int(rgb.shape[0]), int(rgb.shape[1])
        pixels = rgb.to(self._scale)
        if self._gray:
            pixels = gray(pixels)
        activations = Activations({}, size=(height, width))
        if PIXELS in self.layers:
            activations.features[PIXELS] = pixels * PIXEL_UNIT
        with convolutions(self.device, tf32=self.tf32):
            self._forward_steps(pixels, activations, cache, until)
        for layer in self.layers:
            stride = layer_stride(layer)
            if layer not in activations.features and min(height, width) < stride:
                shape = (height // stride, width // stride, self.channels(layer))
                activations.features[layer] = torch.empty(shape, dtype=self.dtype, device=self.device)
        return activations

    def _forward_steps(self, pixels: Tensor, activations: Activations, cache: bool, until: str | None) -> None:
        """Run the steps on the pixels [h, w, 3], up to the last layer that has cells, or `until`."""
        x = pixels
        for step in self._steps:
            if isinstance(step, _Pool):
                if min(x.shape[2:]) < 2:
                    break
                x = max_pool(x)
                if cache:
                    activations.outputs.append(x.new_empty(0))
                continue
            x = self._convolve_pixels(x, step) if x is pixels else self._convolve(x, step)
            if cache:
                activations.outputs.append(x)
            if step.layer in self.layers:
                activations.features[step.layer] = x[0].permute(1, 2, 0)
            if step.layer == until:
                break

    def _convolve_pixels(self, pixels: Tensor, step: _Convolution) -> Tensor:
        """Normalize pixels [h, w, 3], and apply the first convolution, bias and ReLU."""
        if has_pixel_kernels(step.weight):
            return convolve_pixels(pixels, step.weight, step.bias, self._scale, self._shift)
        # [h, w, 3] viewed as [1, 3, h, w] is already in channels-last order: no copy.
        x = (pixels * self._scale + self._shift).to(self.dtype).permute(2, 0, 1).unsqueeze(0)
        return self._convolve(x, step)

    def _convolve(self, x: Tensor, step: _Convolution) -> Tensor:
        """Apply convolution, bias and ReLU to x [1, in, h, w]."""
        pixels = x.shape[2] * x.shape[3]
        if step.fused and pixels * max(step.weight.shape[:2]) < _INDEXED_VALUES:
            if pixels <= step.tried:
                return _fused_convolution(x, step)
            step.tried = pixels  # cuDNN may choose another algorithm for a larger image
            result = _tried_convolution(x, step)
            if result is not None:
                return result
            step.fused = False
        if winograd_pays_off(*x.shape[2:]) and step.transformed is not None:
            return convolve_winograd(x, step.transformed, step.bias)
        return F.conv2d(x, step.weight, step.bias, padding=1).relu_()

    def _convolve_back(self, gradient: Tensor, step: _Convolution) -> Tensor:
        """Return the gradient [1, in, h, w] of a convolution's input, given the gradient of its output before ReLU."""
        if winograd_pays_off(*gradient.shape[2:]) and step.backward_transformed is not None:
            return convolve_winograd(gradient, step.backward_transformed)
        return F.conv2d(gradient, step.backward_weight, padding=1)

    @torch.no_grad()
    def backward(self, activations: Activations, feature_gradient: FeatureGradient) -> Tensor:
        """Compute the gradient with respect to the pixels; consumes `activations`.

        Args:
            activations: Result of a forward pass with cache=True; its tensors are released along the way.
            feature_gradient: Callback for each reported layer, deepest first. It receives the layer's name, its
                features [h, w, c] and the accumulated gradient [h, w, c], and adds dL/dfeatures to the gradient in
                place. It returns whether it has also set the gradient to 0 wherever the ReLU's output is 0.

        Returns:
            dL/drgb, [h, w, 3], float32 (float64 for a float64 network).
        """
        with convolutions(self.device, tf32=self.tf32):
            gradient = self._backward_steps(activations, feature_gradient)
        shape = (*activations.size, 3)
        pixels = torch.zeros(shape, dtype=self._scale.dtype, device=self.device) if gradient is None else gradient
        if (features := activations.features.pop(PIXELS, None)) is not None:
            own = torch.zeros(shape, dtype=self._scale.dtype, device=self.device)
            feature_gradient(PIXELS, features, own)
            pixels = torch.add(pixels, own, alpha=PIXEL_UNIT)
        return gray_gradient(pixels) if self._gray else pixels

    def _backward_steps(self, activations: Activations, feature_gradient: FeatureGradient) -> Tensor | None:
        """Return the gradient of the pixels [h, w, 3]; None if no layer has a gradient."""
        gradient: Tensor | None = None  # [1, c, h, w]
        masked = False  # whether the gradient is already 0 wherever the ReLU's output is 0
        steps = self._steps[: len(activations.outputs)]
        for step in reversed(steps):
            output = activations.outputs.pop()
            if isinstance(step, _Pool):
                if gradient is not None:
                    gradient, masked = max_pool_backward(gradient, activations.outputs[-1]), True
                continue
            features = activations.features.pop(step.layer, None)
            if features is not None and features.numel():
                gradient = torch.zeros_like(output) if gradient is None else gradient
                masked = bool(feature_gradient(step.layer, features, gradient[0].permute(1, 2, 0)))
            if gradient is not None:
                gradient = gradient if masked else relu_backward(gradient, output)
                if step is self._steps[0] and has_pixel_kernels(step.weight):
                    return pixel_gradient(gradient, step.backward_weight, self._scale)
                gradient, masked = self._convolve_back(gradient, step), False
        return None if gradient is None else gradient[0].permute(1, 2, 0).to(self._scale.dtype) * self._scale

    def held_bytes_per_pixel(self) -> float:
        """Return the bytes per pixel that a forward pass stores until `backward` has used them.

        Computed from the layers: a ReLU output of c channels at stride k holds c/k^2 values per pixel.
        """
        size = torch.finfo(self.dtype).bits // 8
        held, stride = 0.0, 1
        for step in self._steps:
            if isinstance(step, _Pool):
                stride *= 2
            else:
                held += size * int(step.weight.shape[0]) / stride**2
        if PIXELS in self.layers:
            held += 3 * torch.finfo(self._scale.dtype).bits / 8
        return held


def _fused_convolution(x: Tensor, step: _Convolution) -> Tensor:
    """Apply convolution, bias and ReLU in one launch: [1, in, h, w] to [1, out, h, w], both channels last."""
    stride = padding = dilation = (1, 1)
    result: Tensor = torch.ops.aten.cudnn_convolution_relu(x, step.weight, step.bias, stride, padding, dilation, 1)
    return result


def _try_fusing(step: _Convolution) -> None:
    """Fuse a convolution if that works on a small image."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn((1, int(step.weight.shape[1]), _TRIAL_SIDE, _TRIAL_SIDE), generator=generator)
    x = x.to(step.weight).contiguous(memory_format=torch.channels_last)
    step.tried = _TRIAL_SIDE**2
    step.fused = _tried_convolution(x, step) is not None


def _tried_convolution(x: Tensor, step: _Convolution) -> Tensor | None:
    """Return the result of the fused convolution; None if cuDNN fails or disagrees with the separate operations.

    PyTorch passes the uninitialized output to cuDNN as an addend with factor 0. An algorithm that multiplies instead of
    skipping it would return NaN whenever the memory happens to contain NaN, so the trial puts NaN there.
    """
    expected = F.conv2d(x, step.weight, step.bias, padding=1).relu_()
    largest = float(expected.amax())  # none is negative
    torch.full_like(expected, torch.nan)  # fills memory that the allocator reuses for the next tensor of this size
    try:
        output = _fused_convolution(x, step)
    except RuntimeError:  # cuDNN has no engine for it
        return None
    same_layout = output.stride() == expected.stride()
    difference = float(expected.sub_(output).abs_().amax())
    return output if same_layout and difference <= _TRIAL_TOLERANCE * largest else None


#: Factor of every layer except the first, for feature scale `even`. With this factor, Gram matrix, mean and standard
#: deviation contribute about equally to the loss at the start of a job.
EVEN_SCALE = 8.0
#: Factor of the first layer, for `even`. Only this layer responds to color directly. With `EVEN_SCALE`, it would
#: contribute less than 1 % of the loss. The larger factor brings colors closer to the style image without degrading the
#: match of other style features (docs/quality.md).
EVEN_COLOR_SCALE = 16.0
#: Factor of the pixels, for `even`. Without it, colors that initially match the style drift away in favor of brush
#: strokes. On six pairs of scene and style, it reduces the color distance by 3 to 16 levels of 8 bits, and degrades the
#: style measure by up to 0.02 (docs/quality.md).
EVEN_PIXEL_SCALE = 28.0
#: Losses that the original VGG19 logs in the first iteration of a published run (installation guide of J. Johnson's
#: "neural-style", default images at 512 pixels), divided by that run's weights of 100 and 5. The run starts from noise
#: to which the network hardly responds. For style layers, the loss is the mean squared difference between Gram matrices
#: / (c h w) of the noise and of a painting. For the content layer, it is the mean squared difference between features
#: of the noise and of a photo.
PUBLISHED = {
    "relu1_1": 300.2129,
    "relu2_1": 7003.4956,
    "relu3_1": 1530.3320,
    "relu4_1": 124046.3516,
    "relu4_2": 418235.7188,
    "relu5_1": 6.568603,
}
#: Longer side in pixels of the images in the published run.
_PUBLISHED_SIDE = 512


def at_scale(weights: BackboneWeights, scale: FeatureScale) -> BackboneWeights:
    """Return the network with its features scaled as requested.

    Networks that are already scaled, and `vgg_conv.pth`, which is the paper's own network and has an input range of 0
    to 255 without normalization, are returned unchanged.
    """
    if weights.scales or bool((weights.input_scale == 255).all()):
        return weights
    return with_scales(weights, paper_scales(weights) if scale == "paper" else even_scales(weights))


def weights_for(weights: BackboneWeights, settings: Settings) -> BackboneWeights:
    """Return the network for a job's settings.

    Its features are scaled to the feature scale, and its input is luminance if the job preserves chroma.
    """
    scaled = at_scale(weights, settings.feature_scale)
    return replace(scaled, gray=True) if settings.preserve_colors == "luminance" else scaled


def even_scales(weights: BackboneWeights) -> dict[str, float]:
    """Return the layer factors for feature scale `even`.

    Except for `PIXELS`, factors are powers of two, so scaling adds no rounding error.
    """
    layers = [layer.replace("conv", "relu") for layer in weights.convolutions]
    return {**dict.fromkeys(layers, EVEN_SCALE), layers[0]: EVEN_COLOR_SCALE, PIXELS: EVEN_PIXEL_SCALE}


def paper_scales(weights: BackboneWeights) -> dict[str, float]:
    """Return the layer factors with which The Starry Night produces the published losses.

    Factors are rounded to two digits, which makes no visible difference. The published run used another painting; two
    other paintings give factors within 25 % of these.
    """
    with Image.open(STARRY_NIGHT) as painting:
        size = [round(side * _PUBLISHED_SIDE / max(painting.size)) for side in painting.size]
        small = painting.convert("RGB").resize((size[0], size[1]), Image.Resampling.LANCZOS)
    pixels = torch.from_numpy(np.array(small, dtype=np.float32)) / 255
    nothing = (torch.tensor(CAFFE_MEAN) / 255).expand(pixels.shape)
    network = FeatureNetwork(weights, tuple(PUBLISHED), torch.float32)
    features, of_nothing = (network.forward(image, cache=False).features for image in (pixels, nothing))

    def gram(values: Tensor) -> Tensor:
        flat = values.flatten(0, 1).double()
        return flat.T @ flat / flat.numel()

    scales = {}
    for layer, published in PUBLISHED.items():
        if layer == CONTENT_LAYER:
            factor = (published / float((features[layer] - of_nothing[layer]).square().mean())) ** (1 / 2)
        else:
            difference = gram(features[layer]) - gram(of_nothing[layer])
            factor = (published / float(difference.square().mean())) ** (1 / 4)
        scales[layer] = float(f"{factor:.2g}")
    return scales


def with_scales(weights: BackboneWeights, scales: Mapping[str, float]) -> BackboneWeights:
    """Return the network with the features of some layers multiplied by a factor.

    A layer without a factor uses the factor of the preceding layer. `PIXELS` has no preceding layer, and is compared
    only if it has a factor of its own.
    """
    convolutions: dict[str, tuple[Tensor, Tensor]] = {}
    before = 1.0
    for layer, (weight, bias) in weights.convolutions.items():
        factor = scales.get(layer.replace("conv", "relu"), before)
        convolutions[layer] = (
            weight if factor == before else (weight.double() * (factor / before)).float(),
            (bias.double() * factor).float(),
        )
        before = factor
    return replace(weights, convolutions=convolutions, scales=dict(scales))
