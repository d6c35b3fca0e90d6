"""Second attempt with fewer activations in memory, after a GPU has run out of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

from sgsst_core.errors import DeviceMemoryError
from sgsst_core.stylizing.job import StylizationJob

T = TypeVar("T")


def with_second_attempt(job: StylizationJob, work: Callable[[], T]) -> T:
    """Return the result of a function, which is called again if the GPU runs out of memory.

    Before that, caches are cleared, and the memory budget for activations is halved for the rest of the job. Results
    then differ by rounding. Several ranks make no second attempt, because the others wait for messages of the first.

    Raises:
        DeviceMemoryError: If the memory is still not enough.
    """
    try:
        return work()
    except torch.OutOfMemoryError:
        if job.collectives.size > 1:
            raise _not_enough(job, "") from None
    # Outside of the handler, because the exception refers to the tensors of the first attempt.
    _halve_activations(job)
    try:
        return work()
    except torch.OutOfMemoryError:
        raise _not_enough(job, ", not even with half of the activations in memory") from None


def _halve_activations(job: StylizationJob) -> None:
    """Clear what depends on the partition, and halve the memory budget for activations."""
    job.loss.halve_memory(max(camera.height * camera.width for camera in job.views.cameras))
    job.view_targets.forget_division()
    if job.graphs is not None:
        job.graphs.clear()
    torch.cuda.empty_cache()


def _not_enough(job: StylizationJob, attempt: str) -> DeviceMemoryError:
    free, total = torch.cuda.mem_get_info(job.network.device)
    return DeviceMemoryError(
        f"The GPU's memory ({total / 1e9:.1f} GB, {free / 1e9:.1f} GB free) is not enough for a step{attempt}. Stop "
        f"other programs on this GPU, or give a smaller --memory-limit than {job.memory_limit / 1e9:.1f} GB or a "
        "smaller --resolution (`max_resolution` in Python)."
    )
