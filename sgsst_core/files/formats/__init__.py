"""Registry of scene formats: one entry per format, each in a module of its own.

To add a format, write a module with a `SceneFormat`, and append it to `FORMATS`. PyTorch is not imported, because the
API process reads headers.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sgsst_core.errors import OutputError, SceneError, reading_scene
from sgsst_core.files.advice import SCENES, refuse_known, refuse_scene_folder
from sgsst_core.files.formats.glb import GLB
from sgsst_core.files.formats.ply import COMPRESSED_PLY, PLY
from sgsst_core.files.formats.scene_format import FileStart, SceneFormat, SceneHeader
from sgsst_core.files.formats.sog import INDEX_NAME, SOG, STREAMED_SOG
from sgsst_core.files.formats.splat import KSPLAT, SPLAT
from sgsst_core.files.formats.spz import SPZ, SPZ_3

#: All scene formats, in the order in which they are tried and listed. Formats without a magic number come last.
FORMATS: tuple[SceneFormat, ...] = (PLY, COMPRESSED_PLY, SPZ, SPZ_3, STREAMED_SOG, SOG, GLB, KSPLAT, SPLAT)
#: Formats of results: PLY, and those that can be written in addition to it.
RESULT_FORMATS = tuple(each for each in FORMATS if each.write)
EXTRA_FORMATS = tuple(each for each in RESULT_FORMATS if each is not PLY)
#: Formats of a downloaded result of the service: file name suffixes without their first dot, and titles.
#: The page shows the result in 3D.
DOWNLOADS = {each.name: each.title for each in RESULT_FORMATS} | {"html": "HTML page, opened without a server"}

if TYPE_CHECKING:
    ResultName = str
    DownloadName = str
else:
    #: Names of `RESULT_FORMATS`, and of `DOWNLOADS`, as choices of options and query parameters.
    ResultName = Literal[tuple(each.name for each in RESULT_FORMATS)]
    DownloadName = Literal[tuple(DOWNLOADS)]

#: Number of leading bytes that are used to detect the format.
HEAD_BYTES = 8192


def listed(names: Sequence[str]) -> str:
    """Return names as an enumeration with "or"."""
    return f"{', '.join(names[:-1])} or {names[-1]}"


#: Enumerations of formats for texts: titles, suffixes, suffixes of results, and of results in addition to a PLY.
TITLES = listed([each.title for each in FORMATS])
SUFFIXES = listed([each.suffix for each in FORMATS])
RESULT_SUFFIXES = listed([each.suffix for each in RESULT_FORMATS])
EXTRA_SUFFIXES = listed([each.suffix for each in EXTRA_FORMATS])
DOWNLOAD_SUFFIXES = listed([f".{name}" for name in DOWNLOADS])


def format_of_name(name: str) -> SceneFormat | None:
    """Return the format that a file name ends with, regardless of case; None for other names."""
    fitting = [each for each in FORMATS if name.lower().endswith(each.suffix)]
    return max(fitting, key=lambda each: len(each.suffix), default=None)


def by_name(name: str) -> SceneFormat:
    """Return the format of a name such as "spz"."""
    return next(each for each in FORMATS if each.name == name)


def result_name(ply: str, format: str) -> str:
    """Return the name of a result in one of `DOWNLOADS`, given the name of its PLY."""
    return f"{ply.removesuffix(PLY.suffix)}.{format}"


def download_of_name(name: str) -> str:
    """Return the one of `DOWNLOADS` that a result is saved as, by the name of its file; PLY if that has no suffix.

    Raises:
        OutputError: If a result cannot be saved with the suffix.
    """
    fitting = [each for each in DOWNLOADS if name.lower().endswith(f".{each}")]
    if not fitting and Path(name).suffix:
        raise OutputError(f"{name}: does not end in {DOWNLOAD_SUFFIXES}. Name the file to write.")
    return max(fitting, key=len, default=PLY.name)


def scene_path(path: Path) -> Path:
    """Return the index of a streamed SOG, given its folder; any other path as it is."""
    index = path / INDEX_NAME
    return index if index.is_file() else path


def read_scene_header(path: Path) -> SceneHeader:
    """Detect the format of a scene file, or of the folder of a streamed SOG, from its content; check its header.

    Raises:
        SceneError: If the file cannot be read, is truncated, has a wrong header, or has an unsupported format.
    """
    path = scene_path(path)
    if path.is_dir():
        refuse_scene_folder(path)
    with reading_scene(path), path.open("rb") as file:
        start = FileStart(path, file.read(HEAD_BYTES), path.stat().st_size)
    for each in FORMATS:
        if each.matches(start):
            return each.read_header(start)
    refuse_known(path, SCENES, SceneError)
    raise SceneError(f"{path}: is not a scene file: expected {TITLES}. Export the scene in one of these formats.")
