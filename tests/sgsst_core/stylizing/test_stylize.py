"""Tests of stylizing in one call: the result has the form of the given scene, and the same colors in all forms."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sgsst_core import Callbacks, Stylizer, load_scene, make_settings, save, stylize
from sgsst_core import run as run_job
from sgsst_core.errors import CameraError, ImageError, SceneError, SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.library import as_scene
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.quality.measure import Float32Reference
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.rendering import Rendering
from tests.sgsst_core.stylizing.test_refining import large_wall
from tests.sgsst_core.trainer_scenes import splats_of, write_gsplat, write_nerfstudio
from tests.small_scenes import cameras, style, wall, write_files

pytestmark = pytest.mark.usefixtures("one_thread")

ROOT = Path(__file__).resolve().parents[3]


def saved(path: Path, scene: Scene) -> Any:
    save(path, scene)
    return load_scene(str(path))


#: Functions that return a scene in one form, given a folder for files.
FORMS: dict[str, Callable[[Scene, Path], Any]] = {
    "ply": lambda scene, folder: saved(folder / "scene.ply", scene),
    "spz": lambda scene, folder: saved(folder / "scene.spz", scene),
    "scene": lambda scene, folder: scene,
    "numpy": lambda scene, folder: {key: value.numpy() for key, value in splats_of(scene).items()},
    "splats": lambda scene, folder: splats_of(scene),
    "parameters": lambda scene, folder: torch.nn.ParameterDict(splats_of(scene)),
    "activated": lambda scene, folder: splats_of(scene, activated=True),
    "gsplat": lambda scene, folder: load_scene(write_gsplat(folder / "step-29999.ckpt", scene)),
    "nerfstudio": lambda scene, folder: load_scene(write_nerfstudio(folder / "step-29999.ckpt", scene)),
}


def run(scene: Any, weights: BackboneWeights, **settings: Any) -> Any:
    return stylize(
        scene, cameras(), style(), preset="preview", weights=weights, steps_coarse=0, steps_sos=2, measure=0, **settings
    )


@pytest.mark.parametrize(
    "form",
    [form if form in ("ply", "numpy", "gsplat") else pytest.param(form, marks=pytest.mark.slow) for form in FORMS],
)
def test_result_has_the_form_of_the_scene_and_new_colors(
    tiny_weights: BackboneWeights, tmp_path: Path, form: str
) -> None:
    given = FORMS[form](wall(sh_degree=1), tmp_path)
    before = as_scene(given)
    unchanged = Scene(*(getattr(before, name).clone() for name in TENSORS))
    result = run(given, tiny_weights)
    assert type(result) is type(given)
    after, alone = as_scene(result), run(before, tiny_weights)
    assert torch.equal(after.sh_dc, alone.sh_dc)
    assert not torch.equal(after.sh_dc, before.sh_dc)
    for name in TENSORS:
        assert torch.equal(getattr(before, name), getattr(unchanged, name)), "the given scene stays"
        if name != "sh_dc":
            assert torch.equal(getattr(after, name), getattr(before, name))
    if form in ("splats", "activated", "numpy", "parameters"):
        assert {key: (value.shape, value.dtype) for key, value in result.items()} == {
            key: (value.shape, value.dtype) for key, value in given.items()
        }
        assert all(result[key] is given[key] for key in given if key != "sh0" and form != "parameters")


@pytest.mark.parametrize("form", ["spz", "scene", "activated"])
def test_split_and_attenuated_results_have_the_form_of_the_scene(
    tiny_weights: BackboneWeights, tmp_path: Path, form: str
) -> None:
    scene = large_wall()
    scene = replace(scene, sh_rest=0.1 * torch.ones(len(scene), 3, 3))
    given = FORMS[form](scene, tmp_path)
    if isinstance(given, dict):
        given["label"] = np.arange(len(scene))
    before = as_scene(given)
    result = run(given, tiny_weights, refine=2, sh_attenuation=0.25)
    after = as_scene(result)
    assert len(after) > len(before)
    alone = run(before, tiny_weights, refine=2, sh_attenuation=0.25)
    for name in TENSORS:
        actual, wanted = (getattr(each, name) for each in (after, alone))
        tolerance = 1e-5 if form == "activated" else 0  # exp and log round
        torch.testing.assert_close(actual, wanted, rtol=tolerance, atol=tolerance)
    if isinstance(given, dict):
        assert (len(result["label"]), set(result["label"])) == (len(after), set(given["label"]))
    else:
        save(tmp_path / "out.ply", result)
        saved = as_scene(load_scene(tmp_path / "out.ply"))
        assert all(torch.equal(getattr(saved, name), getattr(after, name)) for name in TENSORS)


def test_readme_example_runs(tiny_installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ply, _, image = write_files(tmp_path)
    image.rename(tmp_path / "style.jpg")
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(example, names)
    before, after = ply.read_bytes(), Path("stylized.ply").read_bytes()
    changed = sum(a != b for a, b in zip(before, after, strict=True))
    assert 0 < changed <= 12 * len(names["scene"].scene), "only colors"
    assert torch.equal(load_scene("stylized.ply").scene.sh_dc, names["result"].scene.sh_dc)


WRONG: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "scene path": ({"scene": "scene.ply"}, SceneError, "is a str. Read files with `load_scene`"),
    "cameras path": ({"cameras": "cameras.json"}, CameraError, "Read them with `load_cameras`"),
    "style": ({"style": 255 * style()}, ImageError, "by 255"),
    "photos": ({"photos": lambda index: 255 * torch.ones(48, 64, 3)}, ImageError, "photo of view 0 .*by 255"),
    "setting": ({"steps": 5}, SettingsError, "steps"),
    "mode": ({"render_mode": "mip"}, SettingsError, "no render mode 'mip'"),
    "blur": ({"eps2d": 0.0}, SettingsError, "blur eps2d is 0"),
    "preset": ({"preset": "fast"}, SettingsError, "There is no preset 'fast'"),
    "shape": ({"scene": replace(wall(), scales=torch.zeros(5, 3))}, SceneError, r"`scales` has shape \[5, 3\]"),
    "degree": ({"scene": replace(wall(), sh_rest=torch.zeros(616, 24, 3))}, SceneError, r"`sh_rest` has shape"),
    "nan": ({"scene": replace(wall(), quats=torch.full((616, 4), torch.nan))}, SceneError, "`quats` holds 2464 NaN"),
    "integers": ({"scene": replace(wall(), sh_dc=torch.zeros(616, 3).long())}, SceneError, "dtype torch.int64"),
    "empty": ({"scene": wall().subset(torch.zeros(616).bool())}, SceneError, "no Gaussians"),
    "list": ({"scene": replace(wall(), means=[[0.0] * 3])}, SceneError, "`means` is a list"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("case", WRONG)
def test_unusable_arguments_are_refused_with_a_message(tiny_weights: BackboneWeights, case: str) -> None:
    given, error, problem = WRONG[case]
    arguments: dict[str, Any] = {"scene": wall(), "cameras": cameras(1), "style": style(), "preset": "preview"} | given
    with pytest.raises(error, match=problem):
        stylize(**arguments, weights=tiny_weights)


def test_numpy_arrays_are_accepted(tiny_weights: BackboneWeights) -> None:
    scene = wall(sh_degree=1)
    arrays = Scene(*(getattr(scene, name).double().numpy() for name in TENSORS))
    arrays = replace(arrays, opacities=arrays.opacities[:, None], sh_dc=arrays.sh_dc[:, None])
    view = cameras(1)[0]
    K = np.array([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]])
    camera = Camera.from_matrix(view.world_to_camera.numpy(), K, view.width, view.height)
    image = (255 * style()).byte().permute(2, 0, 1).numpy()
    results = [
        stylize(each, [views], style_image, preset="preview", steps_sos=1, weights=tiny_weights)
        for each, views, style_image in ((arrays, camera, image), (scene, view, (255 * style()).byte() / 255))
    ]
    assert torch.equal(results[0].sh_dc, results[1].sh_dc)


def test_scenes_are_drawn_in_the_requested_mode(tiny_weights: BackboneWeights) -> None:
    scene = wall()
    antialiased = run(scene, tiny_weights, render_mode="antialiased", eps2d=0.1)
    assert antialiased.rendering == Rendering("antialiased", 0.1)
    given = replace(scene, rendering=antialiased.rendering)
    assert torch.equal(antialiased.sh_dc, run(given, tiny_weights).sh_dc)
    splats = run(splats_of(scene), tiny_weights, render_mode="antialiased", eps2d=0.1)
    assert torch.equal(splats["sh0"][:, 0], antialiased.sh_dc)
    assert not torch.equal(antialiased.sh_dc, run(scene, tiny_weights).sh_dc)


def test_progress_is_shown_on_a_terminal_only_on_request(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes any output for a terminal
    steps: list[int] = []
    callbacks = Callbacks(progress=lambda progress: steps.append(progress.step))
    run(wall(), tiny_weights, callbacks=callbacks)
    assert capsys.readouterr().out == ""
    run(wall(), tiny_weights, callbacks=callbacks, progress=True)
    assert "2/2" in capsys.readouterr().out
    assert steps == [1, 2, 1, 2]


def test_importing_the_package_imports_no_pytorch() -> None:
    code = "import sys, sgsst_core; print(sorted({'torch', 'numba', 'numpy', 'pydantic'} & set(sys.modules)))"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "[]"


def make(weights: BackboneWeights, scene: Scene, **values: Any) -> Stylizer:
    settings = make_settings(steps_coarse=0, steps_sos=3, early_stop=False, **values)
    return Stylizer.planned(scene, cameras(), style(), settings, weights=weights)


@pytest.mark.parametrize("attenuation", [0.4, 1.0])
def test_job_is_bit_identical_to_that_of_an_attenuated_scene(tiny_weights: BackboneWeights, attenuation: float) -> None:
    scene = wall(sh_degree=2)
    stylizer = make(tiny_weights, scene, sh_attenuation=attenuation)
    came = replace(scene, sh_rest=scene.sh_rest * torch.tensor(1 - attenuation, dtype=torch.float32))
    other = make(tiny_weights, came.without_zero_bands())
    for each in (stylizer, other):
        run_job(each)
    assert torch.equal(stylizer.stylized(), other.stylized())
    assert [record.loss for record in stylizer.history] == [record.loss for record in other.history]
    assert (stylizer.job.scene.sh_degree, stylizer.job.sh_degree) == (0 if attenuation == 1 else 2, 2)
    exact = Float32Reference(stylizer).evaluate(stylizer.job.evaluation_views, stylizer.stylized())
    assert exact.keys() == stylizer.evaluate(stylizer.job.evaluation_views).keys()
    for scale, terms in stylizer.evaluate(stylizer.job.evaluation_views).items():
        assert exact[scale].total == pytest.approx(terms.total, rel=1e-6)


@pytest.mark.parametrize("attenuation", [0.4, 1.0])
def test_written_result_renders_as_optimized(tiny_weights: BackboneWeights, tmp_path: Path, attenuation: float) -> None:
    write_scene(tmp_path / "scene.ply", wall(sh_degree=1))
    source = read_scene(tmp_path / "scene.ply")
    settings = make_settings(steps_coarse=0, steps_sos=2, sh_attenuation=attenuation)
    values = settings.model_dump(exclude={"preset"})
    stylized = stylize(source, cameras(), style(), weights=tiny_weights, **values)
    save(tmp_path / "out.ply", stylized)
    result = read_scene(tmp_path / "out.ply").scene
    stylizer = Stylizer.planned(source.scene, cameras(), style(), settings, weights=tiny_weights)
    again = Stylizer.planned(result, cameras(), style(), make_settings(warm_start=False), weights=tiny_weights)
    colors = stylized.scene.sh_dc[stylizer.job.plan.seen]
    for index in range(3):
        images = [
            each.job.views.render(index, each.job.views.colors(index, sh_dc))
            for each, sh_dc in ((stylizer, colors), (again, again.sh_dc.detach()))
        ]
        assert torch.equal(*images)
