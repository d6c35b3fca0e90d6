import copy
import pickle

import pytest
import torch

from benchmarks.stability.sos_reference import style_loss_reference
from sgsst_core.features.statistics import layer_statistics
from sgsst_core.loss.terms import (
    TERMS,
    ContentDifference,
    LayerTarget,
    LossTerms,
    StyleGradient,
    TermWeights,
    content_factor,
    style_loss,
)
from tests.sgsst_core.synthetic_images import nearly_one_color, relative_error


def make_features(height, width, channels, seed, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn((height, width, channels), generator=generator, dtype=torch.float64)
    return (x @ torch.randn((channels, channels), generator=generator, dtype=torch.float64)).relu().to(dtype)


def autograd_style(x, target, weights):
    """Return the style loss by its definition, and its gradient by autograd."""
    x = x.double().clone().requires_grad_()
    loss = style_loss_reference(x, target, weights)
    return loss.item(), torch.autograd.grad(loss, x)[0]


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_style_gradient_agrees_with_autograd(weighted, dtype, tolerance):
    x = make_features(17, 23, 12, 1, dtype)
    a = torch.rand((17, 23), dtype=torch.float64) if weighted else None
    target = LayerTarget.of(layer_statistics(make_features(30, 20, 12, 2)))
    expected, expected_gradient = autograd_style(x, target, a)
    terms, gradient = style_loss(layer_statistics(x, a), target, feature_eps=torch.finfo(dtype).eps)
    assert float(terms.sum()) == pytest.approx(expected, rel=tolerance)
    assert relative_error(gradient.apply(x, a), expected_gradient) < tolerance


def test_loss_is_zero_at_the_target():
    x = make_features(17, 23, 12, 1)
    terms, gradient = style_loss(layer_statistics(x), LayerTarget.of(layer_statistics(x)))
    assert not terms.any()
    assert gradient.apply(x).abs().max() == 0


@pytest.mark.parametrize("dead_in", ["view", "style", "both"])
def test_dead_channels_give_finite_gradients(dead_in):
    view, style = make_features(17, 23, 12, 1, torch.float32), make_features(17, 23, 12, 2, torch.float32)
    for name, x in (("view", view), ("style", style)):
        if dead_in in (name, "both"):
            x[..., :5] = 0
    terms, gradient = style_loss(layer_statistics(view), LayerTarget.of(layer_statistics(style)))
    result = gradient.apply(view)
    assert torch.isfinite(result).all()
    assert float(terms.sum()) > 0
    if dead_in == "style":
        _, expected = autograd_style(view, LayerTarget.of(layer_statistics(style)), None)
        assert relative_error(result, expected) < 1e-5


def test_map_about_the_rounded_mean_is_equivalent():
    """It matters if features differ by less than the rounding error of their mean, as in pixels of nearly one color."""
    x, target = nearly_one_color(), LayerTarget.of(layer_statistics(make_features(30, 20, 3, 2)))
    _, gradient = style_loss(layer_statistics(x), target, weights=TermWeights(gram=0.0))
    exact = gradient.apply(x.double())
    assert relative_error(gradient.about_rounded_mean().apply(x), exact) < 1e-5
    assert relative_error(gradient.apply(x), exact) > 1e-3


def test_gradient_survives_a_large_mean_to_sigma_ratio():
    generator = torch.Generator().manual_seed(0)
    x = (1e4 + torch.randn((60, 50, 8), generator=generator, dtype=torch.float64)).float()
    style = (1e4 + 2 * torch.randn((60, 50, 8), generator=generator, dtype=torch.float64)).float()
    target = LayerTarget.of(layer_statistics(style))
    _, expected = autograd_style(x, target, None)
    _, gradient = style_loss(layer_statistics(x), target)
    assert relative_error(gradient.apply(x), expected) < 1e-4


@pytest.mark.parametrize("weighted", [False, True])
def test_content_gradient_agrees_with_autograd(weighted):
    x, content = make_features(9, 11, 6, 1).requires_grad_(), make_features(9, 11, 6, 2)
    a = torch.rand((9, 11), dtype=torch.float64) if weighted else torch.ones((9, 11), dtype=torch.float64)
    expected = 0.7 * (a[:, :, None] * (x - content) ** 2).sum() / (a.sum() * 6)
    actual = ContentDifference.of(
        x.detach(), content, content_factor(a.sum(), x.shape[-1], 0.7), a if weighted else None
    )
    assert float(actual.loss()) == pytest.approx(expected.item(), rel=1e-12)
    torch.testing.assert_close(actual.gradient(), torch.autograd.grad(expected, x)[0], rtol=1e-12, atol=0)


def test_loss_and_gradient_are_zero_without_positions():
    x = make_features(17, 23, 12, 1, torch.float32)
    nowhere = torch.zeros((17, 23))
    terms, gradient = style_loss(layer_statistics(x, nowhere), LayerTarget.of(layer_statistics(x)))
    content = ContentDifference.of(
        x, 2 * x, content_factor(nowhere.sum(dtype=torch.float64), x.shape[-1], 0.7), nowhere
    )
    assert not terms.any()
    assert not gradient.apply(x, torch.ones((17, 23))).any()
    assert float(content.loss()) == 0.0
    assert not content.gradient().any()


def test_terms_are_summed_in_their_order():
    """An exact sum (`math.fsum`, or `sum` in later versions of Python) has another last digit."""
    terms = LossTerms(content=3.0, std=1e16, mean=1.0, gram=1.0)
    assert list(terms) == list(TERMS)
    assert terms.total == ((1.0 + 1.0) + 1e16) + 3.0 == 1e16 + 4
    assert LossTerms(gram=1e16, mean=1.0, std=1.0).total == 1e16


def test_terms_add_divide_and_compare_by_name():
    total = LossTerms(gram=1.0, mean=2.0) + LossTerms(mean=4.0, content=5.0)
    assert total == LossTerms(gram=1.0, mean=6.0, content=5.0)
    assert dict(total / 4) == dict.fromkeys(TERMS, 0.0) | {"gram": 0.25, "mean": 1.5, "content": 1.25}
    assert total != LossTerms(gram=1.0)
    assert LossTerms().total == 0.0


def test_terms_are_picklable_and_immutable():
    terms = LossTerms(gram=1 / 3, content=2.5e-30)
    assert pickle.loads(pickle.dumps(terms)) == copy.deepcopy(terms) == terms
    with pytest.raises(TypeError):
        terms["gram"] = 1.0


def test_undeclared_terms_are_refused():
    with pytest.raises(TypeError, match="no term color; it has gram, mean"):
        LossTerms(color=1.0)
    with pytest.raises(KeyError):
        LossTerms()["color"]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("columns", [slice(None), slice(3, 120)])
def test_style_gradient_is_added_block_by_block(dtype, weighted, columns):
    """Blocks are whole rows, or those of a partition tile's inner rectangle; the surroundings stay unchanged."""
    x = make_features(90, 130, 40, 1).to(dtype)
    a = torch.rand((90, 130), generator=torch.Generator().manual_seed(3)) if weighted else None
    random = torch.randn((42, 40), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    gradient = StyleGradient(random[:40], 3 * random[40], random[41])
    before = make_features(90, 130, 40, 2).to(dtype)
    actual, expected, own = before.clone(), before.double(), (slice(5, 80), columns)
    gradient.add_to(actual[own], x[own], None if a is None else a[own])
    weights = 1 if a is None else a[own][:, :, None].double()
    expected[own] += weights * ((x[own].double() - gradient.mean) @ gradient.matrix + gradient.offset)
    tolerance = {torch.float64: 1e-13, torch.float32: 1e-6, torch.bfloat16: 4e-3}[dtype]
    assert relative_error(actual, expected) < tolerance
    assert torch.equal(actual[:5], before[:5])
    assert torch.equal(actual[80:], before[80:])
