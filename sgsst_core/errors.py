"""Exceptions of the core, in one hierarchy.

Every message says what is wrong, where (file, property, view), and what to do about it. Front ends turn
`InvalidInputError` into exit code 2 (command line) or problem+json (HTTP) without parsing the text.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class SgsstError(Exception):
    """Base class of all errors that this package raises deliberately."""

    #: Stable identifier for programs; messages are for people and may change.
    code = "sgsst-error"

    def __init_subclass__(cls, code: str | None = None) -> None:
        if code is not None:
            cls.code = code


class InvalidInputError(SgsstError, code="invalid-input"):
    """User input that cannot be used."""


class SceneError(InvalidInputError, code="invalid-scene"):
    """Unusable 3DGS scene: missing, truncated, not a 3DGS scene, non-finite values, or empty."""


class CameraError(InvalidInputError, code="invalid-cameras"):
    """Unusable cameras: unknown format, distorted model, or no overlap with the scene."""


class ImageError(InvalidInputError, code="invalid-image"):
    """Unusable style image or photo: not an image, too large, or missing."""


class MaskError(InvalidInputError, code="invalid-mask"):
    """Unusable mask of a scene's Gaussians: unreadable, of another length, or with other values than flags."""


class SettingsError(InvalidInputError, code="invalid-settings"):
    """Setting that is out of range or contradicts another one."""


class OutputError(InvalidInputError, code="invalid-output"):
    """Output location that cannot be written."""


class WeightsError(InvalidInputError, code="invalid-weights"):
    """Weights of the feature network that are missing, corrupt or of the wrong shape."""


class SceneTooLargeError(InvalidInputError, code="scene-too-large"):
    """Scene that does not fit in the memory of a machine or of its GPU."""


class CheckpointError(InvalidInputError, code="invalid-checkpoint"):
    """Checkpoint that is missing, corrupt or from another job."""


class TooManyIntersectionsError(SgsstError, code="too-many-intersections"):
    """View with more pairs of Gaussian and raster tile than the rasterizer can index."""


class RanksFailedError(SgsstError, code="workers-failed"):
    """Failure of a job's workers: they were lost too often, or an error ended one of them."""


class RanksDriftedError(SgsstError, code="ranks-drifted"):
    """Different colors on ranks that must agree: one machine computes incorrectly, or rounds differently."""


class DivergedError(SgsstError, code="diverged"):
    """Colors or gradients beyond the range that the optimizer can handle."""


class DeviceMemoryError(SgsstError, code="gpu-memory"):
    """GPU without enough free memory for a step, even with half of the activations."""


class InfrastructureError(SgsstError, code="infrastructure"):
    """Failure of a machine, a network or a file store, independent of the user's input."""


class ClusterAwayError(RanksFailedError, InfrastructureError, code="workers-failed"):
    """Cluster that is unavailable, or that has no capacity for even a single worker."""


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
