"""Tests of the progress of a job: what it counts, and how it reads."""

from __future__ import annotations

import pytest

from sgsst_core.progress import Progress


@pytest.mark.parametrize(
    ("progress", "fraction", "text"),
    [
        (Progress(stage="reading"), 0.0, "reading"),
        (Progress(stage="planning", step=2, total=8, eta_s=31.5), 0.25, "planning: view 2 of 8, 0:32 left"),
        (Progress(stage="starting", step=3, total=12), 0.25, "starting: step 3 of 12"),
        (Progress(stage="sos", step=6, total=12, loss=0.5, mean_loss=0.25), 0.5, "sos: step 6 of 12, loss 0.25"),
        (
            Progress(stage="measuring", step=60, total=60, loss=0.5, eta_s=0.2, views_checked=3, views_to_check=8),
            1.0,
            "measuring: view 3 of 8, loss 0.5, almost done",
        ),
        (Progress(stage="video", step=1, total=4), 0.25, "video: frame 1 of 4"),
    ],
)
def test_text_names_what_the_stage_counts(progress: Progress, fraction: float, text: str) -> None:
    assert (progress.fraction, progress.text()) == (fraction, text)
    assert Progress.model_validate_json(progress.model_dump_json()) == progress
