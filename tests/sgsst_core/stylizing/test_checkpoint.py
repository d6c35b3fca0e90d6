from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save

from sgsst_core.errors import CheckpointError
from sgsst_core.features.partition import Rectangle
from sgsst_core.loss.terms import LossTerms
from sgsst_core.planning.plan import Plan, Work
from sgsst_core.planning.survey import Survey
from sgsst_core.progress import Decision
from sgsst_core.refine import Refinement
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.checkpoint import (
    Checkpoint,
    fingerprint,
    load_checkpoint,
    save_checkpoint,
    versions,
)
from sgsst_core.stylizing.stylizer import StepRecord, StylizerState
from tests.small_scenes import cameras, style, wall


@pytest.fixture
def state() -> StylizerState:
    generator = torch.Generator().manual_seed(7)
    terms = {
        0: LossTerms(gram=1.5, mean=2.5e-30, std=1 / 3),
        1: LossTerms(gram=1e300, mean=0.1, std=0.2, content=0.3),
    }
    return StylizerState(
        sh_dc=torch.randn(5, 3, generator=generator),
        first_moment=torch.randn(5, 3, generator=generator),
        second_moment=torch.rand(5, 3, generator=generator) * 1e-38,
        step=2,
        seconds=0.1 + 0.2,
        generator=generator.get_state(),
        queue=[4, 0, 2],
        history=[
            StepRecord(1, "coarse", 1, 0.1, 3.0, {1: terms[1]}, {"render": 0.1}, 10**10),
            StepRecord(2, "sos", 3, 0.3, 4.0, terms, {"render": 0.2, "loss": 1 / 3}, 10**9),
        ],
        seconds_by_part={"render": 0.1},
        memory=12345,
    )


@pytest.fixture
def full_checkpoint(state: StylizerState) -> Checkpoint:
    seen = torch.tensor([True, True, False, True, True])
    regions = [Rectangle(0, 1, 2, 3), Rectangle(4, 5, 6, 7)]
    survey = Survey(torch.rand(5, dtype=torch.float64), [0, 2], regions, 1 / 3)
    pieces = torch.tensor([[1, 1, 1], [3, 1, 1]], dtype=torch.uint8)
    plan = Plan(
        survey=survey,
        refinement=Refinement(pieces, 1, 4, 1 / 3, 44.4, 41.1, 2, torch.rand(4, 3)),
        optimized=seen,
        seen=seen,
        covered=(0, 2),
        weighted=True,
        steps_coarse=7,
        memory_limit=12345,
        rasterizer="cached",
        cached_weights="half",
        measured=True,
        ranks=2,
        decisions=(Decision("item", "decision", "reason", bytes=3),),
        work=Work(0.1, 0.2, 3.0),
    )
    return Checkpoint(state, plan, 3, "run", versions())


def assert_same(expected: object, actual: object) -> None:
    """Assert that all fields of two objects are equal, and that tensors are bit-identical."""
    assert type(expected) is type(actual)
    for name in type(expected).__dataclass_fields__:  # type: ignore[attr-defined]
        one, other = getattr(expected, name), getattr(actual, name)
        if isinstance(one, torch.Tensor):
            assert one.dtype == other.dtype, name
            assert torch.equal(one, other), name
        elif isinstance(one, StylizerState | Plan | Survey | Refinement):
            assert_same(one, other)
        else:
            assert one == other, name


def test_checkpoint_round_trips_exactly(full_checkpoint: Checkpoint, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c", full_checkpoint, "job")
    loaded = load_checkpoint(tmp_path / "c", "job")
    assert_same(full_checkpoint, loaded)
    torch.Generator().set_state(loaded.state.generator)


def test_checkpoint_of_an_earlier_version_is_refused(full_checkpoint: Checkpoint, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c", full_checkpoint, "job")
    (tmp_path / "c").write_bytes((tmp_path / "c").read_bytes().replace(b'"version":"11"', b'"version":"10"'))
    with pytest.raises(CheckpointError, match="another version of this program"):
        load_checkpoint(tmp_path / "c", "job")


def flipped(data: bytes, at: int) -> bytes:
    """Return the data with one bit flipped."""
    return data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        lambda data: data[:-1],
        lambda data: b"",
        lambda data: b"no checkpoint at all",
        lambda data: save({"a": torch.zeros(1)}),
        lambda data: b"\xff" * 8 + data[8:],
        lambda data: flipped(data, len(data) - 10),
        lambda data: flipped(data, data.index(b"seconds") + 15),
        lambda data: data.replace(rb"\"step\": 2", rb"\"step\": 3"),
    ],
)
def test_damaged_file_is_refused(full_checkpoint: Checkpoint, tmp_path: Path, damage: Any) -> None:
    path = tmp_path / "c"
    save_checkpoint(path, full_checkpoint, "job")
    before = path.read_bytes()
    path.write_bytes(damage(before))
    assert path.read_bytes() != before
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_checkpoint(path, "job")


def test_latest_checkpoint_of_the_job_replaces_earlier_ones(full_checkpoint: Checkpoint, tmp_path: Path) -> None:
    for step in (1, 2, 3):
        save_checkpoint(
            tmp_path / "c", replace(full_checkpoint, state=replace(full_checkpoint.state, step=step)), "job"
        )
    assert [path.name for path in tmp_path.iterdir()] == ["c"]
    assert load_checkpoint(tmp_path / "c", "job").state.step == 3
    with pytest.raises(CheckpointError, match="belongs to another job"):
        load_checkpoint(tmp_path / "c", "another job")


def test_fingerprint_distinguishes_jobs_but_not_their_budgets() -> None:
    scene, views, image, settings = wall(), cameras(), style(), make_settings()
    base, both = fingerprint(scene, views, Style.of(image), settings, "w"), [image, image.flip(0)]
    for same in (make_settings(), make_settings(within=3, memory_limit=10**9, measure=0.0)):
        assert fingerprint(wall(), cameras(), Style.weighted([style()], [3]), same, "w") == base
    mixtures = [Style.weighted(both, [1, 1]), Style.weighted(both, [1, 2]), Style.weighted(both[::-1], [1, 2])]
    moved = scene.means.clone()
    moved[-1, 2] = torch.nextafter(moved[-1, 2], torch.tensor(9.0))
    others = [
        fingerprint(replace(scene, means=moved), views, Style.of(image), settings, "w"),
        fingerprint(scene, views[::-1], Style.of(image), settings, "w"),
        fingerprint(scene, [replace(views[0], fx=65.0), *views[1:]], Style.of(image), settings, "w"),
        fingerprint(scene, views, Style.of(image.transpose(0, 1)), settings, "w"),
        fingerprint(scene, views, Style.of(image.reshape(80, 96, 3)), settings, "w"),
        fingerprint(scene, views, Style.of(image), make_settings(seed=1), "w"),
        fingerprint(scene, views, Style.of(image), make_settings(background=(1, 1, 1)), "w"),
        fingerprint(scene, views, Style.of(image), settings, "v"),
        fingerprint(scene, views, Style.of(image), settings, "w", "photos"),
        *(fingerprint(scene, views, mixture, settings, "w") for mixture in mixtures),
    ]
    assert len({base, *others}) == len(others) + 1
