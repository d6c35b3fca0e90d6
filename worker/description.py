"""Summary of a prepared job: its inputs, and the decisions of the plan with their reasons."""

from __future__ import annotations

from dataclasses import dataclass

from sgsst_core.files.scene_file import SceneFile
from worker.prepare import Job


@dataclass(frozen=True)
class Prepared:
    """Summary of a job before its first step.

    Attributes:
        lines: Pairs of a heading and a line of text; see `describe`.
        step: Step at which the job starts; more than 0 if it resumes from a checkpoint.
        total: Number of steps of the whole job.
    """

    lines: list[tuple[str, str]]
    step: int
    total: int


def describe(job: Job) -> Prepared:
    """Summarize the inputs and the plan for the user."""
    stylizer, settings = job.stylizer, job.stylizer.job.settings
    lines = [
        ("scene", describe_scene(job.scene_file)),
        ("views", _describe_views(job)),
        ("network", _describe_network(job)),
    ]
    lines += [(decision.item, f"{decision.decision}: {decision.reason}") for decision in stylizer.job.plan.decisions]
    rate = f"learning rate {settings.learning_rate:g}"
    if settings.learning_rate_end != settings.learning_rate:
        rate += f" to {settings.learning_rate_end:g}"
    steps = f"{stylizer.job.plan.steps_coarse} steps on the coarsest scale, then {settings.steps_sos} on all"
    if not stylizer.job.plan.steps_coarse:
        steps = f"{settings.steps_sos} steps"
    lines.append(("schedule", f"{steps}; {rate} (preset {settings.preset})"))
    if job.resumed:
        lines.append(("resuming", f"at step {job.resumed.state.step} of {stylizer.job.total_steps}"))
    elif job.outputs.checkpoints.exist:
        note = (
            f"{job.outputs.checkpoint} exists from an earlier run. This run starts from the beginning and replaces it; "
        )
        lines.append(("note", note + "use --resume to continue from it."))
    return Prepared(lines, job.resumed.state.step if job.resumed else 0, stylizer.job.total_steps)


def describe_scene(file: SceneFile) -> str:
    """Return a text about the Gaussians of a file; `about_notes` has what was not read, or not as stored."""
    notes = f", {file.dropped:,} invalid ones dropped" if file.dropped else ""
    if file.clamped:
        notes += f", {file.clamped:,} infinite opacities read as almost 0 or 1"
    return f"{len(file.scene):,} Gaussians{notes}, SH degree {file.scene.sh_degree}"


def _describe_views(job: Job) -> str:
    views = job.stylizer.job.views
    sizes = sorted({(camera.width, camera.height) for camera in views.cameras})
    text = f"{len(views)} of {sizes[0][0]}x{sizes[0][1]}"
    if len(sizes) > 1:
        text = f"{len(views)} of {len(sizes)} sizes, {sizes[0][0]}x{sizes[0][1]} to {sizes[-1][0]}x{sizes[-1][1]}"
    tiling = job.stylizer.job.loss.tiling
    scales = max(tiling.scale_count((height, width)) for width, height in sizes)
    chosen = max(len(tiling.scales((height, width))) for width, height in sizes)
    text += f", {f'{chosen} of ' if chosen < scales else ''}{scales} scale{'s' if scales > 1 else ''}"
    return text + f"; content from {'the photos' if job.request.images else 'unstylized renders'}"


def _describe_network(job: Job) -> str:
    name = job.sources.backbone.name.upper()
    if job.request.backbone == "auto" and name == "VGG16":
        return f"{name}, because VGG19 (the paper's) is not installed; install it with `sgsst weights fetch vgg19`"
    return name
