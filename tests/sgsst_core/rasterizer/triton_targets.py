"""Ahead-of-time compilation of all GPU kernels for real targets, without a GPU or driver, and their resource usage.

    python -m tests.sgsst_core.rasterizer.triton_targets

Triton's interpreter accepts code that does not compile, so both are needed: tests in the interpreter check the kernels'
results, and this module prints as JSON what compiling them gives. Registers and spills are read from the compilers'
output, and the instructions that the compositing kernels execute for each pixel of a pair of Gaussian and raster tile
from NVIDIA's disassembler.
"""

import json
import re
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from sgsst_core.constants import ALPHA_MAX, ALPHA_MIN, EPS2D, TRANSMITTANCE_MIN
from sgsst_core.features import triton_kernels as feature_kernels
from sgsst_core.features.statistics import (
    FLUSH,
    POSITIONS,
    TILE,
    block_of_channels,
    block_of_entries,
)
from sgsst_core.loss import terms
from sgsst_core.loss import triton_kernels as loss_kernels
from sgsst_core.loss.terms import CONTENT_POSITIONS, GRAM_WEIGHT, MEAN_WEIGHT, STD_WEIGHT
from sgsst_core.rasterizer import triton_kernels as kernels
from sgsst_core.scene import triton_kernels as harmonics_kernels

TARGETS = {
    "sm_80": GPUTarget("cuda", 80, 32),
    "sm_90": GPUTarget("cuda", 90, 32),
    "sm_100": GPUTarget("cuda", 100, 32),
    "gfx942": GPUTarget("hip", "gfx942", 64),
}
_CUTS = {"ALPHA_MAX": ALPHA_MAX, "ALPHA_MIN": ALPHA_MIN, "STOP": TRANSMITTANCE_MIN}
_BLOCK = kernels.PROJECTED.value
#: Types of the arguments that are not constants, as `sgsst_core.rasterizer.triton` passes them.
_TYPES = {
    **dict.fromkeys(("means", "quats", "scales", "logits", "colors", "background", "image", "transmittances"), "*fp32"),
    **dict.fromkeys(("image_gradient", "out"), "*fp32"),
    **dict.fromkeys(("camera", "values", "depths"), "*fp64"),
    **dict.fromkeys(("counts", "tiles", "ranks", "slots"), "*i32"),
    **dict.fromkeys(("order", "first_slots", "starts", "gaussians", "ends"), "*i64"),
    **dict.fromkeys(("masks", "slot_pieces", "block_pieces", "slot_starts", "block_starts"), "*i32"),
    **dict.fromkeys(("piece_gaussians", "piece_slots"), "*i32"),
    **dict.fromkeys(("weights", "shift", "firsts", "seconds", "matrix", "mean", "own_mean", "offset"), "*fp32"),
    **dict.fromkeys(("count", "centered", "target_gram", "target_mean", "target_std", "terms"), "*fp64"),
    **dict.fromkeys(("high", "low"), "*bf16"),
    "constant": "*fp32",
    **dict.fromkeys(
        (
            "positions",
            "row_cells",
            "content_row_cells",
            "out_row_cells",
            "weight_row_step",
            "weight_column_step",
            "span",
        ),
        "i32",
    ),
    **dict.fromkeys(("total", "visible", "width", "height", "across"), "i32"),
}
_FORMS: dict[str, tuple[float, str]] = {"float32": (1.0, "*fp32"), "half": (kernels.HALF_SCALE, "*fp16")}


@dataclass(frozen=True)
class Target:
    """Kernel with the constants that the project passes; `types` overrides `_TYPES` for some arguments."""

    kernel: Any
    constants: dict[str, Any]
    warps: int
    types: dict[str, str] = field(default_factory=dict)


def _of_cached_weights(form: str) -> dict[str, Target]:
    scale, weights = _FORMS[form]
    types = {"weights": weights, "gaussians": "*i32"}
    read = {"SCALE": scale, "P": kernels.PIECES.value}
    keep = Target(kernels.store_pieces, {**_CUTS, "SCALE": scale}, kernels.PIXEL_WARPS, {"weights": weights})
    return {
        f"store_pieces_{form}": keep,
        f"apply_pieces_{form}": Target(kernels.apply_pieces, read, 1, types),
        f"piece_gradients_{form}": Target(kernels.piece_gradients, read, 1, types),
    }


def _of_features(form: str, channels: int, of: str) -> dict[str, Target]:
    """Return the kernels that read features and position weights."""
    features, tile = {"float32": "*fp32", "bfloat16": "*bf16"}[form], block_of_channels(channels, TILE)
    matrix: dict[str, Any] = {"CHANNELS": channels, "TILE": tile, "WEIGHTED": True}
    dtype = _DTYPES[form]
    block, step = POSITIONS[dtype.itemsize], terms.STEPS[dtype.itemsize]
    moments = {**matrix, "P": block, "PARTS": FLUSH[dtype.itemsize] // block}
    gradient = {**matrix, "K": block_of_channels(channels, step), "P": terms.POSITIONS}
    gradient |= {"RELU": True, "UNIT": 1.0}
    types = {"features": features, "gradient": features}
    if dtype == torch.bfloat16:
        moments, gradient, types = {**moments, "shift": None}, {**gradient, "mean": None}, {**types, "matrix": features}
    else:
        gradient = {**gradient, "low": None}
    return {
        f"shifted_moments_{of}": Target(
            feature_kernels.shifted_moments,
            moments,
            4,
            {"features": features, "sums": "*fp32"},
        ),
        f"add_style_gradient_{of}": Target(
            loss_kernels.add_style_gradient,
            gradient,
            4,
            types,
        ),
    }


def _of_statistics(channels: int, of: str = "") -> dict[str, Target]:
    """Return the kernels that process sums over features."""
    entries = block_of_entries(channels)
    block = {"ROWS": entries // block_of_channels(channels), "COLUMNS": block_of_channels(channels)}
    return {
        f"combine_moments{of}": Target(
            feature_kernels.combine_moments,
            {"CHANNELS": channels, "ENTRIES": entries},
            4,
            {"sums": "*fp64", "mean": "*fp64"},
        ),
        f"compare{of}": Target(
            loss_kernels.compare,
            {**_LOSS, "CHANNELS": channels, **block, "UNIT": 1.0},
            4,
            {"mean": "*fp64", "offset": "*fp32"},
        ),
    }


#: Registers of a multiprocessor for each lane, and its largest number of programs, of compute capabilities 8.0 to 10.0.
WARP_REGISTERS, MAX_PROGRAMS = 2048, 32
#: Number of channels of the widest layers, and number of color channels.
_WIDEST, _PIXELS = 512, 3
_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
_LOSS = {"GRAM": GRAM_WEIGHT, "MEAN": MEAN_WEIGHT, "STD": STD_WEIGHT, "EPS": 2.0**-23}
_ADDED = {"BLOCK": kernels.ADDED.value, "SLOTS": kernels.SLOTS.value}
KERNELS: dict[str, Target] = {
    "project": Target(
        kernels.project,
        {"EPS2D": EPS2D, "ANTIALIASED": True, "SUPPORT": 8.0, "POWER": 0.85, "BLOCK": _BLOCK},
        4,
    ),
    "list_tiles": Target(kernels.list_tiles, {"SUPPORT": 8.0, "BLOCK": _BLOCK}, 4),
    "render": Target(kernels.render, _CUTS, kernels.PIXEL_WARPS),
    "slot_gradients": Target(kernels.slot_gradients, _CUTS, kernels.SUMMING_WARPS),
    "add_slots": Target(kernels.add_slots, _ADDED, 4, {"slots": "*fp32"}),
    **{
        f"{kernel.__name__}_{form}": Target(
            kernel,
            {"CHANNELS": 64, "MASK": torch.iinfo(integers).max, "BLOCK": feature_kernels.BLOCK.value},
            4,
            {"gradient": types, "source": types, "out": types, "height": "i32", "windows": "i32"},
        )
        for kernel in (feature_kernels.max_pool, feature_kernels.max_pool_backward)
        for form, integers, types in (("float32", torch.int32, "*i32"), ("bfloat16", torch.int16, "*i16"))
    },
    "count_pieces": Target(kernels.count_pieces, _CUTS, kernels.SUMMING_WARPS),
    **_of_cached_weights("float32"),
    **_of_cached_weights("half"),
    **_of_features("float32", _WIDEST, "float32"),
    **_of_features("bfloat16", _WIDEST, "bfloat16"),
    **_of_features("float32", _PIXELS, "pixels"),
    **_of_statistics(_WIDEST),
    **_of_statistics(_PIXELS, "_pixels"),
    **{
        f"{kernel.__name__}_{form}": Target(
            kernel,
            {"CHANNELS": _WIDEST, "BLOCK": _WIDEST, "P": CONTENT_POSITIONS, "WEIGHTED": True}
            | ({"RELU": True} if kernel is loss_kernels.add_content_gradient else {}),
            4,
            dict.fromkeys(("features", "content", "gradient"), types) | {"sums": "*fp32", "factor": "*fp64"},
        )
        for kernel in (loss_kernels.content_sums, loss_kernels.add_content_gradient)
        for form, types in (("float32", "*fp32"), ("bfloat16", "*bf16"))
    },
    **{
        kernel.__name__: Target(
            kernel,
            {"CHANNELS": 64, "BLOCK": 64, "P": feature_kernels.P.value},
            4,
            dict.fromkeys(("weight", "bias", "gradient"), "*bf16")
            | dict.fromkeys(("pixels", "scale", "shift"), "*fp32")
            | {"height": "i32", "out": out},
        )
        for kernel, out in (
            (feature_kernels.convolve_pixels, "*bf16"),
            (feature_kernels.pixel_gradients, "*fp32"),
        )
    },
    "rest_colors": Target(
        harmonics_kernels.rest_colors,
        {"DEGREE": 3, "COEFFICIENTS": 15, "BLOCK": harmonics_kernels.BLOCK.value},
        4,
        {"sh_rest": "*fp32", "center": "*fp64"},
    ),
}


def compile_kernel(name: str, target: str) -> dict[str, Any]:
    """Compile one kernel for one target, and return registers and spills."""
    kernel = KERNELS[name]
    signature = {
        argument: "constexpr" if argument in kernel.constants else {**_TYPES, **kernel.types}[argument]
        for argument in kernel.kernel.arg_names
    }
    # PyTorch aligns memory, as Triton notices when it specializes a kernel.
    aligned = [index for index, types in enumerate(signature.values()) if types.startswith("*")]
    hints = {(index,): [["tt.divisibility", 16]] for index in aligned}
    source = ASTSource(kernel.kernel, signature, constexprs=kernel.constants, attrs=hints)
    compiled = triton.compile(source, target=TARGETS[target], options={"num_warps": kernel.warps})
    if "cubin" in compiled.asm:
        return _of_nvidia(compiled.asm["cubin"], kernel.warps)
    return _of_amd(compiled.asm["amdgcn"])


def _of_nvidia(binary: bytes, warps: int) -> dict[str, Any]:
    """Read registers and spills from a binary with the tools that come with Triton.

    For a compositing kernel, add the warps per multiprocessor and `pixel_instructions`.

    Args:
        binary: Compiled kernel.
        warps: Warps per program.
    """
    usage = _tool(binary, "cuobjdump", "--dump-resource-usage")
    fields = dict(re.findall(r"(REG|STACK|LOCAL):(\d+)", usage))
    registers = int(fields["REG"])
    used: dict[str, Any] = {"registers": registers, "spilled": int(fields["STACK"]) + int(fields["LOCAL"])}
    instructions = pixel_instructions(_tool(binary, "nvdisasm", "-c"))
    if instructions is not None:
        programs = min(WARP_REGISTERS // (-(-registers // 8) * 8) // warps, MAX_PROGRAMS)
        used |= {"warps": programs * warps, "pixel_instructions": instructions}
    return used


def _tool(binary: bytes, name: str, option: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "kernel.cubin"
        file.write_bytes(binary)
        tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / name
        return subprocess.run([tool, option, file], capture_output=True, text=True, check=True).stdout


def pixel_instructions(assembly: str) -> float | None:
    """Return the instructions of a thread per pixel and pair, without those outside of the loop over pairs.

    That loop is the shortest one with exponentials, of which each pixel needs one; None if there is no such loop.
    """
    labels: dict[str, int] = {}
    instructions: list[str] = []
    for line in assembly.splitlines():
        if label := re.match(r"\s*(\.L_x_\d+):", line):
            labels[label[1]] = len(instructions)
        elif code := re.match(r"\s+/\*[0-9a-f]+\*/\s+(.*?);", line):
            instructions.append(code[1])
    loops = []
    for position, instruction in enumerate(instructions):
        target = re.search(r"\bBRA\b.*(\.L_x_\d+)", instruction)
        if target and (start := labels[target[1]]) <= position:
            loop = instructions[start : position + 1]
            loops.append((len(loop), sum("MUFU.EX2" in each for each in loop)))
    return min((round(length / pixels, 1) for length, pixels in loops if pixels), default=None)


def _of_amd(assembly: str) -> dict[str, int]:
    fields = dict(re.findall(r"\.(vgpr_count|vgpr_spill_count|sgpr_spill_count):\s+(\d+)", assembly))
    return {
        "registers": int(fields["vgpr_count"]),
        "spilled": int(fields["vgpr_spill_count"]) + int(fields["sgpr_spill_count"]),
    }


if __name__ == "__main__":
    print(json.dumps({name: {target: compile_kernel(name, target) for target in TARGETS} for name in KERNELS}))
