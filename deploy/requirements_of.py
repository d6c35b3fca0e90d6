"""Print what the project needs beside itself: its dependencies, and those of the extras that are named."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
extras = (name for extra in sys.argv[1:] for name in project["optional-dependencies"][extra])
print(*project["dependencies"], *extras, sep="\n")
