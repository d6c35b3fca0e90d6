"""Render mode of a scene: how Gaussians that are smaller than a pixel are drawn.

PyTorch is not imported, because the API process and the command line's help read this module.
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

from sgsst_core.constants import EPS2D
from sgsst_core.errors import SettingsError

#: Requested render mode; "auto" for that of the scene's file.
RenderMode = Literal["auto", "classic", "antialiased"]

#: Largest blur. Trainers use 0.1 to 0.3; more than this is a typo.
MAX_EPS2D = 100.0


@dataclass(frozen=True)
class Rendering:
    """Render mode of a scene, which must be that of its training.

    Attributes:
        mode: "classic" blurs each Gaussian by the size of a pixel and keeps its peak opacity, so that small ones gain
            weight. "antialiased" multiplies the opacity by sqrt(det S / det(S + eps2d I)), where S is the 2D covariance
            (Mip-Splatting; `rasterize_mode="antialiased"` of gsplat). "2dgs" is for flat Gaussians of 2D Gaussian
            Splatting, which are drawn like classic ones.
        eps2d: Variance in square pixels that is added to both axes of a projected Gaussian.
    """

    mode: Literal["classic", "antialiased", "2dgs"] = "classic"
    eps2d: float = EPS2D

    @property
    def antialiased(self) -> bool:
        """Return whether opacities are compensated for the blur."""
        return self.mode == "antialiased"

    @property
    def text(self) -> str:
        """Return a description such as "antialiased, eps2d 0.1"."""
        return f"{self.mode}, eps2d {self.eps2d:g}"

    def requested(self, mode: RenderMode, eps2d: float | None) -> "Rendering":
        """Return the rendering for a requested mode and blur, where None and "auto" stand for this rendering's own.

        If the mode changes, the blur is that mode's default. Flat Gaussians stay flat in classic mode.

        Raises:
            SettingsError: If there is no such mode, or the blur is out of range.
        """
        if mode not in get_args(RenderMode):
            raise SettingsError(f"There is no render mode {mode!r}. Choose one of {', '.join(get_args(RenderMode))}.")
        if eps2d is not None and not 0 < eps2d <= MAX_EPS2D:
            raise SettingsError(f"The blur eps2d is {eps2d}; it must be above 0, and at most {MAX_EPS2D:g}.")
        same = mode in ("auto", self.mode) or (mode, self.mode) == ("classic", "2dgs")
        chosen = self if same else Rendering(mode)  # type: ignore[arg-type]
        return chosen if eps2d is None else replace(chosen, eps2d=eps2d)


#: Rendering of scenes whose files state none.
CLASSIC = Rendering()
