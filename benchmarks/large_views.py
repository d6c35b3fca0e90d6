"""Steps on a view of 5187x3361 pixels under a memory limit: seconds and peak memory, compared with the plan's bound.

python -m benchmarks.large_views SCENE.ply CAMERAS STYLE [--steps 2] [--memory 10]

CAMERAS is a camera file, or orbit:N.
"""

import time

import torch

from benchmarks.common import input_parser, parse, read_inputs, with_size, write_result
from sgsst_core import Stylizer, make_settings
from sgsst_core.budget import peak_memory

#: Width and height of the view, the paper's largest.
SIZE = (5187, 3361)


def main() -> None:
    """Measure, print and store. The first step prepares the view."""
    parser = input_parser(__doc__)
    parser.add_argument("--steps", type=int, default=2)
    parser.add_argument("--memory", type=float, default=10.0, help="GB to plan with")
    arguments = parse(parser)
    scene, cameras, style = read_inputs(arguments, 1, SIZE[0])
    settings = make_settings(
        "standard",
        steps_sos=arguments.steps,
        scale_sampling=1,
        early_stop=False,
        memory_limit=int(arguments.memory * 1e9),
        precision="float32",
    )
    started = time.perf_counter()
    stylizer = Stylizer.planned(scene, [with_size(cameras[0], *SIZE)], style, settings)
    planning = time.perf_counter() - started
    seconds: list[float] = []
    for _ in range(arguments.steps):
        started = time.perf_counter()
        stylizer.run_step()
        seconds.append(time.perf_counter() - started)
    row = {
        "width": SIZE[0],
        "height": SIZE[1],
        "precision": settings.precision,
        "threads": torch.get_num_threads(),
        "memory_gb": arguments.memory,
        "planning_seconds": planning,
        "first_step_seconds": seconds[0],
        "step_seconds": seconds[1:],
        "parts": stylizer.history[-1].parts,
        "peak_gb": peak_memory() / 1e9,
        "planned_peak_gb": stylizer.job.plan.peak_bytes / 1e9,
        "losses": [record.loss for record in stylizer.history],
    }
    print(row)
    scenes = {arguments.scene.parent.name: arguments.scene}
    write_result("large_views", {"sizes": [row]}, presets=["standard"], scenes=scenes)


if __name__ == "__main__":
    main()
