"""What removing spherical harmonics does to the style of a scene, by the energy of its bands.

python -m benchmarks.sh_attenuation SCENE CAMERAS|orbit:N STYLE NAME [--factors 0,0.5,1,2]

Multiplies the scene's coefficients above degree 0 by each factor, stylizes the result without attenuation, and judges
it on novel views. Factor 0 is what `sh_attenuation` 1 gives. "energy" is the fraction of the color energy that depends on
the view (`harmonics_energy`), before the job. Results are added to benchmarks/results/sh_attenuation.json, under NAME.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.inputs import input_parser, read_inputs
from benchmarks.judged import UNSTYLIZED, judged
from benchmarks.machine import add_pair
from sgsst_core import Stylizer, make_settings
from sgsst_core.bench.quality import make_novel_views
from sgsst_core.quality.judge import Judge
from sgsst_core.quality.lpips import Lpips
from sgsst_core.report.contact_sheet import write_rows
from sgsst_core.scene.spherical_harmonics import harmonics_energy

COLUMNS = ("energy", "style", "interior_style", "sliced_features", "color_distance", "content", "seconds")


def main() -> None:
    """Run all factors, then print and store the results."""
    parser = input_parser(__doc__)
    parser.add_argument("name", help="of the pair, in the results")
    parser.add_argument("--factors", default="0,0.5,1,2")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--out", type=Path, help="folder for a contact sheet")
    arguments = parser.parse_args()
    scene, cameras, style = read_inputs(arguments, arguments.views, arguments.resolution)
    settings = make_settings(steps_coarse=0, steps_sos=arguments.steps, early_stop=False, measure=0)
    description = {"scene": arguments.scene.parent.name, "style": arguments.style.name, "views": arguments.views}
    description |= {"resolution": arguments.resolution, "steps": arguments.steps}
    results, rows = {}, []
    print(f"{arguments.name:20}", *(f"{name:>15}" for name in COLUMNS))
    for factor in arguments.factors.split(","):
        given = replace(scene, sh_rest=scene.sh_rest * float(factor))
        stylizer = Stylizer.planned(given, cameras, style, settings)
        novel_views = make_novel_views(stylizer)
        views = [novel_views.cameras[index] for index in novel_views.views]
        judge = Judge(Lpips(), style, given, novel_views.rasterizer, views)
        started = time.process_time()
        for _ in range(stylizer.job.total_steps):
            stylizer.run_step()
        seconds = time.process_time() - started
        energy = harmonics_energy(given, stylizer.job.plan.survey.total_blend_weights)
        colors = {f"{factor} {UNSTYLIZED}": given.sh_dc, f"{factor} stylized": stylizer.stylized()}
        for row, sh_dc in colors.items():
            results[row] = {"energy": energy, **judged(judge, sh_dc), "seconds": seconds}
            print(f"{row:20}", *(f"{results[row][column]:15.3f}" for column in COLUMNS), flush=True)
            rows.append((row, [judge.renders(sh_dc, camera)[0] for camera in judge.cameras[:3]]))
        add_pair("sh_attenuation", arguments.name, description, results)
    if arguments.out:
        with torch.no_grad():
            write_rows(arguments.out / f"{arguments.name}.jpg", style, rows)


if __name__ == "__main__":
    main()
