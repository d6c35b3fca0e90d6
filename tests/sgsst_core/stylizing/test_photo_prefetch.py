"""Tests of reading photos in advance, on a simulated GPU that must not wait for them."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

if torch.cuda.is_available():
    pytest.skip("there is a GPU: the pretend one would stand in its way", allow_module_level=True)

from sgsst_core.budget import Cache
from sgsst_core.errors import ImageError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.images import save_png
from sgsst_core.files.photos import Photo, load_photo
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import prepare_job
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.planner import plan_job
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.stylizing.views import PhotosAhead
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.device import DEVICE, PretendTensor
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.small_scenes import cameras, style, wall

pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread")

VIEWS, STEPS, SIDE, SEED = 3, 6, 32, 4
PHOTO_BYTES = SIDE * SIDE * 3 * 4
#: Bytes of a handful of numbers.
SCALARS = 256
#: Seconds after which a thread counts as stuck.
STUCK = 60.0


class Photos:
    """Photo files, with a record of which photo was read in which thread.

    Args:
        folder: Folder that the photos are written to.
        broken: Index of a photo whose file is truncated.
        side: Side of the photos when read.

    Attributes:
        asked: Indices of the read photos, in order.
        here: Indices of photos that were read in the thread that constructed this object.
    """

    def __init__(self, folder: Path, broken: int | None = None, side: int = SIDE) -> None:
        self.asked: list[int] = []
        self.here: list[int] = []
        self._thread = threading.current_thread()
        self._changed = threading.Condition()
        self._cameras = cameras(VIEWS, side, side)
        self._paths = [folder / f"{index}.png" for index in range(VIEWS)]
        for index, path in enumerate(self._paths):
            save_png(path, synthetic_image(2 * side, 2 * side, seed=index, dtype=torch.float32))
            if index == broken:
                path.write_bytes(path.read_bytes()[:-100])

    def __call__(self, index: int) -> Tensor:
        with self._changed:
            self.asked.append(index)
            if threading.current_thread() is self._thread:
                self.here.append(index)
            self._changed.notify_all()
        return self.read(index)

    def read(self, index: int) -> Tensor:
        """Read a photo without recording it."""
        return load_photo(Photo(self._paths[index], (0, 0)), self._cameras[index])

    def wait_for(self, count: int) -> None:
        """Wait until `count` photos have been read in total."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.asked) >= count, STUCK), f"{self.asked} were read"


def make(weights: BackboneWeights, photos: Photos, *, cached: bool = False, **values: Any) -> Stylizer:
    """Make a job with two scales per step. Content features are cached only if requested."""
    options = {"steps_coarse": 0, "steps_sos": STEPS, "coarsest_side": 16, "position_weights": "off", "seed": SEED}
    settings = make_settings("paper", **{**options, **values})
    views = cameras(VIEWS, SIDE, SIDE)
    inputs = wall(6, 5), views, Style.of(style()), settings
    plan = plan_job(*inputs, weights=weights).plan  # without photos, so that the trial reads none
    job = prepare_job(plan, *inputs, weights=weights, photos=photos)
    if not cached:
        job.view_targets._content = Cache(0)
    return Stylizer(job)


def drawn() -> list[int]:
    """Return the indices of views in the order of the first two rounds."""
    generator = torch.Generator().manual_seed(SEED)
    return [int(i) for _ in range(2) for i in torch.randperm(VIEWS, generator=generator).flip(0)]


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("photo")]


def on_host(tensor: Tensor) -> Tensor:
    assert isinstance(tensor, PretendTensor)
    return tensor.host


@pytest.mark.slow
def test_step_prefetches_the_next_photo_and_synchronizes_once(
    tiny_weights: BackboneWeights, counts: Counts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the first of two rounds, cached data of each view are computed."""
    photos = Photos(tmp_path)
    stylizer = make(tiny_weights, photos)
    gradient = stylizer.job.views.gradient

    def end_of_step(*arguments: Any) -> Tensor:
        photos.wait_for(stylizer.step + (1 if (stylizer.step + 1) % VIEWS == 0 else 2))
        return gradient(*arguments)

    monkeypatch.setattr(stylizer.job.views, "gradient", end_of_step)
    for step in range(STEPS):
        counts.clear()
        stylizer.run_step()
        if step >= VIEWS:
            assert sum(counts.waits.values()) == 1, counts.waits
            large = {line: size for line, size in counts.copies.items() if size > SCALARS}
            assert list(large.values()) == [PHOTO_BYTES], large  # the photo, and nothing else
        assert len(stylizer.state().queue) == -(step + 1) % VIEWS  # the queue was read, not refilled
    stylizer.job.view_targets.end_prefetch()
    assert photos.asked == drawn() == [record.view for record in stylizer.history]
    assert photos.here == drawn()[::VIEWS]  # only the first of a round is unknown in advance; the thread reads the rest
    assert not threads()


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "views_per_step"), [(3, 1), (2, 2)])
def test_losses_are_identical_without_prefetching(
    tiny_weights: BackboneWeights,
    counts: Counts,
    tmp_path: Path,
    steps: int,
    views_per_step: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options: dict[str, Any] = {"steps_sos": steps, "views_per_step": views_per_step}
    photos, plain = Photos(tmp_path), Photos(tmp_path)
    stylizer, expected = make(tiny_weights, photos, **options), make(tiny_weights, plain, **options)
    monkeypatch.setattr(expected.job.view_targets, "prefetch", lambda *_: None)
    assert run(stylizer) == run(expected) == "finished"
    assert [record.loss for record in stylizer.history] == [record.loss for record in expected.history]
    assert torch.equal(stylizer.stylized(), expected.stylized())
    assert plain.here == plain.asked == photos.asked
    assert photos.here == photos.asked[:1]  # the queue or the step announced all others
    assert not threads()


@pytest.mark.slow
def test_photos_with_cached_features_are_read_once(
    tiny_weights: BackboneWeights, counts: Counts, tmp_path: Path
) -> None:
    photos = Photos(tmp_path)
    run(make(tiny_weights, photos, cached=True))
    assert sorted(photos.asked) == list(range(VIEWS))


@pytest.mark.slow
def test_unreadable_photo_fails_the_step_that_needs_it(
    tiny_weights: BackboneWeights, counts: Counts, tmp_path: Path
) -> None:
    stylizer = make(tiny_weights, Photos(tmp_path, broken=drawn()[1]))
    with pytest.raises(ImageError, match=rf"{drawn()[1]}\.png: is truncated"):
        run(stylizer)
    assert stylizer.step == 1
    assert not threads()


def test_no_thread_is_started_on_a_cpu(tiny_weights: BackboneWeights, tmp_path: Path) -> None:
    photos = Photos(tmp_path)
    run(make(tiny_weights, photos))
    assert photos.here == photos.asked == drawn()


def test_prefetched_photos_are_unchanged(counts: Counts, tmp_path: Path) -> None:
    photos = Photos(tmp_path, side=160)  # CUDA transfers up to 64 KB without waiting, pinned or not
    ahead = PhotosAhead(photos, DEVICE)
    ahead.start(1)
    ahead.start(1)  # already under way
    assert torch.equal(on_host(ahead(2)), photos.read(2))  # out of order
    assert torch.equal(on_host(ahead(1)), photos.read(1))
    assert sorted(photos.asked) == [1, 2]
    assert photos.here == [2]
    assert not counts.waits
    assert counts.copies.total() == 2 * 160 * 160 * 3 * 4
    ahead.stop()
    assert not threads()


def test_error_of_a_photo_is_raised_only_on_request(counts: Counts, tmp_path: Path) -> None:
    photos = Photos(tmp_path, broken=0)
    ahead = PhotosAhead(photos, DEVICE)
    ahead.start(0)
    photos.wait_for(1)
    ahead.start(1)
    assert on_host(ahead(1)).shape == (SIDE, SIDE, 3)
    with pytest.raises(ImageError):
        ahead(0)
    ahead.start(0)
    with pytest.raises(ImageError):
        ahead(0)
    assert photos.asked == [0, 1, 0, 0]
    ahead.start(2)
    ahead.stop()
    assert not threads()
    ahead.start(2)  # another thread
    assert on_host(ahead(2)).shape == (SIDE, SIDE, 3)
    ahead.stop()
