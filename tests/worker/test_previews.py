from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.images import save_jpg
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.color_transfer import warm_start
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.stylizer import Stylizer
from tests.small_scenes import cameras, wall
from worker import prepare as previews_module
from worker.prepare import LiveColors, Previews


def test_first_preview_shows_warm_start_colors(
    tiny_weights: BackboneWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(previews_module, "_FIRST_SECONDS", 3600)
    settings = make_settings("standard", steps_coarse=0, steps_sos=2, coarsest_side=24)
    style = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 0.5, 0.1])
    scene = wall()
    stylizer = Stylizer.planned(scene, cameras(), style, settings, weights=tiny_weights)
    missing: list[str] = []
    previews = Previews(tmp_path / "previews", 3600, missing.append)
    run(stylizer, Callbacks(preview=previews, preview_seconds=0))
    assert stylizer.step == 2
    (written,) = (tmp_path / "previews").iterdir()
    assert written.name == "step_0000000.jpg", "and none before the hour is over"
    assert not missing

    index = stylizer.job.evaluation_views[0]
    wanted = warm_start(scene.sh_dc, stylizer.job.plan.survey.total_blend_weights, stylizer.job.style)[
        stylizer.job.plan.seen
    ]
    views = stylizer.job.views
    save_jpg(tmp_path / "wanted.jpg", views.rasterizer.render(views.colors(index, wanted), views.cameras[index]))
    actual, expected = (np.asarray(Image.open(path)) for path in (written, tmp_path / "wanted.jpg"))
    np.testing.assert_array_equal(actual, expected)
    assert actual.std() > 1


def test_first_previews_follow_each_other_sooner(
    tiny_weights: BackboneWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps take one second each, so that the number of a step is the time of its preview."""
    settings = make_settings("standard", steps_coarse=0, steps_sos=72, coarsest_side=24)
    style = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    stylizer = Stylizer.planned(wall(), cameras(), style, settings, weights=tiny_weights)
    previews = Previews(tmp_path / "previews", 10, pytest.fail)
    previews._started = 0.0
    for second in range(73):
        stylizer.step = second
        monkeypatch.setattr("time.monotonic", lambda now=second: float(now))
        previews(stylizer)
    shown = [int(path.stem.removeprefix("step_")) for path in sorted((tmp_path / "previews").iterdir())]
    assert shown == [*range(0, 21, 2), 23, 26, 29, 33, 37, 42, 47, 53, 59, 66]


def test_thumbnail_shows_the_scene_on_the_left_and_the_result_on_the_right(
    tiny_weights: BackboneWeights, tmp_path: Path
) -> None:
    settings = make_settings("standard", steps_coarse=0, steps_sos=2, coarsest_side=24)
    style = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    stylizer = Stylizer.planned(wall(), cameras(), style, settings, weights=tiny_weights)
    run(stylizer)
    missing: list[str] = []
    Previews(tmp_path, 3600, missing.append).finish(stylizer)
    assert not missing
    (written,) = tmp_path.iterdir()
    assert written.name == "thumbnail.jpg"
    assert written.name > "step_9999999.jpg", "clients show the last preview by name"

    views, index = stylizer.job.views, stylizer.job.evaluation_views[0]
    thumbnail = np.asarray(Image.open(written), dtype=np.float64)
    middle = thumbnail.shape[1] // 2
    for part, colors in ((np.s_[:, :middle], views.scene.sh_dc), (np.s_[:, middle:], stylizer.shown())):
        with torch.no_grad():
            image = views.rasterizer.render(views.colors(index, colors), views.cameras[index])
        wanted = (image.clamp(0, 1) * 255).numpy()[part]
        assert np.abs(thumbnail[part] - wanted).mean() < 5  # JPEG


def test_live_colors_are_those_of_the_step(
    tiny_weights: BackboneWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_COLOR_SECONDS", "_COLOR_SHARE"):
        monkeypatch.setattr(previews_module, name, 0)
    monkeypatch.setattr(previews_module, "_COST_SHARE", 1e9)
    settings = make_settings("standard", steps_coarse=0, steps_sos=3, coarsest_side=24)
    style = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    scene = wall()
    scene.means[:5] += 1000  # no view shows them
    stylizer = Stylizer.planned(scene, cameras(), style, settings, weights=tiny_weights)
    missing: list[str] = []
    colors, by_step = LiveColors(tmp_path / "live", missing.append), {}

    def preview(stylizer: Stylizer) -> None:
        colors(stylizer)
        if not stylizer.step:
            return
        seen = stylizer.job.plan.seen
        wanted = stylizer.job.scene.sh_dc.clone()
        wanted[seen] = stylizer.shown().cpu()
        assert not seen[:5].any()
        by_step[stylizer.step] = np.fromfile(tmp_path / "live" / "colors.f16", "<f2").reshape(-1, 3)
        np.testing.assert_array_equal(by_step[stylizer.step], wanted.numpy().astype("<f2"))

    run(stylizer, Callbacks(preview=preview, preview_seconds=0))
    assert by_step.keys() == {1, 2, 3}
    assert not np.array_equal(by_step[1], by_step[2])
    assert not missing
    assert [path.name for path in (tmp_path / "live").iterdir()] == ["colors.f16"]


def test_live_colors_are_written_seldom_enough(tiny_weights: BackboneWeights, tmp_path: Path) -> None:
    settings = make_settings("standard", steps_coarse=0, steps_sos=2, coarsest_side=24)
    style = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    stylizer = Stylizer.planned(wall(), cameras(), style, settings, weights=tiny_weights)
    missing: list[str] = []
    colors = LiveColors(tmp_path, missing.append)
    run(stylizer, Callbacks(preview=colors, preview_seconds=0))
    first = (tmp_path / "colors.f16").stat().st_mtime_ns
    colors._due = 2.0**60
    colors(stylizer)
    assert (tmp_path / "colors.f16").stat().st_mtime_ns == first
    colors._due = 0.0
    colors(stylizer)
    assert (tmp_path / "colors.f16").stat().st_mtime_ns > first
    (tmp_path / "colors.f16").unlink()
    (tmp_path / "colors.f16").mkdir()
    colors._due = 0.0
    colors(stylizer)
    assert len(missing) == 1, "a missing file does not fail the job"
