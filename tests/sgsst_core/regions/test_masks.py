"""Tests of selecting Gaussians by image masks of some views."""

import torch

from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.regions.selection import count_votes, decide_by_votes
from tests.small_scenes import cameras, wall


def test_votes_are_blend_weights_in_white_mask_pixels():
    """The reference is the image of one Gaussian with color 1."""
    scene, views = wall(8, 6), cameras(2)
    rasterizer = make_rasterizer("cpu", scene)
    masks = [torch.rand(view.height, view.width, generator=torch.Generator().manual_seed(7)) for view in views]
    inside, total = count_votes(rasterizer, views, [lambda mask=mask: mask for mask in masks], len(scene))
    for index in (0, 20, 47):
        colors = torch.zeros(len(scene), 3)
        colors[index] = 1
        shown = [rasterizer.render(colors, view)[:, :, 0].double() for view in views]
        wanted = sum(float((own * mask).sum()) for own, mask in zip(shown, masks, strict=True))
        torch.testing.assert_close(float(inside[index]), wanted, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(float(total[index]), float(sum(own.sum() for own in shown)), rtol=1e-4, atol=1e-5)


def test_mask_of_one_half_selects_half_of_the_wall():
    scene, views = wall(), cameras(1)
    mask = torch.zeros(views[0].height, views[0].width)
    mask[:, views[0].width // 2 :] = 1
    inside, total = count_votes(make_rasterizer("cpu", scene), views, [lambda: mask], len(scene))
    decided = decide_by_votes(scene.means, inside, total)
    x = scene.means[:, 0]
    assert bool(decided[x > 0.2].all())  # those outside the view follow their neighbors
    assert not bool(decided[x < -0.2].any())


def test_undecided_and_unseen_gaussians_follow_their_neighbors():
    places = torch.arange(12.0)[:, None] * torch.tensor([1.0, 0, 0])
    total = torch.ones(12, dtype=torch.float64)
    inside = torch.tensor([0.0] * 3 + [1.0] * 9, dtype=torch.float64)
    inside[10], inside[0] = 0.45, 0.55  # between
    total[11] = inside[11] = 0
    decided = decide_by_votes(places, inside, total)
    assert decided[1:].tolist() == [False, False, *[True] * 9]
    inside[5] = 0.39  # outvoted by a margin, whatever its neighbors are
    assert not bool(decide_by_votes(places, inside, total)[5])


def test_majority_decides_without_decided_neighbors():
    places = torch.randn(3, 3)
    inside, total = torch.tensor([0.55, 0.45, 0.0]).double(), torch.tensor([1.0, 1.0, 0.0]).double()
    assert decide_by_votes(places, inside, total).tolist() == [True, False, False]
