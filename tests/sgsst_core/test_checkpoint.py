from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from sgsst_core.checkpoint import fingerprint, load_checkpoint, save_checkpoint
from sgsst_core.errors import CheckpointError, OutputError
from sgsst_core.loss import LossTerms
from sgsst_core.settings import make_settings
from sgsst_core.stylizer import StepRecord, StylizerState
from tests.small_scenes import cameras, style, wall


@pytest.fixture
def state() -> StylizerState:
    generator = torch.Generator().manual_seed(7)
    terms = {0: LossTerms(1.5, 2.5e-30, 1 / 3, 0.0), 1: LossTerms(1e300, 0.1, 0.2, 0.3)}
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
        measured=[{"step": 0, "held_out": None, "approximation": {"cosine": 1 / 3}}],
    )


def test_everything_comes_back_exactly(state: StylizerState, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c", state, "job")
    loaded = load_checkpoint(tmp_path / "c", "job")
    for name in StylizerState.__dataclass_fields__:
        expected, found = getattr(state, name), getattr(loaded, name)
        assert torch.equal(expected, found) if isinstance(expected, torch.Tensor) else expected == found, name
    torch.Generator().set_state(loaded.generator)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        lambda data: b"",
        lambda data: b"no checkpoint at all",
        lambda data: b"\xff" * 8 + data[8:],
    ],
)
def test_a_damaged_file_is_refused(state: StylizerState, tmp_path: Path, damage: Any) -> None:
    path = tmp_path / "c"
    save_checkpoint(path, state, "job")
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_checkpoint(path, "job")


def test_another_safetensors_file_is_refused(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "c")
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_checkpoint(tmp_path / "c", "job")


def test_another_job_and_a_missing_file_are_refused(state: StylizerState, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c", state, "job")
    with pytest.raises(CheckpointError, match="another job"):
        load_checkpoint(tmp_path / "c", "other")
    with pytest.raises(CheckpointError, match="no checkpoint"):
        load_checkpoint(tmp_path / "missing", "job")


def test_a_folder_that_is_not_there_is_an_output_error(state: StylizerState, tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        save_checkpoint(tmp_path / "missing" / "c", state, "job")


def test_fingerprint_tells_jobs_apart() -> None:
    scene, views, image, settings = wall(), cameras(), style(), make_settings()
    base = fingerprint(scene, views, image, settings, "w")
    assert base == fingerprint(wall(), cameras(), style(), make_settings(), "w")
    moved = scene.means.clone()
    moved[-1, 2] = torch.nextafter(moved[-1, 2], torch.tensor(9.0))
    others = [
        fingerprint(replace(scene, means=moved), views, image, settings, "w"),
        fingerprint(scene, views[::-1], image, settings, "w"),
        fingerprint(scene, [replace(views[0], fx=65.0), *views[1:]], image, settings, "w"),
        fingerprint(scene, views, image.transpose(0, 1), settings, "w"),
        fingerprint(scene, views, image.reshape(80, 96, 3), settings, "w"),
        fingerprint(scene, views, image, make_settings(seed=1), "w"),
        fingerprint(scene, views, image, make_settings(background=(1, 1, 1)), "w"),
        fingerprint(scene, views, image, settings, "v"),
        fingerprint(scene, views, image, settings, "w", "photos"),
    ]
    assert len({base, *others}) == len(others) + 1


def test_fingerprint_leaves_budgets_free() -> None:
    scene, views, image = wall(), cameras(), style()
    free = make_settings(max_seconds=3, memory_limit=10**9)
    assert fingerprint(scene, views, image, free, "w") == fingerprint(scene, views, image, make_settings(), "w")
