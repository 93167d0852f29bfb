"""Settings: what is none is refused, wherever it comes from."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import numpy as np
import pytest

from catstream.errors import SettingsError
from catstream.settings import PRESETS, Settings


@pytest.mark.parametrize("text", [b"\xff", b"coreset_size", b"x = " + b"[" * 100_000], ids=["bytes", "text", "nested"])
def test_a_file_that_is_not_toml_is_named(text, tmp_path):
    (tmp_path / "set.toml").write_bytes(text)
    with pytest.raises(SettingsError, match=r"set\.toml is not TOML"):
        Settings.load(file=tmp_path / "set.toml", environment={})


#: Each way in which a program or a user gives a setting.
WAYS = {
    "Settings": lambda name, value: Settings(**{name: value}),
    "but": lambda name, value: Settings().but({name: value}),
    "replace": lambda name, value: dataclasses.replace(Settings(), **{name: value}),
    "of": lambda name, value: Settings.of({name: value}),
    "set": lambda name, value: Settings.load(overrides=[f"{name}={value}"], environment={}),
    "environment": lambda name, value: Settings.load(environment={f"CATSTREAM_{name.upper()}": str(value)}),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("name", "value", "takes"),
    [
        ("coreset_size", "x", "int >= 2, <= 4096"),
        ("coreset_size", 1, "int >= 2, <= 4096"),
        ("coreset_size", 2.5, "int >= 2, <= 4096"),
        ("scale_count", -3, "int >= 1, <= 15"),
        ("ridge", 0, "float > 0"),
        ("ridge", float("nan"), "float > 0"),
        ("extent_score", float("inf"), "float"),
        ("lockstep", 7, "bool"),
        ("classifier", "wrong", "joint | least-squares | one-class"),
    ],
)
def test_a_value_that_does_not_fit_is_refused_with_what_the_setting_takes(way, name, value, takes):
    with pytest.raises(SettingsError) as error:
        WAYS[way](name, value)
    shown = (repr(value), repr(str(value)), repr(float(value)) if name == "ridge" else "")
    assert str(error.value) in [f"setting {name} cannot be {each}: it takes {takes}" for each in shown]


@pytest.mark.parametrize("way", WAYS)
def test_a_name_that_does_not_exist_is_refused_with_the_nearest_ones(way):
    with pytest.raises(SettingsError) as error:
        WAYS[way]("corset_size", 64)
    told = "there is no setting 'corset_size', did you mean 'coreset_size'"
    assert str(error.value).startswith(told)
    assert "`catstream settings` lists all" in str(error.value)
    assert len(str(error.value)) < 200


def test_a_name_that_is_near_no_other_says_how_to_list_them():
    with pytest.raises(SettingsError, match=r"there is no setting 'qqq': `catstream settings` lists all \d+$"):
        Settings(qqq=1)


def test_what_is_given_without_a_name_is_refused():
    with pytest.raises(SettingsError, match="given by name, got 64"):
        Settings(64)


@pytest.mark.parametrize("value", ["64", True, None, [64], np.float64(6.5)], ids=repr)
def test_a_program_gives_values_of_their_type(value):
    with pytest.raises(SettingsError, match="coreset_size cannot be"):
        Settings(coreset_size=value)


def test_a_number_of_any_kind_is_kept_as_one_of_python():
    settings = Settings(coreset_size=np.int64(32), ridge=np.float32(0.5), context=2)
    assert [type(value) for value in (settings.coreset_size, settings.ridge, settings.context)] == [int, float, float]
    assert settings == Settings(coreset_size=32, ridge=0.5, context=2.0)


@pytest.mark.parametrize(
    ("pair", "name", "value"),
    [
        ("ridge=.5", "ridge", 0.5),
        ("ridge=1e-3", "ridge", 0.001),
        ("ridge=5.", "ridge", 5.0),
        ("seed=007", "seed", 7),
        ("lockstep=True", "lockstep", True),
        ("lockstep=0", "lockstep", False),
        ("detection = full", "detection", "full"),
    ],
)
def test_a_text_is_read_as_a_person_writes_it(pair, name, value):
    assert getattr(Settings.load(overrides=[pair], environment={}), name) == value


@pytest.mark.parametrize("preset", [None, *PRESETS])
def test_settings_survive_texts_copies_and_pickles(preset):
    settings = Settings.load(preset=preset, environment={})
    for other in (Settings.of(settings.texts()), copy.deepcopy(settings), pickle.loads(pickle.dumps(settings))):
        assert other == settings
