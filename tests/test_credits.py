"""Tests that `docs/credits.md` names each picture, and each file that others made, and no file that is gone."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Image in a text, such as in the outputs of a notebook. Shorter ones are icons in style sheets, or made up by tests.
EMBEDDED = re.compile(r'(?:base64,|"image/(?:jpeg|png|webp|gif)": ")[A-Za-z0-9+/]{200}')


@pytest.fixture(scope="module")
def tracked() -> dict[str, bytes]:
    """Return the content of each file of the repository by path."""
    if not (ROOT / ".git").exists():
        pytest.skip("not a Git repository")
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    paths = [ROOT / name for name in names.split("\0") if name]
    return {path.relative_to(ROOT).as_posix(): path.read_bytes() for path in paths if path.is_file()}


@pytest.fixture(scope="module")
def credited() -> list[str]:
    """Return the files and folders in the first column of the table; folders end with a slash."""
    rows = re.findall(r"^\| (`[^|]*) \|", (ROOT / "docs/credits.md").read_text(), re.MULTILINE)
    return [name for row in rows for name in re.findall(r"`([^`]+)`", row)]


def needs_credit(name: str, content: bytes) -> bool:
    """Return whether a file is binary, a vector image, or a vendored one, or has an embedded image."""
    if "/vendor/" in name or name.endswith(".svg"):
        return True
    try:
        return bool(EMBEDDED.search(content.decode())) or b"\0" in content
    except UnicodeDecodeError:
        return True


def covers(entry: str, name: str) -> bool:
    return name.startswith(entry) if entry.endswith("/") else name == entry


def test_files_that_need_credit_are_named_once(tracked: dict[str, bytes], credited: list[str]) -> None:
    needing = [name for name, content in tracked.items() if needs_credit(name, content)]
    assert "docs/notebook.ipynb" in needing, "images in texts are found"
    assert {name: count for name in needing if (count := sum(covers(entry, name) for entry in credited)) != 1} == {}


def test_named_files_exist(tracked: dict[str, bytes], credited: list[str]) -> None:
    assert [entry for entry in credited if not any(covers(entry, name) for name in tracked)] == []
