"""Tests of files derived from results: turns of owners, and the number of blends, while many are requested at once."""

import asyncio
import hashlib
import json
import re
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import av
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from api.static_files import exported_viewer
from service import problems
from service.deadlines import FileThreads
from service.files.blobs import BlobFolder
from service.files.objects import Artifacts
from service.inputs import RESULT, JobParameters, Staged, WorkRequest, job_spec
from service.inspection.derived import MOST_BLENDS, Blend, DerivedFiles
from service.inspection.inspector import Processes
from service.inspection.process import WORK
from service.settings import ServiceSettings
from service.states import Published
from service.store import Store, open_store
from service.store.jobs import NewJob
from service.store.keys import NO_QUOTAS, Quotas
from service.store.tables import JobRow
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import by_name
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import resized
from sgsst_core.scene.spherical_harmonics import scene_colors
from tests.api.service import PATIENCE
from tests.raised import raises_problem
from tests.service.store import helpers
from tests.service.store.helpers import usage_of
from tests.sgsst_core.objects import figure, joined, moved
from tests.small_scenes import cameras, input_files, wall, write_files
from worker.derived import video_cameras, viewpoint_of
from worker.inputs import read_job_capture
from worker.options import JobVideo


@dataclass
class Stored:
    """Store with the files of finished jobs."""

    settings: ServiceSettings
    store: Store
    blobs: BlobFolder
    artifacts: Artifacts

    def finished(self, owner: str, folder: Path) -> JobRow:
        """Return a finished job, whose scene is also its result."""
        (folder / owner).mkdir()
        files = input_files(folder / owner)
        inputs = []
        for role, path in files.items():
            size, sha256 = path.stat().st_size, hashlib.sha256(path.read_bytes()).hexdigest()
            self.blobs.add(path, link=True)
            inputs.append({"role": role, "name": path.name, "sha256": sha256, "size": size})
        job, _ = self.store.jobs.create(NewJob(owner, "job", 0, {}, inputs), limit=1)
        lease = helpers.lease(self.store, "test")
        result = self.artifacts.put(job.id, lease.epoch, RESULT, files["scene"])
        self.store.leases.succeed(lease, [result], {})
        return self.store.jobs.get(job.id, owner)

    @asynccontextmanager
    async def derived(self) -> AsyncIterator[DerivedFiles]:
        processes, threads = Processes(self.settings), FileThreads(PATIENCE)
        try:
            yield DerivedFiles(self.settings, self.store, self.blobs, self.artifacts, threads, processes)
        finally:
            await processes.close()


@pytest.fixture
def stored(tmp_path: Path) -> Iterator[Stored]:
    settings = ServiceSettings(data=tmp_path / "data")
    store = open_store(settings)
    yield Stored(settings, store, BlobFolder(settings.folder, store.inputs, 0), Artifacts(settings.artifacts_url))
    store.close()


@pytest.mark.slow
def test_blends_of_one_key_do_not_delay_another_key(stored: Stored, tmp_path: Path) -> None:
    one, other = (stored.finished(owner, tmp_path) for owner in ("one", "other"))
    order: list[str] = []

    async def blend(derived: DerivedFiles, job: JobRow, weight: float) -> None:
        await derived.blended(job, Blend(weight, {}, PLY), NO_QUOTAS)
        order.append(job.owner)

    async def blend_all() -> None:
        async with stored.derived() as derived:
            waiting = [asyncio.create_task(blend(derived, one, weight / 10)) for weight in range(1, 9)]
            await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            await asyncio.gather(*waiting, blend(derived, other, 0.5))

    asyncio.run(blend_all())
    assert order[-1] == "one"


@pytest.mark.slow
def test_parallel_blends_cannot_pass_their_limit(stored: Stored, tmp_path: Path) -> None:
    job = stored.finished("one", tmp_path)
    source = stored.store.jobs.artifact(job.id, RESULT)
    assert source is not None
    existing = [Published(f"blends/{index}.ply", f"nowhere/{index}", 0, "0" * 64) for index in range(MOST_BLENDS - 1)]
    stored.store.jobs.add_derived(source, existing, "one")

    async def blend_all() -> list[object]:
        async with stored.derived() as derived:
            blends = [derived.blended(job, Blend(weight / 10, {}, PLY), NO_QUOTAS) for weight in range(1, 5)]
            return await asyncio.gather(*blends, return_exceptions=True)

    outcomes = asyncio.run(blend_all())
    assert sum(getattr(outcome, "problem", None) is problems.TOO_MANY_BLENDS for outcome in outcomes) == 3
    assert sum(row.name.startswith("blends/") for row in stored.store.jobs.artifacts(job.id)) == MOST_BLENDS


@pytest.mark.slow
def test_compressed_results_count_toward_the_quota(stored: Stored, tmp_path: Path) -> None:
    job = stored.finished("one", tmp_path)
    before = {row.name for row in stored.store.jobs.artifacts(job.id)}
    objects, used = set(stored.artifacts.objects.below("")), usage_of(stored.store, "one").stored_bytes

    async def compress(quotas: Quotas) -> None:
        async with stored.derived() as derived:
            await derived.compressed(job, by_name("spz"), quotas)

    with raises_problem(problems.QUOTA_EXCEEDED):
        asyncio.run(compress(Quotas(stored_bytes=used)))
    assert set(stored.artifacts.objects.below("")) == objects
    assert usage_of(stored.store, "one").stored_bytes == used
    assert {row.name for row in stored.store.jobs.artifacts(job.id)} == before
    asyncio.run(compress(NO_QUOTAS))
    assert {row.name for row in stored.store.jobs.artifacts(job.id)} == before | {"stylized.spz", "stylized.spz.json"}
    derived = sum(row.size for row in stored.store.jobs.artifacts(job.id) if row.name not in before)
    assert usage_of(stored.store, "one").stored_bytes == used + derived


@pytest.mark.parametrize(("columns", "holds_both"), [(28, True), (20, False)])
def test_page_shows_the_result_alone_if_the_scene_has_other_gaussians(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, columns: int, holds_both: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    write_scene(Path("scene.ply"), wall())
    write_scene(Path(RESULT), wall(columns))
    request = WorkRequest(
        work="page",
        folder=tmp_path,
        staged=Staged(scene=Path("scene.ply"), styles=(), cameras=None, photos=None),
        parameters=JobParameters.model_validate({"background": [1.0, 1.0, 1.0], "orbit": 3, "up": "x"}),
        seconds=0,
        memory=0,
        options={"viewer": exported_viewer(), "title": "wall"},
        output=("page.html", 0),
    )
    WORK["page"][0](request, lambda response: None)
    text = Path("page.html").read_text(encoding="utf-8")
    assert ('id="colors"></script>' not in text) == holds_both
    assert '"up": [1.0, 0.0, 0.0]' in text
    assert '"sog": false' in text
    assert '"background": [1.0, 1.0, 1.0]' in text


def test_poster_shows_a_viewpoint_before_and_after(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _, file, _ = write_files(tmp_path, wall(), cameras(3, 96, 72))
    result = replace(wall(), sh_dc=-wall().sh_dc)
    write_scene(Path(RESULT), result)
    camera = read_cameras(file)[2]
    options = {"viewpoint": viewpoint_of(camera).model_dump()}
    request = WorkRequest(
        work="poster",
        folder=tmp_path,
        staged=Staged(scene=Path("scene.ply"), styles=(), cameras=Path("cameras.json"), photos=None),
        parameters=JobParameters.model_validate({"background": [1.0, 1.0, 1.0]}),
        seconds=0,
        memory=0,
        options=options,
        output=("poster.jpg", 0),
    )
    WORK["poster"][0](request, lambda response: None)
    with Image.open("poster.jpg") as image:
        shown = np.asarray(image.convert("RGB"), dtype=np.float64)
    assert shown.shape == (720, 960, 3)
    larger = resized(camera, 960)
    for scene, part in ((wall(), np.s_[:, :480]), (result, np.s_[:, 480:])):
        rendered = make_rasterizer("cpu", scene, background=(1.0, 1.0, 1.0)).render(scene_colors(scene, larger), larger)
        wanted = 255 * rendered.double().clamp(0, 1).numpy()
        assert np.abs(shown[part] - wanted[part]).mean() < 5  # JPEG


@pytest.mark.parametrize("chosen", [True, False])
def test_page_opens_at_its_start_or_at_the_first_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chosen: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    _, file, _ = write_files(tmp_path, wall(), cameras(3, 96, 72))
    Path(RESULT).write_bytes(Path("scene.ply").read_bytes())
    first, second, _ = (viewpoint_of(camera).model_dump() for camera in read_cameras(file))
    viewpoints = {"start": second if chosen else None, "named": [first]}
    request = WorkRequest(
        work="page",
        folder=tmp_path,
        staged=Staged(scene=Path("scene.ply"), styles=(), cameras=Path("cameras.json"), photos=None),
        parameters=JobParameters(),
        seconds=0,
        memory=0,
        options={"viewer": exported_viewer(), "title": "wall", "viewpoints": viewpoints},
        output=("page.html", 0),
    )
    WORK["page"][0](request, lambda response: None)
    match = re.search(r'id="about">(.*)</script>', Path("page.html").read_text(encoding="utf-8"))
    assert match
    about = json.loads(match[1])
    assert about["viewpoints"] == {"start": second if chosen else first, "named": [first]}
    assert about["up"] == pytest.approx([0, -1, 0], abs=1e-6), "that of the cameras"


def test_page_shows_what_a_crop_leaves_upright(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lying = moved(figure(), Rotation.from_euler("z", 90, degrees=True), 0.2, (5, 0, 0))
    write_scene(Path("scene.ply"), joined(figure(), lying))
    Path(RESULT).write_bytes(Path("scene.ply").read_bytes())
    crop = [{"name": "inside", "select": "box=4,-1,-1,6,1,1"}, {"name": "rest", "freeze": True}]

    def up(**parameters: object) -> list[float]:
        request = WorkRequest(
            work="page",
            folder=tmp_path,
            staged=Staged(scene=Path("scene.ply"), styles=(), cameras=None, photos=None),
            parameters=JobParameters.model_validate({"orbit": 3, **parameters}),
            seconds=0,
            memory=0,
            options={"viewer": exported_viewer(), "title": "figures"},
            output=("page.html", 0),
        )
        WORK["page"][0](request, lambda response: None)
        match = re.search(r'"up": (\[[^]]*\])', Path("page.html").read_text(encoding="utf-8"))
        assert match
        direction: list[float] = json.loads(match[1])
        return direction

    assert up() == [0.0, -1.0, 0.0]
    assert up(regions=crop) == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("path", [pytest.param("cameras", marks=pytest.mark.slow), "orbit"])
def test_video_shows_what_the_crop_of_a_job_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: Literal["cameras", "orbit"]
) -> None:
    """A mask selects rows of the job's scene; the result has others, as after Gaussians were split."""
    monkeypatch.chdir(tmp_path)
    write_scene(Path("scene.ply"), wall())
    write_scene(Path(RESULT), wall(30))
    Path("mask").mkdir()
    left = (wall().means[:, :2] < -0.5).all(dim=1)
    np.save("mask/left.npy", left.numpy())
    crop = [{"name": "left", "select": "mask=left.npy"}, {"name": "rest", "freeze": True}]
    parameters = JobParameters.model_validate({"orbit": 3, "up": "-y", "elevation": 0, "regions": crop})
    staged = Staged(scene=Path("scene.ply"), styles=(), cameras=None, photos=None)
    video = JobVideo(path=path, fps=1, seconds=1, resolution=64)
    request = WorkRequest(
        work="video",
        folder=tmp_path,
        staged=staged,
        parameters=parameters,
        seconds=0,
        memory=0,
        options={"video": video.model_dump()},
        output=("video.mp4", 0),
    )
    assert WORK["video"][0](request, lambda response: None)["frames"] == 1
    with av.open("video.mp4") as container:
        frame = next(container.decode(video=0)).to_ndarray(format="rgb24").astype(float)
    file, result = read_scene(Path("scene.ply")), read_scene(Path(RESULT)).scene

    def error(parameters: JobParameters) -> float:
        job = job_spec(staged, parameters)
        views = read_job_capture(job, file).cameras if path == "cameras" else None
        surrounded = file.scene.subset(left) if parameters.regions else result
        (camera,) = video_cameras(surrounded, job.source, views, video, 64, even=True)
        image = make_rasterizer("cpu", result).render(scene_colors(result, camera), camera)
        return float(np.abs(frame - 255 * image.clamp(0, 1).double().numpy()).mean())

    assert error(parameters) < 15 < error(parameters.model_copy(update={"regions": None})) / 2
