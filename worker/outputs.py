"""Checks of the files that a command is asked to write, before any work starts. PyTorch is not imported."""

from __future__ import annotations

import os
from pathlib import Path

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import ensure_writable_folder
from sgsst_core.files.formats import RESULT_SUFFIXES, format_of_name
from sgsst_core.files.formats.scene_format import SceneFormat


def result_format(out: Path) -> SceneFormat:
    """Return the format of a scene to write, by its file name.

    Raises:
        OutputError: If the name does not end in a suffix of a format that can be written.
    """
    format = format_of_name(out.name)
    if format is None or format.write is None:
        raise OutputError(f"{out}: does not end in {RESULT_SUFFIXES}. Name the scene file to write.")
    return format


def check_is_not_input(out: Path, path: Path, description: str = "scene itself", remark: str = "") -> None:
    """Check that an output is not one of the inputs.

    Args:
        out: File to write.
        path: File to read.
        description: Name of the input in the message.
        remark: Text about the output for the message.

    Raises:
        OutputError: If both are the same file.
    """
    if out.exists() and path.exists() and out.samefile(path):
        raise OutputError(f"{out}{remark}: is the {description}, which would be overwritten. Give another file name.")


def check_file(out: Path) -> None:
    """Check that a file can be written, in a folder that may be missing. Creates nothing.

    Raises:
        OutputError: If it is a folder, or its folder cannot be written or created.
    """
    if out.is_dir():
        raise OutputError(f"{out}: is a folder. Name a file in it.")
    check_folder(Path(os.path.realpath(out)).parent)


def check_folder(folder: Path) -> None:
    """Check that a folder is writable or can be created, without creating it.

    Raises:
        OutputError: If the folder cannot be written or created.
    """
    while not (folder.exists() or folder.is_symlink()) and folder != folder.parent:
        folder = folder.parent
    ensure_writable_folder(folder)
