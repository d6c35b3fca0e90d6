"""Tests of style options."""

from pathlib import Path

import pytest
import torch
from PIL import Image

from sgsst_core.errors import SettingsError
from worker.inputs import load_styles
from worker.options import MOST_STYLE_IMAGES, StyleFile, parse_style, parse_styles, split_weight


@pytest.mark.parametrize(
    ("text", "path", "weight"),
    [
        ("a.jpg", "a.jpg", 1.0),
        ("a.jpg:0.7", "a.jpg", 0.7),
        ("a.jpg:2e-3", "a.jpg", 0.002),
        ("a:b.jpg", "a:b.jpg", 1.0),
        ("a:1:b.jpg:.5", "a:1:b.jpg", 0.5),
        ("a.jpg:", "a.jpg:", 1.0),
        ("a.jpg:x", "a.jpg:x", 1.0),
        (":3", ":3", 1.0),
    ],
)
def test_only_a_trailing_number_is_a_weight(text: str, path: str, weight: float) -> None:
    assert parse_style(text) == StyleFile(Path(path), weight)


def test_long_names_are_read_in_linear_time() -> None:
    name = "a.jpg:" + "3" * 1_000_000 + "x"  # hours in quadratic time
    assert split_weight(name, lambda path: False) == (name, 1.0)


def test_existing_file_with_colon_takes_precedence(tmp_path: Path) -> None:
    odd = tmp_path / "poster:2"
    odd.touch()
    assert parse_style(str(odd)) == StyleFile(odd)
    assert parse_style(f"{odd}:3") == StyleFile(odd, 3.0)


@pytest.mark.parametrize("weight", ["0", "-1", "1e999"])
def test_invalid_weights_are_refused(weight: str) -> None:
    with pytest.raises(SettingsError, match=f"the weight must be a finite number above 0, not {weight}"):
        parse_style(f"a.jpg:{weight}")


def test_number_of_styles_is_limited() -> None:
    assert len(parse_styles(["a.jpg"] * MOST_STYLE_IMAGES)) == MOST_STYLE_IMAGES
    for count in (0, MOST_STYLE_IMAGES + 1):
        with pytest.raises(SettingsError, match=f"There are {count} style images"):
            parse_styles(["a.jpg"] * count)


def test_only_styles_of_many_pixels_are_reduced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size in (("large", (80, 60)), ("small", (20, 20))):
        Image.linear_gradient("L").resize(size).save(tmp_path / f"{name}.png")
    files = [StyleFile(tmp_path / "large.png"), StyleFile(tmp_path / "small.png")]
    whole = load_styles(files)
    assert [image.shape[:2] for image in whole.images] == [(60, 80), (20, 20)]
    assert not whole.notes
    monkeypatch.setattr("worker.inputs.STYLE_PIXELS", 5000)
    style = load_styles(files)
    assert [image.shape[:2] for image in style.images] == [(30, 40), (20, 20)]
    assert torch.equal(style.images[1], whole.images[1])
    assert [note.partition(":")[0] for note in style.notes] == ["large.png"]
