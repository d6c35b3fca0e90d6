"""Tests of turns of owners on inspections, and of limits that grow with the size of files."""

import asyncio
import hashlib
import json
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import pytest
from PIL import Image

from service import problems
from service.deadlines import FileThreads
from service.files.blobs import BlobFolder
from service.inputs import JobParameters, Staged, WorkRequest
from service.inspection.inspector import MAX_WAITING, InspectionProcess, Inspector, Lanes, Show
from service.inspection.process import WORK, _memory_besides_reading
from service.problems import ServiceError
from service.settings import ServiceSettings
from service.store import open_store
from sgsst_core.errors import CameraError
from sgsst_core.files.scene_file import write_scene
from tests.api.service import PATIENCE
from tests.raised import raises_problem
from tests.small_scenes import input_files, wall
from worker.inputs import check_frames_have_sizes


class Work:
    """Requests that the test ends; `order` lists them in the order in which they started."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        self.order: list[str] = []
        self.at_work: dict[str, asyncio.Event] = {}

    async def ask(self, name: str) -> None:
        """Send a request of the owner whose name is the first letter of `name`."""
        async with self.lanes.turn(name[0]):
            self.order.append(name)
            self.at_work[name] = asyncio.Event()
            await self.at_work[name].wait()
            del self.at_work[name]

    async def end(self, name: str) -> None:
        """End a request, and let waiting ones start."""
        self.at_work[name].set()
        await settle()


async def settle() -> None:
    """Let all tasks run until they wait."""
    for _ in range(10):
        await asyncio.sleep(0)


async def start(work: Work, *names: str) -> list[asyncio.Task[None]]:
    tasks = [asyncio.create_task(work.ask(name)) for name in names]
    await settle()
    return tasks


def test_owners_take_turns_on_one_slot() -> None:
    async def run() -> list[str]:
        work = Work(Lanes(1))
        tasks = await start(work, "a1", "a2", "a3", "b1", "b2", "c1")
        while work.at_work:
            await work.end(next(iter(work.at_work)))
        await asyncio.gather(*tasks)
        return work.order

    assert asyncio.run(run()) == ["a1", "b1", "c1", "a2", "b2", "a3"]


def test_queue_limit_applies_per_owner() -> None:
    async def run() -> None:
        work = Work(Lanes(2))
        tasks = await start(work, *(f"a{number}" for number in range(1 + MAX_WAITING)))
        with raises_problem(problems.BUSY):
            await work.ask("a-more")
        tasks += await start(work, "b0")
        assert sorted(work.at_work) == ["a0", "b0"]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        work.at_work.clear()
        again = await start(work, "a-again")
        assert list(work.at_work) == ["a-again"], "those who gave up wait no more"
        await work.end("a-again")
        await asyncio.gather(*again)

    asyncio.run(run())


def test_every_slot_is_returned_after_cancellations() -> None:
    """For random requests, ends and cancellations: at most one slot per owner; no slot is lost or assigned twice."""

    async def run(seed: int) -> None:
        chance = random.Random(seed)
        lanes, had = Lanes(3), Counter[str]()

        async def ask(owner: str) -> None:
            async with lanes.turn(owner):
                had.update([owner])
                assert had[owner] == 1
                assert had.total() <= 3
                try:
                    for _ in range(chance.randrange(4)):
                        await asyncio.sleep(0)
                finally:
                    had.subtract([owner])

        tasks: list[asyncio.Task[None]] = []
        for _ in range(80):
            tasks.append(asyncio.create_task(ask(chance.choice("abcd"))))
            if not chance.randrange(3):
                chance.choice(tasks).cancel()
            for _ in range(chance.randrange(3)):
                await asyncio.sleep(0)
        ended = await asyncio.gather(*tasks, return_exceptions=True)
        assert not [each for each in ended if each and not isinstance(each, asyncio.CancelledError)]
        async with asyncio.timeout(PATIENCE), lanes.turn("x"), lanes.turn("y"), lanes.turn("z"):
            pass

    for seed in range(50):
        asyncio.run(run(seed))


class Inspect(Protocol):
    """Function that inspects files and returns the findings; `show` receives progress."""

    def __call__(self, files: dict[str, Path], show: Show = ..., owner: str = ...) -> dict[str, Any]: ...


@contextmanager
def inspecting(folder: Path, **limits: Any) -> Iterator[Inspect]:
    """Yield a function that inspects files with these limits in the settings, in one process for all calls."""
    settings = ServiceSettings(data=folder / "data", **limits)
    (folder / "data").mkdir(exist_ok=True)
    store = open_store(settings)
    blobs = BlobFolder(settings.folder, store.inputs, 0)
    inspector = Inspector(settings, store, blobs, FileThreads(PATIENCE))

    def inspect(files: dict[str, Path], show: Show = lambda now: None, owner: str = "local") -> dict[str, Any]:
        digests = {role: hashlib.sha256(path.read_bytes()).hexdigest() for role, path in files.items()}
        inputs = [
            {"role": role, "name": path.name, "sha256": digests[role], "size": path.stat().st_size}
            for role, path in files.items()
        ]
        for path in files.values():
            blobs.add(path, link=True)
        rows = store.inputs.blobs(sorted(digests.values()))
        parameters = JobParameters(backbone="auto")
        return runner.run(inspector.inspect("validate", owner, inputs, rows, parameters, show))

    with asyncio.Runner() as runner:
        try:
            yield inspect
        finally:
            runner.run(inspector.processes.close())
            store.close()


def inspect(folder: Path, files: dict[str, Path], **limits: Any) -> dict[str, Any]:
    """Inspect files with these limits in the settings, and return the findings."""
    with inspecting(folder, **limits) as ask:
        return ask(files)


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    return input_files(tmp_path)


def large(path: Path, side: int) -> Path:
    """Write a scene of side * side Gaussians with SH of degree 3."""
    write_scene(path, wall(side, side, sh_degree=3))
    return path


def test_small_file_that_expands_exceeds_the_memory_limit(files: dict[str, Path], tmp_path: Path) -> None:
    Image.new("RGB", (9_900, 9_900)).save(files["style"])  # 294 MB as pixels, 300 kB as a file
    assert files["style"].stat().st_size < 1_000_000
    with pytest.raises(ServiceError, match="memory") as caught:
        inspect(tmp_path, files, inspection_bytes=64_000_000)
    assert caught.value.code == "inspection-limit"


@pytest.mark.slow
def test_large_scene_is_read_within_its_memory_limit(files: dict[str, Path], tmp_path: Path) -> None:
    files["scene"] = large(tmp_path / "large.ply", 1010)
    assert files["scene"].stat().st_size > 250_000_000
    findings = inspect(tmp_path, files, inspection_bytes=16_000_000, inspection_seconds=0.5)
    assert findings["gaussians"] == 1010**2


def test_work_beyond_its_time_limit_is_refused(tmp_path: Path) -> None:
    async def ask_all() -> dict[str, Any]:
        process = InspectionProcess()
        try:
            return {work: await process.ask(request.model_copy(update={"work": work})) for work in WORK}
        finally:
            await process.close()

    staged = Staged(scene=Path("scene.ply"), styles=(), cameras=None, photos=None)
    request = WorkRequest(
        work="", folder=tmp_path, staged=staged, parameters=JobParameters(), seconds=0, memory=0, output=("out.ply", 0)
    )
    for work, answer in asyncio.run(ask_all()).items():
        assert answer["error"]["code"] == "inspection-limit", work


def test_findings_are_reused_for_the_same_owner_only(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    async def ask(*arguments: Any) -> dict[str, Any]:
        asked.append(arguments)
        return {"findings": {}}

    monkeypatch.setattr(InspectionProcess, "ask", ask)
    with inspecting(tmp_path) as inspect:
        for owner, count in (("one", 1), ("one", 1), ("other", 2)):
            inspect(files, owner=owner)
            assert len(asked) == count


@pytest.mark.parametrize(("requested", "limit"), [(None, 1000), (10, 10), (1 << 50, 1000)])
def test_requested_memory_is_at_most_the_default(
    requested: int | None, limit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.inspection.process.default_memory_limit", lambda: 1000)
    request = WorkRequest(
        work="plan",
        folder=Path(),
        staged=Staged(scene=Path("scene.ply"), styles=(), cameras=None, photos=None),
        parameters=JobParameters.model_validate({"memory_limit": requested}),
        seconds=0,
        memory=0,
        threads=0,
    )
    assert _memory_besides_reading(request) == limit


def test_sizes_of_many_frames_are_checked_in_a_file_of_many_values(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    content = {"h": 1, **{str(number): 0 for number in range(100_000)}, "frames": [{"w": 1}] * 100_000}
    path.write_text(json.dumps(content))
    check_frames_have_sizes(path)  # many minutes if each frame copied the values
    for frame in ({"w": 1}, {"w": 1, "h": None}):
        path.write_text(json.dumps({"frames": [frame]}))
        with pytest.raises(CameraError, match="gives no size"):
            check_frames_have_sizes(path)
