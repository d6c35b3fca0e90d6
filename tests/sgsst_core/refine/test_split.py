"""Tests of splitting Gaussians: moments are preserved, values stay finite, and other Gaussians do not change."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.refine import split as module
from sgsst_core.refine.split import (
    MAX_PIECES,
    can_be_split,
    mixture_error,
    parents_of,
    piece_counts,
    pieces_to,
    ratio_of,
    split,
    split_axis,
)
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.rotations import unit_rotations
from sgsst_core.scene.stored_harmonics import StoredHarmonics, held
from tests.sgsst_core.splat_scenes import camera, cloud, single

NUMBERS = [1, *range(3, MAX_PIECES + 1)]


def covariances(scene: Scene) -> Tensor:
    """Return covariances [N, 3, 3] in float64."""
    factors = (
        unit_rotations(torch.nn.functional.normalize(scene.quats.double())) * scene.scales.double().exp()[:, None, :]
    )
    return factors @ factors.transpose(1, 2)


def mixtures(children: Scene, parents: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return opacity-weighted mean [N, 3] and covariance [N, 3, 3] of each parent's children, in float64."""
    opacity = torch.sigmoid(children.opacities.double())
    fraction = opacity / torch.zeros(count, dtype=torch.float64).index_add(0, parents, opacity)[parents]
    mean = torch.zeros(count, 3, dtype=torch.float64).index_add(0, parents, fraction[:, None] * children.means.double())
    apart = children.means.double() - mean[parents]
    own = covariances(children) + apart[:, :, None] * apart[:, None, :]
    return mean, torch.zeros(count, 3, 3, dtype=torch.float64).index_add(0, parents, fraction[:, None, None] * own)


@pytest.mark.parametrize("number", NUMBERS)
def test_split_axis_has_the_parents_variance_and_nearly_its_density(number: int) -> None:
    division = split_axis(number)
    assert len(division.offsets) == len(division.weights) == number
    assert division.weights.sum() == pytest.approx(1, abs=1e-14)
    assert division.weights @ division.offsets == pytest.approx(0, abs=1e-12)
    assert 1 / division.ratio**2 + division.weights @ division.offsets**2 == pytest.approx(1, abs=1e-11)
    assert division.ratio == ratio_of(number)
    x = np.linspace(-9, 9, 20001)
    density = np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
    parts = (
        np.exp(-(((x[:, None] - division.offsets) * division.ratio) ** 2) / 2) * division.ratio / math.sqrt(2 * math.pi)
    )
    error = np.sqrt(((parts @ division.weights - density) ** 2).sum() / (density**2).sum())
    assert mixture_error(division) == pytest.approx(error, abs=1e-6)
    assert error < 0.03
    # Factor on the opacity of a child, which never exceeds the parent's.
    assert float((division.weights * division.ratio).max()) <= 1


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.lists(st.sampled_from(NUMBERS[:8]), min_size=3, max_size=3), st.floats(-8, 2))
def test_children_have_the_parents_mean_and_covariance(seed: int, numbers: list[int], log_scale: float) -> None:
    scene = cloud(30, seed=seed, log_scale=log_scale)
    pieces = torch.tensor(numbers, dtype=torch.uint8).repeat(30, 1)
    pieces[::3] = 1
    children, parents = split(scene, pieces), parents_of(pieces)
    assert len(children) == len(parents) == int(piece_counts(pieces).sum())
    mean, covariance = mixtures(children, parents, 30)
    expected = covariances(scene)
    size = expected.diagonal(dim1=1, dim2=2).sum(1)
    rounding = 1e-6 * scene.means.abs().amax(1).double()  # of positions stored in float32
    assert bool(((mean - scene.means).norm(dim=1) < 1e-5 * size.sqrt() + rounding).all())
    apart = (covariance - expected).flatten(1).norm(dim=1)
    assert bool((apart < 1e-5 * size + 10 * rounding * size.sqrt() + rounding**2).all())


def test_unsplit_gaussians_and_inherited_properties_are_bit_identical(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CHUNK", 50)
    scene = cloud(40, degree=2)
    pieces = torch.ones(40, 3, dtype=torch.uint8)
    pieces[3], pieces[17], pieces[18, 1] = torch.tensor([5, 4, 1]), torch.tensor([3, 3, 3]), 32
    children, parents = split(scene, pieces), parents_of(pieces)
    assert bool((parents[1:] >= parents[:-1]).all())
    for name in ("quats", "sh_dc", "sh_rest"):
        assert torch.equal(getattr(children, name), getattr(scene, name)[parents])
    unsplit = (piece_counts(pieces) == 1)[parents]
    for name in TENSORS:
        assert torch.equal(getattr(children, name)[unsplit], getattr(scene, name)[parents][unsplit])
    monkeypatch.setattr(module, "_CHUNK", 1 << 18)
    again = split(scene, pieces)
    assert all(torch.equal(getattr(again, name), getattr(children, name)) for name in TENSORS)
    assert split(scene, torch.ones(40, 3, dtype=torch.uint8)) is scene


def test_extreme_gaussians_have_finite_children_or_are_not_split() -> None:
    """Cases are needles, points, huge and coincident Gaussians, and opacities of 0 and 1."""
    count = 9
    scene = replace(
        cloud(count, degree=1),
        means=torch.tensor([[0.0, 0.0, 4.0]]).repeat(count, 1),
        scales=torch.tensor(
            [
                [10.0, -40, -40],
                [-59.0] * 3,
                [59.0] * 3,
                [-1.0] * 3,
                [-1.0] * 3,
                [3e38] * 3,
                [-3e38] * 3,
                [0.0] * 3,
                [0.0] * 3,
            ]
        ),
        opacities=torch.tensor([0.0, 0, 0, -3.4e38, 3.4e38, 0, 0, 90, -90]),
    )
    scene.quats[7] = 0
    scene.quats[8] *= 1e-30
    possible = can_be_split(scene)
    assert possible.tolist() == [True, True, True, True, True, False, False, False, True]
    pieces = torch.ones(count, 3, dtype=torch.uint8)
    pieces[possible] = torch.tensor([4, 3, 5], dtype=torch.uint8)
    children = split(scene, pieces)
    for name in TENSORS:
        assert bool(torch.isfinite(getattr(children, name)).all()), name
    opacity = torch.sigmoid(children.opacities.double())
    assert bool((opacity <= torch.sigmoid(scene.opacities.double())[parents_of(pieces)]).all())
    pieces[5, 0] = 3
    with pytest.raises(ValueError, match="extreme"):
        split(scene, pieces)


@pytest.mark.parametrize("pieces", [[[2, 1, 1]], [[0, 1, 1]], [[33, 1, 1]], [[1, 1, 1], [1, 1, 1]]])
def test_invalid_piece_counts_are_refused(pieces: list[list[int]]) -> None:
    with pytest.raises(ValueError, match="pieces must be"):
        split(single((0, 0, 3)), torch.tensor(pieces, dtype=torch.uint8))


@pytest.mark.parametrize(("opacity", "least"), [(0.1, 45.0), (0.4, 40.0), (0.7, 33.0)])
def test_split_gaussian_looks_like_its_parent(opacity: float, least: float) -> None:
    """A single white Gaussian on black is the hardest case, because nothing around it hides a change."""
    scene = single((0.1, 0, 4.0), opacity=opacity, scales=(0.5, 0.3, 0.02), quat=(0.9, 0.1, 0.1, 0.3))
    pieces = torch.tensor([[6, 4, 1]], dtype=torch.uint8)
    images = []
    for each in (scene, split(scene, pieces)):
        images.append(ReferenceRasterizer(each).render(torch.ones(len(each), 3), camera()))
    error = float((images[0] - images[1]).square().mean())
    assert -10 * math.log10(error) > least


def test_lengths_are_split_to_a_size_with_the_fewest_pieces() -> None:
    lengths = torch.tensor([[1.0, 5.0, 0.0], [3.0, 1e9, torch.inf], [2.0, 2.0 + 1e-9, 4.0]], dtype=torch.float64)
    pieces = pieces_to(lengths, 2.0)
    assert pieces.dtype == torch.uint8
    assert pieces[:, 0].tolist() == [1, 4, 1]
    assert pieces[1, 1:].tolist() == [MAX_PIECES, MAX_PIECES]
    assert pieces[2].tolist() == [1, 3, 5]
    generator = torch.Generator().manual_seed(0)
    some = 20 * torch.rand(200, 3, generator=generator, dtype=torch.float64)
    for length, number in zip(some.flatten().tolist(), pieces_to(some, 2.0).flatten().tolist(), strict=True):
        assert length / ratio_of(number) <= 2.0
        fewer = NUMBERS[NUMBERS.index(number) - 1] if number > 1 else None
        assert fewer is None or length / ratio_of(fewer) > 2.0


def test_children_inherit_stored_harmonics(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene.ply", cloud(300, degree=3))
    pieces = torch.ones(300, 3, dtype=torch.uint8)
    pieces[::7, 1] = 3
    plain = split(read_scene(tmp_path / "scene.ply").scene, pieces)
    stored = split(read_scene(tmp_path / "scene.ply", held_bytes=0).scene, pieces)
    assert isinstance(stored.sh_rest, StoredHarmonics)
    assert torch.equal(held(stored.sh_rest), held(plain.sh_rest))
    some = torch.arange(len(plain)) % 3 > 0
    part = stored.sh_rest[some]
    assert isinstance(part, StoredHarmonics)
    assert torch.equal(held(part), held(plain.sh_rest)[some])
