"""Compromised inspecting process, whose reader executes the scene's content as code.

    python compromised.py [landlock] [seccomp]

It behaves as if the kernel did not support the named features.
"""

import json
import sys
from pathlib import Path
from typing import Any

from service.inspection import process, sandbox
from sgsst_core.errors import SceneError
from sgsst_core.files.formats import read_scene_header
from worker import inputs as inputs


def taken_over(path: Path) -> Any:
    _, mark, code = path.read_bytes().partition(b"# attack\n")
    if not mark:
        return read_scene_header(path)
    namespace: dict[str, Any] = {"__name__": "attack"}
    exec(code, namespace)
    raise SceneError(json.dumps(namespace["reached"]))


setattr(inputs, "read_scene_header", taken_over)  # noqa: B010 (it is another module's)
if "landlock" in sys.argv:
    sandbox._landlock_version = lambda: 0
if "seccomp" in sys.argv:
    sandbox._has_seccomp = lambda: False
process.main()
