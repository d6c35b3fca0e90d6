"""A job of the store as what the worker is asked for."""

from __future__ import annotations

from pathlib import Path

from service.files.names import RESULT
from service.files.staging import Staged
from service.parameters import JobParameters
from worker.request import SceneRequest, StylizeRequest
from worker.styles import StyleFile


def scene_request(staged: Staged, parameters: JobParameters) -> SceneRequest:
    """Scene and cameras."""
    return SceneRequest.of(staged.scene, staged.cameras, parameters)


def _styles(staged: Staged, parameters: JobParameters) -> tuple[StyleFile, ...]:
    """The style's pictures; those without weights count alike."""
    weights = parameters.style_weights or [1.0] * len(staged.styles)
    return tuple(StyleFile(path, weight) for path, weight in zip(staged.styles, weights, strict=True))


def stylize_request(staged: Staged, parameters: JobParameters) -> StylizeRequest:
    """Everything; paths are relative to the folder that the job was staged in."""
    return StylizeRequest(
        scene_request(staged, parameters),
        _styles(staged, parameters),
        staged.photos,
        Path("out", RESULT),
        parameters.backbone,
        False,
        parameters.settings(),
    )
