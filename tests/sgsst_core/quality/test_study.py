"""Tests of blind comparisons: what the page reveals, and how votes are counted."""

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.quality.study import StudyError, count_votes, write_study

STYLE = torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0))


def views(index: int) -> list[Tensor]:
    """Return images of one gray level per variant."""
    return [torch.full((16, 24, 3), (index + 1) / 5) for _ in range(3)]


@pytest.fixture
def study(tmp_path: Path) -> tuple[Path, Path]:
    """Write a study of two variants at three views; return its page and its key."""
    page, key = tmp_path / "study.html", tmp_path / "study.key.json"
    write_study(page, key, ["our-method", "their-method"], STYLE, 3, views)
    return page, key


def save_votes(path: Path, key: Path, chosen: list[int], **changes: Any) -> Path:
    """Write votes for the variants with these indices, one per view."""
    known = json.loads(key.read_text())
    votes = [{"view": view, "chosen": known["views"][view][index]} for view, index in enumerate(chosen)]
    values = {"version": 1, "study": known["study"], "voter": path.stem, "votes": votes}
    path.write_text(json.dumps(values | changes))
    return path


def test_page_reveals_no_variant_and_needs_no_other_file(study: tuple[Path, Path]) -> None:
    text = study[0].read_text()
    assert "our-method" not in text
    assert "their-method" not in text
    assert not re.search(r"(src|href)=\"(?!data:)", text)
    assert "http" not in text.replace("http-equiv", "")
    assert text.count("data:image/jpeg") == 1 + 2 * 3


def test_order_of_images_on_the_page_differs_between_views(tmp_path: Path) -> None:
    page, key = tmp_path / "study.html", tmp_path / "study.key.json"
    write_study(page, key, ["a", "b"], STYLE, 40, lambda index: [torch.zeros(2, 2, 3)] * 40)
    text = page.read_text()
    first = [text.index(one) < text.index(other) for one, other in json.loads(key.read_text())["views"]]
    assert 5 < sum(first) < 35  # outside with a probability of 2e-6


def test_tokens_identify_the_images_of_the_variants(study: tuple[Path, Path]) -> None:
    page, key = study
    match = re.search(r"const study = (.*);$", page.read_text(), re.MULTILINE)
    assert match is not None
    on_page = {entry["token"]: entry["image"] for view in json.loads(match[1])["views"] for entry in view}
    for tokens in json.loads(key.read_text())["views"]:
        for index, token in enumerate(tokens):
            image = Image.open(io.BytesIO(base64.b64decode(on_page.pop(token).partition(",")[2])))
            assert image.getpixel((3, 3)) == (51 * (index + 1),) * 3
    assert on_page == {}


def test_fractions_of_votes_cover_all_voters(study: tuple[Path, Path], tmp_path: Path) -> None:
    key = study[1]
    files = [save_votes(tmp_path / "1.json", key, [0, 0, 1]), save_votes(tmp_path / "2.json", key, [0, 0])]
    first, second = count_votes(key, files)
    assert (first.variant, first.votes, first.total) == ("our-method", 4, 5)
    assert (second.variant, second.votes) == ("their-method", 1)
    assert (first.low, first.high) == pytest.approx((0.3755, 0.9638), abs=1e-4)  # of Wilson


def test_votes_of_a_voter_count_once(study: tuple[Path, Path], tmp_path: Path) -> None:
    key = study[1]
    early = save_votes(tmp_path / "1.json", key, [1], voter="v")
    late = save_votes(tmp_path / "2.json", key, [1, 0, 0], voter="v")
    assert count_votes(key, [late, early])[0].total == 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"study": "other"}, "another study"),
        ({"votes": []}, "no votes"),
        ({"votes": [{"view": 3, "chosen": "x"}]}, "does not make"),
        ({"votes": [{"view": 0, "chosen": "x"}]}, "does not make"),
        ({"votes": [{"view": -1, "chosen": "x"}]}, "not a file of votes"),
        ({"version": 2}, "not a file of votes"),
    ],
)
def test_foreign_votes_are_refused(
    study: tuple[Path, Path], tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = save_votes(tmp_path / "1.json", study[1], [0], **changes)
    with pytest.raises(StudyError, match=message):
        count_votes(study[1], [path])


def test_key_that_lacks_tokens_is_refused(study: tuple[Path, Path], tmp_path: Path) -> None:
    content = json.loads(study[1].read_text())
    content["views"][1].pop()
    key = tmp_path / "study.key.json"
    key.write_text(json.dumps(content))
    with pytest.raises(StudyError, match="not the key of a study: a view lacks the token of a variant"):
        count_votes(key, [save_votes(tmp_path / "1.json", study[1], [0])])


def test_repeated_views_are_refused(study: tuple[Path, Path], tmp_path: Path) -> None:
    token = json.loads(study[1].read_text())["views"][0][0]
    path = save_votes(tmp_path / "1.json", study[1], [0], votes=[{"view": 0, "chosen": token}] * 2)
    with pytest.raises(StudyError, match="does not make"):
        count_votes(study[1], [path])


@pytest.mark.parametrize("names", [["a"], ["a", "b", "c", "d", "e"], ["a", "a"]])
def test_wrong_numbers_and_names_of_variants_are_refused(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(SettingsError):
        write_study(tmp_path / "study.html", tmp_path / "study.key.json", names, STYLE, 3, views)
    assert list(tmp_path.iterdir()) == []
