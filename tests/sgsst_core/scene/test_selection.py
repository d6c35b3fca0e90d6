"""Tests of selecting Gaussians by position or property."""

import pytest
import torch

from sgsst_core.regions.selection import in_box, in_half_space, in_sphere, where_property

NAN = float("nan")
MEANS = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 2, 1], [-3, 0, 0], [NAN, 0, 0]])


def test_box_includes_its_border_for_any_order_of_corners():
    wanted = [True, True, False, False, False]
    assert in_box(MEANS, (0, 0, 0, 1, 1, 1)).tolist() == wanted
    assert in_box(MEANS, (1, 0, 1, 0, 1, 0)).tolist() == wanted


def test_sphere_includes_its_border():
    assert in_sphere(MEANS, (0, 0, 0, 3**0.5)).tolist() == [True, True, False, False, False]
    assert in_sphere(MEANS, (0, 0, 0, 3)).tolist() == [True, True, True, True, False]


def test_half_space_lies_on_the_side_of_its_normal():
    assert in_half_space(MEANS, (1, 0, 0, 1)).tolist() == [False, True, True, False, False]
    assert in_half_space(MEANS, (-2, 0, 0, 6)).tolist() == [False, False, False, True, False]


@pytest.mark.parametrize(
    ("sign", "wanted"),
    [
        (">", [False, False, True, False]),
        (">=", [False, True, True, False]),
        ("<", [True, False, False, False]),
        ("<=", [True, True, False, False]),
        ("=", [False, True, False, False]),
        ("!=", [True, False, True, False]),
    ],
)
def test_comparisons_use_float32_and_exclude_nan(sign, wanted):
    """0.1 is compared as float32 too; comparisons with NaN are false."""
    values = torch.tensor([0.0, 0.1, 0.2, NAN])
    assert where_property(values, sign, 0.1).tolist() == wanted
    assert where_property(values.double() * 10, sign, 1.0)[[0, 2, 3]].tolist() == [wanted[0], wanted[2], wanted[3]]
