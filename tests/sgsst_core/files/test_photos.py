"""Tests that photos are found by name, fit their cameras, and are read as the cameras see them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.errors import ImageError
from sgsst_core.files.photos import Photo, check_photos, find_masks, load_photo
from sgsst_core.scene.camera import Camera, resized
from tests.sgsst_core.files.test_images import save


def camera(name: str, width: int = 90, height: int = 60) -> Camera:
    return Camera(name, width, height, 100.0, 100.0, width / 2, height / 2, torch.eye(4, dtype=torch.float64))


def paths(matches: list[Photo | None]) -> list[Path]:
    assert all(matches)
    return [photo.path for photo in matches if photo]


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("0001.jpg", "0001.jpg"),
        ("0001.jpg", "0001"),
        ("0001.JPG", "0001"),
        ("0001.png", "0001.jpg"),
        ("0001.jpg", "images/0001.jpg"),
        ("0001.jpg", "../images/0001"),
        ("0001.jpg", "images\\0001.jpg"),
        ("sub/0001.jpg", "0001.jpg"),
        ("frame.0001.jpg", "frame.0001"),
        ("frame.0001.jpg", "frame.0001.jpg"),
        ("IMG_1.JPG", "img_1.jpg"),
        ("Cam0/a.jpg", "cam0/A"),
        ("u\u0308.jpg", "\u00fc.jpg"),
        ("\u00fc.jpg", "u\u0308.jpg"),
    ],
)
def test_photos_are_matched_by_name(tmp_path: Path, file: str, name: str) -> None:
    save(tmp_path / "other.jpg", Image.new("RGB", (90, 60)))
    path = save(tmp_path / file, Image.new("RGB", (180, 120)))
    assert paths(check_photos(tmp_path, [camera(name)])) == [path]


def test_rig_photos_are_matched_by_folder_and_extension(tmp_path: Path) -> None:
    for name in ("cam0/a.png", "cam1/a.png", "cam1/a.jpg", "b.png", "old/b.png"):
        save(tmp_path / name, Image.new("RGB", (90, 60)))
    names = ["cam1/a.png", "images/cam0/a", "cam1/a.jpg", "b.png"]
    matched = paths(check_photos(tmp_path, [camera(name) for name in names]))
    assert [str(path.relative_to(tmp_path)) for path in matched] == ["cam1/a.png", "cam0/a.png", "cam1/a.jpg", "b.png"]
    several = r"more than one photo for 2 of 3 views: a, cam1/a \(such as cam0/a.png and cam1/a.jpg\)"
    with pytest.raises(ImageError, match=several):
        check_photos(tmp_path, [camera("a"), camera("b"), camera("cam1/a")])


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("a.jpg.png", "a.jpg"),
        ("a.jpg.png", "a"),
        ("a.jpg.mask.png", "images/a.jpg"),
        ("a.mask.png", "a.jpg"),
        ("cam1/a.jpg.png", "images/cam1/a.jpg"),
        ("a.v2.png", "a.v2.jpg"),
    ],
)
def test_masks_are_found_by_the_conventions_of_colmap_and_realityscan(tmp_path: Path, file: str, name: str) -> None:
    save(tmp_path / "cam0" / "other.jpg.png", Image.new("RGB", (90, 60)))
    path = save(tmp_path / file, Image.new("RGB", (90, 60)))
    assert paths(find_masks(tmp_path, [camera(name)])) == [path]
    if path.stem != "a.v2":
        with pytest.raises(ImageError, match="no photo"):
            check_photos(tmp_path, [camera(name)])


def test_masks_named_as_their_cameras_come_first(tmp_path: Path) -> None:
    for name in ("a.png", "a.jpg.png", "b.jpg.png", "b.png.png"):
        save(tmp_path / name, Image.new("RGB", (90, 60)))
    masks = find_masks(tmp_path, [camera(name) for name in ("a.jpg", "b.jpg", "b.png")])
    assert [path.name for path in paths(masks)] == ["a.png", "b.jpg.png", "b.png.png"]


def test_case_of_a_name_counts_if_files_differ_by_it(tmp_path: Path) -> None:
    for name in ("IMG.png", "Img.png", "b.png"):
        save(tmp_path / name, Image.new("RGB", (90, 60)))
    matches = check_photos(tmp_path, [camera("IMG"), camera("img"), camera("B")])
    assert [photo and photo.path.name for photo in matches] == ["IMG.png", None, "b.png"]


def test_photos_in_an_unreadable_format_are_named(tmp_path: Path) -> None:
    for name in ("a.dng", "sub/b.exr", "notes.txt"):
        save(tmp_path / name, Image.new("RGB", (90, 60)), format="PNG")
    with pytest.raises(ImageError, match=r"2 views: a\.jpg, b\. Files of these names are \.dng, \.exr: convert them"):
        check_photos(tmp_path, [camera("a.jpg"), camera("b")])


def test_missing_photos_are_named(tmp_path: Path) -> None:
    save(tmp_path / "v03.png", Image.new("RGB", (90, 60)))
    cameras = [camera(f"v{i:02d}") for i in range(15)]
    with pytest.raises(ImageError, match=r"no photo for 14 of 15 views: v00, v01, v02, v04, .*v10, \.\.\."):
        check_photos(tmp_path, cameras)
    matches = check_photos(tmp_path, [cameras[0], cameras[3]])
    assert [photo and photo.path.name for photo in matches] == [None, "v03.png"]
    with pytest.raises(ImageError, match="not a folder"):
        check_photos(tmp_path / "v03.png", cameras)


def test_photos_with_another_aspect_ratio_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", Image.new("RGB", (93, 60)))
    for check in (
        lambda: check_photos(tmp_path, [camera("a")]),
        lambda: load_photo(Photo(path, (93, 60)), camera("a")),
    ):
        with pytest.raises(ImageError, match="is 93 x 60, but its camera 'a' 90 x 60, another aspect"):
            check()
    # The rounded sides of a small camera do not count as another aspect ratio.
    save(tmp_path / "b.png", Image.new("RGB", (990, 742)))
    check_photos(tmp_path, [resized(camera("b", 990, 742), 22)])


def oriented(folder: Path, orientation: int, size: tuple[int, int]) -> Path:
    """Save a photo whose left half is black and whose right half is white, with an EXIF orientation."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    image = Image.new("RGB", size)
    image.paste("white", (size[0] // 2, 0, *size))
    return save(folder / "a.png", image, exif=exif)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_exif_orientation_is_ignored_if_the_stored_photo_fits(tmp_path: Path, orientation: int) -> None:
    path = oriented(tmp_path, orientation, (90, 60))
    (photo,) = check_photos(tmp_path, [camera("a")])
    assert photo == Photo(path, (90, 60), oriented=False, ambiguous=orientation == 3)
    assert photo
    assert float(load_photo(photo, camera("a"))[:, 60:].min()) == 1
    rotated = load_photo(Photo(path, (90, 60), oriented=True), camera("a")) if orientation == 3 else None
    assert rotated is None or float(rotated[:, :30].min()) == 1


@pytest.mark.parametrize(("orientation", "white"), [(6, slice(40, 60)), (8, slice(0, 20))])
def test_exif_orientation_is_applied_if_only_the_rotated_photo_fits(
    tmp_path: Path, orientation: int, white: slice
) -> None:
    path = oriented(tmp_path, orientation, (60, 90))
    (photo,) = check_photos(tmp_path, [camera("a")])
    assert photo == Photo(path, (90, 60), oriented=True)
    assert photo
    pixels = load_photo(photo, camera("a"))
    assert pixels.shape == (60, 90, 3)
    assert float(pixels[white].min()) == 1  # the stored right side: 6 turns it down, and 8 up


def test_broken_photos_are_detected_early(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no photo")
    with pytest.raises(ImageError, match=r"a\.jpg: is not an image"):
        check_photos(tmp_path, [camera("a")])


def test_photos_are_resized_to_the_camera_without_aliasing(tmp_path: Path) -> None:
    stripes = np.zeros((120, 180, 3), dtype="u1")
    stripes[:, ::2] = 255
    photo = Photo(save(tmp_path / "a.png", Image.fromarray(stripes)), (180, 120))
    small = load_photo(photo, camera("a", 45, 30))
    assert small.shape == (30, 45, 3)
    assert float((small - 0.5).abs()[:, 2:-2].max()) < 0.02  # point sampling would give 0 or 1
    same = load_photo(photo, camera("a", 180, 120))
    assert torch.equal(same, torch.from_numpy(stripes).float() / 255)
    large = load_photo(photo, camera("a", 360, 240))
    assert large.shape == (240, 360, 3)
    assert float(large.min()) >= 0
    assert float(large.max()) <= 1
