"""Real scenes of the folder of `shared_data`."""

from pathlib import Path


def scene_path(shared_data: Path, name: str) -> Path:
    """Return the scene file of the folder `scenes/NAME`, whatever its format."""
    (path,) = (path for path in (shared_data / "scenes" / name).iterdir() if path.name != "cameras.json")
    return path
