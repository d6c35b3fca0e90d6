"""Test of a blind study in a browser: choose by arrow keys, save the votes, count them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from api.cli.main import main
from sgsst_core.quality.study import count_votes
from tests.api.page.browser import Watched
from tests.small_scenes import ball, write_files

pytestmark = pytest.mark.slow


def test_votes_by_arrow_keys_are_saved_and_counted(
    browser: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, cameras, style = write_files(tmp_path, ball())
    page, key = tmp_path / "study.html", tmp_path / "study.key.json"
    variants = [f"{name}={scene}" for name in ("warm-start", "cold-start", "third-way")]
    assert main(["study", "make", *variants, "--cameras", str(cameras), "--style", str(style), "--out", str(page)]) == 0
    watched = Watched(browser, page.as_uri())
    watched.page.goto(page.as_uri())
    known = json.loads(key.read_text())
    for _ in known["views"]:
        watched.page.keyboard.press("ArrowDown")
    watched.page.keyboard.press("Backspace")
    watched.page.keyboard.press("ArrowLeft")
    assert watched.page.get_by_role("status").inner_text().startswith("All views are done")
    with watched.page.expect_download() as download:
        watched.page.get_by_role("button", name="Save votes").click()
    votes = tmp_path / "votes.json"
    download.value.save_as(votes)
    assert watched.wrong == []
    shares = count_votes(key, [votes])
    assert sum(share.votes for share in shares) == shares[0].total == len(known["views"])
    capsys.readouterr()
    assert main(["study", "count", str(key), str(votes)]) == 0
    assert f"{len(known['views'])} votes" in capsys.readouterr().out
    watched.context.close()
