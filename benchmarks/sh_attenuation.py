"""Residue of the original colors that spherical harmonics leave in a stylized scene, by their energy.

python -m benchmarks.sh_attenuation SCENE CAMERAS|orbit:N STYLE [--factors 0,0.5,1,2]

Multiplies the coefficients above degree 0 by each factor, and gives the colors of degree 0 the style's distribution, as
a warm start does. "energy" is the fraction of the color energy that depends on the view (`harmonics_energy`), "residue"
the RMS difference in 8-bit levels that the harmonics make in the covered pixels, "color distance" the Frechet distance
of the renders' colors from the style's.
"""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import fmean

import torch
from torch import Tensor

from benchmarks.inputs import input_parser, read_inputs
from sgsst_core.quality.judge import frechet_distance
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.spherical_harmonics import harmonics_energy, scene_colors
from sgsst_core.scene.stored_harmonics import held
from sgsst_core.style import Style, color_moments, style_moments
from sgsst_core.stylizing.color_transfer import warm_start


def main() -> None:
    """Print a row per factor."""
    parser = input_parser(__doc__)
    parser.add_argument("--factors", default="0,0.5,1,2")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--resolution", type=int, default=200)
    arguments = parser.parse_args()
    scene, cameras, style = read_inputs(arguments, arguments.views, arguments.resolution)
    rasterizer, wanted = make_rasterizer("cpu", scene), style_moments(Style.of(style))
    coverages, weights = zip(*(rasterizer.survey(camera) for camera in cameras), strict=True)
    total = torch.stack(weights).double().sum(dim=0)
    plain = replace(scene, sh_dc=warm_start(scene.sh_dc, total, Style.of(style)), sh_rest=torch.zeros(len(scene), 0, 3))

    def images(factor: float) -> list[Tensor]:
        colored = replace(plain, sh_rest=held(scene.sh_rest) * factor)
        return [rasterizer.render(scene_colors(colored, camera), camera).clamp(0, 1) for camera in cameras]

    before = images(0.0)
    print(f"{'factor':>8} {'energy':>8} {'residue':>8} {'color distance':>15}")
    for factor in map(float, arguments.factors.split(",")):
        triples = list(zip(images(factor), before, coverages, strict=True))
        squares = [float(((a - b).square().mean(2) * c).sum() / c.sum()) for a, b, c in triples]
        distances = [frechet_distance(color_moments(a.reshape(-1, 3), c.flatten()), wanted) for a, _, c in triples]
        energy = harmonics_energy(replace(scene, sh_rest=held(scene.sh_rest) * factor), total)
        print(f"{factor:8g} {energy:8.3f} {255 * math.sqrt(fmean(squares)):8.1f} {fmean(distances):15.1f}", flush=True)


if __name__ == "__main__":
    main()
