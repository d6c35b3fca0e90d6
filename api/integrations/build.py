"""Write the packages for Blender, ComfyUI and LichtFeld Studio as ZIP files, as their users install them.

python api/integrations/build.py FOLDER
"""

import sys
import zipfile
from pathlib import Path

_HERE = Path(__file__).resolve().parent
#: Folder inside each ZIP file; Blender's extensions have none.
PROGRAMS = {"blender": "", "comfyui": "sgsst/", "lichtfeld": "sgsst/"}


def build(program: str, folder: Path) -> Path:
    """Write the package of a program to a folder, with the shared module and the license; return its path."""
    path = folder / f"sgsst-{program}.zip"
    named = {
        file.relative_to(_HERE / program).as_posix(): file
        for file in sorted((_HERE / program).rglob("*"))
        if file.is_file() and file.suffix != ".pyc"
    }
    named["sgsst_rest.py"] = _HERE / "sgsst_rest.py"
    named["LICENSE"] = _HERE.parents[1] / "LICENSE"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, file in named.items():
            archive.write(file, PROGRAMS[program] + name)
    return path


if __name__ == "__main__":
    target = Path(sys.argv[1])
    target.mkdir(parents=True, exist_ok=True)
    for each in PROGRAMS:
        print(build(each, target))
