"""Tests of codebooks, against scipy's k-means and exhaustive search."""

from __future__ import annotations

import numpy as np
from scipy.cluster.vq import kmeans2

from sgsst_core.files.formats.codebooks import VALUES, nearest_entries, palette, value_codebook


def error(rows: np.ndarray, approximations: np.ndarray) -> float:
    return float(((rows.astype(np.float64) - approximations) ** 2).mean())


def test_few_distinct_values_are_stored_exactly() -> None:
    values = np.random.default_rng(0).integers(-100, 100, (500, 3)).astype(np.float32) / 7
    codebook = value_codebook(values)
    assert len(codebook) == VALUES
    assert np.array_equal(codebook[nearest_entries(values, codebook)], values)


def test_values_get_their_nearest_entry_and_a_small_error() -> None:
    generator = np.random.default_rng(1)
    values = np.concatenate([generator.normal(size=20_000), [-40, 60]]).astype(np.float32)
    codebook = value_codebook(values)
    labels = nearest_entries(values, codebook)
    wide = codebook.astype(np.float64)
    best = np.abs(values[:, None] - wide).min(axis=1)
    np.testing.assert_allclose(np.abs(values - wide[labels]), best, rtol=0, atol=1e-12)
    uniform = np.linspace(values.min(), values.max(), VALUES)
    assert error(values, wide[labels]) < 0.05 * error(values, uniform[nearest_entries(values, uniform.astype("f4"))])
    start = np.quantile(values, (np.arange(VALUES) + 0.5) / VALUES)
    reference, other = kmeans2(values[:, None].astype(np.float64), start[:, None], iter=60)
    assert error(values, wide[labels]) < 1.05 * error(values, reference[other, 0])


def test_extreme_values_leave_the_others_their_entries() -> None:
    values = np.random.default_rng(0).normal(size=20_000).astype(np.float32)
    usual = value_codebook(values)
    usual_error = error(values, usual[nearest_entries(values, usual)])
    for extremes in ([1e3], [1e7], [-1e7], [1e3, 1e7, -1e5]):
        extreme = np.concatenate([values, np.array(extremes, np.float32)])
        codebook = value_codebook(extreme)
        nearest = codebook[nearest_entries(extreme, codebook)]
        assert error(values, nearest[: len(values)]) < 1.2 * usual_error
        np.testing.assert_allclose(nearest[len(values) :], extremes, rtol=1e-6)


def test_few_distinct_rows_are_stored_exactly() -> None:
    generator = np.random.default_rng(2)
    rows = generator.normal(size=(300, 9)).astype(np.float32)[generator.integers(0, 300, 5000)]
    vectors, labels = palette(rows, 1024)
    assert len(vectors) <= 300
    assert np.array_equal(vectors[labels], rows)


def test_palette_is_nearly_as_good_as_k_means() -> None:
    generator = np.random.default_rng(3)
    rows = (generator.normal(size=(6000, 4)) * [3, 1, 0.5, 0.1]).astype(np.float32)
    vectors, labels = palette(rows, 1024)
    assert len(vectors) <= 1024
    reference, other = kmeans2(rows.astype(np.float64), 1024, iter=15, minit="points", seed=0)
    assert error(rows, vectors[labels]) < 1.3 * error(rows, reference[other])
