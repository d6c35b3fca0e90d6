import pytest

from sgsst_core.errors import SettingsError
from sgsst_core.settings import Settings, make_settings


def test_paper_is_the_published_schedule() -> None:
    settings = make_settings("paper")
    assert (settings.feature_scale, make_settings("standard").feature_scale) == ("paper", "even")
    assert (settings.steps_coarse, settings.steps_sos) == (10_000, 10_000)
    assert settings.learning_rate == settings.learning_rate_end == 2.5e-3
    assert (settings.content_weight, settings.position_weights) == (1, "off")
    assert settings.max_resolution is None
    assert settings.unseen == "freeze"
    assert not (settings.clamp_aware_gradient)
    assert not (settings.early_stop)
    assert settings.warm_start is False
    assert (settings.training_background, settings.background) == ("background", (0, 0, 0))


def test_values_override_the_preset_unless_none() -> None:
    settings = make_settings("preview", steps_sos=7, seed=None, max_resolution=None)
    assert (settings.steps_sos, settings.steps_coarse) == (7, make_settings("preview").steps_coarse)
    assert settings.max_resolution == 640


def test_time_budget_does_not_stop_early_unless_asked_to() -> None:
    assert make_settings("standard").early_stop
    assert not make_settings("standard", within=60).early_stop
    assert make_settings("standard", within=60, early_stop=True).early_stop


def test_explicit_learning_rate_is_constant_without_an_end() -> None:
    assert make_settings("standard", learning_rate=0.2).learning_rate_end == 0.2


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"steps_sos": -1}, "steps_sos"),
        ({"learning_rate": 0}, "learning_rate"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"content_weight": -1}, "content_weight"),
        ({"content_weight": "weak"}, "content_weight"),
        ({"precision": "float8"}, "precision"),
        ({"within": 0}, "within"),
        ({"within": 1e300}, "within"),
        ({"unheard_of": 1}, "unheard_of"),
    ],
)
def test_values_out_of_range_are_refused_by_name(values: dict[str, object], name: str) -> None:
    with pytest.raises(SettingsError, match=name):
        make_settings(**values)  # type: ignore[arg-type]


def test_strength_names_are_content_weights() -> None:
    weights = [
        make_settings("standard", content_weight=word).content_weight for word in ("strong", "balanced", "light")
    ]
    assert (weights, weights[0]) == (sorted(weights), make_settings("standard").content_weight)
    schema = Settings.model_json_schema()["properties"]["content_weight"]
    assert {"number", "string"} == {kind["type"] for kind in schema["anyOf"]}


def test_unknown_preset_error_lists_the_presets() -> None:
    with pytest.raises(SettingsError, match="preview, standard, paper"):
        make_settings("fast")  # type: ignore[arg-type]


def test_settings_have_the_names_of_the_command_line() -> None:
    assert make_settings("preview", resolution=160).max_resolution == 160
    with pytest.raises(SettingsError, match=r"Setting resolutoin is not a parameter. Did you mean 'resolution'\?"):
        make_settings("preview", resolutoin=160)
