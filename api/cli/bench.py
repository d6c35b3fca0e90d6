"""`sgsst bench`: benchmarks that users can run on their own scene and machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from rich.table import Column, Table
from torch import Tensor

from sgsst_core.bench.variants import (
    Curve,
    Quality,
    Variant,
    as_dict,
    choose_variants,
    compare_quality,
    error_time,
    write_plot,
    write_quality_plot,
    write_sheet,
)
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.files.atomic import ensure_writable_folder, write_json
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.report.document import machine
from sgsst_core.scene.camera import Camera
from worker.inputs import read_scene_and_capture
from worker.job import SceneRequest, check_choice

T = TypeVar("T")


@dataclass(frozen=True)
class VariantsRequest:
    """Request of `sgsst bench error-time` or `sgsst bench quality`.

    Attributes:
        out: Folder for table, plot, JSON and scenes.
        variants: Names of variants; empty for all.
        seconds: Seconds of optimization per variant.
        backbone: "auto", "vgg19" or "vgg16".
        settings: Settings of all variants, on top of the standard preset.
    """

    source: SceneRequest
    style: Path
    out: Path
    variants: Sequence[str]
    seconds: float
    backbone: str
    settings: dict[str, Any]

    @property
    def title(self) -> str:
        """Scene and style, for titles of plots."""
        return f"{self.source.scene.parent.name or self.source.scene.stem}, {self.style.stem}"


@dataclass(frozen=True)
class _Inputs:
    """Contents of the files that a request names."""

    file: SceneFile
    cameras: list[Camera]
    style: Tensor
    weights: BackboneWeights
    variants: list[Variant]

    @staticmethod
    def of(request: VariantsRequest) -> _Inputs:
        """Check and read the files of a request; the quick checks come first."""
        check_choice(request.source)
        variants = choose_variants(request.variants)
        weights = load_network_weights(request.backbone)
        style = load_image(request.style)
        file, capture = read_scene_and_capture(request.source)
        ensure_writable_folder(request.out)
        return _Inputs(file, capture.cameras, style, weights, variants)

    def run(self, measure: Callable[..., T], request: VariantsRequest, progress: Any) -> T:
        """Call `measure` with the arguments of `error_time`, and return its result."""
        arguments = (self.file.scene, self.cameras, self.style, self.variants, request.seconds)
        return measure(*arguments, weights=self.weights, progress=progress, **request.settings)

    def as_dict(self, request: VariantsRequest) -> dict[str, Any]:
        """Return the request as a JSON object."""
        return {
            "version": 1,
            "scene": request.source.scene.parent.name + "/" + request.source.scene.name,
            "style": request.style.name,
            "views": len(self.cameras),
            "sizes": [list(size) for size in sorted({(camera.width, camera.height) for camera in self.cameras})],
            "budget_seconds": request.seconds,
            "settings": request.settings,
            "backbone": self.weights.name,
            "machine": machine(torch.device("cuda" if torch.cuda.is_available() else "cpu")),
        }


def run_error_time(request: VariantsRequest, progress: Any) -> list[Curve]:
    """Run the variants, and write `error_time.json`, `error_time.png` and each variant's scene into the folder.

    The JSON file is written after each evaluation, so that an interrupted run leaves what it has measured.

    Args:
        progress: Callback that receives a curve after each of its evaluations.

    Raises:
        InvalidInputError: If an input cannot be used; the first one is reported.
    """
    inputs = _Inputs.of(request)
    described = inputs.as_dict(request)
    measured: dict[str, Curve] = {}

    def write(curves: Sequence[Curve]) -> None:
        write_json(request.out / "error_time.json", {**described, **as_dict(curves)})

    def evaluated(curve: Curve) -> None:
        measured[curve.variant.name] = curve
        write(list(measured.values()))
        progress(curve)

    curves = inputs.run(error_time, request, evaluated)
    write(curves)
    write_plot(request.out / "error_time.png", curves, request.title)
    for curve in curves:
        if curve.sh_dc is not None:
            write_stylized(inputs.file, request.out / f"{curve.variant.name}.ply", curve.sh_dc)
    return curves


def run_quality(request: VariantsRequest, progress: Any) -> Quality:
    """Run the variants, measure their quality, and write `quality.json`, plots, `quality.jpg` and scenes.

    Arguments and errors are those of `run_error_time`.
    """
    inputs = _Inputs.of(request)
    quality = inputs.run(compare_quality, request, progress)
    write_json(request.out / "quality.json", {**inputs.as_dict(request), **quality.as_dict()})
    write_quality_plot(request.out / "quality.png", quality, request.title)
    write_plot(request.out / "error_time.png", quality.curves, request.title)
    write_sheet(request.out / "quality.jpg", quality)
    for outcome in quality.outcomes[1:]:
        write_stylized(inputs.file, request.out / f"{outcome.name}.ply", outcome.sh_dc)
    return quality


def quality_table(quality: Quality) -> Table:
    """Return a table of the quality measures of each variant. A star marks variants on the Pareto front."""
    figures = ("style", "interior_style", "sliced_features", "color_distance", "content", "features")
    columns = (*figures, "background_sensitivity", "saturated", "short RMSE", "long RMSE", "remaining loss", "steps")
    table = Table(
        Column("", no_wrap=True),
        *columns,
        title="distances after the same time, lower is better; * = on the Pareto front of style and content",
    )
    front = quality.front()
    for outcome in quality.outcomes:
        one = outcome.judgment
        table.add_row(
            outcome.name + (" *" if outcome in front else ""),
            *(_number(value) for value in (one.style, one.interior_style, one.sliced_features)),
            f"{one.color_distance:.0f}",
            *(_number(value) for value in (one.content, one.features, one.background_sensitivity)),
            f"{one.saturated:.1%}",
            *(_number(drift.rmse if drift else None) for drift in (outcome.short, outcome.long)),
            _number(outcome.loss),
            str(outcome.steps or "-"),
        )
    return table


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def error_time_table(curves: Sequence[Curve]) -> Table:
    """Return a table of each variant's remaining loss over time, and of its final loss by scale and judgment."""
    shown = [curve for curve in curves if curve.points]
    scales = sorted({scale for curve in shown for scale in curve.points[-1].by_scale})
    moments = [f"{point.seconds:.0f} s" for point in shown[0].points] if shown else []
    table = Table(
        Column("variant", no_wrap=True),
        *moments,
        *(f"scale {scale}" for scale in scales),
        "style",
        "color_distance",
        "steps",
        title="remaining loss, relative to the start, and judgment of the end",
    )
    for curve in curves:
        if not curve.points:
            continue
        losses = [_number(point.relative) for point in curve.points]
        end = curve.points[-1]
        ends = [end.by_scale[scale] for scale in scales]
        judged = [end.judgment.style, end.judgment.color_distance] if end.judgment else [None, None]
        table.add_row(curve.variant.name, *losses, *(_number(value) for value in (*ends, *judged)), str(end.step))
    return table


def point_line(curve: Curve) -> str:
    """Return the last evaluation of a curve as a line for a log."""
    name, point = curve.variant.name, curve.points[-1]
    remains = "the initial loss was 0," if point.relative is None else f"{point.relative:.2%} of the loss remains"
    return f"{name}: {remains} after {point.seconds:.1f} s, {point.step} steps"
