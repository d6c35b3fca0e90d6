"""Painted views: how well a scene follows a picture of one view, on that view and on others.

python -m benchmarks.painting NAME=SCENE:CAMERAS ...

CAMERAS is a camera file, or orbit:N. Each edit changes the colors of the scene itself, so it is consistent from all
sides. The program gets one view of the edited scene, and is judged on five others, against the unchanged scene, one
affine map of all colors, and the change of the nearest neighbors. Figures are PSNR in dB.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import mean

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.common import parse, read_views, write_result
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.files.scene_file import read_scene
from sgsst_core.painting import PaintedColors, PaintedView, paint
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors

#: Longer side of the views in pixels, number of views, and number of those to judge on.
RESOLUTION, VIEWS, JUDGED = 480, 24, 5


def night(scene: Scene, colors: Tensor) -> Tensor:
    """Return the colors [N, 3] in blue light, brighter near the center of the scene."""
    away = (scene.means - scene.means.median(dim=0).values).norm(dim=1)
    lamp = 1 / (1 + (away / away.median()).square())
    return colors * (torch.tensor([0.25, 0.3, 0.6]) + lamp[:, None] * torch.tensor([0.9, 0.7, 0.3]))


def strokes(scene: Scene, colors: Tensor) -> Tensor:
    """Return the colors [N, 3] with red bands across the scene."""
    height = scene.means @ torch.tensor([0.6, 0.77, 0.2])
    period = 0.2 * float(height.quantile(0.9) - height.quantile(0.1))
    return torch.where((height.remainder(period) < 0.15 * period)[:, None], torch.tensor([0.9, 0.2, 0.1]), colors)


def recolored(scene: Scene, colors: Tensor) -> Tensor:
    """Return the colors [N, 3] with the channels of all colorful Gaussians exchanged."""
    colorful = colors.amax(dim=1) - colors.amin(dim=1) > 0.12
    return torch.where(colorful[:, None], colors[:, [2, 0, 1]], colors)


EDITS: dict[str, Callable[[Scene, Tensor], Tensor]] = {"night": night, "strokes": strokes, "recolored": recolored}


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="NAME=SCENE:CAMERAS")
    arguments = parse(parser)
    results, files = {}, {}
    for text in arguments.scenes:
        name, _, rest = text.partition("=")
        path, _, cameras = rest.partition(":")
        files[name] = Path(path)
        scene = read_scene(files[name]).scene
        views = read_views(cameras, scene, VIEWS, RESOLUTION)
        results[name] = {edit: _measure(scene, views, change) for edit, change in EDITS.items()}
        for edit, figures in results[name].items():
            print(f"{name:10} {edit:10}", *(f"{key} {value:.1f}" for key, value in figures.items()), flush=True)
    write_result("painting", {"resolution": RESOLUTION, "views": VIEWS, "scenes": results}, scenes=files)


def _measure(scene: Scene, views: list[Camera], change: Callable[[Scene, Tensor], Tensor]) -> dict[str, float]:
    rasterizer, original = make_rasterizer("cpu", scene), COLOR_OFFSET + SH_C0 * scene.sh_dc

    def image(colors: Tensor, camera: Camera) -> Tensor:
        shown = replace(scene, sh_dc=(colors - COLOR_OFFSET) / SH_C0)
        return rasterizer.render(scene_colors(shown, camera), camera).clamp(0, 1).double()

    def psnr(colors: Tensor, cameras: list[Camera]) -> float:
        errors = [float((image(colors, each) - image(wanted, each)).square().mean()) for each in cameras]
        return mean(float(-10 * torch.tensor(max(error, 1e-12)).log10()) for error in errors)

    wanted, painted = change(scene, original.clamp(0, 1)), views[len(views) // 2]
    novel = spread([view for view in views if view is not painted], JUDGED)
    target = image(wanted, painted).float()
    view = PaintedView(painted, target, torch.ones(target.shape[:2]))
    result = paint(scene, [view], rasterizer, others=spread(views, 12))
    alone = PaintedColors(scene, [view], rasterizer)
    seen, solved = alone.weights > 0.05, alone.solve(original)[0]
    colors = {
        "nothing": original,
        "one map": _one_map(image(original, painted), target.double(), original),
        "neighbors": _of_neighbors(scene, original, solved, seen),
        "ours": COLOR_OFFSET + SH_C0 * result.sh_dc,
    }
    figures = {f"{name}, others": psnr(values, novel) for name, values in colors.items()}
    return {"painted": psnr(colors["ours"], [painted]), **figures}


def _one_map(before: Tensor, after: Tensor, colors: Tensor) -> Tensor:
    """Return the colors [N, 3] by the affine map that turns one image into another best."""
    terms = torch.cat([before.flatten(0, 1), torch.ones_like(before.flatten(0, 1)[:, :1])], dim=1)
    ridge = 1e-6 * len(terms) * torch.eye(4, dtype=torch.float64)
    map = torch.linalg.solve(terms.T @ terms + ridge, terms.T @ after.flatten(0, 1))
    return (torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1).double() @ map).float()


def _of_neighbors(scene: Scene, original: Tensor, solved: Tensor, seen: Tensor) -> Tensor:
    """Return the solved colors [N, 3], and for all Gaussians not seen the mean change of their neighbors in place."""
    _, nearest = cKDTree(scene.means[seen].numpy()).query(scene.means[~seen].numpy(), k=8)
    colors = solved.clone()
    colors[~seen] = original[~seen] + (solved - original)[seen][torch.as_tensor(nearest)].mean(dim=1)
    return colors


if __name__ == "__main__":
    main()
