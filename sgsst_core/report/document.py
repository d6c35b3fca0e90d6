"""JSON document of a report: inputs, plan, results and history of a job."""

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch

from sgsst_core import container
from sgsst_core.budget import device_peak, peak_memory
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.planning.time_budget import LONGER
from sgsst_core.progress import duration, percent
from sgsst_core.quality.findings import Finding
from sgsst_core.scales import ScaleWeights, predicted_fall, ratio, smoothed
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.checkpoint import versions
from sgsst_core.stylizing.job import StylizationJob, estimate
from sgsst_core.stylizing.loop import Stopped
from sgsst_core.stylizing.stylizer import Evaluation, StepRecord, Stylizer, mean_loss, on_scales_of, relative_loss

#: Version of report.json, raised whenever a field is removed or changes its meaning.
REPORT_VERSION = 4
#: Version of plan.json.
PLAN_VERSION = 3


@dataclass(frozen=True)
class Sources:
    """Origin of a job's inputs, for the report.

    Attributes:
        dropped: Number of Gaussians dropped from the file because of invalid values.
        cameras: Camera file or folder; None for an orbit.
        photos: Folder of the content images; None for unstylized renders.
    """

    scene: Path
    dropped: int
    styles: tuple[Path, ...]
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
    """Build the report as JSON-serializable values. See docs/report-format.md for its fields.

    Args:
        stopped: Reason why the job stopped, as returned by `loop.run`.
        before: Loss of the unstylized scene on the stylizer's `evaluation_views`.
        after: Loss of the last round of views (`round_evaluation`).
    """
    graphs = stylizer.job.graphs
    return {
        **_outcome_json(stylizer, stopped, before, after),
        "findings": [asdict(finding) for finding in findings],
        **_inputs_json(stylizer, sources),
        "plan": {**plan_json(stylizer.job), "measured": _measured(stylizer)},
        "repeat": repeating_options(stylizer),
        "rasterizer": stylizer.job.views.rasterizer.name,
        "memory": {
            "limit_bytes": stylizer.job.memory,
            "peak_bytes": peak_memory(),
            "device_peak_bytes": device_peak(stylizer.job.network.device),
        },
        "graphs": graphs and {"captured": graphs.captured, "problem": graphs.problem},
        "machine": machine(stylizer.job.network.device),
        "history": [_record_json(record, before, stylizer.job.loss.weights) for record in stylizer.history],
    }


def _outcome_json(stylizer: Stylizer, stopped: Stopped, before: Evaluation, after: Evaluation) -> dict[str, Any]:
    """Return program, time, losses and measurements of a job."""
    coarse = sum(record.stage == "coarse" for record in stylizer.history)
    weights = stylizer.job.loss.weights
    return {
        "version": REPORT_VERSION,
        "program": {"name": "sgsst-service", "version": versions()["program"]},
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "stopped": stopped,
        "steps": {
            "coarse": {"planned": stylizer.job.plan.steps_coarse, "done": coarse},
            "sos": {"planned": stylizer.job.settings.steps_sos, "done": len(stylizer.history) - coarse},
        },
        "seconds": round(stylizer.seconds, 3),
        **seconds_json(stylizer, sum(stylizer.seconds_by_part.values())),
        "loss": {
            "views": [stylizer.job.views.cameras[index].name for index in stylizer.job.evaluation_views],
            "before": _evaluation_json(before, weights),
            "after": _evaluation_json(after, weights),
            "relative": relative_loss(before, after, weights),
            "relative_by_scale": {
                str(scale): ratio(after[scale].total, before[scale].total) for scale in before if scale in after
            },
        },
        "loss_over_time": loss_over_time(stylizer, before, stopped),
        "measuring": _measuring_json(stylizer),
        **stylizer.measured,
    }


def seconds_json(stylizer: Stylizer, total: float) -> dict[str, Any]:
    """Return the seconds of a whole job and their parts."""
    parts = sorted(stylizer.seconds_by_part.items())
    return {"seconds_total": round(total, 3), "seconds_by_part": {name: round(seconds, 3) for name, seconds in parts}}


def _inputs_json(stylizer: Stylizer, sources: Sources) -> dict[str, Any]:
    """Return settings and inputs of a job."""
    job, backbone, styles = stylizer.job, sources.backbone, _styles_json(stylizer, sources)
    refined: dict[str, Any] | None = None
    if (refinement := job.plan.refinement) is not None:
        names = ("gaussians", "split", "reverted", "size", "psnr", "lowest_psnr")
        refined = {"gaussians_before": len(refinement.pieces)} | {name: getattr(refinement, name) for name in names}
    cameras, covered = job.views.cameras, set(job.views.covered)
    return {
        "settings": job.settings.model_dump(mode="json"),
        "backbone": {
            "name": backbone.name,
            "source": backbone.source,
            "sha256": backbone.sha256,
            "scales": job.weights.scales,
        },
        "scene": {
            "path": str(sources.scene),
            "gaussians": len(job.scene),
            "sh_degree": job.sh_degree,
            "dropped": sources.dropped,
            "refined": refined,
        },
        "style": {name: styles[0][name] for name in ("path", "width", "height")},
        "styles": styles,
        "regions": _regions_json(stylizer),
        "cameras": {
            "path": str(sources.cameras) if sources.cameras else None,
            "source": "file" if sources.cameras else "orbit",
            "content": str(sources.photos) if sources.photos else "unstylized renders",
            "count": len(cameras),
            "sizes": [list(size) for size in sorted({(camera.width, camera.height) for camera in cameras})],
            "names": [camera.name for camera in cameras],
            "seeing_nothing": [camera.name for index, camera in enumerate(cameras) if index not in covered],
        },
        "position_weights": {
            "used": job.view_targets.weighted,
            "uncovered_fraction": round(job.plan.survey.uncovered_fraction, 6),
        },
    }


def _styles_json(stylizer: Stylizer, sources: Sources) -> list[dict[str, Any]]:
    """Return the style images that the job used, with their sizes and weights."""
    style, regions, paths = stylizer.job.styles.own, stylizer.job.styles.regions, sources.styles
    if regions is not None and not regions.mapped and regions.every[regions.active[0]].style is not None:
        paths = tuple(map(Path, style.names))  # a single active region with its own style covers the whole scene
    return [
        {"path": str(path), "width": image.shape[1], "height": image.shape[0], "weight": weight}
        for path, image, weight in zip(paths, style.images, style.weights, strict=True)
    ]


def _regions_json(stylizer: Stylizer) -> list[dict[str, Any]]:
    """Return the regions of the scene, background first; empty if there are none."""
    regions = stylizer.job.styles.regions
    if regions is None:
        return []
    weights = stylizer.job.plan.survey.total_blend_weights
    return [
        {
            "name": region.name,
            "select": region.select or None,
            "gaussians": int(regions.members(index).sum()),
            "fraction": float(weights[regions.members(index)].sum() / weights.sum()),
            "style": region.style and region.style.text,
            "weight": region.weight,
            "freeze": region.freeze,
            "content_weight": region.content_weight,
            "stylized": not region.freeze and bool((weights[regions.members(index)] > 0).any()),
        }
        for index, region in enumerate(regions.every)
    ]


def plan_json(job: StylizationJob) -> dict[str, Any]:
    """Return the plan of a job as JSON-serializable values, with an estimate of its seconds and a bound on memory."""
    plan = job.plan
    return {
        "version": PLAN_VERSION,
        "decisions": [asdict(decision) for decision in plan.decisions],
        "prediction": {**asdict(estimate(job)), "peak_bytes": plan.peak_bytes, "device_bytes": plan.device_bytes},
    }


def repeating_options(stylizer: Stylizer) -> str | None:
    """Return the options that repeat a job with a time budget exactly, instead of `--within`; None without one."""
    choice, coarse, settings = stylizer.job.plan.time_choice, stylizer.job.plan.steps_coarse, stylizer.job.settings
    if choice is None:
        return None
    steps = f"--steps-coarse {min(coarse, stylizer.step)} --steps-sos {max(stylizer.step - coarse, 0)}"
    stop = " --no-early-stop" if make_settings(settings.preset).early_stop and not settings.early_stop else ""
    return f"--resolution {settings.max_resolution} --views {len(choice.views)} {steps}{stop}"


def _measured(stylizer: Stylizer) -> dict[str, float | None]:
    """Return the measured values that correspond to the plan's prediction.

    `seconds` and `seconds_coarse` are the seconds of a step in the phase on all scales and on the coarsest one.
    `communication` is the median seconds per step spent waiting for other ranks, in the phase on all scales.
    `measuring` is the total seconds spent on measurements. Peak memory is that of the process and of its GPU, in bytes.
    """
    waited = [record.parts.get("communication", 0.0) for record in stylizer.history if record.stage == "sos"]
    return {
        "seconds": _step_seconds(stylizer, "sos"),
        "seconds_coarse": _step_seconds(stylizer, "coarse"),
        "communication": median(waited) if waited else None,
        "peak_bytes": peak_memory(),
        "device_bytes": device_peak(stylizer.job.network.device),
        "measuring": stylizer.seconds_by_part.get("measuring"),
    }


def _step_seconds(stylizer: Stylizer, stage: str) -> float | None:
    """Return the mean over a phase's steps of the median seconds of the steps with as many scales; None without any.

    Steps are thereby typical: first visits, which prepare a view, hardly count.
    """
    steps: list[tuple[int, float]] = []
    before = 0.0
    for record in stylizer.history:
        if record.stage == stage:
            steps.append((len(record.evaluated), record.seconds - before))
        before = record.seconds
    medians = {count: median(seconds for scales, seconds in steps if scales == count) for count, _ in steps}
    return mean(medians[scales] for scales, _ in steps) if steps else None


def _measuring_json(stylizer: Stylizer) -> dict[str, Any]:
    """Return the number of measurements, their time, and its ratio to the time of the steps."""
    seconds = stylizer.seconds_by_part.get("measuring", 0.0)
    novel_views = stylizer.measured["novel_views"]
    return {
        "fraction": stylizer.job.settings.measure,
        "seconds": round(seconds, 3),
        "of_steps": seconds / stylizer.seconds if stylizer.seconds else None,
        "loss_views": len(stylizer.job.evaluation_views),
        "novel_view_count": len(novel_views["views"]) if novel_views else 0,
    }


#: Reasons to stop after which more time might pay, and minimum factor of steps for which the loss is predicted.
_MORE_MIGHT_PAY, _MIN_FACTOR = ("finished", "within"), 1.5
#: Relative losses for which the report states the time of reaching them.
_REACHED = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)


def loss_over_time(stylizer: Stylizer, before: Evaluation, stopped: Stopped) -> dict[str, Any] | None:
    """Summarize how the loss fell over time.

    The loss is the mean over the last round of views, relative to the unstylized scene.

    Returns:
        `relative`: Final loss. `reached`: Seconds and step at which the loss first fell to 0.5, 0.2, 0.1 and so on.
        `last_tenth`: Loss before and after the last tenth of the time. `more_time`: See `_more_time`. None if no step
            used all scales, or if the initial loss is 0.
    """
    records = [record for record in stylizer.history if record.stage == "sos"]
    start, losses = mean_loss(before, stylizer.job.loss.weights), [record.loss for record in records]
    if not records or not start:
        return None
    length = stylizer.job.round_length
    relative = [smoothed(losses[max(0, end - length) : end], length) / start for end in range(1, len(losses) + 1)]
    firsts = {
        wanted: next((record for record, value in zip(records, relative, strict=True) if value <= wanted), None)
        for wanted in _REACHED
    }
    reached = [
        {"relative": wanted, "seconds": round(record.seconds, 3), "step": record.step}
        for wanted, record in firsts.items()
        if record
    ]
    border = 0.9 * stylizer.seconds
    earlier = [value for record, value in zip(records, relative, strict=True) if record.seconds <= border]
    last = {"seconds": stylizer.seconds - border, "from": earlier[-1], "to": relative[-1]} if earlier else None
    more = _more_time(stylizer, records, relative[-1]) if stopped in _MORE_MIGHT_PAY else None
    return {"relative": relative[-1], "reached": reached, "last_tenth": last, "more_time": more}


def _more_time(stylizer: Stylizer, records: Sequence[StepRecord], relative: float) -> dict[str, Any] | None:
    """Predict what `LONGER` times the time would leave of the loss, on the same views.

    Of a time budget, all that is added goes into steps, as far as the job has any left.

    Args:
        records: Steps on all scales.
        relative: Loss that is left.

    Returns:
        `steps` in that time, `relative` loss after them, and both losses as a sentence (`text`). None if the time would
            go into larger views instead, or nothing can be predicted (`predicted_fall`).
    """
    job, factor, longer = stylizer.job, float(LONGER), f"{LONGER} times the time"
    within, choice = job.settings.within, job.plan.time_choice
    if within is not None:
        if stylizer.seconds > within:  # a resumed job, which has had more than one budget
            return None
        every = job.plan.steps_coarse + (choice.all_steps if choice else job.settings.steps_sos)
        factor = min(1 + (LONGER - 1) * within / stylizer.seconds, every / stylizer.step)
        longer = f"{duration(LONGER * within)} instead of {duration(within)}"
    visits = [(record.step, record.view, record.loss) for record in records]
    fall = predicted_fall(visits, factor, job.round_length) if factor >= _MIN_FACTOR else None
    if fall is None:
        return None
    rest = fall * relative
    text = (
        f"{longer} would lower the rest of the loss on these views from {percent(relative)} to about {percent(rest)}."
    )
    return {"steps": round(factor * stylizer.step), "relative": rest, "text": text}


def _evaluation_json(evaluation: Evaluation, weights: ScaleWeights) -> dict[str, Any]:
    scales = {str(scale): {**vars(terms), "total": terms.total} for scale, terms in evaluation.items()}
    return {"total": mean_loss(evaluation, weights), "scales": scales}


def _record_json(record: StepRecord, before: Evaluation, weights: ScaleWeights) -> dict[str, Any]:
    start = mean_loss(on_scales_of(record.terms, before), weights)
    return {
        "step": record.step,
        "stage": record.stage,
        "seconds": round(record.seconds, 3),
        "view": record.view,
        "loss": record.loss,
        "relative": ratio(record.loss, start),
        "scales": _evaluation_json(record.terms, weights)["scales"],
        "evaluated": list(record.evaluated),
        "parts": {name: round(seconds, 4) for name, seconds in record.parts.items()},
        "memory_bytes": record.memory,
        "device_memory_bytes": record.device_memory,
    }


def machine(device: torch.device) -> dict[str, Any]:
    """Describe the machine that ran the job."""
    return {
        "system": platform.platform(),
        "processor": processor(),
        "cores": container.cores(),
        "threads": torch.get_num_threads(),
        "memory_bytes": container.memory().total,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def processor() -> str:
    """Return the processor's name, or its architecture if the name is unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):  # not Linux, or a processor that does not name itself
        return platform.processor() or platform.machine()
