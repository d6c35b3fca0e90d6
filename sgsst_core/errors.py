"""The exceptions of the core, in one tree.

Every message says what was wrong, where (file, property, view), and what to do about it. Front ends
turn `InvalidInputError` into exit code 2 (command line) or problem+json (HTTP) without parsing text.
"""

from __future__ import annotations


class SgsstError(Exception):
    """Root of every error that this package raises on purpose."""

    #: Stable identifier for programs; messages are for people and may change.
    code = "sgsst-error"


class InvalidInputError(SgsstError):
    """Something that the user handed in cannot be used."""

    code = "invalid-input"


class SceneError(InvalidInputError):
    """The 3DGS PLY cannot be used: missing, truncated, not a 3DGS scene, non-finite values, empty."""

    code = "invalid-scene"


class CameraError(InvalidInputError):
    """The cameras cannot be used: unknown form, distorted model, no overlap with the scene."""

    code = "invalid-cameras"


class ImageError(InvalidInputError):
    """A style image or a photo cannot be used: not an image, too large, missing."""

    code = "invalid-image"


class SettingsError(InvalidInputError):
    """A setting is out of range or contradicts another one."""

    code = "invalid-settings"


class OutputError(InvalidInputError):
    """The output location cannot be written."""

    code = "invalid-output"


class WeightsError(InvalidInputError):
    """The weights of the feature network are missing, corrupt or of the wrong shape."""

    code = "invalid-weights"


class SceneTooLargeError(InvalidInputError):
    """The memory of a machine, or of its GPU, cannot hold the scene."""

    code = "scene-too-large"


class CheckpointError(InvalidInputError):
    """A checkpoint is missing, corrupt or belongs to another job."""

    code = "invalid-checkpoint"


class TooManyIntersectionsError(SgsstError):
    """A view has more Gaussian/raster-tile intersections than the rasterizer can address."""

    code = "too-many-intersections"


class RanksFailedError(SgsstError):
    """The workers of a job were lost too often, or failed for a reason of their own."""

    code = "workers-failed"


class RanksDriftedError(SgsstError):
    """Ranks that must have the same colors have not: a machine computes wrongly, or not like the others."""

    code = "ranks-drifted"


class DivergedError(SgsstError):
    """Colors or gradients have left the range in which the optimizer works."""

    code = "diverged"


class InfrastructureError(SgsstError):
    """A machine, a network or a store of files has failed: nothing is wrong with what the user handed in."""

    code = "infrastructure"


class ClusterAwayError(RanksFailedError, InfrastructureError):
    """There is no cluster to run workers on, or it has no free place for a single one."""

    code = "workers-failed"
