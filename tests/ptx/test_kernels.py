"""Tests of compiled kernels at production block sizes, and of the checks of the interpreter that executes them."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterable
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.stability.sos_reference import layer_statistics_reference
from sgsst_core.constants import ALPHA_MIN
from sgsst_core.features.layers import (
    convolve_pixels,
    fused_max_pool,
    fused_max_pool_backward,
    max_pool_backward_reference,
    pixel_gradient,
)
from sgsst_core.features.statistics import fused_statistics
from sgsst_core.loss.terms import StyleGradient, fused_add_content_gradient, fused_add_style_gradient, fused_content_sum
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.rasterizer.triton import CountedPieces, TritonRasterizer
from sgsst_core.rasterizer.triton_kernels import PAIRS
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.rendering import CLASSIC, Rendering
from tests.ptx.driver import PtxDriver, compiled_kernels
from tests.ptx.machine import Kernel
from tests.ptx.memory import FaultError
from tests.ptx.program import Instruction
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import ball, cameras


@pytest.mark.parametrize(
    ("capability", "rendering"), [(80, CLASSIC), (90, CLASSIC), (80, Rendering("antialiased", 0.1))]
)
def test_images_and_gradients_agree_with_reference(capability: int, rendering: Rendering) -> None:
    scene, camera = replace(ball(150), rendering=rendering), cameras(1, 45, 37)[0]
    reference = make_rasterizer("reference", scene)
    colors = torch.rand((len(scene), 3), generator=torch.Generator().manual_seed(0))
    image_gradient = synthetic_image(37, 45, dtype=torch.float32) - 0.5
    image, gradient = (
        reference.render(colors.double(), camera),
        reference.color_gradient(image_gradient.double(), camera),
    )
    with compiled_kernels(capability):
        uncached = make_rasterizer("triton", scene)
        for rasterizer in (uncached, CachedRasterizer(scene, uncached=uncached)):
            assert relative_error(rasterizer.render(colors, camera), image) < 3e-7
            assert relative_error(rasterizer.color_gradient(image_gradient, camera), gradient) < 5e-7


def test_only_pixels_near_a_cutoff_have_larger_errors() -> None:
    """The nearest Gaussian has, in one pixel, a value of alpha that is just above its cutoff, or just below it."""
    scene, camera = replace(ball(60), opacities=torch.linspace(-2, 3, 60)), cameras(1, 19, 17)[0]
    nearest = scene.means[:, 2].argmin()
    alpha = make_rasterizer("reference", scene.subset(nearest[None])).coverage(camera)
    at_cutoff = torch.logit(scene.opacities[nearest].double().sigmoid() * ALPHA_MIN / alpha[alpha > 0].min())
    colors, image_gradient = torch.rand((60, 3)), synthetic_image(17, 19, dtype=torch.float32) - 0.5
    errors = []
    for change in (3e-7, -3e-7):
        opacities = scene.opacities.clone()
        opacities[nearest] = at_cutoff + change
        changed = replace(scene, opacities=opacities)
        reference = ReferenceRasterizer(changed)
        near = reference.near_cutoff(camera, 1e-6)
        assert int(near.sum()) == 1
        elsewhere = image_gradient * ~near[..., None]
        image, gradient = (
            reference.render(colors.double(), camera),
            reference.color_gradient(elsewhere.double(), camera),
        )
        with compiled_kernels(90):
            rasterizer = make_rasterizer("triton", changed)
            actual = rasterizer.render(colors, camera)
            assert relative_error(rasterizer.color_gradient(elsewhere, camera), gradient) < 3e-7
        assert relative_error(actual[~near], image[~near]) < 3e-7
        errors.append(relative_error(actual, image))
    assert max(errors) > 1e-5, "a Gaussian is blended in one of them only"
    assert min(errors) < 3e-7


def test_statistics_of_many_spans_agree_with_float64() -> None:
    image = 255 * synthetic_image(150, 151, dtype=torch.float32)  # 12 spans, the last one incomplete
    exact = layer_statistics_reference(image)
    with compiled_kernels(80):
        statistics = fused_statistics(image)
    assert relative_error(statistics.mean, exact.mean) < 1e-6
    assert relative_error(statistics.centered, exact.centered) < 1e-6


@pytest.mark.parametrize("capability", [80, 90])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("size", [(12, 10), (13, 11), (1, 5)])
def test_pooling_and_its_gradients_are_those_of_the_reference(
    capability: int, dtype: torch.dtype, size: tuple[int, int]
) -> None:
    """Values on a coarse grid, so that most windows have ties, and some are all zero."""
    generator = torch.Generator().manual_seed(0)
    source = torch.randn((1, *size, 64), generator=generator).round().to(dtype).permute(0, 3, 1, 2).relu_()
    gradient = torch.randn((1, size[0] // 2, size[1] // 2, 64), generator=generator).to(dtype).permute(0, 3, 1, 2)
    with compiled_kernels(capability):
        actual, pooled = fused_max_pool_backward(gradient, source), fused_max_pool(source)
    assert torch.equal(pooled, torch.zeros_like(gradient) if min(size) < 2 else F.max_pool2d(source, 2))
    assert pooled.is_contiguous(memory_format=torch.channels_last)
    expected = torch.zeros_like(source) if min(size) < 2 else max_pool_backward_reference(gradient, source)
    assert actual.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(actual, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_threads_that_pool_move_16_bytes_at_a_time(dtype: torch.dtype) -> None:
    source, gradient = (torch.ones((1, side, side, 64), dtype=dtype).permute(0, 3, 1, 2) for side in (7, 3))
    with compiled_kernels(80) as driver:
        fused_max_pool(source)
        fused_max_pool_backward(gradient, source)
        for name in ("max_pool", "max_pool_backward"):
            opcodes = [one.opcode for one in driver.kernels[name].program.instructions]
            accesses = [opcode for opcode in opcodes if opcode[0] in ("ld", "st") and opcode[1] == "global"]
            assert len(accesses) >= 5
            assert all("v4" in opcode for opcode in accesses)


def sparse(shape: tuple[int, ...], strides: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Return zeros with large strides; only accessed pages take memory."""
    count = sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True)) + 1
    mapping = mmap.mmap(-1, count * dtype.itemsize, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x4000)  # NORESERVE
    return torch.frombuffer(mapping, dtype=dtype, count=count).as_strided(shape, strides)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_offsets_beyond_32_bits_are_correct(dtype: torch.dtype) -> None:
    """The last row starts after 2.5e9 values."""
    generator = torch.Generator().manual_seed(0)
    small = (2 + torch.randn((6, 9, 16), generator=generator)).to(dtype)
    features, gradient = (sparse((6, 9, 16), (500_000_000, 16, 1), dtype) for _ in range(2))
    features.copy_(small)
    matrix, mean, offset = (torch.randn(shape, generator=generator) for shape in ((16, 16), (16,), (16,)))
    matrix = matrix + matrix.T
    exact = layer_statistics_reference(small)
    expected = (small.double() - mean.double()) @ matrix.double() + offset.double()
    tolerance = 1e-6 if dtype == torch.float32 else 4e-3
    with compiled_kernels(80):
        assert relative_error(fused_statistics(features).centered, exact.centered) < tolerance
        fused_add_style_gradient(gradient, features, StyleGradient(matrix, mean, offset))
    assert relative_error(gradient.double(), expected) < tolerance


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("channels", [64, 128])
def test_products_of_16_bit_features_are_not_rounded(channels: int, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn((13, 29, channels), generator=generator).relu().to(dtype)
    weights = torch.rand((13, 29), generator=generator)
    exact = layer_statistics_reference(features, weights.to(dtype))
    matrix, mean, offset = (torch.randn(shape, generator=generator) for shape in (2 * (channels,), channels, channels))
    matrix = matrix + matrix.T
    expected = ((features.double() - mean.double()) @ matrix.double() + offset.double()) * weights[..., None]
    gradient = torch.zeros_like(features)
    with compiled_kernels(80) as driver:
        assert relative_error(fused_statistics(features, weights).centered, exact.centered) < 1e-6
        instructions = driver.kernels["shifted_moments"].program.instructions
        assert any(one.opcode[:2] == ("cp", "async") for one in instructions), "loads do not overlap with products"
        fused_add_style_gradient(gradient, features, StyleGradient(matrix, mean, offset), weights)
    assert relative_error(gradient.double(), expected) < torch.finfo(dtype).eps / 2


# --- mutations: a defect in a kernel must be reported ---------------------------------------------------------------


def statistics_kernel(driver: PtxDriver, features: Tensor) -> Kernel:
    fused_statistics(features)
    return driver.kernels["shifted_moments"]


def without_barrier(instruction: Instruction) -> Instruction | None:
    """Replace a barrier of a program by one of a warp."""
    return replace(instruction, opcode=("bar", "warp", "sync")) if instruction.opcode[:2] == ("bar", "sync") else None


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_every_removed_barrier_is_reported(dtype: torch.dtype) -> None:
    features = torch.randn((5, 29, 64), generator=torch.Generator().manual_seed(0)).to(dtype)
    with compiled_kernels(80) as driver:
        kernel = statistics_kernel(driver, features)
        barriers = [
            (number, mutated)
            for number, one in enumerate(kernel.program.instructions)
            if (mutated := without_barrier(one))
        ]
        assert len(barriers) > 2
        for number, mutated in barriers:
            with kernel.changed(number, mutated), pytest.raises(FaultError, match="race in shared memory"):
                fused_statistics(features)
        fused_statistics(features)


def reports(
    kernel: Kernel, mutate: Callable[[Instruction], Instruction | None], run: Callable[[], Tensor]
) -> list[bool]:
    """Return for each mutated instruction whether it causes a fault or another result."""
    exact, reported = run(), []
    for number, instruction in enumerate(kernel.program.instructions):
        mutated = mutate(instruction)
        if mutated is None:
            continue
        with kernel.changed(number, mutated):
            try:
                reported.append(not torch.equal(run(), exact))
            except FaultError:
                reported.append(True)
    return reported


def shifted(instruction: Instruction) -> Instruction | None:
    """Let a comparison accept one position more."""
    if instruction.opcode[:2] != ("setp", "lt"):
        return None
    return replace(instruction, opcode=("setp", "le", *instruction.opcode[2:]))


def test_shifted_masks_are_reported() -> None:
    """Comparisons with one position or channel too many let the kernel read or write beyond the end of a tensor."""
    features = torch.randn((5, 29, 3), generator=torch.Generator().manual_seed(0)).contiguous()
    weights = torch.ones((5, 29))
    with compiled_kernels(80) as driver:
        fused_statistics(features, weights)
        kernel = driver.kernels["shifted_moments"]
        assert sum(reports(kernel, shifted, lambda: fused_statistics(features, weights).centered)) >= 5


def strict(instruction: Instruction) -> Instruction | None:
    """Let a comparison of features with 0 take 0 for a positive number."""
    changed = {"le": "lt", "gtu": "geu"}.get((*instruction.opcode, "")[1])
    if instruction.opcode[0] != "setp" or changed is None or instruction.opcode[-1] not in ("f32", "bf16x2"):
        return None
    return replace(instruction, opcode=("setp", changed, *instruction.opcode[2:]))


def styled(gradient: Tensor, features: Tensor) -> None:
    style = StyleGradient(torch.ones((64, 64)), torch.zeros(64), torch.ones(64))
    fused_add_style_gradient(gradient, features, style, relu=True)


def compared(gradient: Tensor, features: Tensor) -> None:
    factor = torch.ones((), dtype=torch.float64)
    fused_add_content_gradient(gradient, features, features + 1, None, factor, relu=True)


@pytest.mark.parametrize(
    ("name", "add", "capability"),
    [("add_style_gradient", styled, 80), ("add_content_gradient", compared, 90)],  # sm_90 multiplies by `wgmma`
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_every_changed_relu_is_reported(
    name: str, add: Callable[[Tensor, Tensor], None], capability: int, dtype: torch.dtype
) -> None:
    features = torch.randn((5, 29, 64), generator=torch.Generator().manual_seed(0)).relu().to(dtype)

    def gradient() -> Tensor:
        result = torch.zeros_like(features)
        add(result, features)
        return result

    with compiled_kernels(capability) as driver:
        assert torch.equal(gradient() != 0, features != 0)
        reported = reports(driver.kernels[name], strict, gradient)
    assert reported
    assert all(reported)


@pytest.mark.parametrize("name", ["convolve_pixels", "pixel_gradients"])
def test_shifted_borders_of_the_first_layer_are_reported(name: str) -> None:
    """Every comparison of a row or column with the border keeps zeros around the image."""
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn((16, 3, 3, 3), generator=generator).bfloat16().contiguous(memory_format=torch.channels_last)
    pixels, gradient = torch.rand((3, 5, 3), generator=generator), torch.ones((1, 3, 5, 16), dtype=torch.bfloat16)
    one, back = torch.ones(16), weight.transpose(0, 1).contiguous(memory_format=torch.channels_last)
    runs = {
        "convolve_pixels": lambda: convolve_pixels(pixels, weight, one.bfloat16(), one[:3], one[:3]).float(),
        "pixel_gradients": lambda: pixel_gradient(gradient.permute(0, 3, 1, 2), back, one[:3]),
    }
    with compiled_kernels(80) as driver:
        runs[name]()
        reported = reports(driver.kernels[name], shifted, runs[name])
    assert sum(reported) >= 3, reported


def test_shifted_masks_of_the_content_term_are_reported() -> None:
    """Without its mask, a program would compare or change positions beyond the last one."""
    features, content = torch.rand((2, 3, 5, 16), generator=torch.Generator().manual_seed(0))

    def gradient() -> Tensor:
        result = torch.zeros_like(features)
        fused_add_content_gradient(result, features, content, None, torch.ones((), dtype=torch.float64))
        return result

    with compiled_kernels(80) as driver:
        for name, run in (
            ("content_sums", lambda: fused_content_sum(features, content)),
            ("add_content_gradient", gradient),
        ):
            run()
            assert sum(reports(driver.kernels[name], shifted, run)) >= 1


def test_shifted_masks_of_pooling_are_reported() -> None:
    """With odd sides, each mask keeps the windows that the border cuts from reading or writing beyond it."""
    generator = torch.Generator().manual_seed(0)
    source = torch.randn((1, 7, 5, 16), generator=generator).permute(0, 3, 1, 2).relu_()
    gradient = torch.randn((1, 3, 2, 16), generator=generator).permute(0, 3, 1, 2)
    with compiled_kernels(80) as driver:
        fused_max_pool_backward(gradient, source)
        kernel = driver.kernels["max_pool_backward"]
        assert sum(reports(kernel, shifted, lambda: fused_max_pool_backward(gradient, source))) >= 3


def other_lane(instruction: Instruction) -> Instruction | None:
    """Let a broadcast of a pair's values read from the first pair of the step."""
    if instruction.opcode[:3] != ("shfl", "sync", "idx"):
        return None
    target, source, _, *rest = instruction.operands
    return replace(instruction, operands=(target, source, "0", *rest))


def joined(tensors: Iterable[Tensor]) -> Tensor:
    """Return all values of some tensors."""
    return torch.cat([tensor.double().flatten() for tensor in tensors])


def results_of(rasterizer: TritonRasterizer, camera: Camera) -> dict[str, Callable[[], Tensor]]:
    """Return for each compositing kernel a function that runs it and returns all of its results."""
    colors, image_gradient = torch.rand((len(rasterizer.scene), 3)), torch.rand((camera.height, camera.width, 3))
    counted = CountedPieces(rasterizer, camera)

    def count() -> Tensor:
        pieces = CountedPieces(rasterizer, camera)
        return joined((pieces.masks, pieces.slot_pieces, pieces.block_pieces, pieces.ends))

    def store() -> Tensor:
        pieces = counted.store("float32")
        return joined((pieces.piece_gaussians, pieces.piece_slots, pieces.weights, pieces.transmittance))

    return {
        "render": lambda: rasterizer.render(colors, camera),
        "slot_gradients": lambda: rasterizer.color_gradient(image_gradient, camera),
        "survey": lambda: joined(rasterizer.survey(camera)),
        "count_pieces": count,
        "store_pieces": store,
    }


@pytest.mark.parametrize(
    ("name", "broadcasts"),
    [
        ("render", 9),
        ("slot_gradients", 6),
        pytest.param("survey", 6, marks=pytest.mark.slow),
        pytest.param("count_pieces", 8, marks=pytest.mark.slow),
        pytest.param("store_pieces", 7, marks=pytest.mark.slow),
    ],
)
def test_mutations_of_compositing_are_reported(name: str, broadcasts: int) -> None:
    """Raster tiles at the border have pixels outside of the view, and more Gaussians than are prepared at once.

    The view ends between two blocks, in the middle of the ball, so that a pixel too many has weights in another block.
    """
    scene = replace(ball(120), opacities=torch.linspace(-2, 3, 120))
    camera = cameras(1, 40, 40)[0].cropped(0, 0, 20, 20)
    with compiled_kernels(90) as driver:
        rasterizer = make_rasterizer("triton", scene)
        assert isinstance(rasterizer, TritonRasterizer)
        assert int(rasterizer.intersections(camera).starts.diff().max()) > PAIRS.value
        run = results_of(rasterizer, camera)[name]
        run()
        kernel = driver.kernels[name]
        reported = reports(kernel, other_lane, run)
        assert len(reported) >= broadcasts
        assert all(reported)
        assert sum(reports(kernel, shifted, run)) >= 3


@pytest.mark.parametrize("name", ["render", pytest.param("store_pieces", marks=pytest.mark.slow)])
def test_every_removed_barrier_of_compositing_is_reported(name: str) -> None:
    """Compositing kernels that sum over pixels have a single warp, which needs no barriers."""
    with compiled_kernels(90) as driver:
        rasterizer = make_rasterizer("triton", ball(60))
        assert isinstance(rasterizer, TritonRasterizer)
        run = results_of(rasterizer, cameras(1, 19, 17)[0])[name]
        run()
        reported = reports(driver.kernels[name], without_barrier, run)
    assert len(reported) >= 2
    assert all(reported)


def test_memory_faults_are_reported() -> None:
    scene, camera = ball(60), cameras(1, 33, 17)[0]
    with compiled_kernels(80) as driver:
        rasterizer = make_rasterizer("triton", scene)
        colors = torch.rand((len(scene), 3))
        rasterizer.render(colors, camera)
        kernel = driver.kernels["render"]
        stores = [
            number for number, one in enumerate(kernel.program.instructions) if one.opcode[:2] == ("st", "global")
        ]
        store = kernel.program.instructions[stores[0]]
        misaligned = replace(store, operands=(store.operands[0].replace("+ 0", "+ 2"), *store.operands[1:]))
        with kernel.changed(stores[0], misaligned), pytest.raises(FaultError, match="misaligned"):
            rasterizer.render(colors, camera)
        everywhere = replace(store, guard=None)
        with kernel.changed(stores[0], everywhere), pytest.raises(FaultError, match=r"outside of all tensors|race"):
            rasterizer.render(colors, camera)
