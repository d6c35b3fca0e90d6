"""Sample report with the structure that `build_report` gives, created without running a job."""

import math
from typing import Any

from sgsst_core.loss.terms import TERMS


def sample_report(coarse: int = 6, sos: int = 12, scales: int = 2) -> dict[str, Any]:
    """Return a report with all fields set and the given number of steps."""
    history = [_record(step, "coarse" if step <= coarse else "sos", scales) for step in range(1, coarse + sos + 1)]
    seconds = history[-1]["seconds"] if history else 0.0
    before = {str(scale): _terms(1e6 / 4**scale) for scale in range(scales)}
    after = {str(scale): _terms(1e5 / 4**scale) for scale in range(scales)}
    return {
        "version": 4,
        "program": {"name": "sgsst-service", "version": "0.1.0"},
        "created": "2026-01-02T03:04:05+00:00",
        "stopped": "finished",
        "steps": {"coarse": {"planned": coarse, "done": coarse}, "sos": {"planned": sos, "done": sos}},
        "seconds": seconds,
        "seconds_by_part": {
            "vgg_forward": 0.5 * seconds,
            "render": 0.2 * seconds,
            "optimizer": 0.1 * seconds,
            "other": 0.2 * seconds,
        },
        "loss": {
            "views": ["a", "b"],
            "before": {"total": 6e5, "scales": before},
            "after": {"total": 6e4, "scales": after},
            "relative": 0.1,
            "relative_by_scale": dict.fromkeys(before, 0.1),
        },
        "settings": {"preset": "preview", "seed": 3, "within": None, "background": [0.0, 0.5, 1.0]},
        "backbone": {"name": "vgg16", "source": "package index", "sha256": "0123456789abcdef" * 4},
        "scene": {"path": "folder/garden.ply", "gaussians": 123_456, "sh_degree": 3, "dropped": 0},
        "style": {"path": "styles/wave.jpg", "width": 800, "height": 600},
        "styles": [{"path": "styles/wave.jpg", "width": 800, "height": 600, "weight": 1.0}],
        "cameras": {
            "path": None,
            "source": "orbit",
            "content": "unstylized renders",
            "count": 5,
            "sizes": [[640, 480], [1280, 720]],
            "names": ["a", "b", "c", "d", "e"],
            "seeing_nothing": ["e"],
        },
        "position_weights": {"used": True, "uncovered_fraction": 0.25},
        "plan": {
            "decisions": [_decision(index) for index in range(3)],
            "prediction": {"seconds": 2.0, "peak_bytes": 3_000_000_000},
            "measured": {"seconds": 2.5, "peak_bytes": 2_400_000_000},
        },
        "rasterizer": "cached",
        "memory": {"limit_bytes": 8_000_000_000, "peak_bytes": 2_400_000_000},
        "machine": {"processor": "some processor", "cores": 2, "device": "cpu"},
        "history": history,
        "novel_views": {
            "views": ["c"],
            "lpips": "alex",
            "moments": [_moment(s, history) for s in (0, 4, coarse + sos)],
            "judged": {"before": _judged(1.5, 0.0), "after": _judged(0.625, 0.375)},
        },
        "approximations": {
            "what": ["bfloat16 features", "half-precision blend weights"],
            "moments": [
                {"step": step, "view": "b", "relative_error": e, "cosine": 0.97, "seconds": 0.5, "seconds_exact": 1.25}
                for step, e in ((3, 0.21), (9, 0.24))
            ],
        },
        "loss_over_time": {
            "relative": 0.0987,
            "reached": [{"relative": 0.5, "seconds": 1.5, "step": 7}, {"relative": 0.25, "seconds": 2.5, "step": 9}],
            "last_tenth": {"seconds": 0.4, "from": 0.101, "to": 0.0987},
            "more_time": {"steps": 72, "relative": 0.08, "text": "4 times the time would pay."},
        },
        "findings": [
            {
                "subject": "scene",
                "what": "opacity below 1/255",
                "count": 1200,
                "total": 5000,
                "worst": "Gaussian 7",
                "done": "neither drawn nor optimized",
            },
            {"subject": "style", "what": "extreme aspect", "count": 1, "total": 1, "worst": "", "done": "used whole"},
        ],
    }


def _terms(total: float) -> dict[str, float]:
    shares = {term: 2.0**-place for place, term in enumerate(TERMS)}
    return {**{term: share / sum(shares.values()) * total for term, share in shares.items()}, "total": total}


def _record(step: int, stage: str, scales: int) -> dict[str, Any]:
    relative = (1 + 0.2 * math.sin(1.7 * step)) / step**0.5
    chosen = range(scales - 1, scales) if stage == "coarse" else range(scales)
    return {
        "step": step,
        "stage": stage,
        "seconds": round(0.2 * step, 3),
        "view": step % 4,
        "loss": 6e5 * relative,
        "relative": relative,
        "scales": {str(scale): _terms(1e6 / 4**scale * relative) for scale in chosen},
        "parts": {"render": 0.04, "vgg_forward": 0.1},
        "memory_bytes": 2_000_000_000 + 1_000_000 * (step % 7),
    }


def _decision(index: int) -> dict[str, Any]:
    """Return a decision, with or without bytes."""
    texts = {name: f"{name} number {index}" for name in ("item", "decision", "reason", "error")}
    return {**texts, "bytes": 4_000_000 * index or None}


def _moment(step: int, history: list[dict[str, Any]]) -> dict[str, Any]:
    relative = 1.0 if step == 0 else 0.9 / step**0.5
    pairs = {"pairs": 4, "compared": 0.83, "rmse": 0.04 + 0.01 * relative, "lpips": 0.1 - 0.05 * relative}
    return {
        "step": step,
        "seconds": 0.2 * step,
        "gram": {"0": 1e5 * relative, "1": 3e4 * relative},
        "gram_relative": relative,
        "consistency": {"short": {"gap": 1, **pairs}, "long": {"gap": 7, **pairs, "lpips": None}},
    }


def _judged(style: float, content: float) -> dict[str, float]:
    judged = {"style": style, "color_distance": 40 * style, "content": content}
    judged["ssim"] = 1 - content
    interior = {"interior_style": style / 2, "sliced_features": style / 4}
    return {**judged, **interior, "background_sensitivity": 0.25, "saturated": 0.02}
