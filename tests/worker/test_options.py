"""Tests of style and region options on the command line and in JSON."""

from pathlib import Path

import pytest
import torch
from PIL import Image

from sgsst_core.errors import SettingsError
from sgsst_core.settings import checked
from worker.inputs import load_styles
from worker.options import (
    MOST_REGIONS,
    MOST_STYLE_IMAGES,
    REST,
    RegionOptions,
    StyleFile,
    parse_selection,
    parse_style,
    parse_styles,
    region_options,
    region_requests,
    split_weight,
)


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
    assert (parse_style(str(odd)), parse_style(f"{odd}:3")) == (StyleFile(odd), StyleFile(odd, 3.0))


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


@pytest.mark.parametrize(
    ("text", "kind", "numbers"),
    [
        ("box=0,1,2,-3,4.5,6e1", "box", (0, 1, 2, -3, 4.5, 60)),
        ("sphere=0,0,0,1", "sphere", (0, 0, 0, 1)),
        ("half-space= 0, 1 ,0,-2", "half-space", (0, 1, 0, -2)),
    ],
)
def test_geometric_selections_are_parsed(text: str, kind: str, numbers: tuple[float, ...]) -> None:
    selection = parse_selection(text, "region a")
    assert (selection.kind, selection.numbers, selection.text) == (kind, numbers, text)


def test_property_and_mask_selections_are_parsed() -> None:
    selection = parse_selection("property=f_rest_0<=-0.5", "region a")
    assert (selection.name, selection.sign, selection.numbers) == ("f_rest_0", "<=", (-0.5,))
    assert parse_selection("mask=a=b.npy", "region a").path == Path("a=b.npy")
    assert parse_selection("masks=some folder", "region a").path == Path("some folder")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not a known selection"),
        ("cube=1", "is not a known selection"),
        ("box", "is not a known selection"),
        ("mask=", "is not a known selection"),
        ("box=1,2,3", "has 3 numbers. Give 6"),
        ("sphere=0,0,0,x", "'x' in '0,0,0,x' is not a finite number"),
        ("sphere=0,0,nan,1", "is not a finite number"),
        ("sphere=0,0,0,0", "radius is 0. It must be greater than 0"),
        ("half-space=0,0,0,1", "has no direction"),
        ("property=opacity", "is not a comparison"),
        ("property=opacity>>1", "is not a finite number"),
        ("property=>1", "is not a comparison"),
    ],
)
def test_invalid_selections_are_refused(text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=f"^region a: .*{message}"):
        parse_selection(text, "region a")


def test_command_line_options_are_combined(tmp_path: Path) -> None:
    odd = tmp_path / "b:2"
    odd.touch()
    options = region_options(
        ["a:sphere=0,0,0,1", "c:half-space=0,1,0,0"],
        ["a=x.jpg:0.5", f"a={odd}", "rest=y=z.jpg"],
        ["a=1e6", "rest=0.5"],
        ["c"],
        ["a=balanced", "rest=0.5"],
    )
    rest, first, second = region_requests(options)
    assert (rest.name, rest.selection, rest.styles, rest.weight) == (REST, None, (StyleFile(Path("y=z.jpg")),), 0.5)
    assert first.styles == (StyleFile(Path("x.jpg"), 0.5), StyleFile(odd))
    assert (first.weight, first.freeze, second.freeze, second.styles) == (1e6, False, True, ())
    assert [each.content_weight for each in (rest, first, second)] == [0.5, 1e4, None]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ((["a"], [], [], []), "expected NAME:SPEC"),
        (([" :sphere=0,0,0,1"], [], [], []), "expected NAME:SPEC"),
        ((["a=b:sphere=0,0,0,1"], [], [], []), "expected NAME:SPEC"),
        ((["\x1b[31m:sphere=0,0,0,1"], [], [], []), "String should match pattern"),
        ((["a:sphere=0,0,0,1", "a:sphere=0,0,0,2"], [], [], []), "a region a already exists"),
        (([], ["b=x.jpg"], [], []), "there is no region 'b'. Use one of rest"),
        ((["a:sphere=0,0,0,1"], ["a"], [], []), "--region-style a: expected NAME=VALUE"),
        ((["a:sphere=0,0,0,1"], [], ["a=0"], []), "weight = '0': Input should be greater than 0"),
        ((["a:sphere=0,0,0,1"], [], ["a=x"], []), "weight = 'x': Input should be a valid number"),
        ((["a:sphere=0,0,0,1"], ["a=x.jpg:0"], [], []), "the weight must be a finite number above 0, not 0"),
        ((["a:sphere=0,0,0,1"], ["a=x.jpg"], [], ["a"]), "is frozen, so it cannot have a style or weight"),
        ((["a:sphere=0,0,0,1"], [], [], ["a=false"]), "--region-freeze a=false: expected NAME. Give only"),
        (([], [], [], ["rest="]), "--region-freeze rest=: expected NAME. Give only"),
        ((["a:sphere=0,0,0,1"], [], [], ["a"], ["a=light"]), "is frozen, so it cannot have a style or weight"),
        ((["a:sphere=0,0,0,1"], [], [], [], ["a"]), "--region-content-weight a: expected NAME=VALUE"),
        ((["a:sphere=0,0,0,1"], [], [], [], ["a=-1"]), "Input should be greater than or equal to 0"),
        ((["a:sphere=0,0,0,1"], [], [], [], ["a=nan"]), "Input should be a finite number"),
        (([], [], [], [], ["b=light"]), "there is no region 'b'"),
        (([], [], ["rest=1.1e6"], []), "Input should be less than or equal to 1000000"),
        ((["rest:sphere=0,0,0,1"], [], [], []), "takes no SPEC"),
        ((["a:" + "x" * 1001], [], [], []), "at most 1000 characters"),
        (
            ([f"a{n}:sphere=0,0,0,1" for n in range(MOST_REGIONS + 1)], [], [], []),
            rf"There are {MOST_REGIONS + 1} regions\. At most {MOST_REGIONS} are allowed",
        ),
        (  # the rest does not count
            ([f"a{n}:sphere=0,0,0,1" for n in range(MOST_REGIONS + 1)], [], [], [REST]),
            rf"There are {MOST_REGIONS + 1} regions\. At most {MOST_REGIONS} are allowed",
        ),
        (
            (["a:sphere=0,0,0,1"], ["a=x.jpg"] * (MOST_STYLE_IMAGES + 1), [], []),
            rf"{MOST_STYLE_IMAGES + 1} style images\. At most {MOST_STYLE_IMAGES} are allowed",
        ),
    ],
)
def test_invalid_options_are_refused(texts: tuple[list[str], ...], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        region_requests(region_options(*texts))


@pytest.mark.parametrize("name", ["1a", "Grandma's face", "50% [bold]", "ü/../x"])
def test_names_of_regions_are_labels(name: str) -> None:
    (region,) = region_requests(region_options([f" {name} :sphere=0,0,0,1"], [], [f"{name}=2"], []))
    assert (region.name, region.weight) == (name, 2)
    with pytest.raises(SettingsError, match=r"region .* is not a known selection"):
        RegionOptions(name=name, select="cube=1").request()


def test_json_regions_have_content_weights_by_name_or_number() -> None:
    options = [
        checked(RegionOptions, {"name": name, "select": "sphere=0,0,0,1", "content_weight": weight})
        for name, weight in (("a", "light"), ("b", 7), ("c", None))
    ]
    assert [each.content_weight for each in region_requests(options)] == [3e4, 7.0, None]
    for name, weight in (
        ("content_weight", "much"),
        ("content_weight", -1),
        ("content_weight", 1e13),
        ("weight", 1.1e6),
    ):
        with pytest.raises(SettingsError, match=name):
            checked(RegionOptions, {"name": "a", "select": "sphere=0,0,0,1", name: weight})


def test_json_regions_need_selections_and_unique_names() -> None:
    with pytest.raises(SettingsError, match="needs a SPEC"):
        region_requests([RegionOptions(name="a")])
    with pytest.raises(SettingsError, match="two regions 'rest'"):
        region_requests([RegionOptions(name=REST, freeze=True)] * 2)
