"""Whole jobs as a user runs them: `sgsst stylize` as a process, with its seconds by part and the plan's prediction."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from benchmarks.gpu.part import QUICK, Findings, Sizes
from benchmarks.gpu.speed import ZOOM
from sgsst_core.bench.device_checks import random_weights, surface_scene, texture, views
from sgsst_core.features.network_weights import fetch_network_weights
from tests.small_scenes import write_files

#: Seconds after which a job is asked to stop, as by Ctrl-C.
_PATIENCE = 150
#: The program; tests replace it by one with a simulated GPU.
PROGRAM: tuple[str, ...] = (sys.executable, "-m", "api.cli")


def job(sizes: Sizes, findings: Findings) -> None:
    """Run all jobs as by default."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        _install_weights(folder)
        for count, width, height, gaussians in sizes.jobs:
            write_files(folder, surface_scene(gaussians, degree=3), views(count, width, height, ZOOM))
            image = (255 * texture(height, height, seed=3)).byte().numpy()
            Image.fromarray(image).save(folder / "style.png")
            options = ["--steps-sos", "2"] if sizes == QUICK else []
            name, figures = f"{count}x{width}x{height}", _run(folder, options)
            findings.add(name, {"gaussians": gaussians, **figures})
            if "steps" not in figures:
                findings.broken.append(f"{name}: {figures['printed'][-500:]}")


def _install_weights(folder: Path) -> None:
    """Install random weights of VGG19, which take the time of trained ones, in a folder for `SGSST_CACHE`."""
    tensors = {
        f"{name}.{kind}": tensor
        for name, pair in random_weights().convolutions.items()
        for kind, tensor in zip(("weight", "bias"), pair, strict=True)
    }
    torch.save(tensors, folder / "random.pth")
    fetch_network_weights("vgg19", source=folder / "random.pth", folder=folder)


def _run(folder: Path, options: list[str]) -> dict[str, Any]:
    """Run a job, and return its seconds and parts; if it was stopped or failed, the end of what it printed."""
    out = folder / "stylized.ply"
    command = [*PROGRAM, "stylize", "scene.ply", "--cameras", "cameras.json", "--style"]
    command += ["style.png", "--out", out.name, *options]
    path = os.pathsep.join([str(Path.cwd()), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "SGSST_CACHE": str(folder), "PYTHONPATH": path}
    started = time.perf_counter()
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=pipe, stderr=subprocess.STDOUT, text=True)
    try:
        printed, _ = process.communicate(timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate()
    seconds = time.perf_counter() - started
    report = out.with_suffix(".report.json")
    if not report.is_file():
        return {"seconds": seconds, "status": process.returncode, "printed": printed[-3000:]}
    content = json.loads(report.read_text())
    report.unlink()
    figures = {name: content[name] for name in ("seconds_total", "seconds_by_part", "memory")}
    plan = {name: content["plan"][name] for name in ("prediction", "measured")}
    plan["precision"] = next(each["decision"] for each in content["plan"]["decisions"] if each["item"] == "precision")
    return {"seconds": seconds, "steps": len(content["history"]), **figures, "plan": plan, "printed": printed[-3000:]}
