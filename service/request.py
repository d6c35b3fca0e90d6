"""Conversion of a stored job to a specification for the worker."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from service.files.staging import RESULT, Staged, region_mask, region_styles, staged_name
from service.parameters import JobParameters
from worker.job import JobSpec, SceneRequest
from worker.region_requests import RegionRequest
from worker.styles import StyleFile


def _regions(staged: Staged, parameters: JobParameters) -> tuple[RegionRequest, ...]:
    """Return the regions with the paths of their staged styles and masks."""
    paths = {path.name: path for path in staged.styles}

    def staged_file(file: StyleFile) -> StyleFile:
        return replace(file, path=paths[staged_name("style", str(file.path))])

    def staged_region(region: RegionRequest) -> RegionRequest:
        selection = region.selection and replace(region.selection, path=region_mask(region))
        return replace(region, selection=selection, styles=tuple(map(staged_file, region.styles)))

    return tuple(map(staged_region, parameters.region_requests))


def job_spec(staged: Staged, parameters: JobParameters) -> JobSpec:
    """Return the specification of a job; its paths are relative to the staging folder."""
    taken = region_styles(parameters.region_requests)
    own = [path for path in staged.styles if path.name not in taken]
    weights = parameters.style_weights or [1.0] * len(own)
    return JobSpec(
        source=SceneRequest.of(staged.scene, staged.cameras, parameters),
        styles=tuple(StyleFile(path, weight) for path, weight in zip(own, weights, strict=True)),
        images=staged.photos,
        out=Path("out", RESULT),
        settings=parameters.settings(),
        backbone=parameters.backbone,
        regions=_regions(staged, parameters),
        colors=True,
        style_background=parameters.style_background,
        pad_sh=parameters.pad_sh,
    )
