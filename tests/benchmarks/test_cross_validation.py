"""Tests of the cross-validation of defaults: what a choice sees, a run, and that the document shows stored results."""

import math
from pathlib import Path

import pytest
from PIL import Image

from benchmarks.cross_validation import (
    DEFAULT,
    SCORED,
    SECOND_SEED,
    Rows,
    Task,
    choose,
    left_out,
    run,
    score,
    stored,
    tables,
)
from benchmarks.equal_steps import UNSTYLIZED

ROOT = Path(__file__).resolve().parents[2]


def pair(**factors: float) -> Rows:
    """Return rows whose figures are the default's, 1, times a factor per candidate."""
    before = {UNSTYLIZED: dict.fromkeys(SCORED, 2.0), DEFAULT: dict.fromkeys(SCORED, 1.0)}
    return before | {name: dict.fromkeys(SCORED, each) for name, each in factors.items()}


def test_score_is_the_mean_logarithm_of_ratios() -> None:
    rows = {DEFAULT: {"style": 2.0, "color_distance": 10.0}, "cold": {"style": 1.0, "color_distance": 40.0}}
    assert score(rows, "cold") == pytest.approx((math.log(0.5) + math.log(4)) / 2)
    assert score(rows, "random") is None


def test_default_is_chosen_unless_a_candidate_is_better_on_average() -> None:
    worse = {"demo, a": pair(cold=0.9, random=1.1), "playbot, b": pair(cold=1.2, random=1.1)}
    assert choose(worse) == DEFAULT
    assert choose(worse | {"broche, c": pair(cold=0.5)}) == "cold"
    assert choose({"broche, a": pair(cold=0.1)}) == DEFAULT, "one pair is too few"


def test_second_seed_is_shown_but_never_chosen() -> None:
    pairs = {"broche, a": pair(**{SECOND_SEED: 0.5}), "playbot, b": pair(**{SECOND_SEED: 0.5})}
    assert choose(pairs) == DEFAULT
    assert not list(left_out(pairs))
    assert "| second-seed (score -0.693, better on 2), mean | 2 |" in tables(pairs)


def test_choice_sees_neither_the_scene_nor_the_painting_left_out() -> None:
    """On the first pair's scene and painting, `cold` is far ahead; elsewhere `random` is, by little."""
    pairs = {
        "broche, a": pair(cold=0.1, random=1.0),
        "broche, b": pair(cold=0.1, random=1.0),
        "playbot, a": pair(cold=0.1, random=1.0),
        "playbot, b": pair(cold=1.0, random=0.9),
        "playbot, c": pair(cold=1.0, random=0.9),
        "plush, c": pair(cold=0.1, random=1.0),
    }
    chosen = dict(left_out(pairs))
    assert chosen["broche, a"] == "random"
    assert chosen["playbot, c"] == "cold"
    assert chosen["plush, c"] == DEFAULT, "scans are not compared with scenes that fill the view"


@pytest.mark.parametrize(
    ("document", "heading"),
    [
        ("docs/quality.md", "## Current results"),
        ("benchmarks/results/README.md", "## How defaults were cross-validated"),
    ],
)
def test_document_shows_the_stored_results(document: str, heading: str) -> None:
    section = (ROOT / document).read_text().split(f"\n{heading}\n")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ") and line.endswith(" |")]
    shown = [line for pairs in stored().values() for line in tables(pairs).splitlines()]
    assert len(rows) > 4
    assert [row for row in rows if row not in shown] == []


@pytest.mark.slow
def test_run_judges_the_start_and_the_steps(vgg16_weights: object, tmp_path: Path) -> None:
    (tmp_path / "styles").mkdir()
    Image.effect_noise((96, 64), 80).convert("RGB").save(tmp_path / "styles" / "noise.jpg")
    settings = {"steps_coarse": 0, "steps_sos": 3, "early_stop": False, "measure": 0}
    rows = run(Task(tmp_path, "demo, noise", DEFAULT, settings, 96, (2,)))
    assert list(rows) == ["unstylized", "start", "default after 2", DEFAULT]
    assert rows["unstylized"]["content"] == 0 < rows["start"]["content"]
    assert rows[DEFAULT]["color_distance"] < rows["unstylized"]["color_distance"]
    assert rows["default after 2"] != rows[DEFAULT]
