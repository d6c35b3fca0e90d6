"""Exceptions of the core, in one hierarchy.

Every message says what is wrong, where (file, property, view), and what to do about it. Front ends turn
`InvalidInputError` into exit code 2 (command line) or problem+json (HTTP) without parsing the text.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class SgsstError(Exception):
    """Base class of all errors that this package raises deliberately."""

    #: Stable identifier for programs; messages are for people and may change.
    code = "sgsst-error"


class InvalidInputError(SgsstError):
    """User input that cannot be used."""

    code = "invalid-input"


class SceneError(InvalidInputError):
    """Unusable 3DGS scene: missing, truncated, not a 3DGS scene, non-finite values, or empty."""

    code = "invalid-scene"


class CameraError(InvalidInputError):
    """Unusable cameras: unknown format, distorted model, or no overlap with the scene."""

    code = "invalid-cameras"


class ImageError(InvalidInputError):
    """Unusable style image or photo: not an image, too large, or missing."""

    code = "invalid-image"


class MaskError(InvalidInputError):
    """Unusable mask of a scene's Gaussians: unreadable, of another length, or with other values than flags."""

    code = "invalid-mask"


class SettingsError(InvalidInputError):
    """Setting that is out of range or contradicts another one."""

    code = "invalid-settings"


class OutputError(InvalidInputError):
    """Output location that cannot be written."""

    code = "invalid-output"


class WeightsError(InvalidInputError):
    """Weights of the feature network that are missing, corrupt or of the wrong shape."""

    code = "invalid-weights"


class SceneTooLargeError(InvalidInputError):
    """Scene that does not fit in the memory of a machine or of its GPU."""

    code = "scene-too-large"


class CheckpointError(InvalidInputError):
    """Checkpoint that is missing, corrupt or from another job."""

    code = "invalid-checkpoint"


class TooManyIntersectionsError(SgsstError):
    """View with more pairs of Gaussian and raster tile than the rasterizer can index."""

    code = "too-many-intersections"


class RanksFailedError(SgsstError):
    """Failure of a job's workers: they were lost too often, or an error ended one of them."""

    code = "workers-failed"


class RanksDriftedError(SgsstError):
    """Different colors on ranks that must agree: one machine computes incorrectly, or rounds differently."""

    code = "ranks-drifted"


class DivergedError(SgsstError):
    """Colors or gradients beyond the range that the optimizer can handle."""

    code = "diverged"


class DeviceMemoryError(SgsstError):
    """GPU without enough free memory for a step, even with half of the activations."""

    code = "gpu-memory"


class InfrastructureError(SgsstError):
    """Failure of a machine, a network or a file store, independent of the user's input."""

    code = "infrastructure"


class ClusterAwayError(RanksFailedError, InfrastructureError):
    """Cluster that is unavailable, or that has no capacity for even a single worker."""

    code = "workers-failed"


@contextmanager
def reading_scene(path: Path) -> Iterator[None]:
    """Raise SceneError in place of an OSError in the block, which reads a scene file."""
    try:
        yield
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error


def is_out_of_memory(error: Exception) -> bool:
    """Return whether an error reports a lack of memory.

    PyTorch raises a plain RuntimeError on the CPU, and a subclass of it on GPUs.
    """
    text = str(error)
    return isinstance(error, MemoryError) or "can't allocate memory" in text or "out of memory" in text
