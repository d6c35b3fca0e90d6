"""Compile the GPU kernels ahead of time for real targets, without a GPU or a driver, and tell what they take.

    python -m benchmarks.triton_targets [--name triton_targets]

Triton's interpreter accepts what compilation refuses, so that both are needed: the interpreter shows that the kernels
compute the right numbers, this that they are kernels. Registers and spills are read from what the compilers wrote.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from benchmarks.machine import write_result
from sgsst_core.constants import ALPHA_MAX, ALPHA_MIN, EPS2D, FRUSTUM_MARGIN, TRANSMITTANCE_MIN
from sgsst_core.rasterizer import triton_kernels as kernels
from sgsst_core.scene import spherical_harmonics_triton_kernels

TARGETS = {
    "sm_80": GPUTarget("cuda", 80, 32),
    "sm_90": GPUTarget("cuda", 90, 32),
    "sm_100": GPUTarget("cuda", 100, 32),
    "gfx942": GPUTarget("hip", "gfx942", 64),
}
_CUTS = {"ALPHA_MAX": ALPHA_MAX, "ALPHA_MIN": ALPHA_MIN, "STOP": TRANSMITTANCE_MIN, "K": kernels.BLENDED.value}
_BLOCK = kernels.PROJECTED.value
#: Types of the arguments that are no constants, as `sgsst_core.rasterizer.triton` passes them.
_TYPES = {
    **dict.fromkeys(
        ("means", "quats", "scales", "logits", "colours", "background", "image", "transmittances"), "*fp32"
    ),
    **dict.fromkeys(("image_gradient", "out"), "*fp32"),
    **dict.fromkeys(("camera", "values", "depths"), "*fp64"),
    **dict.fromkeys(("counts", "tiles", "ranks", "slots"), "*i32"),
    **dict.fromkeys(("order", "first_slots", "starts", "gaussians"), "*i64"),
    **dict.fromkeys(("total", "visible", "width", "first_row", "last_row", "across"), "i32"),
}
#: Kernel, its constants, its warps, and arguments of another type than in `_TYPES`.
KERNELS: dict[str, tuple[dict[str, Any], int, dict[str, str]]] = {
    "project": (
        {"EPS2D": EPS2D, "MARGIN": FRUSTUM_MARGIN, "SUPPORT": 8.0, "POWER": 0.85, "BLOCK": _BLOCK},
        4,
        {},
    ),
    "list_tiles": ({"SUPPORT": 8.0, "BLOCK": _BLOCK}, 4, {}),
    "render": (_CUTS, 8, {}),
    "slot_gradients": (_CUTS, 8, {}),
    "add_slots": ({"BLOCK": _BLOCK}, 4, {"slots": "*fp32"}),
    "rest_colours": (
        {"DEGREE": 3, "COEFFICIENTS": 15, "BLOCK": spherical_harmonics_triton_kernels.BLOCK.value},
        4,
        {"sh_rest": "*fp32", "centre": "*fp64"},
    ),
}


def compile_kernel(name: str, target: str) -> dict[str, Any]:
    """Registers, spilled bytes or registers, shared memory and seconds of one kernel for one target."""
    constants, warps, types = KERNELS[name]
    module = spherical_harmonics_triton_kernels if name == "rest_colours" else kernels
    kernel = getattr(module, name)
    signature = {
        argument: "constexpr" if argument in constants else {**_TYPES, **types}[argument]
        for argument in kernel.arg_names
    }
    started = time.perf_counter()
    compiled = triton.compile(
        ASTSource(kernel, signature, constexprs=constants), target=TARGETS[target], options={"num_warps": warps}
    )
    seconds = time.perf_counter() - started
    used = _of_nvidia(compiled.asm["cubin"]) if "cubin" in compiled.asm else _of_amd(compiled.asm["amdgcn"])
    return {**used, "shared_bytes": compiled.metadata.shared, "seconds": round(seconds, 2)}


def _of_nvidia(binary: bytes) -> dict[str, int]:
    """From the resource usage that `cuobjdump`, which Triton brings, reads from the binary."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "kernel.cubin"
        file.write_bytes(binary)
        said = subprocess.run([tool, "--dump-resource-usage", file], capture_output=True, text=True, check=True).stdout
    found = dict(re.findall(r"(REG|STACK|LOCAL):(\d+)", said))
    return {"registers": int(found["REG"]), "spilled": int(found["STACK"]) + int(found["LOCAL"])}


def _of_amd(assembly: str) -> dict[str, int]:
    found = dict(re.findall(r"\.(vgpr_count|vgpr_spill_count|sgpr_spill_count):\s+(\d+)", assembly))
    return {
        "registers": int(found["vgpr_count"]),
        "spilled": int(found["vgpr_spill_count"]) + int(found["sgpr_spill_count"]),
    }


def main() -> int:
    """Compile everything and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--name", default=None, help="of the file in benchmarks/results; none is written without it")
    arguments = parser.parse_args()
    if os.environ.get("TRITON_INTERPRET") == "1":
        print("TRITON_INTERPRET is set: kernels would be interpreted, not compiled", file=sys.stderr)
        return 2
    os.environ["TRITON_ALWAYS_COMPILE"] = "1"  # what a cache holds takes no seconds
    table = {name: {target: compile_kernel(name, target) for target in TARGETS} for name in KERNELS}
    for name, targets in table.items():
        for target, used in targets.items():
            print(f"{name:<16}{target:<8}" + "  ".join(f"{key} {value}" for key, value in used.items()), flush=True)
    if arguments.name:
        write_result(arguments.name, {"triton": triton.__version__, "kernels": table})
    return 0


if __name__ == "__main__":
    sys.exit(main())
