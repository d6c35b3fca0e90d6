"""What is written beside a stylized scene: the report's values, a before/after contact sheet, and the loss curves."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import psutil
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.atomic import atomic_path
from sgsst_core.loss.convergence import smoothed
from sgsst_core.loss.terms import LossTerms
from sgsst_core.planning.plan import Plan
from sgsst_core.quality.findings import Finding
from sgsst_core.scene.camera import Camera
from sgsst_core.stylizing.checkpoint import versions
from sgsst_core.stylizing.evaluation import Evaluation, mean_loss
from sgsst_core.stylizing.loop import Stopped
from sgsst_core.stylizing.state import StepRecord
from sgsst_core.stylizing.stylizer import Stylizer

#: Of report.json: raised whenever a field changes its meaning or goes away.
REPORT_VERSION = 2
#: Of plan.json.
PLAN_VERSION = 1


@dataclass(frozen=True)
class Sources:
    """Where a job's inputs came from, for the report.

    Attributes:
        scene: the PLY file.
        dropped: Gaussians of the file that were left out because of non-finite values.
        style: the style image.
        cameras: the camera file or folder; None for an orbit.
        photos: folder of the content images; None for unstylized renders.
        backbone: the feature network's weights.
    """

    scene: Path
    dropped: int
    style: Path
    cameras: Path | None
    photos: Path | None
    backbone: BackboneWeights


def build_report(
    stylizer: Stylizer,
    sources: Sources,
    stopped: Stopped,
    before: Evaluation,
    after: Evaluation,
    findings: Sequence[Finding] = (),
) -> dict[str, Any]:
    """The report as values that JSON can hold; its fields are documented in docs/report-format.md.

    Args:
        stylizer: after its last step.
        stopped: what `run` returned.
        before, after: loss on the stylizer's `evaluation_views`, of the unstylized and the stylized scene.
        findings: what is extreme in scene, views and style.
    """
    history = stylizer.history
    coarse = sum(record.stage == "coarse" for record in history)
    return {
        "version": REPORT_VERSION,
        "program": {"name": "sgsst-service", "version": program_version()},
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "stopped": stopped,
        "steps": {
            "coarse": {"planned": stylizer.plan.steps_coarse, "done": coarse},
            "sos": {"planned": stylizer.settings.steps_sos, "done": len(history) - coarse},
        },
        "seconds": round(stylizer.seconds, 3),
        "seconds_by_part": {name: round(seconds, 3) for name, seconds in sorted(stylizer.seconds_by_part.items())},
        "loss": {
            "views": [stylizer.views.cameras[index].name for index in stylizer.evaluation_views],
            "before": _evaluation_json(before),
            "after": _evaluation_json(after),
            "relative": mean_loss(after) / mean_loss(before),
            "relative_by_scale": {str(scale): after[scale].total / before[scale].total for scale in before},
        },
        "bought": bought(stylizer, before),
        "held_out": held_out_json(stylizer.measured),
        "approximations": approximations_json(stylizer.measured),
        "findings": [asdict(finding) for finding in findings],
        "settings": stylizer.settings.model_dump(mode="json"),
        "backbone": {
            "name": sources.backbone.name,
            "source": sources.backbone.source,
            "sha256": sources.backbone.sha256,
        },
        "scene": {
            "path": str(sources.scene),
            "gaussians": len(stylizer.scene),
            "sh_degree": stylizer.scene.sh_degree,
            "dropped": sources.dropped,
        },
        "style": {"path": str(sources.style), "width": stylizer.style.shape[1], "height": stylizer.style.shape[0]},
        "cameras": _cameras_json(stylizer, sources),
        "position_weights": {
            "used": stylizer.views.weighted,
            "uncovered_share": round(stylizer.plan.survey.uncovered_share, 6),
        },
        "plan": {**stylizer.plan.as_dict(), "measured": _measured(stylizer)},
        "rasterizer": stylizer.views.rasterizer.name,
        "memory": {"limit_bytes": stylizer.memory, "peak_bytes": peak_memory()},
        "machine": machine(stylizer.network.device),
        "history": [_record_json(record, before) for record in history],
    }


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write values as JSON; the file appears whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        # A file name that is no valid Unicode holds lone surrogates: as escapes they are what JSON means by them.
        text = json.dumps(values, indent=1, ensure_ascii=False) + "\n"
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def plan_json(plan: Plan) -> dict[str, Any]:
    """A plan as values that JSON can hold."""
    return {"version": PLAN_VERSION, **plan.as_dict()}


def _measured(stylizer: Stylizer) -> dict[str, float | None]:
    """What happened, beside the plan's prediction.

    Median seconds of a step of either phase and, in the second, of waiting for other ranks; the speed-up over one rank,
    whose seconds are the predicted ones; peak memory in bytes.
    """
    values = {
        stage: [
            sum(seconds for name, seconds in record.parts.items() if name != "prepare")
            for record in stylizer.history
            if record.stage == stage
        ]
        for stage in ("sos", "coarse")
    }
    seconds = {stage: median(steps) if steps else None for stage, steps in values.items()}
    waited = [record.parts.get("communication", 0.0) for record in stylizer.history if record.stage == "sos"]
    expected = stylizer.plan.prediction
    one_rank = expected.seconds_one_rank if expected else None
    return {
        "seconds": seconds["sos"],
        "seconds_coarse": seconds["coarse"],
        "communication": median(waited) if waited else None,
        "speed_up": one_rank / seconds["sos"] if one_rank and seconds["sos"] else None,
        "peak_bytes": peak_memory(),
    }


#: Losses relative to the start, for which the report says when they were reached.
_REACHED = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)


def bought(stylizer: Stylizer, before: Evaluation) -> dict[str, Any] | None:
    """What error the time bought: the mean loss over the last round of views, relative to the start.

    Returns:
        `relative` at the end; `reached`: seconds and step at which it came below 0.5, 0.2, 0.1 and so on; `last_tenth`:
        what the last tenth of the time changed. None where no step was made on all scales.
    """
    records = [record for record in stylizer.history if record.stage == "sos"]
    if not records:
        return None
    start, losses = mean_loss(before), [record.loss for record in records]
    length = stylizer.round_length
    relative = [smoothed(losses[max(0, end - length) : end], length) / start for end in range(1, len(losses) + 1)]
    reached = []
    for wanted in _REACHED:
        first = next((i for i, value in enumerate(relative) if value <= wanted), None)
        if first is not None:
            entry = {"relative": wanted, "seconds": round(records[first].seconds, 3), "step": records[first].step}
            reached.append(entry)
    border = 0.9 * stylizer.seconds
    earlier = [value for record, value in zip(records, relative, strict=True) if record.seconds <= border]
    last = {"seconds": stylizer.seconds - border, "from": earlier[-1], "to": relative[-1]} if earlier else None
    return {"relative": relative[-1], "reached": reached, "last_tenth": last}


def held_out_json(measured: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Quality on views that were not trained on, at each moment; None where there are none."""
    moments = [entry["held_out"] for entry in measured if entry["held_out"]]
    if not moments:
        return None
    first = measured[0]
    return {"views": first["held_out_views"], "lpips": first["lpips"], "moments": moments}


def approximations_json(measured: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The gradient's error at each moment; None where nothing is approximated."""
    moments = [entry["approximation"] for entry in measured if entry["approximation"]]
    return {"what": measured[0]["approximated"], "moments": moments} if moments else None


def _cameras_json(stylizer: Stylizer, sources: Sources) -> dict[str, Any]:
    cameras = stylizer.views.cameras
    covered = set(stylizer.views.covered)
    return {
        "path": str(sources.cameras) if sources.cameras else None,
        "form": "file" if sources.cameras else "orbit",
        "content": str(sources.photos) if sources.photos else "unstylized renders",
        "count": len(cameras),
        "sizes": [list(size) for size in sorted({(camera.width, camera.height) for camera in cameras})],
        "names": [camera.name for camera in cameras],
        "seeing_nothing": [camera.name for index, camera in enumerate(cameras) if index not in covered],
    }


def _evaluation_json(evaluation: Evaluation) -> dict[str, Any]:
    return {"total": mean_loss(evaluation), "scales": {str(s): _terms_json(terms) for s, terms in evaluation.items()}}


def _terms_json(terms: LossTerms) -> dict[str, float]:
    return {
        "gram": terms.gram,
        "mean": terms.mean,
        "std": terms.std,
        "content": terms.content,
        "total": terms.total,
    }


def _record_json(record: StepRecord, before: Evaluation) -> dict[str, Any]:
    start = mean_loss({scale: before[scale] for scale in record.terms if scale in before} or before)
    return {
        "step": record.step,
        "stage": record.stage,
        "seconds": round(record.seconds, 3),
        "view": record.view,
        "loss": record.loss,
        "relative": record.loss / start,
        "scales": {str(scale): _terms_json(terms) for scale, terms in record.terms.items()},
        "parts": {name: round(seconds, 4) for name, seconds in record.parts.items()},
        "memory_bytes": record.memory,
    }


def program_version() -> str:
    """Version of the installed distribution; "unknown" where the source tree is used without installing it."""
    return versions()["program"]


def peak_memory() -> int:
    """Most bytes of physical memory that this process has held so far."""
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # kilobytes everywhere but on macOS


def machine(device: torch.device) -> dict[str, Any]:
    """What the job ran on."""
    return {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_bytes": psutil.virtual_memory().total,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):  # not Linux, or a processor that does not name itself
        return platform.processor() or platform.machine()


# --- contact sheet -------------------------------------------------------------------------------------------------

#: Pixels of the sheet: height of a picture, the style's width at most, gaps, and the labels' text.
_CELL_HEIGHT = 330
_MAX_CELL_WIDTH = 520
_GAP = 12
_LABEL = 18
_PAPER, _INK = (255, 255, 255), (60, 60, 60)


def write_contact_sheet(path: Path, stylizer: Stylizer) -> None:
    """Write a JPEG: the style image, then for each evaluation view the original above the stylized render.

    Raises:
        OutputError: the file cannot be written.
    """
    views = stylizer.views
    device = views.rasterizer.device
    pairs = []
    with torch.no_grad():
        for index in stylizer.evaluation_views:
            dcs = (views.scene.sh_dc.to(device), stylizer.sh_dc.detach())
            # The rasterizer's own render: one rank writes the sheet, and the others take no part in it.
            camera = views.cameras[index]
            renders = [_picture(views.rasterizer.render(views.colours(index, dc), camera)) for dc in dcs]
            pairs.append((camera, renders))
    sheet = _sheet(_picture(stylizer.style), pairs)
    with atomic_path(path) as temporary:
        sheet.save(temporary, format="JPEG", quality=88)


def _picture(image: Tensor) -> Image.Image:
    values = (image.detach().to("cpu", torch.float32).clamp(0, 1) * 255).round().to(torch.uint8)
    return Image.fromarray(values.numpy())


def _fitted(picture: Image.Image, width: int, height: int) -> Image.Image:
    """The picture at the largest size that fits a box, enlarged at need."""
    factor = min(width / picture.width, height / picture.height)
    size = (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
    return picture.resize(size, Image.Resampling.LANCZOS)


def _sheet(style: Image.Image, pairs: Sequence[tuple[Camera, list[Image.Image]]]) -> Image.Image:
    style = _fitted(style, _MAX_CELL_WIDTH, _CELL_HEIGHT)
    columns = [
        (camera.name, [_fitted(picture, _MAX_CELL_WIDTH, _CELL_HEIGHT) for picture in pictures])
        for camera, pictures in pairs
    ]
    heights = [max(pictures[row].height for _, pictures in columns) for row in (0, 1)]
    widths = [style.width, *(pictures[0].width for _, pictures in columns)]
    line = _LABEL + _GAP
    size = (sum(widths) + _GAP * (len(widths) + 1), max(sum(heights) + 2 * line, style.height + line) + _GAP)
    sheet = Image.new("RGB", size, _PAPER)
    draw = ImageDraw.Draw(sheet)
    _place(sheet, draw, style, _GAP, line, "style")
    left = _GAP + style.width + _GAP
    for name, pictures in columns:
        short = name if len(name) <= 24 else "…" + name[-23:]
        _place(sheet, draw, pictures[0], left, line, f"{short}: original")
        _place(sheet, draw, pictures[1], left, line + heights[0] + line, "stylized")
        left += pictures[0].width + _GAP
    return sheet


def _place(
    sheet: Image.Image, draw: ImageDraw.ImageDraw, picture: Image.Image, left: int, top: int, label: str
) -> None:
    sheet.paste(picture, (left, top))
    font = ImageFont.load_default(size=_LABEL - 4)
    while label and draw.textlength(label, font) > picture.width:  # narrow portrait views
        label = label[:-1]
    draw.text((left, top - _LABEL), label, _INK, font)


# --- loss curves ---------------------------------------------------------------------------------------------------

_TOTAL_COLOUR = "#222222"
_SCALE_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


def write_loss_curves(path: Path, history: Sequence[StepRecord], round_length: int) -> None:
    """Write a PNG of the loss against seconds, on a logarithmic axis: one line for each scale, and E.

    Args:
        history: of a stylizer; may be empty.
        round_length: steps in which every view comes once; lines are geometric means over so many, the raw values
            lie faintly behind.

    Raises:
        OutputError: the file cannot be written.
    """
    figure = Figure(figsize=(8, 4.5), dpi=120, layout="constrained")
    axes = figure.subplots()
    scales = sorted({scale for record in history for scale in record.terms})
    for scale in scales:
        label = f"scale {scale} (1/{1 << scale})" if scale else "scale 0 (full size)"
        colour = _SCALE_COLOURS[scale % len(_SCALE_COLOURS)]
        for part in _phases(history):
            chosen = [record for record in part if scale in record.terms]
            _draw(axes, chosen, [record.terms[scale].total for record in chosen], round_length, colour, label)
            label = "" if chosen else label  # one legend entry for both phases
    sos = [record for record in history if record.stage == "sos"]
    if len(scales) > 1:
        _draw(axes, sos, [record.loss for record in sos], round_length, _TOTAL_COLOUR, "mean of the scales")
    _mark_phases(axes, history)
    axes.set_xlabel("seconds")
    axes.set_ylabel("loss")
    if history:
        totals = [terms.total for record in history for terms in record.terms.values()]
        axes.set_ylim(max(min(totals), 1e-300) / 1.3, max(max(totals), 1e-300) * 1.3)
        axes.set_yscale("log")
        axes.set_xlim(left=0)
        axes.legend(frameon=False)
    axes.grid(True, which="both", alpha=0.15)
    axes.spines[["top", "right"]].set_visible(False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _phases(history: Sequence[StepRecord]) -> list[list[StepRecord]]:
    return [[record for record in history if record.stage == stage] for stage in ("coarse", "sos")]


def _draw(
    axes: Axes, records: Sequence[StepRecord], values: Sequence[float], window: int, colour: str, label: str
) -> None:
    if not records:
        return
    seconds = [record.seconds for record in records]
    marker = "o" if len(records) == 1 else None
    axes.plot(seconds, values, color=colour, alpha=0.2, linewidth=0.8)
    axes.plot(seconds, running_mean(values, window), color=colour, label=label or None, marker=marker)


def running_mean(values: Sequence[float], window: int) -> NDArray[np.float64]:
    """Geometric mean of the `window` values around each place, of fewer towards the ends."""
    logs = np.log(np.maximum(np.asarray(values, dtype=np.float64), np.finfo(np.float64).tiny))
    sums = np.concatenate([[0.0], np.cumsum(logs)])
    places = np.arange(len(logs))
    reach = np.minimum(np.minimum(places, places[::-1]), window // 2)
    means: NDArray[np.float64] = np.exp((sums[places + reach + 1] - sums[places - reach]) / (2 * reach + 1))
    return means


def _mark_phases(axes: Axes, history: Sequence[StepRecord]) -> None:
    coarse = [record for record in history if record.stage == "coarse"]
    if not coarse:
        return
    border = coarse[-1].seconds
    transform = axes.get_xaxis_transform()
    axes.text(border / 2, 1.02, "coarsest scale", transform=transform, ha="center", color=_TOTAL_COLOUR, fontsize=9)
    if len(coarse) < len(history):
        axes.axvline(border, color=_TOTAL_COLOUR, linewidth=0.8, linestyle=":")
        middle = (border + history[-1].seconds) / 2
        axes.text(middle, 1.02, "all scales", transform=transform, ha="center", color=_TOTAL_COLOUR, fontsize=9)
